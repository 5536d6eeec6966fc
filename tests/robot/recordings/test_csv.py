"""CSV recordings: configured columns are read, and every error names file and line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.recordings.csv_alignment import labels_from_pairs
from robot.recordings.csv_config import (
    ContactColumns,
    CsvConfig,
    LabelColumns,
    MotionColumns,
    PairColumns,
    PoseColumns,
    TruthColumns,
    VelocityColumns,
    ViewColumns,
)
from robot.recordings.csv_file import read_csv
from robot.recordings.csv_reader import read_csv_recording
from robot.recordings.npz_trace import read_trace
from robot.sources.in_memory import truncate_log
from robot.sources.source import Source
from tactile.base.errors import InputError, InputErrors
from tactile.base.se2 import integrate

VELOCITY = CsvConfig(velocity=VelocityColumns(), rows=1, columns=3)
ODOMETRY = "t,vx,w\n0.0,0.2,0.0\n0.5,0.2,0.1\n1.0,0.2,0.0\n1.5,0.2,0.0\n"
Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes a file with this content."""

    def to_file(content: str, name: str = "odometry.csv") -> Path:
        path = tmp_path / name
        path.write_text(content)
        return path

    return to_file


def with_parts(**parts: Any) -> CsvConfig:
    return VELOCITY.model_copy(update=parts)


def test_velocities_are_integrated_along_the_mid_heading(write: Write) -> None:
    source = read_csv_recording(write(ODOMETRY), VELOCITY)
    assert isinstance(source, Source)
    assert (source.name, source.length, source.rate_hz, source.view_shape) == ("odometry", 4, 2.0, (1, 3, 1))
    odometry = [sample.reading.odometry for sample in source]
    assert tuple(odometry[0]) == (0, 0, 0, 0)
    assert tuple(odometry[1]) == pytest.approx((0.1 * np.cos(0.025), 0.1 * np.sin(0.025), 0.05, 0.5))
    assert tuple(odometry[2]) == pytest.approx((0.1, 0, 0, 0.5))


def test_poses_are_differenced(write: Write) -> None:
    path = write("time, px, py, th\n1,0,0,1.5707963267948966\n2,0,1,1.5707963267948966\n3,-0.5,1,3.3\n")
    config = CsvConfig(time="time", pose=PoseColumns(x="px", y="py", heading="th"))
    odometry = [sample.reading.odometry for sample in read_csv_recording(path, config)]
    assert tuple(odometry[1]) == pytest.approx((1, 0, 0, 1))
    assert tuple(odometry[2]) == pytest.approx((0, 0.5, 3.3 - np.pi / 2, 1))  # sideways


def test_ranges_are_averaged_to_pixels(write: Write) -> None:
    path = write("t,vx,w,r0,r1,r2,r3,r4,r5\n0,0.1,0,1,3,8,9,inf,4\n1,0.1,0,,,,,,\n")
    first, second = read_csv_recording(path, with_parts(views=ViewColumns(max_range=8.0)))
    assert first.reading.view.ravel().tolist() == [0.25, 1.0, 0.75]
    assert not second.reading.view_seen
    assert second.reading.view.shape == (1, 3, 1)


def test_views_of_another_file_are_assigned_to_the_nearest_row(write: Write) -> None:
    views = write("stamp,p2,p1,p3\n0.1,.2,.1,.3\n0.9,.5,.4,.6\n", "views.csv")
    config = with_parts(views=ViewColumns(file=views, time="stamp", prefix="p", tolerance=0.11))
    samples = list(read_csv_recording(write(ODOMETRY), config))
    assert [bool(sample.reading.view_seen) for sample in samples] == [True, False, True, False]
    assert samples[2].reading.view.ravel().tolist() == [0.4, 0.5, 0.6]


def test_contacts_lie_at_the_radius_in_the_direction_of_their_sensors(write: Write) -> None:
    file = write("t,right,left\n0.45,0,1\n1.1,1,1\n", "bumps.csv")
    part = ContactColumns(file=file, directions={"left": 90.0, "right": -90.0}, distance=0.2)
    source = read_csv_recording(write(ODOMETRY), with_parts(contacts=part))
    assert source.whiskers == 2
    readings = [sample.reading for sample in source]
    assert [reading.contact.tolist() for reading in readings] == [[0, 0], [1, 0], [1, 1], [0, 0]]
    assert readings[2].point == pytest.approx(np.array([[0.0, 0.2], [0.0, -0.2]]))
    assert not readings[1].point[1].any()
    sensors = source.info.planar_whiskers
    assert sensors is not None
    assert (sensors.mounts, sensors.length) == (((0, 0, 90), (0, 0, -90)), 0.2)
    assert not source.info.raw_whiskers
    again = truncate_log(source, 2)
    assert [sample.reading.contact.any() for sample in again] == [False, True]


def test_labels_in_the_odometry_file(write: Write) -> None:
    path = write("t,vx,w,place\n0,0.1,0,3\n1,0.1,0,\n2,0.1,0,-1\n3,0.1,0,0\n")
    samples = read_csv_recording(path, with_parts(labels=LabelColumns(column="place")))
    assert [int(sample.reading.label) for sample in samples] == [3, -1, -1, 0]
    assert not any(sample.reading.view_seen for sample in samples)


def test_labels_from_a_file_and_from_pairs(write: Write) -> None:
    labels = write("t,label\n0.51,7\n1.49,8\n", "labels.csv")
    samples = read_csv_recording(write(ODOMETRY), with_parts(labels=LabelColumns(file=labels)))
    assert [int(sample.reading.label) for sample in samples] == [-1, 7, -1, 8]
    pairs = write("t1,t2,score\n1.0,0.5,0.9\n1.5,1.0,0.7\n", "pairs.csv")
    samples = read_csv_recording(write(ODOMETRY), with_parts(pairs=PairColumns(file=pairs)))
    assert [int(sample.reading.label) for sample in samples] == [-1, 0, 0, 1]


@given(st.lists(st.tuples(st.integers(0, 8), st.integers(1, 8), st.sampled_from([0.5, 0.75, 0.8, 0.9]))))
def test_labels_follow_the_best_earlier_match(triples: list[tuple[int, int, float]]) -> None:
    later = [float(earlier + gap) for earlier, gap, _ in triples]
    earlier = [float(earlier) for earlier, _, _ in triples]
    score = [score for *_, score in triples]
    time, label = labels_from_pairs(later, earlier, score, 0.75)
    assert time.tolist() == sorted({*later, *earlier})
    ids = dict(zip(time.tolist(), label.tolist(), strict=True))
    new = 0
    for moment in time.tolist():
        matches = [(s, -i, e) for i, (t, e, s) in enumerate(zip(later, earlier, score, strict=True))
                   if t == moment and s >= 0.75]  # fmt: skip
        assert ids[moment] == (ids[max(matches)[2]] if matches else new)
        new += not matches


def test_truth_is_interpolated_and_unwrapped(write: Write) -> None:
    truth = write("t,x,y,heading\n0.25,0,0,3.0\n1.25,1,2,-3.0\n", "truth.csv")
    samples = list(read_csv_recording(write(ODOMETRY), with_parts(truth=TruthColumns(file=truth))))
    assert [sample.truth is None for sample in samples] == [True, False, False, True]
    assert samples[1].truth == pytest.approx([0.25, 0.5, 3.0 + 0.25 * (2 * np.pi - 6)])
    assert samples[2].truth == pytest.approx([0.75, 1.5, 3.0 + 0.75 * (2 * np.pi - 6)])


def test_truth_in_the_odometry_file(write: Write) -> None:
    path = write("t,vx,w,x,y,heading\n0,0.1,0,1,2,3\n1,0.1,0,1.1,2,3\n")
    samples = list(read_csv_recording(path, with_parts(truth=TruthColumns())))
    assert [sample.truth.tolist() for sample in samples if sample.truth is not None] == [
        [1, 2, 3],
        [1.1, 2, 3],
    ]


def test_the_digest_covers_every_file(write: Write) -> None:
    truth = write("t,x,y,heading\n0,0,0,0\n2,1,0,0\n", "truth.csv")
    config = with_parts(truth=TruthColumns(file=truth))
    one = read_csv_recording(write(ODOMETRY), config).digest
    truth.write_text("t,x,y,heading\n0,0,0,0\n2,1,0,0.0\n")
    assert read_csv_recording(write(ODOMETRY), config).digest != one
    assert read_csv_recording(write(ODOMETRY), VELOCITY).digest != one


def test_motions_equal_velocities_times_their_duration(write: Write) -> None:
    """The steps of `ODOMETRY` last half a second; the first row only sets the clock."""
    rows = "t,distance,turn\n0.0,9.0,1.0\n0.5,0.1,0.05\n1.0,0.1,0.0\n1.5,0.1,0.0\n"
    config = VELOCITY.model_copy(update={"velocity": None, "motion": MotionColumns()})
    motions = read_csv_recording(write(rows, "motions.csv"), config).motion
    np.testing.assert_allclose(motions, read_csv_recording(write(ODOMETRY), VELOCITY).motion, atol=1e-15)


def test_the_lecture_hall_csv_equals_its_reference_trace(reference_data: Path) -> None:
    """Every label of the reference stream follows from the pairs; truth differs by rounding in the files."""
    data = reference_data / "data"
    config = CsvConfig(
        velocity=VelocityColumns(left="vy"),
        pairs=PairColumns(file=data / "tuc_lecture_hall_loops.csv"),
        truth=TruthColumns(file=data / "tuc_lecture_hall_gt.csv", heading="th"),
    )
    log = read_csv_recording(data / "tuc_lecture_hall_odom.csv", config)
    stream = read_trace(reference_data / "traces" / "f_real_tuc_lecture_hall.npz")
    assert (log.label >= 0).sum() == 551
    np.testing.assert_array_equal(log.label, stream.label)
    np.testing.assert_allclose(log.time, stream.time - 100, atol=1e-9)
    assert log.truth is not None
    assert stream.truth is not None
    known = ~np.isnan(log.truth).any(axis=1)
    assert known.sum() == len(known) - 2  # the truth ends 0.19 s before the odometry
    np.testing.assert_allclose(log.truth[known], stream.truth[known], atol=1e-6)


def test_the_intel_laser_csv_equals_its_reference_trace(reference_data: Path) -> None:
    """180 beams as 3 x 6 pixels, equal in every bit; the sideways part of the motion is kept."""
    data = reference_data / "data"
    config = CsvConfig(
        pose=PoseColumns(x="odo_x", y="odo_y", heading="odo_th"),
        views=ViewColumns(file=data / "intel_scans.csv", max_range=8.0),
        truth=TruthColumns(x="gt_x", y="gt_y", heading="gt_th"),
    )
    log = read_csv_recording(data / "intel_odom_gt.csv", config)
    stream = read_trace(reference_data / "traces" / "f_real_intel_laser3x6.npz")
    np.testing.assert_array_equal(log.views, stream.views)
    np.testing.assert_array_equal(log.time, stream.time)
    assert log.truth is not None
    poses = np.loadtxt(data / "intel_odom_gt.csv", delimiter=",", skiprows=1)[:, 1:4]
    np.testing.assert_allclose(integrate(log.motion[:, :3], poses[0])[:, :2], poses[:, :2], atol=1e-9)
    side = np.abs(log.motion[:, 1])
    assert side.max() > 0.1


RANGES = ViewColumns(max_range=8)
LEFT = ContactColumns(directions={"left": 45.0})
FAULTS: dict[str, tuple[str, dict[str, Any], list[str]]] = {
    "column": ("t,vxs,w\n0,1,0\n", {}, [":1: no column 'vx'", "among 't', 'vxs', 'w'", "mean 'vxs'?"]),
    "key": ("stamp,vx,w\n0,1,0\n", {}, [":1: no column 't'", "name the column with table.time"]),
    "word": ("t,vx,w\n0,1,0\n1,fast,0\n", {}, [":3: vx is 'fast'", "expected a number"]),
    "empty": ("t,vx,w\n0,1,0\n\n1,,0\n", {}, [":4: vx is empty", "a number"]),
    "nan": ("t,vx,w\n0,1,0\n1,nan,0\n", {}, [":3: vx is nan", "a finite number"]),
    "inf": ("t,vx,w\n0,1,0\n1,1,-inf\n", {}, [":3: w is -inf"]),
    "time": ("t,vx,w\n0,1,0\nnan,1,0\n", {}, [":3: t is nan"]),
    "cut row": ("t,vx,w\n0,1,0\n1,1", {}, [":3: 2 cells", "3, as in the header", "cut off"]),
    "backwards": ("t,vx,w\n0,1,0\n2,1,0\n1,1,0\n", {}, [":4: t goes back from 2.0 to 1.0 s", "sort"]),
    "repeated": ("t,vx,w\n0,1,0\n2,1,0\n2,1,0\n", {}, [":4: t repeats 2.0 s", "drop the repeated rows"]),
    "no rows": ("t,vx,w\n", {}, ["no rows under its header", "at least one row"]),
    "no header": ("0,1,2\n1,1,2\n", {}, [":1: the first line is '0,1,2'", "a header row"]),
    "doubled": ("t,vx,vx,w\n0,1,1,0\n", {}, [":1: several columns are called 'vx'", "once"]),
    "semicolons": ("t;vx;w\n0;1;0\n", {}, ["separated by semicolons", "commas"]),
    "tabs": ("t\tvx\tw\n0\t1\t0\n", {}, ["separated by tabs"]),
    "neither": (ODOMETRY, {"velocity": None}, ["none of table.pose, table.velocity", "among t, vx, w"]),
    "both": (ODOMETRY, {"pose": PoseColumns()}, ["more than one of table.pose", "one of them"]),
    "no views": (ODOMETRY, {"views": ViewColumns()}, ["no column 'r0'", "table.views.prefix"]),
    "gap": ("t,vx,w,r0,r2\n0,1,0,1,1\n", {"views": ViewColumns()}, ["no column 'r1'", "'r0', 'r2'"]),
    "pixels": ("t,vx,w,r0,r1\n0,1,0,1,1\n", {"views": ViewColumns()}, ["2 columns r0", "3 (table.rows 1 x"]),
    "beams": ("t,vx,w,r0,r1\n0,1,0,1,1\n", {"views": ViewColumns(max_range=8)}, ["or a multiple"]),
    "bytes": ("t,vx,w,r0,r1,r2\n0,1,0,0,9,200\n", {"views": ViewColumns()}, [":2: r* holds 200.0", "by 255"]),
    "half view": ("t,vx,w,r0,r1,r2\n0,1,0,0,,1\n", {"views": ViewColumns()}, [":2: r* is nan"]),
    "behind": ("t,vx,w,r0,r1,r2\n0,1,0,0,-1,1\n", {"views": RANGES}, [":2: r* is -1.0", "0 m or more"]),
    "mm": ("t,vx,w,r0,r1,r2\n0,1,0,900,800,700\n", {"views": RANGES}, ["over 800 m", "by 1000"]),
    "bumper": ("t,vx,w,left\n0,1,0,2\n", {"contacts": LEFT}, [":2: left is 2", "1 in contact, 0 without"]),
    "no bumper": ("t,vx,w\n0,1,0\n", {"contacts": LEFT}, ["no column 'left'", "table.contacts.directions"]),
    "bumper nan": ("t,vx,w,left\n0,1,0,nan\n", {"contacts": LEFT}, [":2: left is nan"]),
    "label": ("t,vx,w,label\n0,1,0,1.5\n", {"labels": LabelColumns()}, [":2: label is 1.5", "an integer"]),
    "truth": ("t,vx,w,x,y,heading\n0,1,0,1,,1\n", {"truth": TruthColumns()}, [":2: y is empty"]),
}  # fmt: skip


@pytest.mark.parametrize(("content", "parts", "pieces"), FAULTS.values(), ids=FAULTS.keys())
def test_faulty_values_are_refused(
    content: str, parts: dict[str, Any], pieces: list[str], write: Write, refused: Callable[..., InputError]
) -> None:
    path = write(content)
    refused(lambda: read_csv_recording(path, with_parts(**parts)), str(path), *pieces)


OTHERS: dict[str, tuple[str, Callable[[Path], dict[str, Any]], list[str]]] = {
    "far view": ("t,r0,r1,r2\n0,0,0,0\n9,0,0,0\n", lambda p: {"views": ViewColumns(file=p)},
                 [":3: the nearest odometry row is 7.5 s away (one of 1", "at most 0.5 s", "raise"]),
    "two views": ("t,r0,r1,r2\n0.9,0,0,0\n1.1,0,0,0\n", lambda p: {"views": ViewColumns(file=p)},
                  [":3: belongs to the same odometry row", "thin them out"]),
    "view time": ("t,r0,r1,r2\n1,0,0,0\n0.5,0,0,0\n", lambda p: {"views": ViewColumns(file=p)},
                  [":3: t goes back"]),
    "exact": ("t,label\n0.1,0\n", lambda p: {"labels": LabelColumns(file=p, tolerance=0)}, ["at most 0 s"]),
    "pair": ("t1,t2,score\n0.5,1,0.9\n", lambda p: {"pairs": PairColumns(file=p)},
             [":2: t1 0.5 is not after t2 1.0", "the later time of a pair first", "swap table.pairs.later"]),
    "score": ("t1,t2,score\n1,0.5,nan\n", lambda p: {"pairs": PairColumns(file=p)}, [":2: score is nan"]),
    "pair time": ("t1,t2,score\n9,0.5,1\n", lambda p: {"pairs": PairColumns(file=p)}, ["time 9.0: the near"]),
    "pair column": ("t1,t2,scores\n9,0.5,1\n", lambda p: {"pairs": PairColumns(file=p)},
                    [":1: no column 'score'", "did you mean 'scores'?"]),
    "both": ("t1,t2,score\n1,0.5,1\n", lambda p: {"pairs": PairColumns(file=p), "labels": LabelColumns()},
             ["both table.labels and table.pairs"]),
    "far bumper": ("t,left,front,right\n9,0,0,0\n", lambda p: {"contacts": ContactColumns(file=p)},
                   [":2: the nearest odometry row is 7.5 s away"]),
    "truth clock": ("t,x,y,heading\n0,0,0,0\n0,1,0,0\n", lambda p: {"truth": TruthColumns(file=p)},
                    [":3: t repeats 0.0 s"]),
    "truth elsewhen": ("t,x,y,heading\n50,0,0,0\n60,1,0,0\n", lambda p: {"truth": TruthColumns(file=p)},
                       ["t is 50.0 to 60.0 s, the odometry's 0.0 to 1.5", "times that overlap", "one clock"]),
    "truth time": ("t,x,y,heading\n0,0,0,0\n,1,0,0\n", lambda p: {"truth": TruthColumns(file=p)},
                   [":3: t is empty"]),
}  # fmt: skip


@pytest.mark.parametrize(("content", "parts", "pieces"), OTHERS.values(), ids=OTHERS.keys())
def test_faulty_values_in_other_files_are_refused(
    content: str,
    parts: Callable[[Path], dict[str, Any]],
    pieces: list[str],
    write: Write,
    refused: Callable[..., InputError],
) -> None:
    path = write(content, "other.csv")
    refused(lambda: read_csv_recording(write(ODOMETRY), with_parts(**parts(path))), *pieces)


def test_all_errors_are_reported_together(write: Write, refused: Callable[..., InputError]) -> None:
    path = write("t,vx,w,r0,r1,r2\n0,1,0,0,0,0\n1,nan,0,0,0,300\n1,1,0,0,0,0\n")
    error = refused(
        lambda: read_csv_recording(path, with_parts(views=ViewColumns())), "vx is nan", "repeats", "300.0"
    )
    assert isinstance(error, InputErrors)
    assert len(error.errors) == 3
    path = write("t,vx,w\n" + "0,x,1\n" * 20)
    error = refused(lambda: read_csv_recording(path, VELOCITY), ":9:", "12 more faults like these")
    assert str(error).count("\n") == 8


@given(st.text(max_size=200) | st.binary(max_size=200))
def test_any_text_is_read_or_gives_one_error(tmp_path_factory: Any, text: str | bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    for content in (text, b"t,vx,w\n" + text if isinstance(text, bytes) else "t,vx,w\n" + text):
        data = content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass")
        path.write_bytes(data)
        message = str(path)
        try:
            read_csv_recording(path, VELOCITY)
        except InputError as error:
            message = str(error)
        assert str(path) in message


def test_line_numbers_count_empty_lines(write: Write) -> None:
    file = read_csv(write("\ufefft,x\r\n\r\n1,2\r\n \r\n3,4"))
    assert file.names == ("t", "x")
    assert file.values.tolist() == [[1, 2], [3, 4]]
    assert [file.place(row).rsplit(":", 1)[1] for row in (0, 1)] == ["3", "5"]
    quoted = read_csv(write('"t","x"\n"1","2"\n'))
    assert quoted.values.tolist() == [[1, 2]]
