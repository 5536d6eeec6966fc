"""Topics of a running robot: samples as of a bag, to the bit; what a connection and a robot can do wrong."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.drivers.outcome import SessionOutcome
from robot.live import topics_rig
from robot.live.live_config import LiveConfig, TopicsLiveConfig
from robot.live.polling import OperatorStop, SessionFault
from robot.live.recorder import LiveRecorder
from robot.live.topic_steps import TopicSteps
from robot.live.topics_client import LiveMessages
from robot.live.topics_rig import TopicsRig, run_topics_loop
from robot.recordings.bags.bag import Topic
from robot.recordings.cdr import doubts_of
from robot.recordings.formats import open_recording
from robot.recordings.mcap_reader import Recording
from robot.recordings.mcap_writer import Recorder
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_pokes import PokeSimulation
from robot.simulation.head.simulated_session import SimulationConfig
from robot.sources.source import SourceDescription, SourceInfo
from tactile.pokes import PokeConfig
from tests.helpers.poke_topics import poke_messages, poked_states
from tests.helpers.ros_bags import (
    ROS2,
    Entry,
    built,
    header,
    image,
    odometry,
    quaternion,
    scan,
    tf,
    transform,
    write_bag,
)
from tests.helpers.stand_in_robot import PlainBridge, SdkBridge, ZenohRobot

START = 1_700_000_000_123_456_789
KINDS = {"/odom": "nav_msgs/msg/Odometry", "/scan": "sensor_msgs/msg/LaserScan"}
SCANS = {"views": {"topic": "/scan", "max_range": 8.0}}
PATIENCE = 60.0


def recording(**topics):
    found = {
        "odometry": "/odom",
        "samples": "views",
        **(topics if {"views", "touch", "wrench"} & topics.keys() else SCANS),
    }
    return RecordingConfig.model_validate({"topics": found | topics})


def drive(seconds: float, seed: int = 0, period: int = 20_000_000, every: int = 5) -> list[Entry]:
    """Odometry and scans of a robot that winds its way, in the order of their stamps."""
    random, found = np.random.default_rng(seed), list[Entry]()
    pose = np.zeros(3)
    for row in range(int(seconds * 1e9 / period)):
        at = START + row * period + int(random.integers(0, period // 4))
        turn = 0.9 * np.sin(0.02 * row)
        pose = pose + [0.01 * np.cos(pose[2]), 0.01 * np.sin(pose[2]), 0.02 * turn + 0.01]
        yaw = float((pose[2] + np.pi) % (2 * np.pi) - np.pi)
        found.append(odometry(at, float(pose[0]), float(pose[1]), yaw, (0.5, 0.1, turn)))
        if row % every == 2:
            ranges = 1.0 + random.random(36) * 5
            found.append(scan(at + int(random.integers(-period, period)), ranges, -1.5, 3.0 / 36))
    return sorted(found, key=lambda entry: entry.time)


def samples_of(
    config: RecordingConfig, entries: list[Entry], *pokes: PokeConfig, say=lambda name, text: None
) -> list:
    """The samples that come out of messages, each added as it arrives."""
    messages = LiveMessages("ws://nowhere", config.topics, lambda sentence: None)
    messages.topics = {entry.topic: Topic(entry.topic, entry.kind, 1) for entry in entries}
    steps, found = TopicSteps(config, messages, 1e6, say, *pokes), []
    for entry in entries:
        content = built(ROS2, entry.kind, entry.fields)
        if entry.topic.startswith("/tf"):
            messages.keep(entry.topic, entry.time, content)
        else:
            steps.add(entry.topic, entry.time, content)
        messages.counts[entry.topic] += 1
        found += [sample for sample, *_ in steps.ready(entry.time, lambda: False)]
    return found


def bits(samples) -> list:
    return [
        (
            sample.time,
            *map(float, sample.reading.odometry),
            sample.reading.contact.tobytes(),
            sample.reading.point.tobytes(),
            sample.reading.view.tobytes(),
            sample.reading.view.shape,
        )
        for sample in samples
    ]


@pytest.mark.parametrize(
    "topics",
    [
        {},
        {"odometry": {"topic": "/odom", "use": "twist"}},
        {"odometry": {"topic": "/odom", "every": 3}},
        {"views": {"topic": "/scan", "rows": 2, "columns": 9, "max_range": 4.0}},
    ],
    ids=["poses", "velocities", "joined", "views"],
)
def test_the_samples_of_topics_are_those_of_a_bag_to_the_bit(topics, tmp_path):
    config, entries = recording(**topics), drive(30.0)
    path = write_bag(tmp_path, "mcap", entries)
    whole = open_recording(config.model_copy(update={"file": path}))
    expected, found = bits(whole), bits(samples_of(config, entries))
    assert len(found) > 200
    assert found == expected[: len(found)]  # the last views wait for odometry
    assert len(expected) - len(found) <= 1


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 400_000_000))
def test_views_that_come_late_and_out_of_turn_change_nothing(seed, delay):
    config, entries = recording(), drive(3.0, seed)
    late = [(entry.time + delay * (entry.topic == "/scan"), number) for number, entry in enumerate(entries)]
    moved = [entries[number] for _, number in sorted(late)]
    first = entries[0].time
    expected = [row for row in bits(samples_of(config, entries)) if row[0] * 1e9 > first]
    found = bits(samples_of(config, moved))
    assert found == expected[: len(found)]
    assert len(found) >= len(expected) - delay // 100_000_000 - 2


def test_rings_have_the_mount_of_the_transforms(tmp_path):
    entries = [
        tf(START, transform(START, "base_link", "laser", 0.1, 0.0, quaternion(1.0)), topic="/tf_static"),
        *(entry if entry.topic == "/odom" else scan(entry.time, 1 + np.arange(72) % 7, -np.pi, np.pi / 36)
          for entry in drive(2.0)),
    ]  # fmt: skip
    path = write_bag(tmp_path, "mcap", entries)
    whole = open_recording(recording().model_copy(update={"file": path}))
    found = bits(samples_of(recording(), entries))
    assert found == bits(whole)[: len(found)]
    assert len(found) > 15


def test_images_and_touch_become_views_as_in_a_bag(tmp_path):
    random = np.random.default_rng(0)
    wheels = [entry for entry in drive(2.0) if entry.topic == "/odom"]
    pictures = [image(START + k * 10**8, random.integers(0, 255, (24, 80), np.uint8)) for k in range(1, 18)]
    joints = [
        Entry(
            "/joints",
            "sensor_msgs/msg/JointState",
            START + k * 10**8,
            {"header": header(START + k * 10**8), "name": ["a", "b", "c"], "position": random.random(3)},
        )
        for k in range(1, 18)
    ]
    for number, (seen, topics) in enumerate(
        ((pictures, {"views": "/image"}), (joints, {"touch": "/joints"}))
    ):
        entries = sorted([*wheels, *seen], key=lambda entry: entry.time)
        (tmp_path / str(number)).mkdir()
        path = write_bag(tmp_path / str(number), "mcap", entries)
        config = recording(**topics)
        found = bits(samples_of(config, entries))
        assert found == bits(open_recording(config.model_copy(update={"file": path})))[: len(found)]
        assert len(found) > 15


def test_touch_whose_values_mostly_lie_outside_of_their_span_is_said():
    """As often as 512 messages say so. In a bag it is an error."""
    wheels = [entry for entry in drive(22.0) if entry.topic == "/odom"]
    kind, told = "sensor_msgs/msg/JointState", list[str]()
    joints = [
        Entry("/joints", kind, at, {"header": header(at), "name": ["a", "b"], "position": [7.0, k % 4 / 4]})
        for k, at in enumerate(range(START + 10**7, START + 22 * 10**9, 2 * 10**7))
    ]
    entries = sorted([*wheels, *joints], key=lambda entry: entry.time)
    for high, times in ((0.4, 2), (6.9, 0)):
        told.clear()
        config = recording(touch={"topic": "/joints", "high": high})
        samples_of(config, entries, say=lambda name, text: told.append(f"{name}: {text}"))
        said = (
            "outside: most values of /joints are not within 0 to 0.4; set recording.topics.touch.low and high"
        )
        assert told == [said] * times


POKES = PokeConfig(directions=4, reach=0.12, speed=0.05)


def poked(rings: int) -> tuple[RecordingConfig, list[Entry]]:
    """Topics of an arm that another program moves."""
    simulation = SimulationConfig(touch="force", path={"circuits": "C"}, seed=5)
    pose, _, felt = poked_states(PokeSimulation(simulation, POKES), rings=rings)
    return recording(odometry="/tool_pose", wrench="/ft"), poke_messages(pose, felt)


def test_pokes_of_another_program_are_those_of_its_bag_to_the_bit(tmp_path):
    config, entries = poked(8)
    path = write_bag(tmp_path, "mcap", entries)
    expected = bits(open_recording(config.model_copy(update={"file": path}), None, POKES))
    assert len(expected) == 8
    assert bits(samples_of(config, entries, POKES)) == expected
    random = np.random.default_rng(0)  # messages of the two topics arrive at different times
    delay = {"/ft": 0.3, "/tool_pose": 0.0}
    arrival = [entry.time + 1e9 * delay[entry.topic] + random.integers(100) for entry in entries]
    moved = [entries[number] for number in np.argsort(arrival, kind="stable")]
    assert bits(samples_of(config, moved, POKES)) == expected


def events_of(entries: list[Entry], **topics) -> tuple[list[str], list]:
    config, told = recording(**topics), list[str]()
    messages = LiveMessages("ws://nowhere", config.topics, lambda sentence: None)
    messages.topics = {name: Topic(name, kind, 1) for name, kind in KINDS.items()}
    steps, found = TopicSteps(config, messages, 0.2, lambda name, text: told.append(name)), []
    for entry in entries:
        steps.add(entry.topic, entry.time, built(ROS2, entry.kind, entry.fields))
        messages.counts[entry.topic] += 1
        found += list(steps.ready(entry.time, lambda: False))
    return told, found


def shifted(entries: list[Entry], seconds: float, x: float = 0.0) -> list[Entry]:
    """The messages, later and with poses moved along x."""
    found = []
    for entry in entries:
        at = entry.time + int(seconds * 1e9)
        fields = dict(entry.fields)
        fields["header"] = {**fields["header"], "stamp": {"sec": at // 10**9, "nanosec": at % 10**9}}
        if entry.topic == "/odom":
            place = {k: v for k, v in fields["pose"]["pose"]["position"].items()}
            place["x"] += x
            fields["pose"] = {"pose": {**fields["pose"]["pose"], "position": place}}
        found.append(entry._replace(time=at, fields=fields))
    return found


def test_a_pause_is_bridged_by_poses_and_begins_a_piece_with_velocities():
    whole = shifted(drive(20.0), 0.0, x=7.0)  # near the origin it could be an odometry that began anew
    cut = [entry for entry in whole if not START + 8e9 < entry.time < START + 12e9]
    told, found = events_of(cut)
    assert told == ["gap"]
    assert not any(begins for _, begins, _ in found)
    told, found = events_of(cut, odometry={"topic": "/odom", "use": "twist"})
    assert told == ["reset"]
    assert sum(begins for _, begins, _ in found) == 1
    (first,) = [sample for sample, begins, _ in found if begins]
    assert tuple(first.reading.odometry[:3]) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("pause", [0.02, 1.5, 6.0])
def test_an_odometry_that_begins_anew_is_a_piece_and_no_jump(pause):
    before = shifted(drive(15.0), 0.0, x=7.0)
    told, found = events_of([*before, *shifted(drive(5.0, 1), 15.0 + pause)])
    assert told == ["reset"]
    assert sum(begins for _, begins, _ in found) == 1
    moves = np.array([sample.reading.odometry[:2] for sample, *_ in found])
    assert np.hypot(*moves.T).max() < 0.2


def test_an_even_drive_has_no_events():
    told, found = events_of(drive(30.0, period=100_000_000))
    assert told == []
    assert len(found) > 50


def test_two_publishers_of_one_topic_end_the_session_with_their_name():
    one, other = drive(15.0), shifted(drive(15.0, 3), 0.007, x=0.3)
    wheels = [entry for entry in [*one, *other] if entry.topic == "/odom"]
    with pytest.raises(SessionFault, match="two nodes publish"):
        events_of(sorted([*wheels, *(e for e in one if e.topic == "/scan")], key=lambda entry: entry.time))


def test_poses_sent_many_times_end_the_session_with_the_setting_that_takes_each_once():
    times = {"/odom": 20, "/scan": 1}
    messages = [shifted([each], k * 1e-3)[0] for each in drive(15.0) for k in range(times[each.topic])]
    with pytest.raises(SessionFault, match=r"mostly 20 alike.* --set recording.topics.odometry.every=20"):
        events_of(messages)
    told, found = events_of(messages, odometry={"topic": "/odom", "every": 20})
    assert not {"gap", "reset"} & set(told)
    assert len(found) > 100


def test_a_clock_that_is_set_back_ends_the_session_and_one_set_ahead_does_not():
    def told_of(jump):
        entries = drive(8.0)
        half = len(entries) // 2
        arrivals = zip(entries[half:], shifted(entries[half:], jump), strict=True)
        return [*entries[:half], *(late._replace(time=entry.time) for entry, late in arrivals)]

    with pytest.raises(SessionFault, match="set back") as raised:
        events_of(told_of(-3.0))
    assert raised.value.fault.outcome is SessionOutcome.CLOCK_JUMPED
    told, found = events_of(told_of(3.0))
    assert len(found) > 60
    assert not any(begins for _, begins, _ in found)
    assert set(told) <= {"gap", "dropped", "reset"}


@pytest.mark.parametrize("stamp", [0.0, 5.0])
def test_messages_without_stamps_of_their_own_name_the_other_clock(stamp):
    at = {"sec": int(stamp), "nanosec": 0}
    entries = [
        entry._replace(fields={**entry.fields, "header": {**entry.fields["header"], "stamp": at}})
        for entry in drive(3.0)
    ]
    with pytest.raises(SessionFault, match=r"recording\.topics\.clock=bag") as raised:
        events_of(entries)
    assert raised.value.fault.outcome is SessionOutcome.TOPIC_UNUSABLE
    _, found = events_of(entries, clock="bag")
    assert len(found) > 20


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
