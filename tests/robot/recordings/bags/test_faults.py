"""Bags that cannot be read, and settings that do not fit: one clear error each, or a warning."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ratslam.__main__ import main
from robot.recordings.bags.description import describe_bag
from robot.recordings.formats import RecordingConfig, open_recording
from robot.sources.source import Source
from tactile.base import bounded
from tactile.base.errors import InputError
from tests.helpers.ros_bags import Entry, header, odometry, pose, scan, tf, transform, write_bag

START, STEP = 1_700_000_000_000_000_000, 100_000_000  # ns
TIMES = [START + STEP * row for row in range(12)]
WHEELS = [odometry(time, 0.1 * row, 0.0, 0.05 * row) for row, time in enumerate(TIMES)]
SCANS = [scan(time, np.arange(1, 19) * 0.25, -1.5, 3.0 / 18) for time in TIMES]
BOTH = sorted([*WHEELS, *SCANS], key=lambda entry: entry.time)
TOPICS = {"odometry": "/odom", "views": "/scan"}
MEMORY = 4 << 30  # bytes of address space beyond those in use
Refused = Callable[..., InputError]


def opened(path: Path, told: list[str] | None = None, **topics: Any) -> Source:
    config = RecordingConfig.model_validate({"file": path, "topics": TOPICS | topics})
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
    "zero": ([0, *TIMES[1:]], ["/odom, message 0", "the stamp is 0 (in 1 of 12", "recording.topics.clock"]),
    "back": ([*TIMES[:6], TIMES[2], *TIMES[7:]],
             ["message 6", "goes back from 1700000000.500000000 to 1700000000.200000000 s", "clock to bag"]),
}  # fmt: skip


@pytest.mark.parametrize("case", STAMPS)
def test_disorder_is_refused_and_the_bag_time_cures_it(case: str, tmp_path: Path, refused: Refused) -> None:
    stamps, pieces = STAMPS[case]
    path = written(tmp_path, "sqlite3", with_stamps(stamps))
    refused(lambda: opened(path, views=None), *pieces)
    assert opened(path, views=None, clock="bag").length == 12


def test_equal_stamps_gaps_and_jumps_are_reported(tmp_path: Path) -> None:
    stamps = [*TIMES[:5], *TIMES[4:7], *(time + 5 * 10**9 for time in TIMES[7:])]
    entries = with_stamps(stamps)
    leap = odometry(entries[-1].time + 1, 99.0, 0.0, 0.0)
    leap.fields["header"]["stamp"].update(header(TIMES[-1] + 6 * 10**9)["stamp"])
    told: list[str] = []
    path = written(tmp_path, "mcap", [*entries, leap])
    assert opened(path, told, views=None).length == 12
    repeated, gap, jump = (sentence.removeprefix(f"{path}, /odom: ") for sentence in told)
    assert repeated.startswith("1 of 13 messages repeat the stamp of the message before, the first at 17000")
    assert gap == "nothing for 5.1 s from 1700000000.600000000 s on, the longest of 2 gaps"
    assert jump.startswith("jumps by 97.9 m in 1.1 s at 1700000007.100 s, the largest of 1 steps faster than")


def test_numbers_that_cannot_be_are_refused(tmp_path: Path, refused: Refused) -> None:
    bad = [*WHEELS[:3], odometry(TIMES[3], np.nan, 0.0, 0.0), *WHEELS[4:]]
    path = written(tmp_path, "ros1", bad)
    refused(lambda: opened(path, views=None), "/odom, message 3", "odometry is nan", "a finite number")
    zero = pose(0.0, 0.0, 0.0) | {"orientation": {}}
    poses = [
        Entry("/pose", "geometry_msgs/msg/PoseStamped", TIMES[0], {"header": header(START), "pose": zero})
    ]
    path = written(tmp_path, "mcap", [*WHEELS, *poses])
    refused(
        lambda: opened(path, views=None, truth="/pose"), "/pose, message 0", "the orientation is 0, 0, 0, 0"
    )
    refused(lambda: opened(path, views=None, odometry="/pose"), "orientation is 0")
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
    refused(lambda: opened(path, views=None, touch=touch), "values from 700 to 900", "0 to 1", "touch is nan")


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
