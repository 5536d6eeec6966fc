"""Frames, arm states and whole sessions for the live recorder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from robot.drivers.head.decoder import Cut, Frames, assemble_cycle
from robot.drivers.ur10.shared_state import ARM_STATE
from robot.live.recorder import LiveRecorder
from robot.recordings.mcap_reader import McapScanner, RecordingEntry
from robot.recordings.mcap_writer import Recorder
from robot.sources.source import SourceDescription, SourceInfo
from tactile.base.types import Cycle, Odometry
from tactile.whisker_geometry import HeadConfig

ROOT = Path(__file__).parents[3]
W, RATE = 4, 200
START = 5e4
"""Start of a session, host time, s."""
INFO = SourceInfo(raw_whiskers=True, head=HeadConfig(rest_deg=74.0))


def some_frames(count: int, seed: int = 0, first: int = 0) -> Frames:
    random = np.random.default_rng(seed)
    values = random.integers(-(2**15), 2**15, (count, W, 3)).astype(np.int16)
    number = first + np.arange(count)
    return Frames(
        number, 7_000_000 + number * (1_000_000 // RATE), random.integers(0, 16, count, np.uint8), values
    )


def some_states(count: int, seed: int = 0, begin: float = START) -> np.ndarray:
    random = np.random.default_rng(seed)
    states = np.zeros(count, ARM_STATE)
    for name in ARM_STATE.names or ():
        shape = states[name].shape
        if ARM_STATE[name].base.kind == "f":
            states[name] = random.normal(size=shape)
        else:
            states[name] = random.integers(0, 2**31, shape)
    states["progress"], states["safety"] = -1, 2**31 + 5
    states["host"] = begin + np.arange(count) / 125
    return states


def rows(frames: Frames, which: Any) -> Frames:
    return Frames(*(column[which] for column in frames))


def motion_of_whisk(k: int) -> Odometry:
    return Odometry(*(np.float64(value) for value in (0.01 * (k % 3), 0.002, 0.05, 1.0)))


def same_bits(one: Any, other: Any) -> bool:
    """Whether two tuples of arrays are equal in every bit, shape, dtype and order in memory."""
    if isinstance(one, tuple):
        return type(one) is type(other) and all(map(same_bits, one, other))
    a, b = np.asarray(one), np.asarray(other)
    alike = a.flags.c_contiguous == b.flags.c_contiguous
    return alike and (a.shape, a.dtype, a.tobytes()) == (b.shape, b.dtype, b.tobytes())


def open_recorder(path: Path) -> LiveRecorder:
    path.unlink(missing_ok=True)
    return LiveRecorder(Recorder(path, SourceDescription((2, 2, 1), W, 1.0, INFO)))


def content(path: Path, kind: type) -> list[Any]:
    return [entry.content for entry in McapScanner(path).entries() if isinstance(entry.content, kind)]


def session(path: Path, whisks: int = 3) -> tuple[list[Cycle], Frames, np.ndarray]:
    """Records whisks, arm states and two events; returns the whisk cycles, all frames and all states."""
    frames, states = some_frames(whisks * RATE, seed=whisks), some_states(whisks * 125)
    recorder = open_recorder(path)
    cycles = []
    recorder.add_event(START, "start", "emulated: a robot, über")
    for k in range(whisks):
        for block in np.split(np.arange(k * RATE, (k + 1) * RATE), RATE // 4):
            recorder.add_frames(rows(frames, block), START + block[-1] / RATE)
            recorder.add_states(
                states[
                    (states["host"] > START + block[0] / RATE - 0.02)
                    & (states["host"] <= START + block[-1] / RATE)
                ]
            )
        mine = rows(frames, slice(k * RATE, (k + 1) * RATE))
        cut = Cut.of(k, START + k + 0.25, START + k, mine, motion_of_whisk(k), seen=k != 1)
        recorder.add_whisk(cut, mine, np.array([0.01 * k, 0.0, 0.05 * k]) if k != 2 else None)
        cycles.append(assemble_cycle(mine, cut))
    recorder.add_event(START + whisks, "dropped", "1 image")
    recorder.close()
    return cycles, frames, states


def entries_of(path: Path) -> list[RecordingEntry]:
    return list(McapScanner(path).entries())
