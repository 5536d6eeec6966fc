"""Known recordings pass with a margin; the same data in wrong units, or with wrong steps, are found."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.recordings import input_judge as judging
from robot.recordings.csv_config import CsvConfig, PoseColumns, TruthColumns, VelocityColumns
from robot.recordings.csv_reader import read_csv_recording
from robot.recordings.formats import open_recording
from robot.recordings.input_judge import DEFAULT_LIMITS, InputJudge, MotionTrack, UnitLimits
from robot.recordings.npz_trace import read_trace
from robot.recordings.recording_config import RecordingConfig
from robot.recordings.sanity_checks import Stretch
from robot.sources.in_memory import InMemorySource
from robot.sources.odometry import OdometryCorrection, from_poses, from_velocities, replace_steps
from tactile.base.errors import InputError
from tactile.base.se2 import between, integrate
from tests.robot.conftest import SYNTHETIC

REAL = ("f_real_intel_laser3x6", "f_real_tuc_lecture_hall")
Refused = Callable[..., InputError]
DEGREES, MILLIMETRES, MILLISECONDS = 180 / np.pi, 1000.0, 1000.0


@pytest.fixture(params=["intel", "lecture hall"])
def table(request: pytest.FixtureRequest, reference_data: Path) -> tuple[Path, CsvConfig]:
    """Each real recording as CSV, without its views."""
    data = reference_data / "data"
    if request.param == "intel":
        truth = TruthColumns(x="gt_x", y="gt_y", heading="gt_th")
        pose = PoseColumns(x="odo_x", y="odo_y", heading="odo_th")
        return data / "intel_odom_gt.csv", CsvConfig(pose=pose, truth=truth)
    truth = TruthColumns(file=data / "tuc_lecture_hall_gt.csv", heading="th")
    return data / "tuc_lecture_hall_odom.csv", CsvConfig(velocity=VelocityColumns(left="vy"), truth=truth)


def _check_margins(log: InMemorySource) -> None:
    """Each limit is far above its quantity."""
    robot = judging.typical_motion(MotionTrack(log.time, log.moved, log.motion, log.truth))
    ratios = [max(pair) / min(pair) if min(pair) else 1.0 for pair in (robot.path, robot.turning)]
    assert 5 * robot.interval < DEFAULT_LIMITS.interval
    assert 5 * max(robot.speed, robot.true_speed) < DEFAULT_LIMITS.speed
    assert 5 * robot.turn_rate < DEFAULT_LIMITS.turn_rate
    assert 5 * robot.turn < np.pi
    assert 20 * max(ratios) < judging.RATIO


def test_real_tables_pass_with_a_margin(table: tuple[Path, CsvConfig]) -> None:
    _check_margins(read_csv_recording(*table))


PLANTED: list[tuple[str, Any, str]] = [
    ("in_w", DEGREES, "in radians"),
    ("in_v", MILLIMETRES, "in metres"),
    ("in_view", 255.0, "in 0..1"),
    ("in_t", MILLISECONDS, "times in seconds"),
    ("truth", np.array([MILLIMETRES, MILLIMETRES, 1]), "truth in metres"),
    ("truth", np.array([1, 1, DEGREES]), "in radians"),
]
"""By what an array is multiplied, and what is expected instead."""


def _arrays(trace: Path) -> dict[str, np.ndarray]:
    with np.load(trace) as arrays:
        names = [name for name in arrays.files if name.startswith("in_") or name in ("params_json", "truth")]
        return {name: arrays[name].copy() for name in names}


@pytest.mark.parametrize("name", [*SYNTHETIC, *REAL])
def test_traces_pass_with_a_margin_and_are_refused_in_a_wrong_unit(name, find_trace, tmp_path, refused):
    trace, path = find_trace(name), tmp_path / "planted.npz"
    _check_margins(read_trace(trace))
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
    ("table", "column", "factor", "expected"),
    [("intel", "odo_th", DEGREES, "a heading in radians"), ("intel", "odo_x", MILLIMETRES, "in metres"),
     ("intel", "gt_th", DEGREES, "a heading in radians"), ("intel", "t", MILLISECONDS, "times in seconds"),
     ("lecture hall", "t", MILLISECONDS, "times in seconds"), ("lecture hall", "w", DEGREES, "in radians"),
     ("lecture hall", "vx", MILLIMETRES, "in metres")],
    indirect=["table"],
)  # fmt: skip
def test_a_wrong_unit_of_a_table_is_refused(table, column, factor, expected, tmp_path, refused):
    path, config = table
    header, *_ = path.read_text().split("\n", 1)
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    values[:, header.split(",").index(column)] *= factor
    planted = tmp_path / "planted.csv"
    np.savetxt(planted, values, "%.6f", ",", header=header, comments="")
    refused(lambda: read_csv_recording(planted, config), str(planted), expected)
    without_truth = config if column == "gt_th" else config.model_copy(update={"truth": None})
    refused(lambda: read_csv_recording(planted, without_truth), expected)


def _drive(rows: int = 400, interval: float = 0.1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, velocities [N, 2] (m/s, rad/s) and poses of a robot that drives, stands and turns."""
    time = np.arange(rows) * interval
    phase = np.arange(rows) // 40 % 4
    speeds = np.array([(0.4, 0.01), (0.4, 0.01), (0.0, 0.6), (0.0, 0.0)])[phase]
    return time, speeds, integrate(from_velocities(time, speeds[:, 0], 0.0, speeds[:, 1])[:, :3])


def _two_nodes(poses: np.ndarray) -> np.ndarray:
    poses[1::2, :2] += np.linspace(0, 0.8, len(poses) // 2)[:, None]
    return poses


def _faulty(kind: str) -> MotionTrack:
    """A drive with this fault: `A, B` where A is the fault and B what was recorded."""
    time, speeds, poses = _drive()
    everywhere = np.ones(len(time), bool)
    if kind.endswith("velocities"):
        time = time + np.where(np.arange(len(time)) >= (290 if "standing" in kind else 220), 60.0, 0.0)
        time = time * {"milliseconds": 1e3, "kiloseconds": 1e-4}.get(kind.split(",")[0], 1.0)
        if "gap" not in kind:
            time = np.arange(len(time)) * 0.1 * (time[1] / 0.1)
        motion = from_velocities(time, speeds[:, 0], 0.0, speeds[:, 1])
        return MotionTrack(time, everywhere, motion, held=True)
    change: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "wild": lambda poses: poses + 3.0 * (np.arange(len(poses)) == 150)[:, None] * [1, 0, 0],
        "reset": lambda poses: np.append(poses[:230], integrate(between(poses[229:-1], poses[230:])), axis=0),
        "two nodes": _two_nodes,
        "single precision": lambda poses: (poses + [4e5, 5e6, 0]).astype(np.float32).astype(float),
        "centimetres": lambda poses: poses * [100, 100, 1],
        "slow centimetres": lambda poses: poses * [100, 100, 1],
        "kilometres": lambda poses: poses * [1e-3, 1e-3, 1],
        "slow degrees": lambda poses: np.column_stack([poses[:, :2], np.degrees(np.unwrap(poses[:, 2]))]),
    }
    poses = change.get(kind.split(",")[0], lambda poses: poses)(poses)
    time = time * {"slow degrees": 10, "slow centimetres": 2.5}.get(kind.split(",")[0], 1)
    if "gap" in kind:
        time = time + np.where(np.arange(len(time)) >= 120, 60.0, 0.0)
    return MotionTrack(time, everywhere, from_poses(time, poses), poses=poses)


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
def test_a_fault_of_the_odometry_is_judged(kind: str) -> None:
    refused, *pieces = JUDGED[kind]
    told: list[str] = []
    errors = InputJudge(warn=told.append).errors(_faulty(kind), lambda row: f"row {row}", "file")
    assert len(errors) == refused
    assert len(told) == (not refused)
    (said,) = [*map(str, errors), *told]
    for piece in pieces:
        assert piece in said
    alone = judging.judge_motion(*_faulty(kind)[:3:2], "session")
    assert bool(alone) == (not kind.startswith(("two", "slow deg")))


@pytest.mark.parametrize("kind", ["clean, poses", "clean, velocities"])
def test_a_clean_drive_has_no_finding(kind: str) -> None:
    assert InputJudge(warn=pytest.fail).errors(_faulty(kind), str, "file") == []


@pytest.mark.parametrize("kind", ["wild, poses", "reset, poses", "gap, velocities"])
def test_the_printed_cure_repeats_the_step_before(kind: str) -> None:
    """The path that results is off by less than two steps."""
    track = _faulty(kind)
    told: list[str] = []
    errors = InputJudge(warn=told.append).errors(track, str, "file")
    (said,) = [*map(str, errors), *told]
    settings = {name: float(value) for name, value in re.findall(r"odometry\.(\w+)=([\d.]+)", said)}
    correction = OdometryCorrection.model_validate(settings)
    assert InputJudge(correction=correction).errors(track, str, "file") == []
    mended = integrate(replace_steps(correction, track.motion[:, :3]))
    assert np.hypot(*(mended - _drive()[2])[:, :2].T).max() < 0.09


def test_two_wild_rows_are_a_jump_and_no_unit(trace: Path, tmp_path: Path, refused: Refused) -> None:
    arrays, path = _arrays(trace), tmp_path / "wild.npz"
    for name, value in (("in_w", 1e5), ("in_v", 1e6)):
        arrays[name][[40, 41]] = value, -value
    np.savez(path, **arrays)
    refused(lambda: read_trace(path), "row 40: the odometry jumps by 5e+05 m", "largest_step")
    for stretch in (Stretch(25.0), Stretch(None, 15.0)):
        assert 0 < read_trace(path, InputJudge(stretch=stretch)).length < len(arrays["in_t"])


def test_limits_can_be_raised(stream: Callable[..., Path], refused: Refused) -> None:
    path = stream(in_v=np.full(12, 40.0), truth=None)
    refused(lambda: read_trace(path), "over 40 m/s", "raise recording.limits.speed (25)")
    config = RecordingConfig(file=path, limits=UnitLimits(speed=50.0))
    assert open_recording(config).length == 12


@pytest.mark.parametrize("turns", [0.4, 5.0])
def test_headings_in_degrees_are_detected(turns: float) -> None:
    """Headings in radians pass, in degrees they are refused, wrapped or not."""
    time = np.arange(200) * 0.5
    heading = np.linspace(0, 2 * np.pi * turns, 200) - 1.0
    wrapped = (heading + np.pi) % (2 * np.pi) - np.pi
    limits = UnitLimits(turn_rate=0.5) if turns < 1 else DEFAULT_LIMITS  # slow turning requires a lower limit
    for column in (heading, wrapped):
        assert judging.heading_errors(column, time, "th", "file", limits) == []
        (error,) = judging.heading_errors(np.rad2deg(column), time, "th", "file", limits)
        assert "multiply by pi/180" in str(error)


@pytest.mark.parametrize("rows", [0, 1, 2, 3])
def test_an_empty_track_is_accepted(rows: int) -> None:
    still = MotionTrack(np.arange(rows) * 1.0, np.ones(rows, bool), np.zeros((rows, 4)), np.zeros((rows, 3)))
    assert judging.unit_errors(still, "file") == []
    assert judging.unit_errors(still._replace(moved=np.zeros(rows, bool), truth=None), "file") == []
