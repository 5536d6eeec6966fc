"""CSV recordings: configured columns are read, and every error names file and line."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.recordings.csv_config import CsvConfig
from robot.recordings.csv_description import describe_csv
from robot.recordings.csv_file import read_csv
from robot.recordings.csv_reader import read_csv_recording
from robot.recordings.input_judge import InputJudge
from robot.recordings.npz_trace import read_trace
from robot.sources.in_memory import truncate_log
from robot.sources.odometry import from_poses
from tactile.base.errors import InputErrors
from tactile.base.se2 import integrate

ODOMETRY = "t,vx,w\n0.0,0.2,0.0\n0.5,0.2,0.1\n1.0,0.2,0.0\n1.5,0.2,0.0\n"


@pytest.fixture
def write(tmp_path):
    def to_file(content, name="odometry.csv"):
        path = tmp_path / name
        path.write_text(content)
        return path

    return to_file


def read(path, warn=None, **parts):
    """Reads velocities, or another odometry if `parts` name one, with three pixels a view."""
    table = {"rows": 1, "columns": 3} | ({} if {"pose", "motion"} & set(parts) else {"velocity": {}}) | parts
    return read_csv_recording(path, CsvConfig.model_validate(table), InputJudge(warn=warn))


def test_velocities_are_integrated_along_the_mid_heading(write):
    source = read(write(ODOMETRY))
    assert (source.name, source.length, source.rate_hz, source.view_shape) == ("odometry", 4, 2.0, (1, 3, 1))
    odometry = [sample.reading.odometry for sample in source]
    assert tuple(odometry[0]) == (0, 0, 0, 0)
    assert tuple(odometry[1]) == pytest.approx((0.1 * np.cos(0.025), 0.1 * np.sin(0.025), 0.05, 0.5))
    assert tuple(odometry[2]) == pytest.approx((0.1, 0, 0, 0.5))
    # Motions equal velocities times their duration; the first row only sets the clock.
    rows = "t,distance,turn\n0.0,9.0,1.0\n0.5,0.1,0.05\n1.0,0.1,0.0\n1.5,0.1,0.0\n"
    np.testing.assert_allclose(read(write(rows, "motions.csv"), motion={}).motion, source.motion, atol=1e-15)


def test_views_are_averages_of_ranges_or_pixels_of_another_file(write):
    path = write("t,vx,w,r0,r1,r2,r3,r4,r5\n0,0.1,0,1,3,8,9,inf,4\n1,0.1,0,,,,,,\n")
    source = read(path, views={"max_range": 8.0})
    assert source.views[0].ravel().tolist() == [0.25, 1.0, 0.75]
    assert source.seen.tolist() == [True, False]
    views = write("stamp,p2,p1,p3\n0.1,.2,.1,.3\n0.9,.5,.4,.6\n", "views.csv")
    part = {"file": views, "time": "stamp", "prefix": "p", "tolerance": 0.11}
    source = read(write(ODOMETRY), views=part)
    assert source.seen.tolist() == [True, False, True, False]
    assert source.views[2].ravel().tolist() == [0.4, 0.5, 0.6]


def test_contacts_lie_at_the_radius_in_the_direction_of_their_sensors(write):
    file = write("t,right,left\n0.45,0,1\n1.1,1,1\n", "bumps.csv")
    part = {"file": file, "directions": {"left": 90.0, "right": -90.0}, "distance": 0.2}
    source = read(write(ODOMETRY), contacts=part)
    assert source.whiskers == 2
    readings = [sample.reading for sample in source]
    assert [reading.contact.tolist() for reading in readings] == [[0, 0], [1, 0], [1, 1], [0, 0]]
    assert readings[2].point == pytest.approx(np.array([[0.0, 0.2], [0.0, -0.2]]))
    assert not readings[1].point[1].any()
    sensors = source.info.planar_whiskers
    assert (sensors.mounts, sensors.length) == (((0, 0, 90), (0, 0, -90)), 0.2)
    assert not source.info.raw_whiskers
    again = truncate_log(source, 2)
    assert [sample.reading.contact.any() for sample in again] == [False, True]


def test_labels_of_the_odometry_file_and_of_another(write):
    path = write("t,vx,w,place\n0,0.1,0,3\n1,0.1,0,\n2,0.1,0,-1\n3,0.1,0,0\n")
    source = read(path, labels={"column": "place"})
    assert source.label.tolist() == [3, -1, -1, 0]
    assert not source.seen.any()
    labels = write("t,label\n0.51,7\n1.49,8\n", "labels.csv")
    assert read(write(ODOMETRY), labels={"file": labels}).label.tolist() == [-1, 7, -1, 8]


PAIRS = st.tuples(st.integers(0, 8), st.integers(1, 8), st.sampled_from([0.5, 0.75, 0.8, 0.9]))


@given(st.lists(PAIRS, min_size=1))
def test_labels_follow_the_best_earlier_match(tmp_path_factory, triples):
    odometry, pairs = (tmp_path_factory.getbasetemp() / name for name in ("o.csv", "pairs.csv"))
    odometry.write_text("t,vx,w\n" + "".join(f"{t},0.1,0\n" for t in range(17)))
    lines = [f"{earlier + gap},{earlier},{score}\n" for earlier, gap, score in triples]
    pairs.write_text("t1,t2,score\n" + "".join(lines))
    source = read(odometry, pairs={"file": pairs})
    ids = {int(t): int(label) for t, label in zip(source.time, source.label, strict=True) if label >= 0}
    assert ids.keys() == {t for earlier, gap, _ in triples for t in (earlier, earlier + gap)}
    new = 0
    for moment in ids:
        matches = [(s, -i, e) for i, (e, gap, s) in enumerate(triples) if e + gap == moment and s >= 0.75]
        assert ids[moment] == (ids[max(matches)[2]] if matches else new)
        new += not matches


def test_truth_is_interpolated_and_unwrapped(write):
    truth = write("t,x,y,heading\n0.25,0,0,3.0\n1.25,1,2,-3.0\n", "truth.csv")
    found = read(write(ODOMETRY), truth={"file": truth}).truth
    turn = 2 * np.pi - 6
    assert found[1:3] == pytest.approx(np.array([[0.25, 0.5, 3 + 0.25 * turn], [0.75, 1.5, 3 + 0.75 * turn]]))
    assert np.isnan(found[[0, 3]]).all()
    path = write("t,vx,w,x,y,heading\n0,0.1,0,1,2,3\n1,0.1,0,1.1,2,3\n")
    assert read(path, truth={}).truth.tolist() == [[1, 2, 3], [1.1, 2, 3]]
    path, *others = (write(ODOMETRY), {}, {"truth": {"file": truth}})
    digests = [read(path, **parts).digest for parts in others]
    truth.write_text(truth.read_text().replace("3.0", "3.00"))
    assert len({*digests, read(path, truth={"file": truth}).digest}) == 3


def test_the_lecture_hall_csv_equals_its_reference_trace(reference_data):
    data = reference_data / "data"
    pairs = {"file": data / "tuc_lecture_hall_loops.csv"}
    truth = {"file": data / "tuc_lecture_hall_gt.csv", "heading": "th"}
    log = read(data / "tuc_lecture_hall_odom.csv", velocity={"left": "vy"}, pairs=pairs, truth=truth)
    stream = read_trace(reference_data / "traces" / "f_real_tuc_lecture_hall.npz")
    assert (log.label >= 0).sum() == 551
    np.testing.assert_array_equal(log.label, stream.label)
    np.testing.assert_allclose(log.time, stream.time - 100, atol=1e-9)
    known = ~np.isnan(log.truth).any(axis=1)
    assert known.sum() == len(known) - 2  # the truth ends 0.19 s before the odometry
    np.testing.assert_allclose(log.truth[known], stream.truth[known], atol=1e-6)


def test_the_intel_laser_csv_equals_its_reference_trace(reference_data):
    data = reference_data / "data"
    pose = {"x": "odo_x", "y": "odo_y", "heading": "odo_th"}
    views = {"file": data / "intel_scans.csv", "max_range": 8.0}
    log = read(data / "intel_odom_gt.csv", pose=pose, views=views, rows=3, columns=6)
    stream = read_trace(reference_data / "traces" / "f_real_intel_laser3x6.npz")
    np.testing.assert_array_equal(log.views, stream.views)
    np.testing.assert_array_equal(log.time, stream.time)
    poses = np.loadtxt(data / "intel_odom_gt.csv", delimiter=",", skiprows=1)[:, 1:4]
    np.testing.assert_allclose(integrate(log.motion[:, :3], poses[0])[:, :2], poses[:, :2], atol=1e-9)
    assert np.abs(log.motion[:, 1]).max() > 0.1


RANGES = {"views": {"max_range": 8}}
VIEWS = {"views": {}}
LEFT = {"contacts": {"directions": {"left": 45.0}}}
POSE = {"pose": {}}
TURNED = {"pose": {"quaternion": ["a", "b", "c", "d"]}}
LONG = f"t,vx,w,s\n0,1,0,{'x' * (1 << 20)}\n"
STATED, OF_TIME = "t,vx [furlong/s],w\n0,1,0\n", "t [mm],vx,w\n0,1,0\n"
ROUNDED = "t,vx,w\n" + "".join(f"{k // 4},1,{k}\n" for k in range(16))
HOLE = "t,vx,w\n" + "".join(f"{k},1,{'x' if 9 < k < 15 else 0}\n" for k in range(200))
QUATERNIONS = "t,x,y,a,b,c,d\n0,0,0,0,0,0,1\n1,0,0,0,0,0,0\n2,0,0,1,1,0,1\n"
PLANE = "t,x,y,z,heading\n0,0,0,0,0\n1,1,0,1,0\n2,2,.01,3,0\n"
FAULTS = {
    "column": ("t,vxs,w\n0,1,0\n", {}, [":1: no column 'vx'", "among 't', 'vxs', 'w'", "mean 'vxs'?"]),
    "key": ("stamp,vx,w\n0,1,0\n", {}, [":1: no column 't'", "name the column with table.time"]),
    "word": ("t,vx,w\n0,1,0\n1,f\x1b,0\n2,x,0\n3,,0\n", {}, [r":3: vx is 'f\x1b' (and so in 1 m", ":5: vx"]),
    "empty": ("t,vx,w\n0,1,0\n\n1,,0\n2,,0\n", {}, [":4: vx is empty", "a number"]),
    "nan": ("t,vx,w\n0,1,0\n1,nan,0\n2,nan,0\n", {}, [":3: vx is nan", "a finite number"]),
    "time": ("t,vx,w\n0,1,0\nnan,1,0\nx,1,0\n", {}, [":3: t is nan", ":4: t is 'x'"]),
    "cut": ("t,vx,w\n0,1,0\n1,1\n# off\n2", {}, [":3: 2 cells (and so in 1 more", "3, as in the", "cut off"]),
    "unquoted": ("t,vx,w,f\n0,1,0,a,b\n1,1,0,a,b\n", {}, [":2: 5 cells", "4, as in", "quote text"]),
    "no date": ("t,vx,w\n2024-13-01 10:00:00,1,0\n", {}, ["t is '2024-13-01 10:00:00'"]),
    "decimal commas": ("t;vx;w\n0,5;1;0\n1,5;1;0\n", {}, [":2: t is '0,5'", "decimal points"]),
    "name": ("t,vx,w\x1b[2J\n0,1,0\n", {}, [r":1: the header names a column 'w\x1b[2J'", "without control"]),
    "long name": (f"t,vx,w,{'x' * 201}\n0,1,0,1\n", {}, ["201 characters", "at most 200 a name"]),
    "wide": (f"t,vx,w{',r' * 20000}\n0,1,0\n", {}, [":1: 20003 columns", "at most 4096"]),
    "long line": (LONG, {}, [":2: 1048582 characters in a line", "at most"]),
    "large views": (ODOMETRY + "2,1,0\n", {"rows": 4096, "columns": 4096}, ["5 views of 16777216"]),
    "unit": (STATED, {}, ["'vx [furlong/s]' states the unit 'furlong/s'", "units.length"]),
    "unit of another": (OF_TIME, {}, ["states the unit 'mm'", "a unit of time (s, ms,", "units.time"]),
    "rounded": (ROUNDED, {}, [":3: t is rounded: 4 rows share each time", "--set recording.table.rate=4,"]),
    "hole": (HOLE, {}, [":12: w is 'x' (and so in 4 more rows)"]),
    "quaternion": (QUATERNIONS, TURNED, [":3: (a, b, c, d) is [0.0, ", "in 1 more row", "of length 1"]),
    "plane": (PLANE, POSE, ["the path lies in x-z: y hardly changes", "name z as table.pose.y"]),
    "backwards": ("t,vx,w\n0,1,0\n2,1,0\n1,1,0\n0,1,0\n", {}, [":4: t goes back from 2.0 to 1.0 s", "sort"]),
    "set back": ("t,vx,w\n" + "".join(f"{k - 2 * (k > 50)},1,0\n" for k in range(99)), {}, [":53: t goes"]),
    "repeated": ("t,vx,w\n0,1,0\n2,1,0\n2,1,0\n2,1,0\n", {}, [":4: t repeats 2.0 s", "drop the repeated"]),
    "no rows": ("t,vx,w\n", {}, ["no rows under its header", "at least one row"]),
    "no header": ("0,1,2\n1,1,2\n", {}, [":1: the first line is '0,1,2'", "a header row"]),
    "doubled": ("t,vx,vx,w\n0,1,1,0\n", {}, [":1: several columns are called 'vx'", "once"]),
    "neither": (ODOMETRY, {"velocity": None}, ["none of table.pose, table.velocity", "among t, vx, w"]),
    "both": (ODOMETRY, {"velocity": {}, "pose": {}}, ["more than one of table.pose", "one of them"]),
    "no views": (ODOMETRY, VIEWS, ["no column 'r0'", "table.views.prefix"]),
    "gap": ("t,vx,w,r0,r2\n0,1,0,1,1\n", VIEWS, ["no column 'r1'", "'r0', 'r2'"]),
    "pixels": ("t,vx,w,r0,r1\n0,1,0,1,1\n", VIEWS, ["2 columns r0", "3 (table.rows 1 x"]),
    "beams": ("t,vx,w,r0,r1\n0,1,0,1,1\n", RANGES, ["or a multiple"]),
    "bytes": ("t,vx,w,r0,r1,r2\n0,1,0,0,9,200\n", VIEWS, [":2: r* holds 200.0", "by 255"]),
    "behind": ("t,vx,w,r0,r1,r2\n0,1,0,0,-1,1\n", RANGES, [":2: r* is -1.0", "0 m or more"]),
    "mm": ("t,vx,w,r0,r1,r2\n0,1,0,900,800,700\n", RANGES, ["over 800 m", "views.unit=mm"]),
    "bumper": ("t,vx,w,left\n0,1,0,2\n", LEFT, [":2: left is 2", "1 in contact, 0 without"]),
    "no bumper": ("t,vx,w\n0,1,0\n", LEFT, ["no column 'left'", "table.contacts.directions"]),
    "label": ("t,vx,w,label\n0,1,0,1.5\n", {"labels": {}}, [":2: label is 1.5", "an integer"]),
    "truth": ("t,vx,w,x,y,heading\n0,1,0,1,,1\n", {"truth": {}}, [":2: y is empty"]),
}  # fmt: skip


@pytest.mark.parametrize(("content", "parts", "pieces"), FAULTS.values(), ids=FAULTS.keys())
def test_faulty_values_are_refused(content, parts, pieces, write, refused):
    path = write(content)
    refused(lambda: read(path, **parts), str(path), *pieces)


OTHERS = {
    "far": ("views", "t,r0,r1,r2\n0,0,0,0\n9,0,0,0\n", [":3: the", "7.5 s away (one of 1", "at most 0.5 s"]),
    "two": ("views", "t,r0,r1,r2\n0.9,0,0,0\n1.1,0,0,0\n", [":3: belongs to the same odometry row"]),
    "time": ("views", "t,r0,r1,r2\n1,0,0,0\n0.5,0,0,0\n0,0,0,0\n", [":3: t goes back"]),
    "exact": ("labels", "t,label\n0.1,0\n", ["at most 0 s"]),
    "order": ("pairs", "t1,t2,score\n0.5,1,0.9\n", [":2: t1 0.5 is not after t2 1.0", "swap table.pairs"]),
    "score": ("pairs", "t1,t2,score\n1,0.5,nan\n", [":2: score is nan"]),
    "far pair": ("pairs", "t1,t2,score\n9,0.5,1\n", ["time 9.0: the nearest"]),
    "column": ("pairs", "t1,t2,scores\n9,0.5,1\n", [":1: no column 'score'", "did you mean 'scores'?"]),
    "far bumper": ("contacts", "t,left,front,right\n9,0,0,0\n", [":2: the nearest odometry row is 7.5 s"]),
    "clock": ("truth", "t,x,y,heading\n0,0,0,0\n0,1,0,0\n0,1,0,0\n", [":3: t repeats 0.0 s"]),
    "elsewhen": ("truth", "t,x,y,heading\n50,0,0,0\n60,1,0,0\n", ["50.0 to 60.0 s", "0.0 to 1.5", "overlap"]),
    "no time": ("truth", "t,x,y,heading\n0,0,0,0\n,1,0,0\n,1,0,0\n", [":3: t is empty (and so in 1 more"]),
}  # fmt: skip


@pytest.mark.parametrize(("part", "content", "pieces"), OTHERS.values(), ids=OTHERS.keys())
def test_faulty_values_in_other_files_are_refused(part, content, pieces, write, refused):
    settings = {"file": write(content, "other.csv")} | ({"tolerance": 0} if part == "labels" else {})
    refused(lambda: read(write(ODOMETRY), **{part: settings}), *pieces)


def test_all_errors_are_reported_together(write, refused):
    path = write("t,vx,w,r0,r1,r2\n0,nan,0,0,0,0\n1,nan,0,0,0,300\n1,1,0,0,0,0\n")
    error = refused(lambda: read(path, views={}), "vx is nan", "repeats", "300.0")
    assert isinstance(error, InputErrors)
    assert len(error.errors) == 3
    both = {"pairs": {"file": path}, "labels": {}}
    refused(lambda: read(path, **both), "both table.labels and table.pairs")


LEFT_OUT = {
    "pose": ("t,x,y,heading\n0,0,0,0\n1,nan,0,0\n2,2,0,0\n3,3,0,0\n", POSE, [0, 2, 1],
             [":3: x is nan; expected a finite number; 1 of 4 rows are left out"]),
    "velocity": ("t,vx,w\n0,1,0\n1,fast,0\n2,1,0\n", {}, [0, 2], [":3: vx is 'fast'"]),
    "motion": ("t,distance,turn\n0,1,0\n1,1,0\n2,,0\n3,1,0\n", {"motion": {}}, [0, 1, 2], [":4: distance"]),
    "cut off": ("t,vx,w\n0,1,0\n1,1,0\n2,1", {}, [0, 1], [":4: 2 cells; expected 3"]),
    "power loss": ("t,vx,w\n0,1,0\n1,1,0\n\0\0\0\0", {}, [0, 1], [":4: 1 cells"]),
    "stamp 0": ("t,x,y,heading\n5,0,0,0\n0,1,0,0\n7,2,0,0\n8,3,0,0\n", POSE, [0, 2, 1],
                [":3: t goes back from 5.0 to 0.0 s", "1 of 4 rows are left"]),
    "bumps": ("t,vx,w,left\n0,1,0,1\n1,1,0,\n2,1,0,0\n", LEFT, [0, 1, 1], [":3: left is"]),
    "quaternion": ("t,x,y,a,b,c,d\n0,0,0,0,0,0,1\n1,0,0,0,0,0,0\n2,3,0,0,0,0,1\n", TURNED, [0, 3],
                   [":3: (a, b, c, d)"]),
    "view": ("t,vx,w,r0,r1,r2\n0,1,0,1,nan,1\n1,1,0,1,inf,1\n", RANGES, [0, 1],
             [":2: r1 is nan", "1 of 2 views are left out"]),
    "truth": ("t,vx,w,x,y,heading\n0,1,0,1,,1\n1,1,0,1,1,1\n", {"truth": {}}, [0, 1],
              [":2: y is empty", "1 of 2 true poses are left out"]),
}  # fmt: skip


@pytest.mark.parametrize(("content", "parts", "moved", "pieces"), LEFT_OUT.values(), ids=LEFT_OUT.keys())
def test_one_bad_row_is_left_out_with_a_warning(content, parts, moved, pieces, write):
    said = []
    path = write(content)
    source = read(path, said.append, **parts)
    assert source.motion[:, 0].tolist() == moved
    assert all(piece in said[0] for piece in [str(path), *pieces])
    assert len(said) == 1
    if "views" in parts:
        assert source.seen.tolist() == [False, True]


TIME = np.arange(24) / 8
POSES = np.column_stack([np.sin(TIME), TIME * TIME, TIME - 1.0])  # as a body that turns while it drives
TURNS = np.column_stack([0 * TIME, 0 * TIME, np.sin(POSES[:, 2] / 2), np.cos(POSES[:, 2] / 2)])
AHEAD = np.pi / 4 - POSES[:, 2] / 2  # half the turn about the y axis that takes the z axis there
CAMERA = np.column_stack([0 * TIME, np.sin(AHEAD), 0 * TIME, np.cos(AHEAD)])
DAYS = np.array([f"2024-05-01T10:00:{t:06.3f}" for t in TIME.tolist()])
X, Y, H = POSES.T
NAME, HEIGHT = np.full(24, "odom"), 1 + 0.01 * np.sin(TIME)
RADS = np.degrees(H)
AS_USERS_HAVE_THEM = {
    "text": ("t,frame_id,x,y,heading,note", [TIME, NAME, X, Y, H, np.full(24, "")]),
    "quoted text": ("t,x,y,heading,note", [TIME, X, Y, H, np.full(24, '"a, b"')]),
    "comments": ("# robot 7, Monday\n\n# of 3, 4, 5, 6\nt,x,y,heading", [TIME, X, Y, H]),
    "comment as header": ("# robot, 7, of, Monday\n#t, x, y, heading", [TIME, X, Y, H]),
    "units": ("t [s], x [m], y [m], heading [rad]", [TIME, X, Y, H]),
    "other units": ("t (µs),x [mm],y [mm],heading [°]", [TIME * 1e6, X * 1e3, Y * 1e3, RADS]),
    "units in names": ("time_ns,x_cm,y_cm,yaw_deg", [TIME * 1e9, X * 100, Y * 100, RADS]),
    "dates": ("time,x,y,heading", [np.char.add(DAYS, "Z"), X, Y, H]),
    "dates with zones": ("stamp,x,y,heading",
                         [np.char.add(np.char.replace(DAYS, "T", " "), "+02:00"), X, Y, H]),
    "TUM": ("# timestamp tx ty tz qx qy qz qw", [TIME, X, Y, HEIGHT, *TURNS.T]),
    "EuRoC": ("#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z",
              [(1.4e9 + TIME) * 1e9, X, Y, HEIGHT, TURNS[:, 3], *TURNS.T[:3]]),
    "rostopic": ("%time,field.header.frame_id,field.pose.pose.position.x,field.pose.pose.position.y,"
                 + ",".join(f"field.pose.pose.orientation.{axis}" for axis in "xyzw")
                 + "".join(f",field.pose.covariance{k}" for k in range(36)),
                 [(1.4e9 + TIME) * 1e9, NAME, X, Y, *TURNS.T, *np.zeros((36, 24))]),
    "camera": ("t,x,y,z,qx,qy,qz,qw", [TIME, X, 0.01 * HEIGHT, Y, *CAMERA.T]),
    "rounded": ("t,x,y,heading", [np.floor(TIME), X, Y, H]),
    "semicolons": ("t;x;y;heading", [TIME, X, Y, H]),
    "tabs": ("t\tx\ty\theading", [TIME, X, Y, H]),
    "commas at the end": ("t,x,y,heading,,", [TIME, X, Y, H, np.full(24, ""), np.full(24, "")]),
}  # fmt: skip


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize(("header", "columns"), AS_USERS_HAVE_THEM.values(), ids=AS_USERS_HAVE_THEM.keys())
def test_a_file_as_users_have_it_is_read_as_the_doctor_describes_it(header, columns, encoding, tmp_path):
    mark = next((mark for mark in ";\t" if mark in header), "," if "," in header else " ")
    rows = [mark.join(map(str, row)) for row in zip(*(column.tolist() for column in columns), strict=True)]
    rows[9:9] = ["# pause, of 3 s"]
    path = tmp_path / "log.csv"
    path.write_text("\r\n".join([header, *rows]), encoding=encoding, newline="")
    source = read_csv_recording(path, CsvConfig.model_validate(describe_csv(path).table))
    np.testing.assert_allclose(source.motion, from_poses(TIME, POSES), atol=3e-7)


def test_settings_name_units_and_the_header_those_of_other_files(write):
    """The unit in the settings goes before that of the header, for the odometry; speeds stay per second."""
    path = write("t [s],vx,w,r0,r1,r2\n0,200,0,,,\n500,200,5.729577951308232,,,\n")
    units = {"time": "ms", "length": "mm", "angle": "deg"}
    file = write("stamp,r0 [mm],r1 [mm],r2 [mm]\n500,4000,8000,9000\n", "views.csv")
    views = {"file": file, "time": "stamp", "max_range": 8}
    file = write("t [s],x,y,heading\n0,0,0,0\n0.5,10,0,90\n", "truth.csv")
    truth = {"file": file, "units": {"length": "cm", "angle": "deg"}}
    source = read(path, units=units, views=views, truth=truth)
    assert source.motion[1] == pytest.approx([0.1 * np.cos(0.025), 0.1 * np.sin(0.025), 0.05, 0.5])
    assert source.views[1].ravel().tolist() == [0.5, 1.0, 1.0]
    assert source.truth[1] == pytest.approx([0.1, 0, np.pi / 2])


def test_views_of_rows_that_are_left_out_are_lost_with_them(write):
    rows = "".join(f"{k},1,0,3\n" for k in range(3, 41))
    odometry = write(f"t,vx,w,label\n0,1,0,0\n1,x,0,1\n2,1,0,2\n{rows}41")
    views = write("t,r0,r1,r2\n" + "".join(f"{k},0,0,{k % 2}\n" for k in range(42)), "views.csv")
    source = read(odometry, views={"file": views}, labels={})
    assert source.time.tolist() == [0, *range(2, 41)]
    assert source.seen.all()
    np.testing.assert_array_equal(source.views[:, 0, 2, 0], source.time % 2)
    assert source.label.tolist()[:3] == [0, 2, 3]
    # They count where a rate is given.
    path = write("t,vx,w\n7,1,0\n7,x,0\n7,1,0\n8,1,0\n")
    assert read(path, rate=4.0).time.tolist() == [7, 7.5, 7.75]


def test_line_numbers_count_empty_lines(write):
    file = read_csv(write("\ufefft,x\r\n\r\n1,2\r\n \r\n3,4"))
    assert (file.names, file.values.tolist()) == (("t", "x"), [[1, 2], [3, 4]])
    assert [file.place(row).rsplit(":", 1)[1] for row in (0, 1)] == ["3", "5"]
    assert read_csv(write('"t","x"\n"1","2"\n')).values.tolist() == [[1, 2]]
