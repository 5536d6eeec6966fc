"""Sessions on an emulated Create: complete and repeated, and ended by a fault.

`pytest tests/ratslam/live/test_create_session.py --soak -s` applies the usual time limits and prints a line
for each fault: outcome, and the time until the wheels stood, by the robot's own log.
"""

import itertools
import json
import os
import signal
import time
from contextlib import AbstractContextManager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from evaluation.artifacts.run_reader import read_manifest
from evaluation.metrics.trajectory import ate
from ratslam.live.create_session import CreateSession
from ratslam.runs.build_session import build_session
from ratslam.runs.run import run
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig, load_config
from ratslam.service.recording_check import diagnose_recording
from robot.drivers.create.driver_config import CreateConfig
from robot.live.create_rig import run_create_loop
from robot.live.live_config import LiveConfig
from robot.live.live_emulator_config import create_emulator_config
from robot.live.selftest import check_session
from robot.recordings.mcap_reader import Recording
from robot.world.arena import make_arena
from tactile.base.errors import InputError
from tactile.base.se2 import integrate
from tactile.base.types import MotionKind, StepEnd
from tactile.whisker_geometry import HeadConfig
from tests.helpers.create_line import Line, SimulatedDriver
from tests.helpers.live import until
from tests.ratslam.live.bench import PLAN, SLACK, CreateBench
from tests.ratslam.live.live_session import Session

pytest.importorskip("serial", reason="needs pyserial")
pytest.importorskip("termios", reason="needs pseudo-terminals")
SAME = ("steps.csv", "online.tum", "odometry.tum", "trajectory.tum")
HOLD = 0.5
"""s: `patience` of the driver, and the longest time until the robot stands after a kill."""
HANG, SILENCE = HOLD + 0.1, HOLD + 0.3
WATCHDOG = b"robot.drivers.create.watchdog"
IN_TIME = [pytest.mark.soak, pytest.mark.timeout(1200)]


class Fault(NamedTuple):
    outcome: str  # of the session, "" if it was killed
    limit: float  # s until the wheels stand; inf if nothing can stop the robot
    request: dict[str, Any] = {}  # of the emulated robot  # noqa: RUF012
    sent: int = 0  # a signal to the session, or to its child
    child: bytes = b""


FAULTS = {
    "Ctrl-C": Fault("interrupted", HOLD, sent=signal.SIGINT),
    "bumper stuck": Fault("bumper_stuck", 3.0 + HOLD, {"do": "bump"}),
    "wheel drop": Fault("wheel_drop", HOLD, {"do": "drop"}),
    "cliff": Fault("left_safe_mode", HOLD, {"do": "cliff"}),
    "silent": Fault("robot_silent", SILENCE, {"do": "lose", "replies": 10**9}),
    "garbage": Fault("robot_garbled", SILENCE, {"do": "scramble", "replies": 10**9}),
    "unplugged": Fault("link_lost", HOLD, {"do": "unplug"}),
    "killed session": Fault("", HOLD, sent=signal.SIGKILL),
    "unplugged and killed session": Fault("", HOLD, {"do": "unplug"}, sent=signal.SIGKILL),
    "killed mapper": Fault("mapper_gone", HOLD, sent=signal.SIGKILL, child=b"spawn_main"),
    "killed watchdog": Fault("watchdog_gone", HOLD, sent=signal.SIGKILL, child=WATCHDOG),
    "killed emulator": Fault("link_lost", np.inf),
    "hanging session": Fault("host_late", HANG, sent=signal.SIGSTOP),
    "hanging watchdog": Fault("watchdog_gone", HANG, sent=signal.SIGSTOP, child=WATCHDOG),
}
QUICK = ("bumper stuck", "wheel drop", "unplugged", "killed session", "killed mapper", "killed watchdog")
"""What every run of the suite tests, and Ctrl-C by `test_whiskers_that_are_unplugged_are_awaited`."""


def cause(fault: Fault, robot: CreateBench, session: Session) -> float:
    """Causes a fault; returns its time, s, host."""
    now = time.monotonic()
    if fault.request:
        robot.robot(**fault.request)
    elif not fault.sent:
        robot.whiskers.process.kill()
        robot.whiskers.process.wait()
    if fault.sent:
        now = time.monotonic()
        os.kill(session.child(fault.child) if fault.child else session.pid, fault.sent)
    if fault.sent == signal.SIGSTOP and not fault.child:
        time.sleep(2.0)
        session.send(signal.SIGCONT)
    if fault.request == {"do": "unplug"}:
        session.code()
        assert fault.sent or "may still roll" in session.output()
        time.sleep(1.0 if fault.sent else 0.0)
        assert robot.rolls()
        now = time.monotonic()
        robot.robot("plug")
        until(lambda: robot.state()["mode"] == "PASSIVE", "the watchdog ends the interface")
    return now


@pytest.mark.parametrize("name", QUICK)
def test_a_fault_stops_the_robot(robot: CreateBench, name: str) -> None:
    fault = FAULTS[name]
    with robot.rolling() as session:
        cause(fault, robot, session)
        if not fault.outcome:
            robot.stopped_after()
            session.code()
            assert Recording(session.directory / "session.mcap").length is not None
            return
        recording = robot.ended(session, fault.outcome)
        assert session.report()["standing"] == (name != "unplugged")  # which it cannot know then
        if name == "bumper stuck":  # the motion is followed by BACK, as for any contact of the body
            ends = [(sample.reading.motion, sample.reading.moment) for sample in recording]
            bump = ends.index((MotionKind.FORWARD, StepEnd.ABORT))
            assert ends[bump + 1] == (MotionKind.BACK, StepEnd.FREE)


@pytest.mark.parametrize("name", [pytest.param(name, marks=IN_TIME) for name in FAULTS])
def test_a_fault_stops_the_robot_in_time(robot: CreateBench, tmp_path: Path, name: str) -> None:
    fault = FAULTS[name]
    with usual_session(robot, minutes=2) as session:
        session.until(lambda: robot.rolls() and robot.state()["travelled"] > 0.08, "three steps")
        moment = cause(fault, robot, session)
        took = robot.stopped_after(moment) if robot.runs() else np.inf
        if fault.outcome:
            session.ends(fault.outcome)
        else:
            until(lambda: not session.lives(), "its mapper ends")
        check_replay(session, tmp_path / "again", whole=name != "killed mapper")
    print(f"\n{name:<30} {fault.outcome or 'killed':<16} stood after {took:.3f} s, limit {fault.limit:.1f} s")
    assert took <= fault.limit


def usual_session(robot: CreateBench, **duration: float) -> AbstractContextManager[Session]:
    """A session of a new robot, with its own mapper and the usual time limits, except that emulated whiskers
    may be late."""
    robot.close()
    robot.ready()
    live = robot.live(silence=1.0, plan={**PLAN, **duration})
    return robot.session(live, rate_check=True, session={"precision": "float32"})


def check_replay(session: Session, again: Path, *, whole: bool) -> None:
    """Maps the recording of a session again and compares what both mapped, to the bit: all of it (`whole`),
    or what the mapper had mapped when it ended."""
    run(load_config(session.directory / "config.yaml"), again)
    for name in SAME[:3]:
        live, repeated = ((path / name).read_text() for path in (session.directory, again))
        assert repeated.startswith(live), name
        assert len(live.splitlines()) > 2
        assert not whole or live == repeated, name


@pytest.mark.soak
@pytest.mark.timeout(1200)
def test_three_minutes_and_their_replay(robot: CreateBench, tmp_path: Path) -> None:
    with usual_session(robot, minutes=3) as session:
        report = session.ends("complete")
    print(json.dumps(report, indent=1), (session.directory / "gridscore.json").read_text())
    assert (report["standing"], report["head"]["missing"]) == (True, 0)
    assert report["ends"]["hit1"] > 5
    check_replay(session, tmp_path / "again", whole=True)
    reports = [sample.reading for sample in Recording(session.directory / "session.mcap")]
    for before, report in itertools.pairwise(reports):
        assert (len(report.strain) > 0) == (before.moment == StepEnd.HIT1)


@pytest.mark.parametrize("model", ["create1", "create2"])
def test_a_session_is_repeated_to_the_bit(robot: CreateBench, tmp_path: Path, model: str) -> None:
    robot.ready(model)
    plan = {"arena": PLAN["arena"], "seed": 7, "reports": 6, "behaviour": {"fast": 0.018}}
    live = robot.live(**SLACK, plan=plan, model=model)
    touch = {"reports": {"walls": "geometric"}}  # no strain templates, whose training takes seconds
    with robot.session(live, grid={"particles": 20}, touch=touch) as session:
        recording = robot.ended(session, "complete")
    assert session.report()["standing"]
    run(load_config(session.directory / "config.yaml"), tmp_path / "again")
    for name in SAME:
        assert (session.directory / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    for directory in (session.directory, tmp_path / "again"):  # at 20 readings a second
        warned = any("replies in motion are 0 or 1 mm" in said for said in read_manifest(directory).warnings)
        assert warned == (model == "create1")  # a Create 2 counts ticks
    doctor = diagnose_recording(session.directory / "session.mcap").render()
    assert ("replies in motion are 0 or 1 mm" in doctor) == warned
    odometry = [sample.reading.odometry for sample in recording]
    assert len(odometry) == 6
    assert 0.03 < sum(step.dx for step in odometry) < 0.15  # steps of 9 mm, more on a busy machine
    assert np.allclose([sample.time for sample in recording], np.cumsum([step.dt for step in odometry]))


def test_light_bumpers_are_touches_that_are_recorded_and_repeated_to_the_bit(robot, tmp_path):
    robot.ready("create2")
    plan = {"arena": PLAN["arena"], "seed": 7, "reports": 12, "behaviour": {"fast": 0.15}}
    live = robot.live(**SLACK, plan=plan, model="create2", touch="light")
    with robot.session(live, grid={"particles": 20}) as session:
        recording = robot.ended(session, "complete")
    assert session.report()["standing"]
    run(load_config(session.directory / "config.yaml"), tmp_path / "again")
    for name in SAME:
        assert (session.directory / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    readings = [sample.reading for sample in recording]
    touching = next(reading for reading in readings if reading.contact.any())
    assert touching.view[0, touching.contact, 0] == touching.view.max() > 0.8
    assert np.linalg.norm(touching.point[touching.contact]) == pytest.approx(0.17)  # the robot's radius
    assert readings[0].view.max() < 0.4
    assert [event.name for event in recording.events] == ["light"]


class SimulatedCreate(SimulatedDriver):
    """The driver of an emulated Create 2 in simulated time; sleeps are shorter than its period."""

    last_reply = property(lambda self: self.loop.last_reply)
    doubt, due = "", 0.0

    def sleep(self, seconds):
        self.line.wait(seconds)
        if self.line.now >= self.due:
            self.loop.poll()
            self.due = self.line.now + self.period

    def release(self):
        self.loop.release()
        self.sleep(self.period)

    def odometry(self):
        return self.loop.take_odometry()

    def gap(self):
        return self.loop.gap()


def explore_by_light(monkeypatch, part):
    """The readings of a session in simulated time, and the true poses [T, 3]."""
    rig = part.rig
    world = create_emulator_config(rig.create, "127.0.0.1")
    line = Line(world, make_arena(rig.create.plan.arena, world.seed))
    rig.robot = SimulatedCreate(line, CreateConfig(model=rig.create.model))
    clock = SimpleNamespace(monotonic=lambda: line.now, sleep=rig.robot.sleep)
    monkeypatch.setattr("robot.live.create_rig.time", clock)
    monkeypatch.setattr("robot.live.create_rig.TICK", rig.robot.period / 2)
    free = np.random.default_rng(world.seed).normal(0.0, 2.0, (30, 6)).round()
    rig.monitor.learn(np.maximum(free, 0.0))
    rig.begin()
    readings, poses = [], []

    def offer(sample):
        readings.append(sample.reading)
        poses.append(line.robot.pose)

    mapper = SimpleNamespace(behind=lambda: 0.0, alive=True, offer=offer)
    run_create_loop(rig, mapper, lambda *_: None)
    return readings, np.array(poses)


@pytest.mark.soak
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("noise", ["measured", "bias"])
def test_what_a_map_by_light_bumpers_is_worth(monkeypatch, tmp_path, noise):
    """ATE in m of odometry; of the map; of maps of its contacts straight ahead and at random times."""
    errors, session = [], None
    for seed in range(10, 20):
        plan = {"arena": PLAN["arena"], "wheels": {"noise": noise}, "seed": seed}
        create = {"port": "create.tty", "model": "create2", "touch": "light", "plan": plan}
        given = {"live": {"create": create}, "backend": "grid", "grid": {"side": 4.0}}
        part = CreateSession(RunConfig.model_validate(given), tmp_path, lambda: False)
        readings, truth = explore_by_light(monkeypatch, part)
        if session is None:
            session = build_session(complete(part.job.config, part.job.source, 2.0), part.job.source)
        random, ahead = np.random.default_rng(seed).permutation(len(readings)), np.arange(6) == 2
        touches = [(reading.contact, reading.point) for reading in readings]
        maps = touches, [(any(c) & ahead, 0.17 * np.outer(any(c) & ahead, (1, 0))) for c, _ in touches]
        found = [ate(integrate(np.array([reading.odometry[:3] for reading in readings])), truth)]
        for touched in (*maps, [touches[k] for k in random]):
            session.restart(0)
            both = zip(readings, touched, strict=True)
            list(session.replay([each._replace(contact=c, point=p) for each, (c, p) in both]))
            found.append(ate(session.map.trajectory(), truth))
        errors.append(found)
        print(noise, seed, *(f"{error:.3f}" for error in found), flush=True)
    worse = (np.array(errors)[:, 1:] > np.array(errors)[:, :1]).sum(axis=0)
    print(noise, "median", np.median(errors, axis=0).round(3), "worse than odometry", worse)
    assert np.median(errors, axis=0)[1] < np.median(errors, axis=0)[[0, 3]].min()


def test_whiskers_that_are_unplugged_are_awaited(robot: CreateBench) -> None:
    """The robot stands meanwhile; the motion so far is recorded without a touch."""
    with robot.rolling() as session:
        robot.whiskers(do="unplug")
        until(lambda: not robot.rolls(), "the robot stands")
        robot.whiskers(do="plug")
        until(robot.rolls, "the robot goes on")
        session.send(signal.SIGINT)
        recording = robot.ended(session, "interrupted")
        assert session.report()["standing"]
    unsampled = [sample.reading for sample in recording if not sample.reading.alive.any()]
    assert 1 <= len(unsampled) <= 2  # the motion that Ctrl-C ends at once may have no sample either
    assert not any(reading.contact.any() for reading in unsampled)
    assert [event.name for event in recording.events][:2] == ["held", "resumed"]


def test_the_self_test_moves_nothing(robot: CreateBench, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("robot.live.selftest.LISTEN_TIME", 0.3)
    monkeypatch.setattr("robot.live.selftest.MIN_RATE_SHARE", 0.0)
    live, before = LiveConfig.model_validate(robot.live(**SLACK)), robot.state()
    text = "\n".join(check_session(live, HeadConfig(), tmp_path / "run"))
    until(lambda: robot.state()["mode"] == "PASSIVE", "the robot is passive again")
    after = robot.state()
    assert all(before[name] == after[name] for name in ("x", "y", "speeds"))
    for part in ("disk: ", "can be opened", "4 whiskers at 2000 Hz", "safe mode", "4 of 4 alive", "clocks: "):
        assert part in text
    robot.robot("bump")
    with pytest.raises(InputError, match="left pressed"):
        list(check_session(live, HeadConfig(), tmp_path / "run"))
    assert not (tmp_path / "run").exists()
