"""Bags that cannot be read, and settings that do not fit: one clear error each, or a warning."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer

from ratslam.__main__ import main
from robot.recordings.bags.bag_description import describe_bag, suggested_topics
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.sources.source import Source
from tactile.base import bounded
from tactile.base.errors import InputError
from tests.helpers.ros_bags import Entry, header, odometry, pose, quaternion, scan, tf, transform, write_bag

START, STEP = 1_700_000_000_000_000_000, 100_000_000  # ns
TIMES = [START + STEP * row for row in range(12)]
WHEELS = [odometry(time, 0.1 * row, 0.0, 0.05 * row) for row, time in enumerate(TIMES)]
SCANS = [scan(time, np.arange(1, 19) * 0.25, -1.5, 3.0 / 18) for time in TIMES]
BOTH = sorted([*WHEELS, *SCANS], key=lambda entry: entry.time)
TOPICS = {"odometry": "/odom", "views": "/scan"}
MEMORY = 4 << 30  # bytes of address space beyond those in use
Refused = Callable[..., InputError]


def opened(path: Path, told: list[str] | None = None, to: float | None = None, **topics: Any) -> Source:
    config = RecordingConfig.model_validate({"file": path, "topics": TOPICS | topics, "to": to})
    return open_recording(config, None if told is None else told.append)


def written(folder: Path, kind: str, entries: Sequence[Entry] = BOTH) -> Path:
    (folder / kind).mkdir(parents=True)
    return write_bag(folder / kind, kind, entries)


def with_stamps(stamps: Sequence[int]) -> list[Entry]:
    return [
        odometry(stamp, 0.1 * row, 0.0, 0.0)._replace(time=time)
        for row, (stamp, time) in enumerate(zip(stamps, TIMES, strict=False))
    ]


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_big_endian_messages_are_read(kind: str, tmp_path: Path) -> None:
    sources = []
    for little in (True, False):
        (tmp_path / str(little)).mkdir()
        path = write_bag(tmp_path / str(little), kind, BOTH, little_endian=little)
        sources.append([(time, reading.odometry, reading.view.tolist()) for time, reading, _ in opened(path)])
    assert sources[0] == sources[1]


@pytest.mark.parametrize(
    "kind",
    ["ros1-bz2", "ros1-lz4", "sqlite3-message", "sqlite3-file", "mcap-message", "mcap-file", "mcap-storage"],
)
def test_what_expands_to_too_much_is_refused(
    kind: str, tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    beams = [scan(time, np.ones(400_000), -1.5, 1e-6) for time in TIMES[:1]]
    path = written(tmp_path, kind, sorted([*WHEELS, *beams], key=lambda entry: entry.time))
    assert describe_bag(path).topics
    monkeypatch.setattr(bounded, "MOST_BYTES", 1 << 20)
    refused(lambda: opened(path), "expands to", "at most 1 MiB: 1 MiB, or 32 times what is stored")


def test_missing_topics_are_named_with_those_that_exist(tmp_path: Path, refused: Refused) -> None:
    path = written(tmp_path, "mcap", [*BOTH, Entry("/lab", "lab_msgs/msg/Custom", TIMES[-1], {})])
    refused(
        lambda: opened(path, views="/scna"),
        "no topic '/scna'",
        "'/lab', '/odom', '/scan'",
        "did you mean '/scan'?",
    )
    refused(lambda: opened(path, views="/lab"), "/lab: messages of type lab_msgs/msg/Custom", "LaserScan")
    refused(lambda: opened(path, odometry="/scan"), "/scan: messages of type", "nav_msgs/msg/Odometry")
    refused(lambda: opened(path, touch="/scan"), "both views and touch")
    refused(lambda: opened(path, views=None, touch="/scan"), "/scan: messages of type", "JointState")
    refused(lambda: opened(path, odometry=None), "no odometry", "/scan (sensor_msgs/msg/LaserScan)")
    refused(lambda: opened(path, odometry={"tf": ["odom", "base_link"]}), "/tf: no frame 'odom'")
    refused(lambda: opened(path, openratslam="irat", odometry=None, views=None), "no topic '/irat/odom'")
    refused(
        lambda: open_recording(RecordingConfig(file=path)), "recording.topics: no odometry", "/odom (nav_msgs"
    )


def test_frames_that_are_not_connected_are_refused(tmp_path: Path, refused: Refused) -> None:
    still = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    entries = [
        tf(time, transform(time, "odom", "base", 0, 0, still), transform(time, "a", "b", 0, 0, still))
        for time in TIMES
    ]
    entries.append(tf(START, transform(START, "base", "laser", 0, 0, still), topic="/tf_static"))
    path = written(tmp_path, "ros1", entries)
    refused(
        lambda: opened(path, views=None, odometry={"tf": ["odom", "b"]}), "/tf odom to b", "not connected"
    )
    refused(
        lambda: opened(path, views=None, odometry={"tf": ["odom", "bass"]}),
        "no frame 'bass'",
        "did you mean 'base'?",
    )
    refused(lambda: opened(path, views=None, odometry={"tf": ["base", "laser"]}), "frames that never move")


STAMPS = {
    "zero": (lambda n: [*[0] * n, *TIMES[n:]], ["/odom, message 0", "the stamp is 0"]),
    "back": (lambda n: [*TIMES[:6], *TIMES[1 : 1 + n], *TIMES[6 + n :]],
             ["message 6", "goes back from 1700000000.500000000 to 1700000000.100000000 s"]),
}  # fmt: skip


@pytest.mark.parametrize("case", STAMPS)
def test_one_disorder_is_left_out_and_more_are_cured_by_the_bag_time(
    case: str, tmp_path: Path, refused: Refused
) -> None:
    make, pieces = STAMPS[case]
    path, told = written(tmp_path, "sqlite3", with_stamps(make(2))), list[str]()
    refused(lambda: opened(path, views=None), *pieces, "(so in 2 of 12", "--set recording.topics.clock=bag")
    assert opened(path, views=None, clock="bag").length == 12
    assert opened(written(tmp_path, "mcap", with_stamps(make(1))), told, views=None).length == 11
    for piece in (*pieces, "1 of 12 messages are left out"):
        assert piece in told[0]


def test_equal_stamps_and_jumps_are_reported(tmp_path: Path, refused: Refused) -> None:
    told: list[str] = []
    path = written(tmp_path, "mcap", with_stamps([*TIMES[:5], *TIMES[4:11]]))
    assert opened(path, told, views=None).length == 11
    (repeated,) = (sentence.removeprefix(f"{path}, /odom: ") for sentence in told)
    assert repeated.startswith("1 of 12 messages repeat the stamp of the message before, the first at 17000")
    leap = [odometry(TIMES[-1] + STEP, 99.0, 0.0, 0.0)]
    jump = refused(
        lambda: opened(written(tmp_path, "ros1", [*WHEELS, *leap]), views=None),
        "message 12: the odometry jumps by",
        "--set recording.odometry.largest_step=",
    )
    assert "unit" not in str(jump)


LEAPS = {  # messages from number 6 on are 60 s ahead, by the clock in their headers or by that of the bag
    "header": ("header", "--set recording.topics.clock=bag", "bag"),
    "bag": ("bag", "--set recording.topics.clock=header", "header"),
    "both": ("header", "--set recording.odometry.largest_step", ""),
}


@pytest.mark.parametrize("leaping", LEAPS)
def test_a_velocity_does_not_hold_over_a_gap(leaping: str, tmp_path: Path, refused: Refused) -> None:
    """The cure is the other clock where that does not leap; doctor chooses it."""
    used, cure, right = LEAPS[leaping]
    entries = []
    for row, time in enumerate(TIMES):
        ahead = 60 * 10**9 * (row >= 6)
        stamp, receipt = (time + ahead * (leaping in (clock, "both")) for clock in ("header", "bag"))
        fields = {"header": header(stamp), "twist": {"linear": {"x": 0.4}}}
        entries.append(Entry("/odom", "geometry_msgs/msg/TwistStamped", receipt, fields))
    path = written(tmp_path, "mcap", entries)
    refused(lambda: opened(path, views=None, clock=used), "/odom, message 6: nothing for 60.1 s", cure)
    if right:
        source = opened(path, views=None, clock=right)
        assert sum(float(sample.reading.odometry.dx) for sample in source) == pytest.approx(0.4 * 1.1)
        assert suggested_topics(describe_bag(path)).get("clock", "header") == right


@pytest.mark.parametrize("other", [("odom", "chassis"), ("map", "base_link"), ("odom", "foot")])
def test_several_publishers_are_named_and_chosen(
    other: tuple[str, str], tmp_path: Path, refused: Refused
) -> None:
    """Poses that agree, those of a foot beside those of the base, are only told."""

    def wheels(frame: str, child: str, shift: int) -> list[Entry]:
        side = 0.0 if child in ("foot", "base_link") and frame == "odom" else 0.5
        found = [odometry(time + shift, 0.1 * row, side, 0.0) for row, time in enumerate(TIMES)]
        for entry in found:
            entry.fields["header"]["frame_id"], entry.fields["child_frame_id"] = frame, child
        return found

    both = [*wheels("odom", "base_link", 0), *wheels(*other, STEP // 2)]
    path, told = written(tmp_path, "ros1", sorted(both, key=lambda entry: entry.time)), list[str]()
    pieces = ("/odom, message 1", "odom to base_link (12)", f"{' to '.join(other)} (12)")
    if other[1] == "foot":
        assert opened(path, told, views=None).length == 24
        assert all(piece in told[0] for piece in (*pieces, "their poses agree"))
    else:
        cure = "--set recording.topics.odometry.frames=[odom,base_link]"
        refused(lambda: opened(path, views=None), *pieces, cure)
    one = opened(path, views=None, odometry={"topic": "/odom", "frames": ["odom", "base_link"]})
    assert one.length == 12


def test_a_frame_that_changes_once_is_cured_by_the_longer_part(tmp_path: Path, refused: Refused) -> None:
    found = [odometry(time, 0.1 * row + 0.4 * (row > 7), 0.0, 0.0) for row, time in enumerate(TIMES)]
    for row, entry in enumerate(found):
        entry.fields["header"]["frame_id"], entry.fields["child_frame_id"] = (
            "map" if row > 7 else "odom",
            "base",
        )
    path = written(tmp_path, "ros1", found)
    cure = f"recording.to={(TIMES[7] + TIMES[8] - 2 * TIMES[0]) / 2e9:.3f}"
    refused(lambda: opened(path, views=None), "/odom, message 8", "several frames", f"--set {cure}")
    assert opened(path, views=None, to=float(cure.split("=")[1])).length == 8


def test_numbers_that_cannot_be_are_refused(tmp_path: Path, refused: Refused) -> None:
    bad = [odometry(time, np.nan, 0.0, 0.0) for time in TIMES[3:5]]
    path, told = written(tmp_path, "ros1", [*WHEELS[:3], *bad, *WHEELS[5:]]), list[str]()
    refused(
        lambda: opened(path, views=None),
        "/odom, message 3",
        "the position is nan",
        "(so in 2 of 12 messages)",
    )
    path = written(tmp_path, "sqlite3-message", [*WHEELS[:3], bad[0], *WHEELS[4:]])
    assert opened(path, told, views=None).length == 11
    assert "message 3" in told[0]
    assert "1 of 12 messages are left out" in told[0]
    zero = pose(0.0, 0.0, 0.0) | {"orientation": {}}
    poses = [
        Entry("/pose", "geometry_msgs/msg/PoseStamped", TIMES[0], {"header": header(START), "pose": zero})
    ]
    path = written(tmp_path, "mcap", [*WHEELS, *poses])
    refused(
        lambda: opened(path, views=None, truth="/pose"), "/pose, message 0", "the orientation is 0, 0, 0, 0"
    )
    refused(lambda: opened(path, views=None, odometry="/pose"), "orientation is 0", "odometry.use=twist")
    far = [scan(time, np.full(18, 5000.0), -1.5, 0.1, range_max=1e5) for time in TIMES]
    path = written(tmp_path, "sqlite3", [*WHEELS, *far])
    cure = "recording.topics.views.max_range"
    refused(lambda: opened(path), "half of the ranges are over 5000 m", cure)


def test_topics_without_common_time_are_refused(tmp_path: Path, refused: Refused) -> None:
    later = [scan(time + 10**12, np.full(18, 1.0), -1.5, 0.1)._replace(time=time) for time in TIMES]
    path = written(tmp_path, "mcap", [*WHEELS, *later])
    refused(lambda: opened(path), "/scan: time is 1700001000.0 to", "times that overlap", "one clock")
    refused(lambda: opened(path, samples="views"), "times that overlap")
    assert opened(path, clock="bag").length == 12


def test_touch_that_does_not_fit_is_refused(tmp_path: Path, refused: Refused) -> None:
    def arrays(values: Sequence[float]) -> list[Entry]:
        return [Entry("/skin", "std_msgs/msg/Float32MultiArray", time, {"data": values}) for time in TIMES]

    touch = {"topic": "/skin", "rows": 2, "columns": 2}
    path = written(tmp_path, "mcap", [*WHEELS, *arrays([0.1, 0.2, 0.3])])
    refused(lambda: opened(path, views=None, touch=touch), "/skin, message 0", "3 values", "2 x 2")
    path = written(tmp_path, "ros1", [*WHEELS, *arrays([700, 800, 900, np.nan])])
    refused(lambda: opened(path, views=None, touch=touch), "message 0, at", "touch is nan", "(so in 12 of 12")
    path = written(tmp_path, "sqlite3", [*WHEELS, *arrays([700, 800, 900, 900])])
    refused(lambda: opened(path, views=None, touch=touch), "values from 700 to 900", "0 to 1")
    one = arrays([0.1, 0.2, 0.3, 0.4])
    for spoilt_by in ([0.1, 0.2, np.nan, 0.4], [0.1]):
        one[5] = arrays(spoilt_by)[5]
        told: list[str] = []
        path = written(tmp_path / str(len(spoilt_by)), "mcap", [*WHEELS, *one])
        seen = [bool(sample.reading.view_seen) for sample in opened(path, told, views=None, touch=touch)]
        assert (seen, len(told)) == ([row != 5 for row in range(12)], 1)


def test_empty_bags_are_refused(tmp_path: Path, refused: Refused) -> None:
    for kind in ("ros1", "sqlite3", "mcap"):
        path = written(tmp_path, kind, [])
        refused(lambda path=path: opened(path), "a bag without messages")
    (tmp_path / "folder").mkdir()
    refused(lambda: opened(tmp_path / "folder"), "is a folder without metadata.yaml")
    refused(lambda: opened(tmp_path / "none"), "no such file")


def test_the_parts_of_a_bag_are_one_recording(tmp_path: Path) -> None:
    """Of ROS 1 in a folder; a storage file without its folder, compressed messages included."""
    (tmp_path / "parts").mkdir()
    for number, part in enumerate((BOTH[12:], BOTH[:12])):
        (tmp_path / str(number)).mkdir()
        shutil.move(write_bag(tmp_path / str(number), "ros1", part), tmp_path / "parts" / f"{number}.bag")
    source = opened(tmp_path / "parts")
    assert source.length == 12
    for kind in ("sqlite3-message", "mcap"):
        folder = written(tmp_path, kind)
        (file,) = (path for path in folder.iterdir() if path.suffix != ".yaml")
        assert [sample.time for sample in opened(file)] == [sample.time for sample in source]


def test_the_command_refuses_a_bag_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, "ros1")
    path.write_bytes(path.read_bytes()[:-200])
    config = tmp_path / "run.yaml"
    config.write_text(f"recording: {{file: {path}, topics: {{odometry: /odom, views: /scan}}}}\n")
    assert main(["run", str(config), "-o", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()
    err = capsys.readouterr().err
    assert "Traceback" not in err
    assert "cannot be read as a bag" in err
    assert len(err.strip().splitlines()) == 1


RING = [scan(time, np.linspace(1 + 0.1 * row, 4, 36), -np.pi, np.pi / 18) for row, time in enumerate(TIMES)]
MOUNT = tf(START, transform(START, "base_link", "laser", 0, 0, quaternion(np.pi / 2)), topic="/tf_static")
INDEX: dict[str, dict[str, Any]] = {
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
def test_an_mcap_is_read_whole_whatever_its_index(case: str, tmp_path: Path) -> None:
    """The mount of the ring is read while the ring is; messages may be stored out of order."""
    options = dict(INDEX[case])
    disorder = options.pop("disorder", 0)
    folder = written(tmp_path, "mcap", sorted([*WHEELS, *RING, MOUNT], key=lambda entry: entry.time))
    with (folder / "run.mcap").open("rb") as old, (tmp_path / "copy.mcap").open("wb") as new:
        out, ids = Writer(new, chunk_size=2000, **options), dict[int, int]()
        out.start(profile="ros2", library="test")
        messages = list(make_reader(old).iter_messages())
        for schema, channel, message in [*messages[disorder:], *messages[:disorder]]:
            assert schema is not None
            if channel.id not in ids:
                kind = out.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = out.register_channel(channel.topic, "cdr", kind, channel.metadata)
            out.add_message(ids[channel.id], message.log_time, message.data, message.publish_time)
        out.finish()
    told: list[str] = []
    found, right = (list(opened(path, told)) for path in (tmp_path / "copy.mcap", folder))
    assert [sample.time for sample in found] == [sample.time for sample in right]
    assert all(np.array_equal(a.reading.view, b.reading.view) for a, b in zip(found, right, strict=True))
    assert all(sample.reading.view_seen for sample in found)
    assert told == []


@pytest.mark.parametrize("fan", [False, True])
def test_two_lasers_on_one_topic_have_their_own_mounts(fan: bool, tmp_path: Path) -> None:
    """One looks ahead, the other back; an unknown mount is told once."""
    rear = tf(START, transform(START, "base_link", "rear", 0, 0, quaternion(np.pi)), topic="/tf_static")
    front = tf(START, transform(START, "base_link", "laser", 0, 0, quaternion(0.0)), topic="/tf_static")
    ranges, entries = np.linspace(1, 4, 36), [*WHEELS, front, rear]
    for row, time in enumerate(TIMES):
        seen = np.roll(ranges, 18) if row % 2 else ranges
        entry = scan(time, seen[:-9] if fan else seen, -np.pi, np.pi / 18)
        entry.fields["header"]["frame_id"] = "rear" if row % 2 else "laser"
        entries.append(entry)
    entries.sort(key=lambda entry: entry.time)
    for known in (True, False):
        path = written(tmp_path / str(known), "mcap", [entry for entry in entries if known or entry != rear])
        told: list[str] = []
        span = {"topic": "/scan", "span": [-np.pi, np.pi]} if fan else "/scan"
        one, two = (sample.reading.view for sample in list(opened(path, told, views=span))[:2])
        assert len(told) == (not known)
        assert known or "no transform from base_link to rear" in told[0]
        inside = slice(9, 13) if fan else slice(None)
        assert np.allclose(one.ravel()[inside], two.ravel()[inside]) == known


METADATA: dict[str, tuple[str, str, str | None]] = {
    "more than there are": ("message_count: 12", "message_count: 15", "12 of 15 messages were read"),
    "fewer": ("message_count: 12", "message_count: 3", None),
    "none": ("message_count: 12", "message_count: 0", None),
    "no storage": ("storage_identifier: sqlite3", 'storage_identifier: ""', None),
    "another file": ("- run.db3", "- run.db3", "copy.db3 is not in metadata.yaml"),
}


@pytest.mark.parametrize("case", METADATA)
def test_what_is_not_read_is_said(case: str, tmp_path: Path) -> None:
    old, new, expected = METADATA[case]
    folder = written(tmp_path, "sqlite3")
    text = (folder / "metadata.yaml").read_text()
    assert old in text
    (folder / "metadata.yaml").write_text(text.replace(old, new))
    if case == "another file":
        shutil.copy(folder / "run.db3", folder / "copy.db3")
    told: list[str] = []
    assert opened(folder / "metadata.yaml", told).length == 12
    assert (expected is None) == (not told), told
    assert expected is None or expected in told[0]


def container(path: Path, profile: str, encoding: str, schema: str) -> None:
    with path.open("wb") as file:
        out = Writer(file)
        out.start(profile=profile, library="test")
        kind = out.register_schema("nav_msgs/msg/Odometry", schema, b"{}")
        out.add_message(out.register_channel("/odom", encoding, kind), 1, b"{}", 1)
        out.finish()


@pytest.mark.parametrize(
    "case", [("ros1", "ros1", "ros1msg"), ("", "json", "jsonschema"), ("ros2", "json", "jsonschema")]
)
def test_other_containers_are_named(case: tuple[str, str, str], tmp_path: Path, refused: Refused) -> None:
    path = tmp_path / "other.mcap"
    container(path, *case)
    for read in (opened, describe_bag):
        refused(
            lambda read=read: read(path), f"of profile {case[0] or 'none'} with", case[1], "rosbags-convert"
        )


def test_a_cut_mcap_is_called_a_cut_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = written(tmp_path, "mcap") / "run.mcap"
    whole = file.read_bytes()
    for share in (0.3, 0.7, 0.95):
        file.write_bytes(whole[: int(share * len(whole))])
        for command in (
            ["doctor", str(file)],
            ["tools", "recover", str(file), "-o", str(tmp_path / "new.mcap")],
        ):
            assert main(command) == 2
            error = capsys.readouterr().err
            assert "a ROS 2 bag that is cut off" in error
            assert "`mcap recover run.mcap" in error


def spoilt(name: str, number: int) -> list[Entry]:
    """Many messages of which one is spoilt."""
    entry = (RING * 3)[number]
    fields = {
        "angles": {"angle_increment": np.nan},
        "beams": {"ranges": np.zeros(0, np.float32)},
        "few": {"ranges": np.ones(5, np.float32)},
    }[name]
    return [entry._replace(fields=dict(entry.fields) | fields)]


@pytest.mark.parametrize("number", [0, 7])
@pytest.mark.parametrize("case", ["angles", "beams", "few", "cut", "zero turn", "nan turn"])
def test_one_bad_message_is_left_out(case: str, number: int, tmp_path: Path) -> None:
    ring, links = list(RING), [MOUNT] * 2
    if case.endswith("turn"):
        turn = quaternion(0.0) | {"w": 0.0 if case == "zero turn" else np.nan}
        links[number > 0] = tf(START, transform(START, "base_link", "laser", 0, 0, turn), topic="/tf_static")
    elif case != "cut":
        ring[number : number + 1] = spoilt(case, number)
    entries = sorted([*links, *WHEELS, *ring], key=lambda entry: entry.time)
    path = written(tmp_path, "sqlite3", entries)
    if case == "cut":
        with sqlite3.connect(path / "run.db3") as base:
            rows = base.execute("select m.id from messages m join topics t on m.topic_id = t.id "
                                "where t.name = '/scan' order by timestamp").fetchall()  # fmt: skip
            base.execute("update messages set data = substr(data, 1, 60) where id = ?", rows[number])
    told: list[str] = []
    seen = [bool(sample.reading.view_seen) for sample in opened(path, told)]
    assert len(told) == 1
    assert "1 of" in told[0]
    if case.endswith("turn"):
        assert seen == [True] * 12
    else:
        assert f"message {number}, at" in told[0] or "less than half of the sectors" in told[0]
        assert seen == [row != number for row in range(12)]
    views = suggested_topics(describe_bag(path))["views"]
    assert views == (
        {"topic": "/scan", "span": [-3.1416, 3.1416]} if (case, number) == ("few", 0) else "/scan"
    )


def test_many_bad_messages_are_refused(tmp_path: Path, refused: Refused) -> None:
    ring = [*spoilt("angles", 0), *spoilt("angles", 1), *RING[2:]]
    path = written(tmp_path, "mcap", [*WHEELS, *ring])
    refused(lambda: opened(path), "/scan, message 0, at", "angle_min is", "(so in 2 of 12 messages)")
