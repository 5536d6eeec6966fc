"""Bags that cannot be read, and settings that do not fit: one clear error each, or a warning."""

import re
import shutil
import sqlite3

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer

from robot.recordings.bags.bag_description import describe_bag, suggested_topics
from robot.recordings.formats import open_recording
from robot.recordings.mcap_writer import recover
from robot.recordings.recording_config import RecordingConfig
from tactile.base import bounded
from tests.helpers.ros_bags import Entry, header, odometry, pose, scan
from tests.robot.recordings.bags.conftest import SCANS, START, STEP, TIMES, WHEELS, framed, link, opened

RING = [scan(time, np.linspace(1 + 0.1 * row, 4, 36), -np.pi, np.pi / 18) for row, time in enumerate(TIMES)]
MOUNT = [link("base_link", "laser", np.pi / 2)]


def with_stamps(stamps):
    return [odometry(stamps[row], 0.1 * row, 0, 0)._replace(time=TIMES[row]) for row in range(12)]


def renamed(entries, frame, child):
    for entry in entries:
        entry.fields["header"]["frame_id"], entry.fields["child_frame_id"] = frame, child
    return entries


@pytest.mark.parametrize("kind", ["ros1-bz2", "ros1-lz4", "sqlite3-message", "mcap-file", "mcap-storage"])
def test_what_expands_to_too_much_is_refused(kind, write, refused, monkeypatch):
    path = write(WHEELS, [scan(START, np.ones(400_000), -1.5, 1e-6)], kind=kind)
    assert describe_bag(path).topics
    monkeypatch.setattr(bounded, "MOST_BYTES", 1 << 20)
    refused(lambda: opened(path, views="/scan"), "expands to", "at most 1 MiB: 1 MiB, or 32 times")


MISSING = {
    "topic": ({"views": "/scna"}, ["no topic '/scna'", "'/lab', '/odom', '/scan'", "did you mean '/scan'?"]),
    "views of another type": ({"views": "/lab"}, ["/lab: messages of type lab_msgs/msg/Custom", "LaserScan"]),
    "odometry of another type": ({"odometry": "/scan"}, ["/scan: messages of type", "nav_msgs/msg/Odometry"]),
    "touch of another type": ({"touch": "/scan"}, ["/scan: messages of type", "JointState"]),
    "odometry": ({"odometry": None}, ["no odometry", "/scan (sensor_msgs/msg/LaserScan)"]),
    "frame": ({"odometry": {"tf": ["odom", "base_link"]}}, ["/tf: no frame 'odom'"]),
    "preset": ({"openratslam": "irat", "odometry": None}, ["no topic '/irat/odom'"]),
}  # fmt: skip


@pytest.mark.parametrize(("topics", "pieces"), MISSING.values(), ids=MISSING.keys())
def test_missing_topics_are_named_with_those_that_exist(topics, pieces, write, refused):
    path = write(WHEELS, SCANS, [Entry("/lab", "lab_msgs/msg/Custom", TIMES[-1], {})])
    refused(lambda: opened(path, **topics), *pieces)
    refused(lambda: open_recording(RecordingConfig(file=path)), "recording.topics: no odometry", "/odom (nav")


def test_frames_that_are_not_connected_are_refused(write, refused):
    still = np.zeros((12, 3))
    path = write(framed("odom", "base", still), framed("a", "b", still), [link("base", "laser")], kind="ros1")
    for child, *pieces in (
        ("b", "/tf odom to b", "not connected"),
        ("bass", "'bass'", "did you mean 'base'?"),
    ):
        refused(lambda child=child: opened(path, odometry={"tf": ["odom", child]}), *pieces)
    refused(lambda: opened(path, odometry={"tf": ["base", "laser"]}), "frames that never move")


STAMPS = {
    "zero": (lambda n: [*[0] * n, *TIMES[n:]], ["/odom, message 0", "the stamp is 0"]),
    "back": (lambda n: [*TIMES[:6], *TIMES[1 : 1 + n], *TIMES[6 + n :]],
             ["message 6", "goes back from 1700000000.623456789 to 1700000000.223456789 s"]),
}  # fmt: skip


@pytest.mark.parametrize(("make", "pieces"), STAMPS.values(), ids=STAMPS.keys())
def test_one_disorder_is_left_out_and_more_are_cured_by_the_bag_time(make, pieces, write, refused):
    path, told = write(with_stamps(make(2)), kind="sqlite3"), []
    refused(lambda: opened(path), *pieces, "(so in 2 of 12", "--set recording.topics.clock=bag")
    assert opened(path, clock="bag").length == 12
    assert opened(write(with_stamps(make(1))), told).length == 11
    assert all(piece in told[0] for piece in (*pieces, "1 of 12 messages are left out"))


def test_equal_stamps_and_jumps_are_reported(write, refused):
    told = []
    path = write(with_stamps([*TIMES[:5], *TIMES[4:11]]))
    assert opened(path, told).length == 11
    assert told[0].startswith(f"{path}, /odom: 1 of 12 messages repeat the stamp of the message before, the")
    path = write(WHEELS, [odometry(TIMES[-1] + STEP, 99.0, 0.0, 0.0)], kind="ros1")
    jump = refused(lambda: opened(path), "message 12: the odometry jumps", "recording.odometry.largest_step=")
    assert "unit" not in str(jump)


LEAPS = {  # messages from number 6 on are 60 s ahead, by the clock in their headers or by that of the bag
    "header": ("header", "--set recording.topics.clock=bag", "bag"),
    "bag": ("bag", "--set recording.topics.clock=header", "header"),
    "both": ("header", "--set recording.odometry.largest_step", ""),
}


@pytest.mark.parametrize("leaping", LEAPS)
def test_a_velocity_does_not_hold_over_a_gap(leaping, write, refused):
    """The cure is the other clock where that does not leap; doctor chooses it."""
    used, cure, right = LEAPS[leaping]
    entries = []
    for row, time in enumerate(TIMES):
        ahead = 60 * 10**9 * (row >= 6)
        stamp, receipt = (time + ahead * (leaping in (clock, "both")) for clock in ("header", "bag"))
        fields = {"header": header(stamp), "twist": {"linear": {"x": 0.4}}}
        entries.append(Entry("/odom", "geometry_msgs/msg/TwistStamped", receipt, fields))
    path = write(entries)
    refused(lambda: opened(path, clock=used), "/odom, message 6: nothing for 60.1 s", cure)
    if right:
        assert opened(path, clock=right).motion[:, 0].sum() == pytest.approx(0.4 * 1.1)
        assert suggested_topics(describe_bag(path)).get("clock", "header") == right


@pytest.mark.parametrize("other", [("odom", "chassis"), ("map", "base_link"), ("odom", "foot")])
def test_several_publishers_are_named_and_chosen(other, write, refused):
    agree = other == ("odom", "foot")
    one = renamed([odometry(time, 0.1 * row, 0, 0) for row, time in enumerate(TIMES)], "odom", "base_link")
    side = 0.0 if agree else 0.5
    two = [odometry(time + STEP // 2, 0.1 * row, side, 0.0) for row, time in enumerate(TIMES)]
    path, told = write(one, renamed(two, *other), kind="ros1"), []
    pieces = ("/odom, message 1", "odom to base_link (12)", f"{' to '.join(other)} (12)")
    if agree:
        assert opened(path, told).length == 24
        assert all(piece in told[0] for piece in (*pieces, "their poses agree"))
    else:
        cure = "--set recording.topics.odometry.frames=[odom,base_link]"
        refused(lambda: opened(path), *pieces, cure)
    assert opened(path, odometry={"topic": "/odom", "frames": ["odom", "base_link"]}).length == 12


def test_a_frame_that_changes_once_is_cured_by_the_longer_part(write, refused):
    found = [odometry(time, 0.1 * row + 0.4 * (row > 7), 0.0, 0.0) for row, time in enumerate(TIMES)]
    path = write(renamed(found[:8], "odom", "base"), renamed(found[8:], "map", "base"), kind="ros1")
    cure = f"recording.to={(TIMES[7] + TIMES[8] - 2 * TIMES[0]) / 2e9:.3f}"
    refused(lambda: opened(path), "/odom, message 8", "several frames", f"--set {cure}")
    assert opened(path, to=float(cure.split("=")[1])).length == 8


def test_numbers_that_cannot_be_are_refused(write, refused):
    bad, told = [odometry(time, np.nan, 0.0, 0.0) for time in TIMES[3:5]], []
    path = write(WHEELS[:3], bad, WHEELS[5:], kind="ros1")
    refused(lambda: opened(path), "/odom, message 3", "the position is nan", "(so in 2 of 12 messages)")
    assert opened(write(WHEELS[:3], bad[:1], WHEELS[4:], kind="sqlite3-message"), told).length == 11
    assert re.search("message 3.*1 of 12 messages are left out", told[0])
    zero = {"header": header(START), "pose": pose(0.0, 0.0, 0.0) | {"orientation": {}}}
    path = write(WHEELS, [Entry("/pose", "geometry_msgs/msg/PoseStamped", START, zero)])
    refused(lambda: opened(path, truth="/pose"), "/pose, message 0", "the orientation is 0, 0, 0, 0")
    refused(lambda: opened(path, odometry="/pose"), "orientation is 0", "odometry.use=twist")
    path = write(WHEELS, [scan(time, np.full(18, 5000.0), -1.5, 0.1, range_max=1e5) for time in TIMES])
    refused(lambda: opened(path, views="/scan"), "half of the ranges are over 5000 m", "views.max_range")


def test_topics_without_common_time_are_refused(write, refused):
    later = [scan(time + 10**12, np.full(18, 1.0), -1.5, 0.1)._replace(time=time) for time in TIMES]
    path = write(WHEELS, later)
    refused(lambda: opened(path, views="/scan"), "/scan: time is 1700001000.1", "times that overlap")
    refused(lambda: opened(path, views="/scan", samples="views"), "times that overlap")
    assert opened(path, views="/scan", clock="bag").length == 12


def test_touch_that_does_not_fit_is_refused(write, refused):
    def arrays(values):
        return [Entry("/skin", "std_msgs/msg/Float32MultiArray", time, {"data": values}) for time in TIMES]

    touch = {"topic": "/skin", "rows": 2, "columns": 2}
    for values, *pieces in (
        ([0.1, 0.2, 0.3], "/skin, message 0", "3 values", "2 x 2"),
        ([700, 800, 900, np.nan], "message 0, at", "touch is nan", "(so in 12 of 12"),
        ([700, 800, 900, 900], "values from 700 to 900", "0 to 1"),
    ):
        path = write(WHEELS, arrays(values))
        refused(lambda path=path: opened(path, touch=touch), *pieces)
    one = arrays([0.0, 1.0, 1.0, 1.0])
    for spoilt_by in ([0.1, 0.2, np.nan, 0.4], [0.1]):
        one[5], told = arrays(spoilt_by)[5], []
        seen = opened(write(WHEELS, one), told, touch=touch).seen
        assert (seen.tolist(), len(told)) == ([row != 5 for row in range(12)], 1)


def test_empty_and_cut_bags_are_refused(write, tmp_path, refused):
    for kind in ("ros1", "sqlite3", "mcap"):
        path = write([], kind=kind)
        refused(lambda path=path: opened(path), "a bag without messages")
    (tmp_path / "folder").mkdir()
    refused(lambda: opened(tmp_path / "folder"), "is a folder without metadata.yaml")
    refused(lambda: opened(tmp_path / "none"), "no such file")
    path = write(WHEELS, SCANS, kind="ros1")
    path.write_bytes(path.read_bytes()[:-200])
    refused(lambda: opened(path), "cannot be read as a bag")
    file = write(WHEELS, SCANS) / "run.mcap"
    whole = file.read_bytes()
    for share in (0.3, 0.7, 0.95):
        file.write_bytes(whole[: int(share * len(whole))])
        for action in (lambda: describe_bag(file), lambda: recover(file, tmp_path / "new.mcap")):
            refused(action, "a ROS 2 bag that is cut off", "`mcap recover run.mcap")


def test_the_parts_of_a_bag_are_one_recording(write, tmp_path):
    (tmp_path / "parts").mkdir()
    for number, part in enumerate((SCANS[6:] + WHEELS[6:], SCANS[:6] + WHEELS[:6])):
        shutil.move(write(part, kind="ros1"), tmp_path / "parts" / f"{number}.bag")
    source = opened(tmp_path / "parts", views="/scan")
    assert source.length == 12
    for kind in ("sqlite3-message", "mcap"):
        (file,) = (path for path in write(WHEELS, SCANS, kind=kind).iterdir() if path.suffix != ".yaml")
        assert np.array_equal(opened(file, views="/scan").time, source.time)


INDEX = {
    "unchunked": {"use_chunking": False},
    "unchunked, out of order": {"use_chunking": False, "disorder": 3},
    "chunks without index": {"index_types": IndexType.NONE},
    "chunks, their index only": {"index_types": IndexType.CHUNK},
    "no summary": {"use_chunking": False, "use_statistics": False, "use_summary_offsets": False,
                   "repeat_channels": False, "repeat_schemas": False},
    "no channels in the summary": {"repeat_channels": False},
    "no types in the summary": {"repeat_schemas": False},
}  # fmt: skip


@pytest.mark.parametrize("case", INDEX)
def test_an_mcap_is_read_whole_whatever_its_index(case, write, tmp_path):
    """The mount of the ring is read while the ring is; messages may be stored out of order."""
    options = dict(INDEX[case])
    disorder = options.pop("disorder", 0)
    folder = write(WHEELS, RING, MOUNT)
    with (folder / "run.mcap").open("rb") as old, (tmp_path / "copy.mcap").open("wb") as new:
        out, ids = Writer(new, chunk_size=2000, **options), {}
        out.start(profile="ros2", library="test")
        messages = list(make_reader(old).iter_messages())
        for schema, channel, message in [*messages[disorder:], *messages[:disorder]]:
            if channel.id not in ids:
                kind = out.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = out.register_channel(channel.topic, "cdr", kind, channel.metadata)
            out.add_message(ids[channel.id], message.log_time, message.data, message.publish_time)
        out.finish()
    told = []
    found, right = (opened(path, told, views="/scan") for path in (tmp_path / "copy.mcap", folder))
    np.testing.assert_array_equal(found.views, right.views)
    assert found.seen.all()
    assert (found.time.tolist(), told) == (right.time.tolist(), [])


@pytest.mark.parametrize("fan", [False, True])
def test_two_lasers_on_one_topic_have_their_own_mounts(fan, write):
    front, rear = [link("base_link", "laser")], [link("base_link", "rear", np.pi)]
    ranges, scans = np.linspace(1, 4, 36), []
    for row, time in enumerate(TIMES):
        seen = np.roll(ranges, 18) if row % 2 else ranges
        scans.append(scan(time, seen[:-9] if fan else seen, -np.pi, np.pi / 18))
        scans[-1].fields["header"]["frame_id"] = "rear" if row % 2 else "laser"
    span = {"topic": "/scan", "span": [-np.pi, np.pi]} if fan else "/scan"
    inside = slice(9, 13) if fan else slice(None)
    for known in (True, False):
        told = []
        one, two = opened(write(WHEELS, front, rear * known, scans), told, views=span).views[:2]
        assert len(told) == (not known)
        assert known or "no transform from base_link to rear" in told[0]
        assert np.allclose(one.ravel()[inside], two.ravel()[inside]) == known


METADATA = {
    "more than there are": ("message_count: 12", "message_count: 15", "12 of 15 messages were read"),
    "fewer": ("message_count: 12", "message_count: 3", None),
    "none": ("message_count: 12", "message_count: 0", None),
    "no storage": ("storage_identifier: sqlite3", 'storage_identifier: ""', None),
    "another file": ("- run.db3", "- run.db3", "copy.db3 is not in metadata.yaml"),
}


@pytest.mark.parametrize("case", METADATA)
def test_what_is_not_read_is_said(case, write):
    old, new, expected = METADATA[case]
    folder, told = write(WHEELS, SCANS, kind="sqlite3"), []
    text = (folder / "metadata.yaml").read_text()
    assert old in text
    (folder / "metadata.yaml").write_text(text.replace(old, new))
    if case == "another file":
        shutil.copy(folder / "run.db3", folder / "copy.db3")
    assert opened(folder / "metadata.yaml", told, views="/scan").length == 12
    assert (expected is None) == (not told), told
    assert expected is None or expected in told[0]


@pytest.mark.parametrize(
    ("profile", "encoding", "schema"),
    [("ros1", "ros1", "ros1msg"), ("", "json", "jsonschema"), ("ros2", "json", "jsonschema")],
)
def test_other_containers_are_named(profile, encoding, schema, tmp_path, refused):
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        out = Writer(file)
        out.start(profile=profile, library="test")
        kind = out.register_schema("nav_msgs/msg/Odometry", schema, b"{}")
        out.add_message(out.register_channel("/odom", encoding, kind), 1, b"{}", 1)
        out.finish()
    pieces = f"of profile {profile or 'none'} with", encoding, "rosbags-conv"
    for read in (opened, describe_bag):
        refused(lambda read=read: read(path), *pieces)


SPOILT = {"angles": {"angle_increment": np.nan}, "beams": {"ranges": np.zeros(0, np.float32)},
          "few": {"ranges": np.ones(5, np.float32)}}  # fmt: skip


def spoilt(case, number):
    return RING[number]._replace(fields=dict(RING[number].fields) | SPOILT[case])


@pytest.mark.parametrize("number", [0, 7])
@pytest.mark.parametrize("case", [*SPOILT, "cut", "zero turn", "nan turn"])
def test_one_bad_message_is_left_out(case, number, write):
    ring, links, told = list(RING), MOUNT * 2, []
    if case.endswith("turn"):
        links[number > 0] = bad = link("base_link", "laser")
        bad.fields["transforms"][0]["transform"]["rotation"]["w"] = 0.0 if case == "zero turn" else np.nan
    elif case != "cut":
        ring[number] = spoilt(case, number)
    path = write(links, WHEELS, ring, kind="sqlite3")
    if case == "cut":
        with sqlite3.connect(path / "run.db3") as base:
            rows = base.execute("select m.id from messages m join topics t on m.topic_id = t.id "
                                "where t.name = '/scan' order by timestamp").fetchall()  # fmt: skip
            base.execute("update messages set data = substr(data, 1, 60) where id = ?", rows[number])
    seen = opened(path, told, views="/scan").seen
    assert len(told) == 1
    assert "1 of" in told[0]
    if case.endswith("turn"):
        assert seen.all()
    else:
        assert f"message {number}, at" in told[0] or "less than half of the sectors" in told[0]
        assert seen.tolist() == [row != number for row in range(12)]
    views = suggested_topics(describe_bag(path))["views"]
    few = (case, number) == ("few", 0)
    assert views == ({"topic": "/scan", "span": [-3.1416, 3.1416]} if few else "/scan")


def test_many_bad_messages_are_refused(write, refused):
    path = write(WHEELS, [spoilt("angles", 0), spoilt("angles", 1), *RING[2:]])
    refused(lambda: opened(path, views="/scan"), "/scan, message 0, at", "angle_min is", "(so in 2 of 12")
