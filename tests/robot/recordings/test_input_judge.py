"""Reference traces; known recordings pass with a margin, and wrong units, steps and values are found."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.metrics.trajectory import ate
from robot.recordings import input_judge as judging
from robot.recordings.csv_config import CsvConfig
from robot.recordings.csv_reader import read_csv_recording
from robot.recordings.formats import open_recording
from robot.recordings.input_judge import DEFAULT_LIMITS, InputJudge, MotionTrack, UnitLimits
from robot.recordings.mcap_reader import Recording
from robot.recordings.mcap_writer import record_source
from robot.recordings.npz_trace import read_trace
from robot.recordings.recording_config import RecordingConfig
from robot.recordings.sanity_checks import Stretch
from robot.simulation.rat.simulated_session import PathFileConfig, read_path
from robot.sources.odometry import OdometryCorrection, from_poses, from_velocities, replace_steps
from tactile.base.errors import InputError, InputErrors
from tactile.base.se2 import between, integrate

SYNTHETIC = [
    "a_square3", "b_figure8_alias", "c_corridor_wrap", "d1_rotation_generic", "e_kidnap", "j_reverse_stop",
]  # fmt: skip
REAL = ("f_real_intel_laser3x6", "f_real_tuc_lecture_hall")
DEGREES, MILLIMETRES, MILLISECONDS, ROWS = 180 / np.pi, 1000.0, 1000.0, np.arange(400)


def real_table(name, data):
    if name == "intel":
        truth, pose = ({"x": f"{of}_x", "y": f"{of}_y", "heading": f"{of}_th"} for of in ("gt", "odo"))
        return data / "intel_odom_gt.csv", CsvConfig.model_validate({"pose": pose, "truth": truth})
    truth = {"file": data / "tuc_lecture_hall_gt.csv", "heading": "th"}
    settings = {"velocity": {"left": "vy"}, "truth": truth}
    return data / "tuc_lecture_hall_odom.csv", CsvConfig.model_validate(settings)


PLANTED = [
    ("in_w", DEGREES, "in radians"), ("in_v", MILLIMETRES, "in metres"), ("in_view", 255.0, "in 0..1"),
    ("in_t", MILLISECONDS, "times in seconds"), ("truth", np.array([1, 1, DEGREES]), "in radians"),
    ("truth", np.array([MILLIMETRES, MILLIMETRES, 1]), "truth in metres"),
]  # fmt: skip
"""By what an array is multiplied, and what is expected instead."""


def _arrays(trace):
    with np.load(trace) as arrays:
        names = [name for name in arrays.files if name.startswith("in_") or name in ("params_json", "truth")]
        return {name: arrays[name].copy() for name in names}


@pytest.mark.parametrize("name", [*SYNTHETIC, *REAL])
def test_traces_pass_with_a_margin_and_are_refused_in_a_wrong_unit(name, find_trace, tmp_path, refused):
    trace, path = find_trace(name), tmp_path / "planted.npz"
    log = read_trace(trace)
    robot = judging.typical_motion(MotionTrack(log.time, log.moved, log.motion, log.truth))
    ratios = [max(pair) / min(pair) if min(pair) else 1.0 for pair in (robot.path, robot.turning)]
    assert 5 * robot.interval < DEFAULT_LIMITS.interval
    assert 5 * max(robot.speed, robot.true_speed) < DEFAULT_LIMITS.speed
    assert 5 * robot.turn_rate < DEFAULT_LIMITS.turn_rate
    assert 5 * robot.turn < np.pi
    assert 20 * max(ratios) < judging.RATIO
    arrays = _arrays(trace)
    for array, factor, expected in PLANTED:
        if array == "in_view" and name == "f_real_tuc_lecture_hall":
            continue  # its views are ids
        np.savez(path, **arrays | {array: arrays[array] * factor})
        refused(lambda: read_trace(path), str(path), expected)
    del arrays["truth"]
    for array, factor, expected in PLANTED[:2]:
        np.savez(path, **arrays | {array: arrays[array] * factor})
        if array == "in_w" and name == "j_reverse_stop":
            read_trace(path)  # 1.1 degrees per second: undetectable
        else:
            refused(lambda expected=expected: read_trace(path), str(path), expected)


@pytest.mark.parametrize(
    ("name", "column", "factor", "expected"),
    [("intel", "odo_th", DEGREES, "a heading in radians"), ("intel", "odo_x", MILLIMETRES, "in metres"),
     ("intel", "gt_th", DEGREES, "a heading in radians"), ("intel", "t", MILLISECONDS, "times in seconds"),
     ("lecture hall", "t", MILLISECONDS, "times in seconds"), ("lecture hall", "w", DEGREES, "in radians"),
     ("lecture hall", "vx", MILLIMETRES, "in metres")],
)  # fmt: skip
def test_wrong_units_of_tables_are_refused(name, column, factor, expected, reference_data, tmp_path, refused):
    path, config = real_table(name, reference_data / "data")
    header, *_ = path.read_text().split("\n", 1)
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    values[:, header.split(",").index(column)] *= factor
    planted = tmp_path / "planted.csv"
    np.savetxt(planted, values, "%.6f", ",", header=header, comments="")
    for truth in (config.truth, config.truth if column == "gt_th" else None):
        settings = config.model_copy(update={"truth": truth})
        refused(lambda settings=settings: read_csv_recording(planted, settings), str(planted), expected)


def _drive():
    """Times, velocities [N, 2] (m/s, rad/s) and poses of a robot that drives, stands and turns."""
    time, speeds = ROWS * 0.1, np.array([(0.4, 0.01), (0.4, 0.01), (0.0, 0.6), (0.0, 0.0)])[ROWS // 40 % 4]
    return time, speeds, integrate(from_velocities(time, speeds[:, 0], 0.0, speeds[:, 1])[:, :3])


SLOWER = {"milliseconds": 1e3, "kiloseconds": 1e-4, "slow degrees": 10, "slow centimetres": 2.5}
CHANGED = {
    "wild": lambda poses: poses + 3.0 * (ROWS == 150)[:, None] * [1, 0, 0],
    "reset": lambda poses: np.append(poses[:230], integrate(between(poses[229:-1], poses[230:])), axis=0),
    "two nodes": lambda poses: poses + (ROWS % 2 * (ROWS - 1) * 0.8 / 398)[:, None] * [1, 1, 0],
    "single precision": lambda poses: (poses + [4e5, 5e6, 0]).astype(np.float32).astype(float),
    "centimetres": lambda poses: poses * [100, 100, 1],
    "slow centimetres": lambda poses: poses * [100, 100, 1],
    "kilometres": lambda poses: poses * [1e-3, 1e-3, 1],
    "slow degrees": lambda poses: np.column_stack([poses[:, :2], np.degrees(np.unwrap(poses[:, 2]))]),
}


def _faulty(kind):
    """A drive with this fault: `A, B` where A is the fault and B what was recorded."""
    fault, recorded = kind.split(", ")
    time, speeds, poses = _drive()
    pause = {"gap": 220 if recorded == "velocities" else 120, "gap standing": 290}.get(fault, 400)
    time = (time + 60.0 * (pause <= ROWS)) * SLOWER.get(fault, 1.0)
    if recorded == "velocities":
        return MotionTrack(time, ROWS >= 0, from_velocities(time, speeds[:, 0], 0.0, speeds[:, 1]), held=True)
    poses = CHANGED.get(fault, lambda poses: poses)(poses)
    return MotionTrack(time, ROWS >= 0, from_poses(time, poses), poses=poses)


JUDGED = {
    "wild, poses": (True, "row 150: the odometry jumps by 3", "largest_step=0.2"),
    "reset, poses": (False, "row 230: the odometry jumps by", "recording.odometry.largest_step"),
    "two nodes, poses": (True, "two nodes publish", "recording.topics.odometry.every=2"),
    "single precision, poses": (False, "precision was lost far from the origin", "double precision"),
    "centimetres, poses": (True, "over 40 m/s", "centimetres: --set recording.odometry.length_scale"),
    "slow centimetres, poses": (True, "starts from rest to 16 m/s", "length_scale=0.01"),
    "kilometres, poses": (False, "the whole path is", "length_scale=1000"),
    "slow degrees, poses": (True, "headings agree with the direction", "turn_scale=0.0174533"),
    "milliseconds, velocities": (True, "over 100 s", "these are milliseconds: divide the times by 1000"),
    "kiloseconds, velocities": (True, "less than 1e-05 s", "these are kiloseconds"),
    "gap, velocities": (True, "row 220: nothing for 60.1 s", "recording.odometry.largest_step"),
    "gap standing, velocities": (False, "row 290: nothing for 60.1 s", "is not known"),
    "gap, poses": (False, "row 120: nothing for 60.1 s", "poses and motions bridge it"),
}
"""By fault: whether it is refused, what is found where, and the cure."""


@pytest.mark.parametrize("kind", JUDGED)
def test_a_fault_of_the_odometry_is_judged(kind):
    refused, *pieces = JUDGED[kind]
    told = []
    errors = InputJudge(warn=told.append).errors(_faulty(kind), lambda row: f"row {row}", "file")
    assert (len(errors), len(told)) == (refused, not refused)
    (said,) = [*map(str, errors), *told]
    for piece in pieces:
        assert piece in said
    alone = judging.judge_motion(*_faulty(kind)[:3:2], "session")
    assert bool(alone) == (not kind.startswith(("two", "slow deg")))


def test_poses_that_are_repeated_are_no_fault_of_a_unit():
    """Each pose of a drive in steps of 20 ms, twenty times at 1000 Hz; in degrees it remains one."""
    time, speeds, _ = _drive()
    poses = integrate(from_velocities(time / 5, speeds[:, 0], 0.0, speeds[:, 1])[:, :3]).repeat(20, axis=0)
    time = np.arange(len(poses)) * 1e-3
    track = MotionTrack(time, time >= 0, from_poses(time, poses), poses=poses)
    (error,) = InputJudge().errors(track, str, "file")
    for piece in ("poses are the pose before again, mostly 20 alike", "recording.topics.odometry.every=20"):
        assert piece in str(error)
    once = MotionTrack(time[::20], time[::20] >= 0, from_poses(time[::20], poses[::20]), poses=poses[::20])
    assert InputJudge(warn=pytest.fail).errors(once, str, "file") == []
    degrees = poses * [1, 1, np.degrees(1)]
    (error,) = InputJudge().errors(track._replace(motion=from_poses(time, degrees), poses=degrees), str, "f")
    assert "again" not in str(error)


@pytest.mark.parametrize("kind", ["clean, poses", "clean, velocities"])
def test_a_clean_drive_has_no_finding(kind):
    assert InputJudge(warn=pytest.fail).errors(_faulty(kind), str, "file") == []


@pytest.mark.parametrize("kind", ["wild, poses", "reset, poses", "gap, velocities"])
def test_the_printed_cure_repeats_the_step_before(kind):
    """The path that results is off by less than two steps."""
    track, told = _faulty(kind), []
    errors = InputJudge(warn=told.append).errors(track, str, "file")
    (said,) = [*map(str, errors), *told]
    settings = {name: float(value) for name, value in re.findall(r"odometry\.(\w+)=([\d.]+)", said)}
    correction = OdometryCorrection.model_validate(settings)
    assert InputJudge(correction=correction).errors(track, str, "file") == []
    mended = integrate(replace_steps(correction, track.motion[:, :3]))
    assert np.hypot(*(mended - _drive()[2])[:, :2].T).max() < 0.09


@pytest.mark.parametrize("name", SYNTHETIC)
def test_two_wild_rows_are_a_jump_and_no_unit(name, find_trace, tmp_path, refused):
    arrays, path = _arrays(find_trace(name)), tmp_path / "wild.npz"
    for name, value in (("in_w", 1e5), ("in_v", 1e6)):
        arrays[name][[40, 41]] = value, -value
    np.savez(path, **arrays)
    refused(lambda: read_trace(path), "row 40: the odometry jumps by 5e+05 m", "largest_step")
    for stretch in (Stretch(25.0), Stretch(None, 15.0)):
        assert 0 < read_trace(path, InputJudge(stretch=stretch)).length < len(arrays["in_t"])


def test_limits_can_be_raised(stream, refused):
    path = stream(in_v=np.full(12, 40.0), truth=None)
    refused(lambda: read_trace(path), "over 40 m/s", "raise recording.limits.speed (25)")
    config = RecordingConfig(file=path, limits=UnitLimits(speed=50.0))
    assert open_recording(config).length == 12


@pytest.mark.parametrize("turns", [0.4, 5.0])
def test_headings_in_degrees_are_detected(turns):
    time = np.arange(200) * 0.5
    heading = np.linspace(0, 2 * np.pi * turns, 200) - 1.0
    wrapped = (heading + np.pi) % (2 * np.pi) - np.pi
    limits = UnitLimits(turn_rate=0.5) if turns < 1 else DEFAULT_LIMITS  # slow turning requires a lower limit
    for column in (heading, wrapped):
        assert judging.heading_errors(column, time, "th", "file", limits) == []
        (error,) = judging.heading_errors(np.rad2deg(column), time, "th", "file", limits)
        assert "multiply by pi/180" in str(error)


@pytest.mark.parametrize(("rate", "said"), [(0.9, 1), (2.6, 0)])
def test_whole_degrees_of_a_robot_that_turns_slowly_are_doubted(rate, said):
    """A turn of some degrees a step, as whole degrees."""
    turns = np.radians(np.diff(np.floor(rate * np.arange(301)), prepend=0.0))
    motion = np.column_stack([np.full(301, 0.0173), np.zeros(301), turns, np.full(301, 0.05)])
    found = judging.judge_motion(0.05 * np.arange(301), motion, "session")
    assert len([line for line in found if "are 1 degree, all are whole ones" in line]) == said
    motion[:, 2] *= np.linspace(0.9, 1.1, 301)  # no whole ones
    assert not any("whole ones" in line for line in judging.judge_motion(0.05 * np.arange(301), motion, "s"))


@pytest.mark.parametrize("rows", [0, 1, 2, 3])
def test_an_empty_track_is_accepted(rows):
    still = MotionTrack(np.arange(rows) * 1.0, np.ones(rows, bool), np.zeros((rows, 4)), np.zeros((rows, 3)))
    assert judging.unit_errors(still, "file") == []
    assert judging.unit_errors(still._replace(moved=np.zeros(rows, bool), truth=None), "file") == []


@pytest.mark.parametrize("name", SYNTHETIC)
def test_a_trace_is_read_row_by_row(name, find_trace):
    trace = find_trace(name)
    source = read_trace(trace)
    with np.load(trace) as arrays:
        np.testing.assert_array_equal(source.time, arrays["in_t"])
        np.testing.assert_array_equal(source.views.reshape(source.length, -1), arrays["in_view"])
        np.testing.assert_array_equal(source.truth, arrays["truth"])
        step = np.diff(arrays["in_t"], prepend=arrays["in_t"][:1])
        way, turn = arrays["in_v"] * step, arrays["in_w"] * step
    moved = np.column_stack([way * np.cos(turn), way * np.sin(turn), turn, step])
    np.testing.assert_allclose(source.motion, moved, atol=1e-12)
    assert (source.name, source.view_shape, source.whiskers) == (trace.stem, (3, 6, 1), 0)
    assert source.rate_hz == pytest.approx(2.0)
    assert source.seen.all()
    parameters = source.info.provenance["parameters"]
    assert (parameters["exp_loops"], type(parameters["vt_match_threshold"])) == (20, float)


PUBLISHED = {"b_figure8_alias": 0.174, "f_real_intel_laser3x6": 24.16, "f_real_tuc_lecture_hall": 12.95}


@pytest.mark.parametrize(("name", "expected"), PUBLISHED.items())
def test_the_error_of_raw_odometry_is_the_published_one(name, expected, find_trace):
    source = read_trace(find_trace(name))
    assert ate(integrate(source.motion[:, :3]), source.truth) == pytest.approx(expected, rel=3e-3)


def test_rows_without_odometry_do_not_advance_its_clock(stream):
    flags = np.full(12, 3.0)
    flags[[0, 4, 5]], flags[7] = 1, 2
    source = read_trace(stream(in_flags=flags, in_v=np.where(flags == 1, np.nan, 0.1)))
    assert source.motion[:, 3].tolist() == [0, 0, 0.5, 0.5, 0, 0, 1.5, 0.5, 0.5, 0.5, 0.5, 0.5]
    assert source.seen.tolist() == [i != 7 for i in range(12)]
    assert ((source.motion[:, 0] != 0) == (source.motion[:, 3] > 0)).all()
    assert (source.views[7] == 0).all()
    # A view may share its time with odometry.
    time, flags = 100 + 0.5 * (np.arange(12) // 2), np.tile([1.0, 2.0], 6)
    assert read_trace(stream(in_t=time, in_flags=flags)).rate_hz == 2.0


def test_views_of_two_columns_are_place_labels(stream, tmp_path):
    ids = np.column_stack([np.arange(12) // 3, np.zeros(12)])
    ids[4] = np.nan
    source = read_trace(stream(in_view=ids, in_flags=np.where(np.isnan(ids[:, 0]), 2.0, 3.0)))
    assert source.label.tolist() == [0, 0, 0, 1, -1, 1, 2, 2, 2, 3, 3, 3]
    assert (source.seen.any(), source.view_shape, source.info.labels_only) == (False, (2, 3, 1), True)
    record_source(source, tmp_path / "labels.mcap")
    assert Recording(tmp_path / "labels.mcap").info.labels_only
    params = '{"template_x_size": 2, "template_y_size": 1}'
    source = read_trace(stream(in_view=np.full((12, 2), 0.25), params_json=params, truth=None))
    assert (source.views == 0.25).all()
    assert (source.seen.all(), source.truth) == (True, None)


def test_samples_share_no_writable_memory_and_the_digest_depends_on_the_content(stream):
    source = read_trace(stream())
    assert read_trace(stream()).digest == source.digest != read_trace(stream(in_v=np.full(12, 0.11))).digest
    sample = next(iter(source))
    sample.truth[:] = 9
    with pytest.raises(ValueError, match="read-only"):
        sample.reading.view[:] = 1
    assert (next(iter(source)).truth == 0).all()


def _with(array, row, value):
    changed = np.array(array, dtype=np.float64)
    changed[row] = value
    return changed


TIME, VIEW = 100 + 0.5 * np.arange(12), np.full((12, 6), 0.5)
IDS = np.column_stack([np.arange(12), np.zeros(12)])
FAULTS = {
    "backwards": ({"in_t": _with(TIME, 5, 100.25)}, ["row 5: in_t goes back from 102.0 to 100.25 s", "sort"]),
    "repeated": ({"in_t": _with(TIME, 5, 102)}, ["row 5: in_t repeats 102.0 s", "drop the repeated"]),
    "nan time": ({"in_t": _with(TIME, 5, np.nan)}, ["row 5: in_t is nan", "correct or drop"]),
    "inf speed": ({"in_v": _with(np.ones(12), 3, np.inf)}, ["row 3: in_v is inf", "a finite number"]),
    "nan turn": ({"in_w": _with(np.ones(12), 3, np.nan)}, ["row 3: in_w is nan"]),
    "nan view": ({"in_view": _with(VIEW, 7, np.nan)}, ["row 7: in_view is nan"]),
    "nan truth": ({"truth": _with(np.zeros((12, 3)), 2, np.nan)}, ["row 2: truth is nan"]),
    "bytes": ({"in_view": 255 * VIEW}, ["holds 127.5 (and so in 11 more rows)", "0..1", "by 255"]),
    "below": ({"in_view": _with(VIEW, 3, -1)}, ["row 3: in_view holds -1.0;", "shift and scale"]),
    "wide": ({"in_view": 9000 * VIEW}, ["by their largest possible value, at least 4500"]),
    "flags": ({"in_flags": _with(np.full(12, 3), 4, 0)}, ["row 4: in_flags is 0.0", "1 (view), 2"]),
    "view shape": ({"in_view": np.zeros((12, 5))}, ["in_view has 5 columns", "6 (template_y_size 2", "or 2"]),
    "view rank": ({"in_view": np.zeros(12)}, ["in_view has shape [12]", "[N, V] with N = 12"]),
    "length": ({"in_w": np.zeros(11)}, ["in_w has shape [11]", "[N] with N = 12, the rows of in_t"]),
    "truth shape": ({"truth": np.zeros((12, 2))}, ["truth has shape [12, 2]", "[N, 3]"]),
    "text": ({"in_v": np.full(12, "fast")}, ["in_v has dtype <U4", "real numbers"]),
    "objects": ({"in_v": np.array([None] * 12)}, ["Object arrays cannot be loaded"]),
    "absent": ({"in_veiw": VIEW, "in_view": None}, ["no array 'in_view'", "among 'in_t'", "mean 'in_veiw'?"]),
    "two absent": ({"in_v": None, "in_w": None}, ["no array 'in_v'", "no array 'in_w'"]),
    "no rows": ({"in_t": np.zeros(0)}, ["in_t has no rows", "at least one sample"]),
    "json": ({"params_json": "{"}, ["params_json is not JSON", "a JSON object"]),
    "list": ({"params_json": "[1]"}, ["params_json holds list"]),
    "key": ({"params_json": '{"template_ysize": "3"}'}, ["no key 'template_y_size'", "'template_ysize'?"]),
    "size": ({"params_json": '{"template_y_size": "x"}'}, ["template_y_size is 'x'", "of pixels"]),
    "id": ({"in_view": _with(IDS, 2, [0.5, 0])}, ["row 2: in_view's place id is 0.5", "from 0"]),
    "turned id": ({"in_view": _with(IDS, 2, [0, 0.1])}, ["in_view's relative angle is 0.1", "not supported"]),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "pieces"), FAULTS.values(), ids=FAULTS.keys())
def test_faulty_values_are_refused(changes, pieces, stream, refused):
    path = stream(**changes)
    refused(lambda: read_trace(path), str(path), *pieces)


def test_all_errors_are_reported_together(stream, refused):
    turn, speed = _with(np.zeros(12), 3, np.nan), 1e3 * np.ones(12)
    path = stream(in_t=_with(TIME, 5, 102), in_v=speed, in_w=turn, in_view=255 * VIEW)
    error = refused(lambda: read_trace(path), "repeats", "in_w is nan", "127.5", "over 1000 m/s")
    assert isinstance(error, InputErrors)
    assert len(error.errors) == 4  # each cause once, although the truth contradicts the speed too


def test_a_broken_archive_gives_one_error(stream, tmp_path, refused):
    content = stream().read_bytes()
    path = tmp_path / "bad.npz"
    for size in [*range(1, len(content) - 1, 97), len(content) - 1]:
        path.write_bytes(content[:size])
        refused(lambda: read_trace(path), str(path), "cannot be read as .npz", "a NumPy archive")
    refused(lambda: read_trace(path), "truncated or damaged: copy it again")
    np.save(tmp_path / "single.npy", np.zeros(3))
    (tmp_path / "single.npy").rename(path)
    refused(lambda: read_trace(path), "cannot be read as .npz", "write it with numpy.savez")


def test_a_stretch_without_samples_is_refused():
    time = np.arange(5.0)
    assert Stretch(1.0, 3.0).rows(time, "a").tolist() == [False, True, True, True, False]
    with pytest.raises(InputError, match="nothing from"):
        Stretch(5.0).rows(time, "a")


@given(st.integers(0, 10**6))
def test_all_and_only_the_places_between_a_jump_away_and_back_are_wild(seed):
    """On the path of a real rat, with reflections of up to three samples."""
    path, draw = read_path(PathFileConfig()), np.random.default_rng(seed)
    assert len(path.time) == 5960
    place, bad = path.position.copy(), np.zeros(5960, bool)
    for at in draw.choice(np.arange(5, 5940, 10), draw.integers(0, 30), replace=False).tolist():
        angle, rows = draw.uniform(0, 2 * np.pi), slice(at, at + draw.integers(1, 4))
        place[rows] += draw.uniform(0.5, 2) * np.array([np.cos(angle), np.sin(angle)])
        bad[rows] = True
    steps = np.diff(place, axis=0, prepend=place[:1])
    motion = np.column_stack([steps, np.zeros(5960), np.diff(path.time, prepend=path.time[:1])])
    wild, moved = judging.tracker_faults(MotionTrack(path.time, np.ones(5960, bool), motion))
    assert (wild == bad).all()
    assert not moved.any()
