"""Rate maps, tuning curves and the file of recorded cells: occupancy, smoothing, bad input."""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from evaluation.cells import rate_map
from evaluation.cells.fields import find_fields
from evaluation.cells.recording import BinnedSums, CellRecording, read_recording, write_recording
from evaluation.papers.cells import agreement
from evaluation.papers.cells.agreement import quiet
from evaluation.papers.figure import Task
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tests.evaluation.cells.box_walk import EDGES, mixed_cells, mixed_sums, random_walk, sheet_recording

WALK = random_walk()


def test_all_time_lies_in_some_bin_and_maps_of_a_walk_are_laws_of_their_sums() -> None:
    sums = mixed_sums(WALK)
    total = (mixed_cells(WALK) * rate_map.sample_seconds(WALK.time)[:, None]).sum(axis=0)
    assert_allclose([sums.seconds.sum(), sums.heading_seconds.sum()], 600, rtol=1e-9)
    assert_allclose(sums.place.sum(axis=(1, 2)), total, rtol=1e-9)
    assert_allclose(sums.heading.sum(axis=1), total, rtol=1e-9)
    # Bins with too little time have no rate.
    rates = rate_map.rate_maps(sums, least_seconds=1.0)
    assert (np.isnan(rates) == (sums.seconds < 1.0)).all()
    assert 0 < np.isnan(rates[0]).sum() < 400
    # Finished maps are smoothed as sums are.
    rates = rate_map.smooth_rates(rate_map.rate_maps(sums, 0.0, 1e-3), sums.seconds, 1.5)
    assert_allclose(rates, rate_map.rate_maps(sums, 1.5, 1e-3), rtol=1e-9)
    # A cell that is always active has a flat map.
    maps = (rate_map.rate_maps(sums, smoothing)[9] for smoothing in (0.0, 1.5))
    for found in (*maps, rate_map.tuning_curves(sums)[9]):
        assert_allclose(found[np.isfinite(found)], 1.0, rtol=1e-12)


@given(st.integers(3, 25), st.integers(3, 25), st.floats(0.3, 5.0))
def test_smoothing_keeps_the_sum(height: int, width: int, sigma: float) -> None:
    values = stream(height * 100 + width, "smoothing").random((2, height, width))
    smooth = rate_map.smooth_plane(values, sigma)
    assert_allclose(smooth.sum(axis=(1, 2)), values.sum(axis=(1, 2)), rtol=1e-12)


def test_poses_outside_or_unknown_lie_in_no_bin_and_the_last_edge_in_the_last_bin() -> None:
    nan = np.nan
    truth = np.array([[0, 0, 0], [1, 1, 0.08], [1.01, 0.5, 0], [nan, 0.5, -0.08], [0.5, 0.05, nan]])
    assert rate_map.place_index(truth, EDGES, EDGES).tolist() == [0, 399, -1, -1, 20 + 10]
    assert rate_map.heading_index(truth, 36).tolist() == [0, 0, 0, 0, -1]
    assert rate_map.circle_bin(np.array([2 * np.pi - 0.08, np.pi]), 36).tolist() == [0, 18]
    sums = rate_map.bin_activity(np.arange(5.0), truth, np.ones((5, 1)), EDGES, EDGES)
    assert sums.seconds[0, 0] == sums.seconds[19, 19] == 1.0
    assert sums.seconds.sum() == sums.place.sum() == sums.heading.sum() == 2.0


TIME, TRUTH, ACTIVITY = np.arange(5.0), np.full((5, 3), 0.5), np.ones((5, 2))


def binned(time: np.ndarray = TIME, truth: np.ndarray = TRUTH) -> BinnedSums:
    return rate_map.bin_activity(time, truth, ACTIVITY, EDGES, EDGES)


@pytest.mark.parametrize(("wrong", "named"), [
    (lambda sums: binned(truth=TRUTH * np.nan), "no known pose"),
    (lambda sums: binned(truth=TRUTH + 7), "no time is spent"),
    (lambda sums: binned(truth=TRUTH[:4]), "equal lengths"),
    (lambda sums: binned(time=TIME[::-1]), "rising times"),
    (lambda sums: rate_map.arena_edges(TRUTH * np.nan), "no known pose"),
    (lambda sums: rate_map.arena_edges(TRUTH), "without width"),
    (lambda sums: rate_map.rate_maps(sums._replace(seconds=np.zeros((20, 20)))), "visited arena"),
    (lambda sums: rate_map.rate_maps(sums._replace(seconds=np.ones((20, 19)))), r"sums\.place"),
    (lambda sums: rate_map.tuning_curves(sums._replace(heading_seconds=np.zeros(36))), "visited arena"),
    (lambda sums: rate_map.tuning_curves(sums._replace(heading_seconds=np.ones(35))), r"sums\.heading"),
    (lambda sums: rate_map.weigh_bins(np.ones((2, 5)), np.zeros(5)), "no time in any bin"),
    (lambda sums: rate_map.weigh_bins(np.ones((2, 5)), np.ones(6)), "bins of the rates"),
])  # fmt: skip
def test_unfit_paths_and_sums_are_refused(wrong, named: str) -> None:
    with pytest.raises(InputError, match=named):
        wrong(mixed_sums(WALK))


STEPS, NETWORK, CHOSEN = 7, (4, 3, 3), 5


def made(sums: bool) -> CellRecording:
    random, cells = np.random.default_rng(0), int(np.prod(NETWORK))
    binned = BinnedSums(
        np.linspace(0.0, 1.0, 4), np.linspace(0.0, 2.0, 3), random.random((2, 3)),
        random.random((cells, 2, 3), np.float32), random.random(6), random.random((cells, 6), np.float32),
    )  # fmt: skip
    return CellRecording(
        NETWORK, 0.05, np.arange(STEPS) / 50, np.full((STEPS, 3), np.nan), random.random((STEPS, 3)),
        random.random(STEPS), np.arange(STEPS, dtype=np.int32) - 1, np.arange(CHOSEN, dtype=np.int32),
        random.random((STEPS, CHOSEN), np.float32), binned if sums else None,
    )  # fmt: skip


@pytest.mark.parametrize("sums", [True, False])
def test_a_recording_is_read_as_it_was_written_and_equal_ones_give_equal_bytes(tmp_path, sums):
    recording = made(sums)
    for name in ("one.npz", "other.npz"):
        write_recording(tmp_path / name, recording)
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "other.npz").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2
    found = read_recording(tmp_path / "one.npz")
    assert (found.shape, found.cell_size) == (recording.shape, recording.cell_size)
    assert (found.sums is None) == (recording.sums is None)
    pairs = [*zip(recording[2:-1], found[2:-1], strict=True)]
    pairs += zip(recording.sums or (), found.sums or (), strict=True)
    for written, read in pairs:
        assert read.dtype == written.dtype
        np.testing.assert_array_equal(read, written)


def test_broken_foreign_and_missing_files_and_arrays_that_do_not_fit_are_refused(tmp_path):
    file = tmp_path / "cells.npz"
    write_recording(file, made(True))
    content = file.read_bytes()
    with np.load(file) as archive:
        arrays = dict(archive)
    for spoilt in (
        content[: len(content) // 2], b"", b"text", {"a": np.zeros(3)}, arrays | {"format": np.array("9")},
        arrays | {"activity": np.zeros((STEPS, 6), np.float32)}, arrays | {"truth": np.zeros((STEPS, 2))},
        arrays | {"energy": np.zeros(STEPS - 1)}, arrays | {"cell": np.array([0, 1, 2, 3, 36], np.int32)},
        arrays | {"cell": np.array([0, 1, 2, 3, -1], np.int32)}, arrays | {"shape": np.array([4, 3])},
        arrays | {"sums/seconds": np.zeros((3, 2))}, arrays | {"sums/heading": np.zeros((35, 6))},
    ):  # fmt: skip
        np.savez(file, **spoilt) if isinstance(spoilt, dict) else file.write_bytes(spoilt)
        with pytest.raises(InputError, match=r"cells\.npz: another kind of file"):
            read_recording(file)
    with pytest.raises(InputError, match="no such file"):
        read_recording(tmp_path / "none.npz")


def _import(name: str) -> ModuleType:
    with quiet():
        return pytest.importorskip(name)


def _quietly(function: Callable[..., Any], *args: Any, **keys: Any) -> Any:
    with quiet():
        return function(*args, **keys)


@pytest.fixture(scope="module")
def opexebo() -> ModuleType:
    return _import("opexebo")


@pytest.fixture(scope="module")
def spikes() -> np.ndarray:
    """[T, 10] number of spikes in each step of 0.05 s, 8 spikes/s at activity 1."""
    return stream(0, "spikes").poisson(mixed_cells(WALK) * 8.0 * 0.05)


@pytest.fixture(scope="module")
def sums(spikes: np.ndarray) -> BinnedSums:
    return rate_map.bin_activity(*WALK, spikes / 0.05, EDGES, EDGES, 36)


def test_occupancy_and_maps_are_those_of_opexebo(
    opexebo: ModuleType, spikes: np.ndarray, sums: BinnedSums
) -> None:
    keys = {"bin_edges": (EDGES, EDGES), "limits": (0.0, 1.0, 0.0, 1.0)}
    occupancy, _, _ = _quietly(opexebo.analysis.spatial_occupancy, WALK.time, WALK.truth.T[:2], 1.0, **keys)
    maps = []
    for count in spikes.T:
        tracking = np.repeat(np.column_stack([WALK.time, WALK.truth[:, :2]]), count, axis=0).T
        maps.append(_quietly(opexebo.analysis.rate_map, occupancy, tracking, 1.0, **keys))
    assert_allclose(sums.seconds, occupancy.filled(0), atol=1e-9)
    assert_allclose(rate_map.rate_maps(sums, 0.0, 1e-3), [each.filled(np.nan) for each in maps], rtol=1e-9)


@pytest.mark.parametrize("sigma", [1.0, 2.0])
def test_smoothing_is_that_of_opexebo(opexebo: ModuleType, sums: BinnedSums, sigma: float) -> None:
    """Its two conventions: bins without a rate count as 0, or are ignored (`mask_fill=nan`)."""
    rates = rate_map.rate_maps(sums, 0.0, 1e-3)
    rates[:, 4:6, 7] = np.nan
    known = np.isfinite(rates)
    filled = rate_map.smooth_plane(np.nan_to_num(rates), sigma)
    ignored = rate_map.smooth_rates(rates, np.ones((20, 20)), sigma)
    for mine, fill in ((filled, 0.0), (ignored, np.nan)):
        for cell in (0, 8):
            masked = np.ma.masked_invalid(rates[cell])
            other = _quietly(opexebo.general.smooth, masked, sigma, mask_fill=fill)
            assert_allclose(mine[cell][known[cell]], other.compressed(), rtol=1e-6)


@pytest.mark.parametrize("spots", [[(5, 5)], [(4, 14), (14, 5)], [(3, 3), (16, 3), (9, 16)]])
def test_separate_fields_are_those_of_opexebo(opexebo: ModuleType, spots: list[tuple[int, int]]) -> None:
    """Its search, given the peaks, ends at 0.2 of the peak of the map opened by a disk of radius 1."""
    morphology = _import("skimage.morphology")
    y, x = np.mgrid[:20, :20]
    rates = np.stack([20 * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 8) for b, a in spots]).sum(axis=0)
    keys = {"min_peak": 0.0, "min_mean": 0.0, "peak_coords": np.array(spots)}
    other, label = _quietly(opexebo.analysis.place_field, rates, **keys)
    opened = morphology.reconstruction(morphology.erosion(rates, morphology.disk(1)), rates)
    fields = find_fields(rates[None], 0.2 * opened.max() / rates.max())
    assert len(fields.cell) == len(other) == len(spots)
    assert ((fields.label[0] > 0) == (label > 0)).all()
    assert sorted(fields.bins) == sorted(each["area"] for each in other)
    assert_allclose(sorted(fields.peak), sorted(each["peak_rate"] for each in other), atol=1e-6)


def test_scores_agree_with_opexebo_and_pynapple(spikes: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    _import("pynapple")
    cells = np.arange(spikes.shape[1])
    recording = sheet_recording(WALK, np.zeros(0, int))._replace(cell=cells, activity=spikes.astype(float))
    monkeypatch.setattr(agreement, "record_rat", lambda *_, **__: recording)
    found = agreement.compare_scores(Task(3, 10))
    assert {score: apart for score, _, _, apart, _ in found if not apart <= agreement.GOAL} == {}
    assert len({(score, package) for score, package, *_ in found}) == len(found) == 12
    assert all(largest > 0 for *_, largest in found)
