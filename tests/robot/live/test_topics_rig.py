"""Sessions on topics of a running robot: what is recorded is what was mapped; what a connection and a robot
can do wrong."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from robot.drivers.outcome import SessionOutcome
from robot.live import topics_rig
from robot.live.live_config import LiveConfig, TopicsLiveConfig
from robot.live.polling import OperatorStop, SessionFault
from robot.live.recorder import LiveRecorder
from robot.live.topics_rig import TopicsRig, run_topics_loop
from robot.recordings.cdr import doubts_of
from robot.recordings.formats import open_recording
from robot.recordings.mcap_reader import Recording
from robot.recordings.mcap_writer import Recorder
from robot.recordings.recording_config import RecordingConfig
from robot.sources.source import SourceDescription, SourceInfo
from tests.helpers.ros_bags import write_bag
from tests.helpers.stand_in_robot import PlainBridge, SdkBridge, ZenohRobot
from tests.robot.live.test_topics import (
    KINDS,
    POKES,
    bits,
    drive,
    poked,
    recording,
    samples_of,
    shifted,
)

PATIENCE = 60.0


class Listening:
    """A mapper that only listens."""

    alive, failure = True, ""

    def __init__(self, lag: Callable[[], float] = lambda: 0.0) -> None:
        self.samples, self.begun, self.lag = [], [], lag

    def behind(self) -> float:
        return self.lag()

    def offer(self, sample, begins=False) -> None:
        self.samples.append(sample)
        self.begun.append(begins)


def configured(address: str, **settings) -> LiveConfig:
    return LiveConfig(topics=TopicsLiveConfig(source=address, **settings), budget=0.6)


class Session:
    """A session in a thread's place: the rig is driven by the test until enough samples have come."""

    def __init__(
        self, address: str, path=None, config: RecordingConfig | None = None, pokes=None, **settings
    ) -> None:
        self.mapper, self.told, self._stop = Listening(), [], False
        config = config or recording()
        live, say = configured(address, **settings), self.told.append
        self.rig = TopicsRig(live, config, lambda: self._stop, say, *([pokes] if pokes else []))
        steps = self.rig.steps
        shape = SourceDescription(steps.shape or (3, 6, 1), steps.whiskers, 0.0, SourceInfo(pokes=pokes))
        self.recorder = None if path is None else LiveRecorder(Recorder(path, shape))

    def run(self, act: Callable[[int], bool]) -> None:
        """Maps until `act`, called after each sample or each wait with their number, returns false."""
        self.rig.recorder = self.recorder
        self.rig.begin()
        take = self.rig.client.take

        def taking(longest):
            self._stop = not act(len(self.mapper.samples))
            return take(longest)

        self.rig.client.take = taking
        try:
            run_topics_loop(self.rig, self.mapper, lambda moment, odometry: None)
        except OperatorStop:
            pass
        finally:
            self.rig.client.take = take
            if self.recorder is not None:
                self.recorder.close()


@contextmanager
def session_on(robot, *arguments, **settings) -> Iterator[Session]:
    """A session that has subscribed to the topics of a robot; both are closed afterwards."""
    try:
        session = Session(robot.address, *arguments, **settings)
        with session.rig:
            wait(lambda: robot.heard(list(KINDS)))
            yield session
    finally:
        robot.close()


def wait(done: Callable[[], bool]) -> None:
    due = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < due
        time.sleep(0.005)


def paced(bridge, entries, then: Callable[[], bool] = lambda: True):
    """Sends a few messages each time it is called; afterwards waits for `then` and half a second more."""
    rest, done = list(entries), [0.0]

    def act(count: int) -> bool:
        if rest:
            bridge.send(*rest[:20])
            del rest[:20]
            return True
        if not done[0] and then():
            done[0] = time.monotonic()
        return not done[0] or time.monotonic() < done[0] + 0.5

    return act


@pytest.mark.parametrize("bridge", [SdkBridge, PlainBridge, ZenohRobot])
def test_a_session_records_every_message_and_the_samples_that_were_mapped(bridge, loopback, tmp_path):
    entries, robot = drive(10.0), bridge(loopback, KINDS | {"/imu": "sensor_msgs/msg/Imu"})
    with session_on(robot, tmp_path / "session.mcap", max_wait=30.0) as session:
        session.run(paced(robot, entries))
    mapped = session.mapper.samples
    assert bits(mapped) == bits(Recording(tmp_path / "session.mcap"))
    whole = write_bag(tmp_path, "mcap", entries)
    expected = bits(open_recording(recording().model_copy(update={"file": whole})))
    assert len(expected) - len(mapped) <= 1
    assert bits(mapped) == expected[: len(mapped)]
    again = open_recording(recording().model_copy(update={"file": tmp_path / "session.mcap"}))  # as any bag
    assert bits(again)[: len(mapped)] == bits(mapped)
    assert session.rig.messages.counts == {"/odom": 500, "/scan": sum(e.topic == "/scan" for e in entries)}


def test_a_piece_begins_where_it_did_live_and_is_told_as_often(loopback, tmp_path):
    """Also where the last views of the piece before come after the odometry that began anew."""
    whole = [*shifted(drive(6.0), 0.0, x=7.0), *shifted(drive(4.0, 1), 7.5)]
    late = sorted(whole, key=lambda entry: entry.time + 2_500_000_000 * (entry.topic == "/scan"))
    robot = PlainBridge(loopback, KINDS)
    with session_on(robot, tmp_path / "session.mcap", max_wait=30.0) as session:
        session.run(paced(robot, late))
    read = Recording(tmp_path / "session.mcap")
    (begun,) = np.flatnonzero(session.mapper.begun)
    assert len(session.mapper.begun) > begun + 20 > 40
    assert read.begins == {begun}
    assert doubts_of(read.events) == doubts_of(session.rig.events) != []


def test_a_session_of_pokes_of_another_program_is_that_of_its_recording(loopback, tmp_path):
    config, entries = poked(3)
    robot = SdkBridge(loopback, {entry.topic: entry.kind for entry in entries})
    path = tmp_path / "session.mcap"
    try:
        session = Session(robot.address, path, config, POKES, max_wait=30.0)
        with session.rig:
            wait(lambda: robot.heard(["/ft", "/tool_pose"]))
            session.run(paced(robot, entries))
    finally:
        robot.close()
    mapped, recorded = session.mapper.samples, Recording(path)
    assert len(mapped) == 3
    assert bits(mapped) == bits(recorded)
    assert recorded.info.pokes == POKES
    again = config.model_copy(update={"file": path})
    assert bits(open_recording(again, None, POKES)) == bits(mapped)
    assert any(sample.reading.contact.any() for sample in mapped)


def test_channels_of_ros_1_are_recorded_as_those_of_ros_2(loopback, tmp_path):
    entries, robot = drive(3.0), PlainBridge(loopback, KINDS, ros1=True)
    with session_on(robot, tmp_path / "session.mcap", max_wait=30.0) as session:
        session.run(paced(robot, entries))
    found = bits(session.mapper.samples)
    assert found == bits(samples_of(recording(), entries))[: len(found)]
    again = open_recording(recording().model_copy(update={"file": tmp_path / "session.mcap"}))
    assert bits(again)[: len(found)] == found
    assert len(found) > 20


@pytest.mark.parametrize("bridge", [PlainBridge, ZenohRobot])
def test_a_connection_cut_again_and_again_loses_no_recording(bridge, loopback, tmp_path):
    robot, random = bridge(loopback, KINDS), np.random.default_rng(5)
    rest = drive(30.0)
    cuts = sorted(random.integers(100, 1400, 8).tolist(), reverse=True)

    def act(count: int) -> bool:
        if not robot.heard(list(KINDS)):
            return True
        if not rest:
            return False
        if cuts and len(rest) < cuts[0]:
            cuts.pop(0)
            robot.cut()
            return True
        robot.send(*rest[:20])
        del rest[:20]
        return True

    with session_on(robot, tmp_path / "session.mcap", max_wait=0.05) as session:
        session.run(act)
    assert session.rig.outages == 8
    read = Recording(tmp_path / "session.mcap")
    assert bits(session.mapper.samples) == bits(read)
    assert not read.truncated
    assert "the connection to the robot was lost (8 x, first: " in " ".join(doubts_of(read.events))
    assert read.begins == {k for k, begins in enumerate(session.mapper.begun) if begins}


@pytest.mark.parametrize("bridge", [PlainBridge, ZenohRobot])
@pytest.mark.parametrize("kind", [KINDS["/scan"], "sensor_msgs/msg/Imu"], ids=["same", "other"])
def test_a_topic_that_vanishes_is_heard_again_unless_its_type_has_changed(bridge, kind, loopback):
    robot, entries = bridge(loopback, KINDS), drive(6.0)
    half, vanished, stage = len(entries) // 2, [0], iter((0, 1))
    first, second = paced(robot, entries[:half]), paced(robot, entries[half:], lambda: same)
    same = kind == KINDS["/scan"]

    def act(count: int) -> bool:
        if first(count):
            return True
        if next(stage, 1) == 0:
            robot.withdraw("/scan")
            vanished[0] = count
            return True
        if "/scan" in session.rig.client.channels and not vanished[0]:
            return second(count)
        if vanished[0] and "/scan" not in session.rig.client.channels:
            vanished[0] = 0
            robot.advertise("/scan", kind)
        return True

    with session_on(robot, max_wait=30.0, patience=3.0) as session:
        if same:
            session.run(act)
            assert len(session.mapper.samples) > 50
            return
        with pytest.raises(SessionFault, match=f"advertised as {kind} now, not as {KINDS['/scan']}"):
            session.run(act)


def test_what_a_robot_sends_amiss_is_named_and_left_out(loopback, tmp_path):
    robot = PlainBridge(loopback, KINDS)
    amiss = iter([
        lambda: robot.say(b"\x01\x00"), lambda: robot.say("{"), lambda: robot.say('{"op": "advertise"}'),
        lambda: robot.send_raw("/scan", b"\x00\x01\x00\x00garbage"), lambda: robot.send_raw("/odom", b""),
        lambda: robot.say(b"\x07" * 100), lambda: robot.say('[1, 2]'), lambda: robot.say("\x00" * 70),
    ])  # fmt: skip
    send = paced(robot, drive(8.0))

    def act(count: int) -> bool:
        next(amiss, lambda: None)()
        return send(count)

    with session_on(robot, tmp_path / "session.mcap", max_wait=30.0) as session:
        session.run(act)
    assert len(session.mapper.samples) > 70
    assert session.rig.spoilt["/scan"] == session.rig.spoilt["/odom"] == 1
    assert session.rig.spoilt["connection"] >= 4
    assert any("cannot be decoded" in said for said in session.told)
    assert bits(session.mapper.samples) == bits(Recording(tmp_path / "session.mcap"))


@pytest.mark.parametrize("name", ["gone", "silent", "useless"])
def test_what_does_not_end_ends_the_session(name, loopback):
    robot = PlainBridge(loopback, KINDS)
    send = paced(robot, drive(2.0))

    def act(count: int) -> bool:
        if name == "useless":
            robot.send_raw("/odom", b"\x00\x01\x00\x00nothing")
        elif count > 10 and name == "gone":
            robot.close()
        else:
            send(count)
        return True

    expected = {
        "gone": SessionOutcome.CONNECTION_LOST, "silent": SessionOutcome.TOPIC_SILENT,
        "useless": SessionOutcome.TOPIC_UNUSABLE,
    }[name]  # fmt: skip
    with session_on(robot, patience=0.5 if name != "useless" else 60.0) as session:
        with pytest.raises(SessionFault) as raised:
            session.run(act)
        assert raised.value.fault.outcome is expected


def test_a_mapper_that_lags_drops_views_and_no_motion(loopback):
    robot, entries = PlainBridge(loopback, KINDS), drive(6.0)
    dropping = iter([True] * 20 + [False] * 100_000)
    with session_on(robot, max_wait=30.0) as session:
        session.mapper.lag = lambda: 9.0 if len(session.mapper.samples) % 3 == 2 and next(dropping) else 0.0
        session.run(paced(robot, entries))
    assert session.rig.steps.dropped["mapper late"] == 20
    whole = samples_of(recording(), entries)
    total = sum(float(sample.reading.odometry.dtheta) for sample in whole)
    assert sum(float(s.reading.odometry.dtheta) for s in session.mapper.samples) == pytest.approx(
        total, abs=1e-9
    )


def test_time_in_which_the_session_itself_stood_still_is_no_silence_of_the_robot(loopback, monkeypatch):
    clock = SimpleNamespace(monotonic=lambda: now[0], time=time.time, process_time=time.process_time)
    with session_on(PlainBridge(loopback, KINDS), patience=3.0) as session:
        now = [time.monotonic()]
        monkeypatch.setattr(topics_rig, "time", clock)
        session.rig.begin()
        now[0] += 100.0  # behind a pipe that nobody reads, say
        session.rig.check_patience()
        for _ in range(4):
            now[0] += 0.7
            session.rig.check_patience()
        now[0] += 0.7
        with pytest.raises(SessionFault, match="no message for 3 s"):
            session.rig.check_patience()
