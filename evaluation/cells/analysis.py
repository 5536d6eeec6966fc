"""All scores of cells: a table with one row for each cell.

Activity has no unit: that of all cells sums to 1. A `gain` turns it into spikes/s; without one, a cell with
the mean activity of the network fires at 1 Hz. Scores in bits/spike and lengths do not
depend on it; rates, bits/s and the Rayleigh test do.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.cells import head_direction
from evaluation.cells.fields import border_score, find_fields
from evaluation.cells.information import information, information_rate, mean_rate, selectivity, sparsity
from evaluation.cells.rate_map import coherence, rate_maps, recorded_sums, tuning_curves
from evaluation.cells.recording import CellRecording
from tactile.base.files import write_atomically


class CellScores(NamedTuple):
    """Scores of n cells, each [n]; NaN where undefined, as for a cell without activity.

    Attributes:
        cell: index in the flattened network. sheet_x, sheet_y: place on the torus, m. sheet_heading: rad.
        mean_rate: in the box, Hz. peak_rate: of the rate map, Hz. information: bits/spike.
        information_rate: bits/s. sparsity: (0, 1]. selectivity: peak over mean. coherence: of the map
            without smoothing, z. fields: number. field_area: of the largest, m^2. border: border score.
        vector_length: of the tuning curve, [0, 1]. direction: preferred, rad. heading_peak: Hz.
        rayleigh_z, rayleigh_p: Rayleigh test. heading_information: of the tuning curve, bits/spike.
        conjunctive: the smaller of `information` and `heading_information`, bits/spike.
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
    vector_length: np.ndarray
    direction: np.ndarray
    heading_peak: np.ndarray
    rayleigh_z: np.ndarray
    rayleigh_p: np.ndarray
    heading_information: np.ndarray
    conjunctive: np.ndarray


def analyse_cells(recording: CellRecording, gain: float | None = None) -> CellScores:
    """Scores of the cells of `recorded_sums`: of the chosen ones or, if only sums were recorded, of all.

    Args:
        gain: spikes/s for each unit of activity; None: the number of cells of the network.

    Raises:
        InputError: no cells were recorded, lengths differ, no pose is known, the path has no area, or nothing
            was visited.
    """
    (sums, cell), hz = recorded_sums(recording), gain or math.prod(recording.shape)
    rates, curves = rate_maps(sums) * hz, tuning_curves(sums) * hz
    place, turn = (rates, sums.seconds), (curves, sums.heading_seconds)
    fields, about_place, about_heading = find_fields(rates), information(*place), information(*turn)
    heading, row, column = np.unravel_index(cell, recording.shape)
    bin_area = float((sums.x_edges[1] - sums.x_edges[0]) * (sums.y_edges[1] - sums.y_edges[0]))
    return CellScores(
        cell=np.asarray(cell),
        sheet_x=column * recording.cell_size,
        sheet_y=row * recording.cell_size,
        sheet_heading=heading * 2 * np.pi / recording.shape[0],
        mean_rate=mean_rate(*place),
        peak_rate=head_direction.peak_rate(*place),
        information=about_place,
        information_rate=information_rate(*place),
        sparsity=sparsity(*place),
        selectivity=selectivity(*place),
        coherence=coherence(rate_maps(sums, 0.0), sums.seconds),
        fields=fields.number,
        field_area=fields.largest * bin_area,
        border=border_score(*place),
        vector_length=head_direction.mean_vector_length(*turn),
        direction=head_direction.preferred_direction(*turn),
        heading_peak=head_direction.peak_rate(*turn),
        rayleigh_z=head_direction.rayleigh_z(*turn),
        rayleigh_p=head_direction.rayleigh_p(*turn),
        heading_information=about_heading,
        conjunctive=np.minimum(about_place, about_heading),
    )


def write_scores(path: Path, scores: CellScores) -> None:
    """Writes a CSV file: a header with the names of `CellScores`, then a line for each cell; floats exactly
    (repr)."""

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            rows = zip(*(column.tolist() for column in scores), strict=True)
            csv.writer(file, lineterminator="\n").writerows([CellScores._fields, *rows])

    write_atomically(path, write)
