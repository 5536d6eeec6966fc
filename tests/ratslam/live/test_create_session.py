"""Short sessions on an emulated Create: complete and repeated, and ended by a fault."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ratslam.runs.run import run
from ratslam.runs.settings.run_config import load_config
from robot.live.live_config import LiveConfig
from robot.live.selftest import check_session
from robot.recordings.mcap_reader import Recording
from tactile.base.errors import InputError
from tactile.base.types import MotionKind, StepEnd
from tactile.whisker_geometry import HeadConfig
from tests.helpers.live import PATIENCE, until
from tests.ratslam.live.create_bench import CreateBench, child_of, create_bench, kill
from tests.ratslam.live.live_session import Session
from tests.ratslam.live.server_process import SessionServer

pytest.importorskip("serial", reason="needs pyserial")
pytest.importorskip("termios", reason="needs pseudo-terminals")
SAME = ("steps.csv", "trajectory.tum", "online.tum", "odometry.tum")
SLACK = {"patience": 5.0, "silence": 2.0, "replug": 20.0, "stuck": 0.8}
"""Time limits for a busy machine, and a short one for the bumper."""


@pytest.fixture(scope="module")
def table(loopback: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[CreateBench]:
    with create_bench(loopback, tmp_path_factory.mktemp("create")) as bench:
        yield bench


@pytest.fixture
def robot(table: CreateBench) -> CreateBench:
    """The emulated robot without faults."""
    table.robot("clear")
    table.robot("plug")
    return table


@contextmanager
def rolling(robot: CreateBench, server: SessionServer, **settings: Any) -> Iterator[Session]:
    """A session with a stub mapper, when the robot has driven two steps and rolls."""
    live = robot.live(**(SLACK | settings)) | {"head": {"address": robot.host, "silence": 5.0}}
    before = robot.state()["travelled"]
    session = server.start({"live": live, "backend": "grid"})
    try:
        session.until(lambda: robot.rolls() and robot.state()["travelled"] > before + 0.05, "two steps")
        yield session
    finally:
        session.end()


def check_end(robot: CreateBench, session: Session, outcome: str, seconds: float = 2 * PATIENCE) -> Recording:
    """The recording of a session that ends by itself, within some seconds, with an outcome."""
    code = session.code(seconds)
    report = session.report()
    assert report["outcome"] == outcome, session.output()
    assert code == {"complete": 0, "interrupted": 130}.get(outcome, 2)
    assert "Traceback" not in session.output(), session.output()
    robot.stopped_after(0.0)
    recording = Recording(session.directory / "session.mcap")
    assert not recording.truncated
    assert recording.length == report["reports"]
    return recording


def test_a_session_is_repeated_to_the_bit(robot: CreateBench, server: SessionServer, tmp_path: Path) -> None:
    plan = {"arena": {"side": 1.25}, "seed": 7, "reports": 6}
    live = robot.live(**SLACK, plan=plan) | {"head": {"address": robot.host, "silence": 5.0}}
    touch = {"reports": {"walls": "geometric"}}  # no strain templates, whose training takes seconds
    config = {"live": live, "backend": "grid", "grid": {"particles": 20}, "touch": touch}
    session = server.start(config, mapper=None)
    try:
        recording = check_end(robot, session, "complete", 4 * PATIENCE)
    finally:
        session.end()
    assert session.report()["standing"]
    run(load_config(session.directory / "config.yaml"), tmp_path / "again")
    for name in SAME:
        assert (session.directory / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    odometry = [sample.reading.odometry for sample in recording]
    assert len(odometry) == 6
    assert 0.08 < sum(step.dx for step in odometry) < 0.4  # steps of 25 mm, more on a busy machine
    times = [sample.time for sample in recording]
    assert np.allclose(times, np.cumsum([step.dt for step in odometry]))


def test_a_bumper_that_stays_pressed(robot: CreateBench, server: SessionServer) -> None:
    """The motion is aborted and followed by BACK, as for any contact of the body; the session then ends."""
    with rolling(robot, server) as session:
        robot.robot("bump")
        recording = check_end(robot, session, "bumper_stuck")
    ends = [(sample.reading.motion, sample.reading.moment) for sample in recording]
    bump = ends.index((MotionKind.FORWARD, StepEnd.ABORT))
    assert ends[bump + 1] == (MotionKind.BACK, StepEnd.FREE)
    assert session.report()["standing"]


def test_a_lifted_wheel_and_an_interrupt(robot: CreateBench, server: SessionServer) -> None:
    with rolling(robot, server) as session:
        robot.robot("drop")
        check_end(robot, session, "wheel_drop")
    robot.robot("clear")
    with rolling(robot, server) as session:
        session.process.send_signal(signal.SIGINT)
        check_end(robot, session, "interrupted")
        assert session.report()["standing"]


def test_whiskers_that_are_unplugged_are_awaited(robot: CreateBench, server: SessionServer) -> None:
    """The robot stands meanwhile; the motion so far is recorded without a touch."""
    with rolling(robot, server) as session:
        robot.whiskers(do="unplug")
        until(lambda: not robot.rolls(), "the robot stands")
        robot.whiskers(do="plug")
        until(robot.rolls, "the robot goes on")
        session.process.send_signal(signal.SIGINT)
        recording = check_end(robot, session, "interrupted")
    unsampled = [sample.reading for sample in recording if not sample.reading.alive.any()]
    assert 1 <= len(unsampled) <= 2  # the motion that Ctrl-C ends at once may have no sample either
    assert not any(reading.contact.any() for reading in unsampled)
    assert [event.name for event in recording.events][:2] == ["held", "resumed"]


def test_the_self_test_moves_nothing(robot: CreateBench, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("robot.live.selftest.LISTEN_TIME", 0.3)
    monkeypatch.setattr("robot.live.selftest.MIN_RATE_SHARE", 0.0)
    before = robot.state()
    lines = list(
        check_session(LiveConfig.model_validate(robot.live(**SLACK)), HeadConfig(), tmp_path / "run")
    )
    until(lambda: robot.state()["mode"] == "PASSIVE", "the robot is passive again")
    after = robot.state()
    assert (before["x"], before["y"], before["speeds"]) == (after["x"], after["y"], after["speeds"])
    text = "\n".join(lines)
    for part in ("disk: ", "can be opened", "4 whiskers at 2000 Hz", "safe mode", "4 of 4 alive", "clocks: "):
        assert part in text
    robot.robot("bump")
    with pytest.raises(InputError, match="left pressed"):
        list(check_session(LiveConfig.model_validate(robot.live(**SLACK)), HeadConfig(), tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_unplugged_and_plugged_in_again(robot: CreateBench, server: SessionServer) -> None:
    with rolling(robot, server) as session:
        robot.robot("unplug")
        assert session.code() == 2
        assert session.report()["outcome"] == "link_lost"
        assert not session.report()["standing"]
        assert "may still roll" in session.output()
        assert robot.rolls()
        robot.robot("plug")
        until(lambda: robot.state()["mode"] == "PASSIVE", "the watchdog ends the interface")
        assert not robot.rolls()


def test_killed_processes(robot: CreateBench, server: SessionServer) -> None:
    with rolling(robot, server) as session:
        kill(session.mapper(), signal.SIGKILL)
        check_end(robot, session, "mapper_gone")
    with rolling(robot, server) as session:
        kill(child_of(session.process.pid, b"robot.drivers.create.watchdog"), signal.SIGKILL)
        check_end(robot, session, "watchdog_gone")
    with rolling(robot, server) as session:
        session.process.kill()
        robot.stopped_after(0.0)
    assert Recording(session.directory / "session.mcap").length is not None
