"""Unit check: known recordings pass with a margin; the same data in wrong units are refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from robot.recordings.csv_config import CsvConfig, PoseColumns, TruthColumns, VelocityColumns
from robot.recordings.csv_reader import read_csv_recording
from robot.recordings.formats import RecordingConfig, open_recording
from robot.recordings.npz_trace import read_trace
from robot.recordings.unit_check import (
    DEFAULT_LIMITS,
    RATIO,
    MotionTrack,
    UnitLimits,
    heading_errors,
    typical_motion,
    unit_errors,
)
from robot.sources.in_memory import InMemorySource
from tactile.base.errors import InputError

REAL = ("f_real_intel_laser3x6", "f_real_tuc_lecture_hall")
DEGREES, MILLIMETRES, MILLISECONDS = 180 / np.pi, 1000.0, 1000.0


@pytest.fixture(params=REAL)
def real(request: pytest.FixtureRequest, find_trace: Callable[[str], Path]) -> Path:
    """Each real reference trace."""
    return find_trace(request.param)


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


def _margins(log: InMemorySource) -> dict[str, float]:
    """Ratio of each limit to its quantity."""
    robot = typical_motion(MotionTrack(log.time, log.moved, log.motion, log.truth))
    ratios = [max(pair) / min(pair) if min(pair) else 1.0 for pair in (robot.path, robot.turning)]
    return {
        "interval": DEFAULT_LIMITS.interval / robot.interval,
        "speed": DEFAULT_LIMITS.speed / robot.speed,
        "true_speed": DEFAULT_LIMITS.speed / robot.true_speed,
        "turn_rate": DEFAULT_LIMITS.turn_rate / robot.turn_rate,
        "turn": np.pi / robot.turn,
        "path": RATIO / ratios[0],
        "turning": RATIO / ratios[1],
    }


def _check_margins(log: InMemorySource) -> None:
    margins = _margins(log)
    print(log.name, {name: round(margin, 1) for name, margin in margins.items()})
    assert min(margins.values()) > 5
    assert min(margins["path"], margins["turning"]) > 20


def test_traces_pass_with_a_margin(trace: Path) -> None:
    _check_margins(read_trace(trace))


def test_real_traces_pass_with_a_margin(real: Path) -> None:
    _check_margins(read_trace(real))


def test_real_tables_pass_with_a_margin(table: tuple[Path, CsvConfig]) -> None:
    _check_margins(read_csv_recording(*table))


PLANTED = {
    "turn in degrees": ("in_w", DEGREES, "in radians"),
    "speed in mm/s": ("in_v", MILLIMETRES, "in metres"),
    "views in bytes": ("in_view", 255.0, "in 0..1"),
    "time in ms": ("in_t", MILLISECONDS, "times in seconds"),
    "truth in mm": ("truth", np.array([MILLIMETRES, MILLIMETRES, 1]), "truth in metres"),
    "truth in degrees": ("truth", np.array([1, 1, DEGREES]), "in radians"),
}


def _plant(
    trace: Path, path: Path, array: str, factor: float | np.ndarray, drop: tuple[str, ...] = ()
) -> Path:
    with np.load(trace) as arrays:
        changed = {
            name: arrays[name] for name in arrays.files if name.startswith("in_") or name == "params_json"
        }
        changed["truth"] = arrays["truth"]
    changed[array] = changed[array] * factor
    np.savez(path, **{name: value for name, value in changed.items() if name not in drop})
    return path


@pytest.mark.parametrize(("array", "factor", "expected"), PLANTED.values(), ids=PLANTED.keys())
def test_a_wrong_unit_is_refused(
    trace: Path,
    array: str,
    factor: float,
    expected: str,
    tmp_path: Path,
    refused: Callable[..., InputError],
) -> None:
    path = _plant(trace, tmp_path / "planted.npz", array, factor)
    refused(lambda: read_trace(path), str(path), expected)


@pytest.mark.parametrize(
    ("real", "array", "factor", "expected"),
    [
        pytest.param(name, *planted, id=f"{name}-{label}")
        for name in REAL
        for label, planted in PLANTED.items()
        if (name, label) != ("f_real_tuc_lecture_hall", "views in bytes")  # its views are ids
    ],
    indirect=["real"],
)
def test_a_wrong_unit_of_a_real_recording_is_refused(
    real: Path,
    array: str,
    factor: float,
    expected: str,
    tmp_path: Path,
    refused: Callable[..., InputError],
) -> None:
    path = _plant(real, tmp_path / "planted.npz", array, factor)
    refused(lambda: read_trace(path), str(path), expected)


@pytest.mark.parametrize(("array", "factor", "expected"), list(PLANTED.values())[:2], ids=list(PLANTED)[:2])
def test_a_wrong_unit_is_refused_without_truth(
    trace: Path,
    array: str,
    factor: float,
    expected: str,
    tmp_path: Path,
    refused: Callable[..., InputError],
) -> None:
    path = _plant(trace, tmp_path / "planted.npz", array, factor, drop=("truth",))
    if array == "in_w" and trace.stem == "j_reverse_stop":
        read_trace(path)  # 1.1 degrees per second: undetectable
    else:
        refused(lambda: read_trace(path), str(path), expected)


@pytest.mark.parametrize(
    ("table", "column", "factor", "expected"),
    [("intel", "odo_th", DEGREES, "a heading in radians"), ("intel", "odo_x", MILLIMETRES, "in metres"),
     ("intel", "gt_th", DEGREES, "a heading in radians"), ("intel", "t", MILLISECONDS, "times in seconds"),
     ("lecture hall", "t", MILLISECONDS, "times in seconds"), ("lecture hall", "w", DEGREES, "in radians"),
     ("lecture hall", "vx", MILLIMETRES, "in metres")],
    indirect=["table"],
)  # fmt: skip
def test_a_wrong_unit_of_a_table_is_refused(
    table: tuple[Path, CsvConfig],
    column: str,
    factor: float,
    expected: str,
    tmp_path: Path,
    refused: Callable[..., InputError],
) -> None:
    path, config = table
    header, *_ = path.read_text().split("\n", 1)
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    values[:, header.split(",").index(column)] *= factor
    planted = tmp_path / "planted.csv"
    np.savetxt(planted, values, "%.6f", ",", header=header, comments="")
    refused(lambda: read_csv_recording(planted, config), str(planted), expected)
    without_truth = config if column == "gt_th" else config.model_copy(update={"truth": None})
    refused(lambda: read_csv_recording(planted, without_truth), expected)


def test_two_outliers_do_not_change_the_verdict(trace: Path, tmp_path: Path) -> None:
    """Two outlier rows in a recording with little turning."""
    with np.load(trace) as arrays:
        changed = {
            name: arrays[name] for name in arrays.files if name.startswith("in_") or name == "params_json"
        }
        changed["truth"] = arrays["truth"]
    for name, value in (("in_w", 1e5), ("in_v", 1e6)):
        changed[name] = changed[name].copy()
        changed[name][[40, 41]] = value, -value
    np.savez(tmp_path / "wild.npz", **changed)
    assert read_trace(tmp_path / "wild.npz").length == len(changed["in_t"])


def test_a_real_row_of_five_milliseconds_passes(find_trace: Callable[[str], Path]) -> None:
    log = read_trace(find_trace("f_real_intel_laser3x6"))
    rate = np.abs(log.motion[1:, 2]) / log.motion[1:, 3]
    assert rate.max() > 90


def test_limits_can_be_raised(stream: Callable[..., Path], refused: Callable[..., InputError]) -> None:
    path = stream(in_v=np.full(12, 40.0), truth=None)
    refused(lambda: read_trace(path), "over 40 m/s", "if it really is so, raise limits.speed (25)")
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
        assert heading_errors(column, time, "th", "file", limits) == []
        (error,) = heading_errors(np.rad2deg(column), time, "th", "file", limits)
        assert "multiply by pi/180" in str(error)


def test_an_empty_track_is_accepted() -> None:
    for rows in (0, 1, 2, 3):
        still = MotionTrack(
            np.arange(rows) * 1.0, np.ones(rows, bool), np.zeros((rows, 4)), np.zeros((rows, 3))
        )
        assert unit_errors(still, "file") == []
        assert unit_errors(still._replace(moved=np.zeros(rows, bool), truth=None), "file") == []
