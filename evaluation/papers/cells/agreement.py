"""The table of agreement: scores of recorded pose cells beside those of opexebo and pynapple.

Each package gets the same maps in its own convention; `grid_score`, `border_score` and `_mutual_information`
call the packages so. They are also what the tests of `evaluation/cells` compare its scores with.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np

from evaluation.cells import rate_map
from evaluation.cells.fields import Fields, find_fields, score_borders
from evaluation.cells.grid_score import autocorrelogram, lattice_scores
from evaluation.cells.head_direction import mean_vector_length, peak_rate
from evaluation.cells.information import (
    information,
    information_above_mean,
    information_rate,
    selectivity,
    sparsity,
)
from evaluation.cells.recording import BinnedSums
from evaluation.papers.cells.rat_sessions import SECONDS, record_rat
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import table_lines
from tactile.base.errors import InputError

CELLS, GOAL = 100, 1e-6
"""Cells compared, and the largest difference wanted."""
COLUMNS = ("score", "package", "cells", "largest difference", "goal", "largest score")


_Pair = tuple[str, str, np.ndarray, np.ndarray]
"""A score, the package, and the values of ours and of theirs for the same cells [n], NaN where undefined."""


def compare_scores(task: Task, seconds: float = SECONDS) -> list[tuple[str, str, int, float, float]]:
    """Scores of recorded pose cells of a rat, beside those of two other packages on the same maps: score,
    package, number of cells, largest difference (infinite where only one is undefined) and largest score.

    Args:
        task: its sessions are the number of cells. seconds: of the session.

    Raises:
        InputError: a package is not installed.
    """
    count = task.sessions or CELLS
    recording = record_rat("rat", count, seconds=seconds, seed=task.first)
    rates = recording.activity * float(np.prod(recording.shape))
    edges = rate_map.arena_edges(recording.truth, 20)
    return compare_sums(rate_map.bin_activity(recording.time, recording.truth, rates, *edges, 36))


def compare_sums(sums: BinnedSums) -> list[tuple[str, str, int, float, float]]:
    """The scores of cells from their sums, rates in Hz, as `compare_scores` gives them."""
    opexebo, pynapple = load_package("opexebo"), load_package("pynapple")
    with quiet():
        pairs = [*_beside_opexebo(opexebo, sums), *_beside_pynapple(pynapple, sums)]
    return [(score, package, *difference_of(mine, theirs)) for score, package, mine, theirs in pairs]


def difference_of(mine: np.ndarray, theirs: np.ndarray) -> tuple[int, float, float]:
    """Number of values, largest difference (infinite where only one is undefined), and largest value of
    ours.

    Args:
        mine, theirs: of equal shape, any unit, NaN where undefined.
    """
    apart = np.abs(mine - theirs)[~(np.isnan(mine) & np.isnan(theirs))]
    difference = float(np.nan_to_num(apart, nan=np.inf).max(initial=0.0))
    largest = float(np.nanmax(np.abs(mine))) if np.isfinite(mine).any() else np.nan
    return len(mine), difference, largest


def _agreement_table(result: list[tuple[str, str, int, float, float]]) -> list[str]:
    note = (
        "Recorded pose cells of a rat in 20 x 20 place and 36 heading bins, maps smoothed over 1.5 bins; "
        "each package gets the same maps, in its own convention (`evaluation/cells/README.md`)."
    )
    rows = (
        [*names, f"{difference:.1e}", f"{GOAL:.0e}", "-" if np.isnan(largest) else f"{largest:.3g}"]
        for *names, difference, largest in result
    )
    return table_lines([note], COLUMNS, rows)


def _beside_opexebo(opexebo: ModuleType, sums: BinnedSums) -> Iterator[_Pair]:
    analysis, maps, curves = opexebo.analysis, rate_map.rate_maps(sums, 1.5), rate_map.tuning_curves(sums)
    masked = [np.ma.masked_invalid(each) for each in maps]
    seconds = np.ma.masked_where(np.isnan(maps[0]), sums.seconds)
    stats = [analysis.rate_map_stats(each, seconds) for each in masked]
    named: dict[str, tuple[Callable[..., np.ndarray], str]] = {
        "information above the mean": (information_above_mean, "spatial_information_content"),
        "sparsity": (sparsity, "sparsity"),
        "selectivity": (selectivity, "selectivity"),
        "peak of the map": (peak_rate, "peak_rate"),
    }
    for name, (score, key) in named.items():
        yield name, "opexebo", score(maps, sums.seconds), _numbers(each[key] for each in stats)
    plain = np.nan_to_num(rate_map.rate_maps(sums, 0.0))
    framed = rate_map.neighbour_means(np.pad(plain, ((0, 0), (1, 1), (1, 1))))[:, 1:-1, 1:-1]
    theirs = _numbers(analysis.rate_map_coherence(np.ma.masked_invalid(each)) for each in plain)
    yield "coherence, not transformed", "opexebo", rate_map.correlate(plain, framed), theirs
    tuned = [analysis.tuning_curve_stats(np.ma.masked_invalid(each)) for each in curves]
    vector = mean_vector_length(curves, sums.heading_seconds)
    yield "mean vector length", "opexebo", vector, _numbers(each["hd_mvl"] for each in tuned)
    fields = find_fields(maps)
    own = np.unique(fields.cell)
    theirs = _numbers(border_score(opexebo, maps, fields, cell) for cell in own)
    yield "border score, same fields", "opexebo", score_borders(maps, fields)[own], theirs
    images = autocorrelogram(np.nan_to_num(maps))
    theirs = _numbers(grid_score(opexebo, image) for image in images)
    yield "grid score", "opexebo", lattice_scores(images), theirs


def _beside_pynapple(pynapple: ModuleType, sums: BinnedSums) -> Iterator[_Pair]:
    for what, rates, seconds in (
        ("place", rate_map.rate_maps(sums, 1.5), sums.seconds),
        ("heading", rate_map.tuning_curves(sums), sums.heading_seconds),
    ):
        theirs = _mutual_information(pynapple, rates, seconds)
        mine = information(rates, seconds), information_rate(rates, seconds)
        yield f"information, {what}", "pynapple", mine[0], theirs["bits/spike"]
        yield f"information rate, {what}", "pynapple", mine[1], theirs["bits/sec"]


def _numbers(values: Iterator[Any]) -> np.ndarray:
    return np.array([float(value) for value in values])


FIGURE = Figure("Agreement with other packages", compare_scores, _agreement_table, None)

HOW = {
    "opexebo": "pip install --no-deps opexebo",
    "pynapple": "pip install pynapple",
    "pynwb": "pip install 'ratslam[nwb]'",
    "ratinabox.utils": "pip install 'ratslam[ratinabox]'",
}
"""How each package is installed."""


def load_package(name: str) -> ModuleType:
    """A package of `HOW`.

    Raises:
        InputError: it is not installed.
    """
    with quiet():
        try:
            return import_module(name)
        except ImportError as error:
            raise InputError(name, "is not installed", "the package to compare with", HOW[name]) from error


@contextmanager
def quiet() -> Iterator[None]:
    """Hides the packages' warnings of their own divisions and of deprecated calls."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        yield


def grid_score(opexebo: ModuleType, image: np.ndarray) -> float:
    """opexebo's grid score of an autocorrelogram [H, W]."""
    with quiet(), _scalar_radius():
        return float(opexebo.analysis.grid_score(image)[0])


def border_score(opexebo: ModuleType, maps: np.ndarray, fields: Fields, cell: int) -> float:
    """opexebo's border score of a cell of maps [C, H, W], with these fields as its own."""
    own = np.flatnonzero(fields.cell == cell) + 1
    hidden = np.isnan(maps[cell])
    each = [
        {"field_map": np.ma.masked_where(hidden, (fields.label[cell] == number).astype(float))}
        for number in own
    ]
    labels = np.searchsorted(own, fields.label[cell], side="right")
    masked, width = np.ma.masked_invalid(maps[cell]), maps.shape[1]
    with quiet():
        return float(opexebo.analysis.border_score(masked, labels, each, "square", search_width=width)[0])


def _mutual_information(
    pynapple: ModuleType, rates: np.ndarray, seconds: np.ndarray
) -> dict[str, np.ndarray]:
    """pynapple's information of rates [C, ...] with occupancy [...] s: columns `bits/spike`, `bits/sec`."""
    known = np.where(np.isfinite(rates[0]), seconds, 0.0)
    names = [f"axis{k}" for k in range(seconds.ndim)]
    coordinates = {"unit": np.arange(len(rates))}
    with quiet():
        table: Any = import_module("xarray").DataArray(
            rates, dims=["unit", *names], coords=coordinates, attrs={"occupancy": known}
        )
        found = pynapple.compute_mutual_information(table)
    return {column: np.asarray(found[column], float) for column in ("bits/spike", "bits/sec")}


@contextmanager
def _scalar_radius() -> Iterator[None]:
    """opexebo's radius of the central field is an array of one number, which NumPy no longer takes as int."""
    module = sys.modules["opexebo.analysis.grid_score"]
    radius = vars(module)["_findCentreRadius"]

    def scalar(image: np.ndarray, **options: Any) -> Any:
        return np.asarray(radius(image, **options)).item()

    with patch.object(module, "_findCentreRadius", scalar):
        yield
