"""Topics of a running robot: samples as of a bag, to the bit, and events of its odometry and its clock."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.drivers.outcome import SessionOutcome
from robot.live.polling import SessionFault
from robot.live.topic_steps import TopicSteps
from robot.live.topics_client import LiveMessages
from robot.recordings.bags.bag import Topic
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_pokes import PokeSimulation
from robot.simulation.head.simulated_session import SimulationConfig
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

START = 1_700_000_000_123_456_789
KINDS = {"/odom": "nav_msgs/msg/Odometry", "/scan": "sensor_msgs/msg/LaserScan"}
SCANS = {"views": {"topic": "/scan", "max_range": 8.0}}


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
