"""A whisk costs the same work however long the session: counted, not timed."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from robot.drivers.head.decoder import Cut
from robot.live.live_config import LiveConfig
from robot.live.live_rig import ArmOdometry
from robot.simulation.head.odometry_errors import OdometryConfig
from tests.robot.live.live_recordings import RATE, START, open_recorder, some_frames, some_states

HZ = 125


class Work(NamedTuple):
    """Work for some whisks: calls, bytes of the recording, and bytes that the odometer keeps."""

    calls: int
    written: int
    kept: int


def count_calls(work: Callable[[], object]) -> int:
    """Number of calls, of C functions and of generators' steps too."""
    calls = 0

    def note(frame: object, event: str, argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
    return calls


def work_of_blocks(path: Path, whisks: int, block: int, kind: str) -> list[Work]:
    """The work for each block of whisks, from the arm's states and the head's frames to the recording."""
    config = LiveConfig(noise=OdometryConfig(noise="gated"), odometry=kind, seed=1)
    odometer, recorder = ArmOdometry(config), open_recorder(path)
    time = np.arange(HZ) / HZ
    states, frames = some_states(HZ), some_frames(RATE)

    def whisk(k: int) -> None:
        begin = START + k
        pose = np.column_stack([0.02 * np.sin(k + time), 0.02 * np.cos(k + time), 0.1 * (k + time)])
        speed = np.full((HZ, 6), 0.02)
        odometer.add(begin + time, config.arm.placing.tcp_from_pose(pose), speed)
        states["host"] = begin + time
        recorder.add_states(states)
        mine = frames._replace(sequence=frames.sequence + k * RATE, time=frames.time + k * 1_000_000)
        recorder.add_frames(mine, begin + 1.0)
        odometry, truth = odometer.step(float(k), begin + 0.5)
        recorder.add_whisk(Cut.of(k, begin + 0.5, begin, mine, odometry), mine, truth)

    found = []
    with recorder:
        for first in range(0, whisks, block):
            before = path.stat().st_size
            calls = count_calls(lambda first=first: [whisk(k) for k in range(first, first + block)])
            found.append(Work(calls, path.stat().st_size - before, len(pickle.dumps(odometer))))
    return found


@pytest.mark.parametrize(
    ("whisks", "block"), [(400, 50), pytest.param(20_000, 1_600, marks=pytest.mark.soak)]
)
@pytest.mark.parametrize("kind", ["pose", "velocity"])
def test_a_whisk_costs_the_same_work_late_in_a_session(
    tmp_path: Path, kind: str, whisks: int, block: int
) -> None:
    """What the odometer keeps bounds what it computes with."""
    _, early, *_, late = work_of_blocks(tmp_path / "a.mcap", whisks // block * block, block, kind)
    for name, first, last in zip(Work._fields, early, late, strict=True):
        assert last <= 1.05 * first, name
