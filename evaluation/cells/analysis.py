"""All scores of cells: a table with one row for each cell, and their shuffled controls.

Activity of pose cells has no unit: that of all cells sums to 1. A `gain` turns it into spikes/s; without one,
a cell with the mean activity of the network fires at 1 Hz. Scores in bits/spike and lengths do not
depend on it; rates, bits/s and the Rayleigh test do. Cells of an animal (`recording.record_spikes`) have
spikes/s.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.cells import head_direction
from evaluation.cells.fields import border_score, find_fields
from evaluation.cells.grid_score import HEXAGONAL, SQUARE, autocorrelogram, score_lattices
from evaluation.cells.information import information, mean_rate, selectivity, sparsity
from evaluation.cells.rate_map import (
    LEAST_SECONDS,
    coherence,
    rate_maps,
    recorded_sums,
    smooth_rates,
    sum_into,
    tuning_curves,
    weigh_bins,
)
from evaluation.cells.recording import BinnedSums, CellRecording
from evaluation.cells.shuffling import ShuffledScores, path_bins, shuffled_scores
from tactile.base.files import write_atomically


class CellScores(NamedTuple):
    """Scores of n cells, each [n]; NaN where undefined, as for a cell without activity.

    Attributes:
        cell: index in the flattened network, or of the unit. sheet_x, sheet_y: place on the torus, m.
            sheet_heading: rad.
        mean_rate: in the box, Hz. peak_rate: of the rate map, Hz. information: bits/spike.
        information_rate: bits/s. sparsity: (0, 1]. selectivity: peak over mean. coherence: of the map
            without smoothing, z. fields: number. field_area: of the largest, m^2. border: border score. grid:
            grid score. square: its counterpart for square lattices.
        vector_length: of the tuning curve, [0, 1]. direction: preferred, rad. heading_peak: Hz.
        rayleigh_z, rayleigh_p: Rayleigh test. heading_information: of the tuning curve, bits/spike.
        conjunctive: the smaller of `information` and `heading_information`, bits/spike. speed: speed score,
            NaN if only sums were recorded.
    """

    cell: np.ndarray
    sheet_x: np.ndarray
    sheet_y: np.ndarray
    sheet_heading: np.ndarray
    mean_rate: np.ndarray
    peak_rate: np.ndarray
    information: np.ndarray
    information_rate: np.ndarray
    sparsity: np.ndarray
    selectivity: np.ndarray
    coherence: np.ndarray
    fields: np.ndarray
    field_area: np.ndarray
    border: np.ndarray
    grid: np.ndarray
    square: np.ndarray
    vector_length: np.ndarray
    direction: np.ndarray
    heading_peak: np.ndarray
    rayleigh_z: np.ndarray
    rayleigh_p: np.ndarray
    heading_information: np.ndarray
    conjunctive: np.ndarray
    speed: np.ndarray


def analyse_cells(recording: CellRecording, gain: float | None = None) -> CellScores:
    """Scores of the cells of `recorded_sums`: of the chosen ones or, if only sums were recorded, of all.

    Args:
        gain: spikes/s for each unit of activity; None: the number of cells of the network, of an animal 1.

    Raises:
        InputError: no cells were recorded, lengths differ, no pose is known, the path has no area, or nothing
            was visited.
    """
    (sums, cell), hz = recorded_sums(recording), gain or math.prod(recording.shape) or 1.0
    parts = [_score_sums(part, hz) for part in sums.parts()]
    sheet = np.full((3, len(cell)), np.nan)
    if any(recording.shape):
        sheet = np.array(np.unravel_index(cell, recording.shape), float)
    heading, row, column = sheet
    speed = np.full(len(cell), np.nan)
    if len(recording.cell):
        at = path_bins(recording, "speed")
        inside = at.flat >= 0
        if at.seconds[inside].sum() > 0:
            rows = at.flat[inside], at.seconds[inside], recording.activity[inside]
            seconds, total = sum_into(*rows, at.shape)
            speed = speed_score(total / np.where(seconds > 0, seconds, np.nan), seconds)
    return CellScores(
        cell=np.asarray(cell),
        sheet_x=column * recording.cell_size,
        sheet_y=row * recording.cell_size,
        sheet_heading=heading * 2 * np.pi / max(recording.shape[0], 1),
        **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
        speed=speed,
    )


def _score_sums(sums: BinnedSums, hz: float) -> dict[str, np.ndarray]:
    """The scores [n] of sums, by name."""
    rates, curves = rate_maps(sums) * hz, tuning_curves(sums) * hz
    place, turn = (rates, sums.seconds), (curves, sums.heading_seconds)
    fields, about_place, about_heading = find_fields(rates), information(*place), information(*turn)
    mean, lattice = mean_rate(*place), score_lattices(autocorrelogram(rates), LATTICES)
    bin_area = float((sums.x_edges[1] - sums.x_edges[0]) * (sums.y_edges[1] - sums.y_edges[0]))
    return {
        "mean_rate": mean,
        "peak_rate": head_direction.peak_rate(*place),
        "information": about_place,
        "information_rate": about_place * mean,
        "sparsity": sparsity(*place),
        "selectivity": selectivity(*place),
        "coherence": coherence(rate_maps(sums, 0.0), sums.seconds),
        "fields": fields.number,
        "field_area": fields.largest * bin_area,
        "border": border_score(*place),
        "grid": lattice[0],
        "square": lattice[1],
        "vector_length": head_direction.mean_vector_length(*turn),
        "direction": head_direction.preferred_direction(*turn),
        "heading_peak": head_direction.peak_rate(*turn),
        "rayleigh_z": head_direction.rayleigh_z(*turn),
        "rayleigh_p": head_direction.rayleigh_p(*turn),
        "heading_information": about_heading,
        "conjunctive": np.minimum(about_place, about_heading),
    }


def speed_score(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] correlation of rates [n, B] with the running speed over its B bins, weighted by their times [B] s.

    -1 to 1, NaN for a cell with one rate at all speeds. Kropff et al. 2015 take samples, which gives less.
    """
    rates, share = weigh_bins(rates, seconds)
    bins = np.arange(rates.shape[1])
    about = bins - (share @ bins)[:, None], rates - (share * rates).sum(axis=1, keepdims=True)
    power = [(share * each**2).sum(axis=1) for each in about]
    scale = np.sqrt(power[0] * power[1])
    return (share * about[0] * about[1]).sum(axis=1) / np.where(scale > 0, scale, np.nan)


def control_scores(recording: CellRecording, shuffles: int = 100, seed: int = 0) -> dict[str, ShuffledScores]:
    """Scores and their shuffled controls, by the names of `CellScores`, of the chosen cells of a recording.

    The scores are those of `analyse_cells`, and shuffled maps are smoothed as its maps are.

    Args:
        shuffles: of each cell. seed: of the shifts.

    Raises:
        InputError: as `analyse_cells`, or the session is too short for shuffles.
    """
    found = {}
    for kind, names in CONTROLLED.items():
        bins = path_bins(recording, kind)
        if kind == "speed" and not bins.seconds[bins.flat >= 0].sum() > 0:
            continue  # no speed is known
        each = shuffled_scores(recording.activity, bins, partial(_score_bins, kind), shuffles, seed)
        for k, name in enumerate(names):
            found[name] = ShuffledScores(each.score[k], each.shuffled[:, k])
    return found


CONTROLLED = {
    "place": ("information", "sparsity", "selectivity", "coherence", "border", "grid", "square"),
    "heading": ("vector_length", "heading_information"),
    "speed": ("speed",),
}
"""The scores with a control by the bins that they need. The number and size of fields have ties, and the p
value of the Rayleigh test is itself one."""
LATTICES = HEXAGONAL, SQUARE
"""Of the scores `grid` and `square`."""
CORRECTED = ("information", "heading_information")
"""Scores that grow with the scatter of few spikes, of which the mean of shuffles is taken off."""
LOWER = ("sparsity",)
"""Scores that tuning makes smaller: the 5th percentile of their shuffles is the limit."""


def _score_bins(kind: str, rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[k, n] the scores of a kind of `CONTROLLED` of rates per bin without smoothing."""
    if kind == "speed":
        return speed_score(rates, seconds)[None]
    visited = np.where(seconds >= LEAST_SECONDS, 1.0, np.nan)
    if kind == "heading":
        turn = rates * visited, seconds
        return np.array([head_direction.mean_vector_length(*turn), information(*turn)])
    maps = smooth_rates(rates, seconds, 1.5) * visited
    images, place = autocorrelogram(maps), (maps, seconds)
    scores = information(*place), sparsity(*place), selectivity(*place), coherence(rates * visited, seconds)
    return np.array([*scores, border_score(*place), *score_lattices(images, LATTICES)])


def write_scores(
    path: Path,
    scores: CellScores,
    controls: Mapping[str, ShuffledScores] | None = None,
    names: tuple[str, ...] = (),
) -> None:
    """Writes a CSV file: a header with the names of `CellScores`, then a line for each cell; floats exactly
    (repr).

    Args:
        controls: `control_scores` of the cells, as columns behind the score: `NAME_shuffled`, the mean of the
            shuffles, `NAME_p95`, their 95th percentile (`NAME_p05` of one that tuning makes smaller), and
            `NAME_corrected`, an information minus that mean.
            None: without them. names: of the cells, instead of their indices.
    """
    columns: dict[str, list[object]] = {}
    for name, values in scores._asdict().items():
        columns[name] = list(names) if name == "cell" and names else values.tolist()
        if controls is not None and name in controls:
            control = controls[name]
            columns[f"{name}_shuffled"] = control.mean.tolist()
            if name in LOWER:
                columns[f"{name}_p05"] = control.low_percentile.tolist()
            else:
                columns[f"{name}_p95"] = control.percentile.tolist()
            if name in CORRECTED:
                columns[f"{name}_corrected"] = control.corrected.tolist()

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            rows = zip(*columns.values(), strict=True)
            csv.writer(file, lineterminator="\n").writerows([columns, *rows])

    write_atomically(path, write)
