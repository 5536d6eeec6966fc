"""Reference traces: their values, and the errors of faulty ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.metrics.trajectory import ate
from robot.recordings.mcap_reader import Recording
from robot.recordings.mcap_writer import record_source
from robot.recordings.npz_trace import read_trace
from robot.sources.source import Source
from tactile.base.errors import InputError, InputErrors
from tactile.base.se2 import integrate
from tactile.base.types import Observation

Refused = Callable[..., InputError]


def test_a_trace_is_read_row_by_row(trace: Path) -> None:
    source = read_trace(trace)
    assert isinstance(source, Source)
    with np.load(trace) as arrays:
        np.testing.assert_array_equal(source.time, arrays["in_t"])
        np.testing.assert_array_equal(source.views.reshape(source.length, -1), arrays["in_view"])
        np.testing.assert_array_equal(source.truth, arrays["truth"])
        step = np.diff(arrays["in_t"], prepend=arrays["in_t"][:1])
        way, turn = arrays["in_v"] * step, arrays["in_w"] * step
    # Motion is along the heading after the turn of a row.
    moved = np.column_stack([way * np.cos(turn), way * np.sin(turn), turn, step])
    np.testing.assert_allclose(source.motion, moved, atol=1e-12)
    assert (source.name, source.view_shape, source.whiskers) == (trace.stem, (3, 6, 1), 0)
    assert source.rate_hz == pytest.approx(2.0)
    assert source.seen.all()
    assert source.info.provenance["parameters"]["exp_loops"] == 20
    assert isinstance(source.info.provenance["parameters"]["vt_match_threshold"], float)
    assert all(isinstance(sample.reading, Observation) for sample in source)


@pytest.mark.parametrize(
    ("name", "expected"),
    [("b_figure8_alias", 0.174), ("f_real_intel_laser3x6", 24.16), ("f_real_tuc_lecture_hall", 12.95)],
)
def test_the_error_of_raw_odometry_is_the_published_one(name, expected, find_trace):
    source = read_trace(find_trace(name))
    assert ate(integrate(source.motion[:, :3]), source.truth) == pytest.approx(expected, rel=3e-3)


def test_rows_without_odometry_do_not_advance_its_clock(stream: Callable[..., Path]) -> None:
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


def test_views_of_two_columns_are_place_labels(stream: Callable[..., Path], tmp_path: Path) -> None:
    """Unless the template has two pixels."""
    ids = np.column_stack([np.arange(12) // 3, np.zeros(12)])
    ids[4] = np.nan
    source = read_trace(stream(in_view=ids, in_flags=np.where(np.isnan(ids[:, 0]), 2.0, 3.0)))
    assert source.label.tolist() == [0, 0, 0, 1, -1, 1, 2, 2, 2, 3, 3, 3]
    assert not source.seen.any()
    assert source.view_shape == (2, 3, 1)
    record_source(source, tmp_path / "labels.mcap")
    assert source.info.labels_only
    assert Recording(tmp_path / "labels.mcap").info.labels_only
    params = '{"template_x_size": 2, "template_y_size": 1}'
    source = read_trace(stream(in_view=np.full((12, 2), 0.25), params_json=params, truth=None))
    assert (source.views == 0.25).all()
    assert source.seen.all()
    assert source.truth is None


def test_samples_share_no_writable_memory(stream: Callable[..., Path]) -> None:
    source = read_trace(stream())
    sample = next(iter(source))
    sample.truth[:] = 9
    with pytest.raises(ValueError, match="read-only"):
        sample.reading.view[:] = 1
    assert (next(iter(source)).truth == 0).all()


def test_the_digest_depends_on_the_content_only(stream: Callable[..., Path]) -> None:
    one = read_trace(stream()).digest
    assert read_trace(stream()).digest == one
    assert read_trace(stream(in_v=np.full(12, 0.11))).digest != one


def _with(array: Any, row: int, value: Any) -> np.ndarray:
    changed = np.array(array, dtype=np.float64)
    changed[row] = value
    return changed


TIME, VIEW = 100 + 0.5 * np.arange(12), np.full((12, 6), 0.5)
IDS = np.column_stack([np.arange(12), np.zeros(12)])
FAULTS: dict[str, tuple[dict[str, Any], list[str]]] = {
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


def test_all_errors_are_reported_together(stream: Callable[..., Path], refused: Refused) -> None:
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
