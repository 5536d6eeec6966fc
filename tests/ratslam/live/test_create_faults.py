"""Sessions on an emulated Create with real time limits, each ended by a fault, and a long one.

`pytest tests/ratslam/live/test_create_faults.py --soak -s` prints a line for each fault: outcome, and the
time until the wheels stood, by the robot's own log.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from ratslam.runs.run import run
from ratslam.runs.settings.run_config import load_config
from robot.recordings.mcap_reader import Recording
from tactile.base.types import MotionKind, Report, StepEnd
from tests.helpers.live import PATIENCE
from tests.ratslam.live.create_bench import CreateBench, child_of, create_bench, ended, kill
from tests.ratslam.live.live_session import Session
from tests.ratslam.live.server_process import SessionServer

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1200)]
pytest.importorskip("serial", reason="needs pyserial")
pytest.importorskip("termios", reason="needs pseudo-terminals")
HOLD = 0.5
"""s: `patience` of the driver, and the longest time until the robot stands after a kill."""
HANG = HOLD + 0.1
ENDLESS = 10**9


@pytest.fixture
def robot(loopback: str, tmp_path: Path) -> Iterator[CreateBench]:
    """An emulator for each test: some end it."""
    with create_bench(loopback, tmp_path) as bench:
        yield bench


class Fault(NamedTuple):
    """Attributes:
    name: for the printed line. outcome: of the session, "" if it was killed. limit: s until the wheels
        stand; inf if nothing can stop the robot. cause: causes the fault, returns its time (s, host).
    """

    name: str
    outcome: str
    limit: float
    cause: Callable[[CreateBench, Session], float]


def _line_fault(robot: CreateBench, do: str, **request: object) -> float:
    now = time.monotonic()
    robot.robot(do, **request)
    return now


def _replug(robot: CreateBench, session: Session) -> float:
    robot.robot("unplug")
    session.code()
    assert robot.rolls()
    return _line_fault(robot, "plug")


def _kill_unplugged(robot: CreateBench, session: Session) -> float:
    robot.robot("unplug")
    session.process.kill()
    time.sleep(1.0)
    assert robot.rolls()
    return _line_fault(robot, "plug")


def _hang(robot: CreateBench, session: Session) -> float:
    now = kill(session.process.pid, signal.SIGSTOP)
    time.sleep(2.0)
    os.kill(session.process.pid, signal.SIGCONT)
    return now


def _watchdog(session: Session) -> int:
    return child_of(session.process.pid, b"robot.drivers.create.watchdog")


def _mapper(session: Session) -> int:
    return child_of(session.process.pid, b"spawn_main")


def _kill_emulator(robot: CreateBench, session: Session) -> float:
    now = kill(robot.process.pid, signal.SIGKILL)
    robot.process.wait()
    return now


FAULTS = (
    Fault("Ctrl-C", "interrupted", HOLD, lambda _, session: kill(session.process.pid, signal.SIGINT)),
    Fault("bumper stuck", "bumper_stuck", 3.0 + HOLD, lambda robot, _: _line_fault(robot, "bump")),
    Fault("wheel drop", "wheel_drop", HOLD, lambda robot, _: _line_fault(robot, "drop")),
    Fault("cliff", "left_safe_mode", HOLD, lambda robot, _: _line_fault(robot, "cliff")),
    Fault("silent", "robot_silent", 0.3 + HOLD, lambda robot, _: _line_fault(robot, "lose", replies=ENDLESS)),
    Fault(
        "garbage",
        "robot_garbled",
        0.3 + HOLD,
        lambda robot, _: _line_fault(robot, "scramble", replies=ENDLESS),
    ),
    Fault("unplugged, plugged in", "link_lost", HOLD, _replug),
    Fault("killed session", "", HOLD, lambda _, session: kill(session.process.pid, signal.SIGKILL)),
    Fault("unplugged, killed session, plugged in", "", HOLD, _kill_unplugged),
    Fault("killed mapper", "mapper_gone", HOLD, lambda _, session: kill(_mapper(session), signal.SIGKILL)),
    Fault(
        "killed watchdog", "watchdog_gone", HOLD, lambda _, session: kill(_watchdog(session), signal.SIGKILL)
    ),
    Fault("killed emulator", "link_lost", np.inf, _kill_emulator),
    Fault("hanging session", "host_late", HANG, _hang),
    Fault(
        "hanging watchdog", "watchdog_gone", HANG, lambda _, session: kill(_watchdog(session), signal.SIGSTOP)
    ),
)


@pytest.mark.parametrize("fault", FAULTS, ids=[fault.name for fault in FAULTS])
def test_a_session_with_a_fault(
    robot: CreateBench, server: SessionServer, tmp_path: Path, fault: Fault
) -> None:
    session = start(robot, server, minutes=2)
    try:
        session.until(lambda: robot.rolls() and robot.state()["travelled"] > 0.08, "three steps")
        mapper = _mapper(session)
        moment = fault.cause(robot, session)
        took = np.inf
        if robot.process.poll() is None:
            took = robot.stopped_after(moment)
        if fault.outcome:
            session.code()
            assert session.report()["outcome"] == fault.outcome, session.output()
            assert "Traceback" not in session.output(), session.output()
        else:
            ended(mapper, 2 * PATIENCE)
        rows = replay(session, tmp_path / "again", whole=fault.name != "killed mapper")
    finally:
        session.end()
    limit = "-" if np.isinf(fault.limit) else f"{fault.limit:.1f} s"
    stood = "-" if np.isinf(took) else f"{took:.3f} s"
    print(f"\n{fault.name:<40} {fault.outcome or 'killed':<16} stood after {stood:<9} limit {limit}, {rows}")
    assert took <= fault.limit or np.isinf(fault.limit)


def start(robot: CreateBench, server: SessionServer, **duration: float) -> Session:
    """A session with its own mapper and the usual time limits, except that emulated whiskers may be late."""
    plan = {"arena": {"side": 1.25}, "wheels": {"noise": "bias"}, "seed": 7, **duration}
    live = robot.live(plan=plan) | {"head": {"address": robot.host, "silence": 1.0}}
    config = {"live": live, "backend": "grid", "session": {"precision": "float32"}}
    return server.start(config, mapper=None, rate_check=True)


def replay(session: Session, again: Path, *, whole: bool) -> str:
    """Maps the recording of a session again and compares what both mapped, to the bit.

    Args:
        whole: whether the mapper mapped everything that was recorded.
    """
    recording = Recording(session.directory / "session.mcap")
    run(load_config(session.directory / "config.yaml"), again)
    for name in ("steps.csv", "online.tum", "odometry.tum"):
        live, repeated = ((path / name).read_text() for path in (session.directory, again))
        assert repeated.startswith(live), name
        assert len(live.splitlines()) > 2
        assert not whole or live == repeated, name
    return f"{recording.length} reports recorded"


def test_three_minutes_and_their_replay(robot: CreateBench, server: SessionServer, tmp_path: Path) -> None:
    session = start(robot, server, minutes=3)
    try:
        assert session.code(400) == 0, session.output()
    finally:
        session.end()
    report = session.report()
    print(json.dumps(report, indent=1))
    print((session.directory / "gridscore.json").read_text())
    assert (report["outcome"], report["standing"]) == ("complete", True)
    assert report["head"]["missing"] == 0
    assert report["ends"]["hit1"] > 5
    replay(session, tmp_path / "again", whole=True)
    check_behaviour([sample.reading for sample in Recording(session.directory / "session.mcap")])


def check_behaviour(reports: list[Report]) -> None:
    """Each motion follows the one before as in Fox et al. 2012, II-C."""
    slow = False
    for report, then in itertools.pairwise(reports):
        forward = report.motion == MotionKind.FORWARD
        assert (len(report.strain) > 0) == slow
        if slow:
            assert report.moment in (StepEnd.HIT2, StepEnd.ABORT)
            over = np.abs(report.strain).max() > 2e-3
            assert report.moment == StepEnd.HIT2 or over or len(report.strain) >= 0.98 * 2.0 * 2000
        if report.moment == StepEnd.ABORT or slow:
            assert then.motion == MotionKind.BACK
        elif report.motion == MotionKind.BACK:
            assert then.motion == MotionKind.TURN
        elif forward:
            assert then.motion == MotionKind.FORWARD
        slow = report.moment == StepEnd.HIT1
