"""All scores of cells: a table with one row for each cell.

Activity has no unit: that of all cells sums to 1. `AnalysisSettings.gain` turns it into spikes/s; without
one, a cell with the mean activity of the network fires at 1 Hz. Scores in bits/spike and lengths do not
depend on it; rates, bits/s and the Rayleigh test do.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field

from evaluation.cells.fields import FieldSettings, border_score, find_fields
from evaluation.cells.head_direction import (
    mean_vector_length,
    peak_rate,
    preferred_direction,
    rayleigh_p,
    rayleigh_z,
)
from evaluation.cells.information import information, information_rate, mean_rate, selectivity, sparsity
from evaluation.cells.rate_map import (
    MapSettings,
    arena_edges,
    bin_activity,
    coherence,
    rate_maps,
    tuning_curves,
)
from evaluation.cells.recording import BinnedSums, CellRecording
from tactile.base.errors import InputError
from tactile.base.files import write_atomically
from tactile.base.settings import Settings


class AnalysisSettings(Settings):
    """How recorded cells are scored."""

    maps: MapSettings = MapSettings()
    """Bins and smoothing; the bins of sums are those of the recording."""
    fields: FieldSettings = FieldSettings()
    """What counts as a field."""
    gain: float | None = Field(default=None, gt=0)
    """Spikes/s for each unit of activity; None: the number of cells of the network."""


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


def analyse_cells(recording: CellRecording, settings: AnalysisSettings | None = None) -> CellScores:
    """Scores of the chosen cells, from their time series, in bins over the box that the path fills.

    Raises:
        InputError: no cells were chosen, lengths differ, no pose is known or the path has no area.
    """
    settings = settings or AnalysisSettings()
    if len(recording.cell) == 0 or recording.activity.shape[1:] != recording.cell.shape:
        found = f"activity of {recording.activity.shape} for {len(recording.cell)} cells"
        raise InputError("recording", found, "one column for each chosen cell", "choose cells to record")
    edges = arena_edges(recording.truth, settings.maps.place_bins)
    sums = bin_activity(
        recording.time, recording.truth, recording.activity, *edges, settings.maps.heading_bins
    )
    return _score_sums(sums, recording.cell, recording, settings)


def analyse_all_cells(recording: CellRecording, settings: AnalysisSettings | None = None) -> CellScores:
    """Scores of all cells of the network, from the sums of the recording.

    Raises:
        InputError: the recording has no sums, or nothing was visited.
    """
    cells = math.prod(recording.shape)
    if recording.sums is None or len(recording.sums.place) != cells:
        raise InputError("recording.sums", "not of all cells", f"sums of {cells} cells", "record the sums")
    return _score_sums(recording.sums, np.arange(cells), recording, settings or AnalysisSettings())


def _score_sums(
    sums: BinnedSums, cell: np.ndarray, recording: CellRecording, settings: AnalysisSettings
) -> CellScores:
    """Scores of `cell` [n], indices in the network of the recording, from their sums."""
    hz, maps = settings.gain or math.prod(recording.shape), settings.maps
    rates = rate_maps(sums, maps.smoothing, maps.least_seconds) * hz
    raw = rate_maps(sums, 0.0, maps.least_seconds)
    curves = tuning_curves(sums, maps.heading_smoothing, maps.least_seconds) * hz
    place, turn = (rates, sums.seconds), (curves, sums.heading_seconds)
    fields = find_fields(rates, settings.fields.share, settings.fields.least_bins)
    about_place, about_heading = information(*place), information(*turn)
    heading, row, column = np.unravel_index(cell, recording.shape)
    bin_area = float((sums.x_edges[1] - sums.x_edges[0]) * (sums.y_edges[1] - sums.y_edges[0]))
    return CellScores(
        cell=np.asarray(cell),
        sheet_x=column * recording.cell_size,
        sheet_y=row * recording.cell_size,
        sheet_heading=heading * 2 * np.pi / recording.shape[0],
        mean_rate=mean_rate(*place),
        peak_rate=peak_rate(*place),
        information=about_place,
        information_rate=information_rate(*place),
        sparsity=sparsity(*place),
        selectivity=selectivity(*place),
        coherence=coherence(raw, sums.seconds),
        fields=fields.number,
        field_area=fields.largest * bin_area,
        border=border_score(*place),
        vector_length=mean_vector_length(*turn),
        direction=preferred_direction(*turn),
        heading_peak=peak_rate(*turn),
        rayleigh_z=rayleigh_z(*turn),
        rayleigh_p=rayleigh_p(*turn),
        heading_information=about_heading,
        conjunctive=np.minimum(about_place, about_heading),
    )


def write_scores(path: Path, scores: CellScores) -> None:
    """Writes a CSV file: a header with the names of `CellScores`, then a line for each cell; floats exactly
    (repr)."""

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(CellScores._fields)
            writer.writerows(zip(*(column.tolist() for column in scores), strict=True))

    write_atomically(path, write)
