"""The scores of cells that are compared with those of their shuffles, as functions of rates and seconds."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from evaluation.cells.autocorrelogram import autocorrelogram
from evaluation.cells.border import border_score
from evaluation.cells.coherence import coherence
from evaluation.cells.fields import largest_field
from evaluation.cells.grid_score import HEXAGONAL, SQUARE, lattice_scores
from evaluation.cells.head_direction import mean_vector_length, rayleigh_z
from evaluation.cells.information import (
    conjunctive_information,
    information,
    information_rate,
    selectivity,
    sparsity,
)
from evaluation.cells.rate_map import (
    arena_edges,
    heading_index,
    place_index,
    sample_seconds,
    smooth_rates,
)
from evaluation.cells.recording import CellRecording
from evaluation.cells.shuffling import PathBins, Score

SMOOTHING = 1.5
"""Standard deviation of the Gaussian over place, bins."""


def smoothed(score: Score) -> Score:
    """The score of the smoothed map."""
    return lambda rates, seconds: score(smooth_rates(rates, seconds, SMOOTHING), seconds)


PLACE_SCORES: Mapping[str, Score] = {
    "information": smoothed(information),
    "information rate": smoothed(information_rate),
    "1 - sparsity": smoothed(lambda rates, seconds: 1 - sparsity(rates, seconds)),
    "selectivity": smoothed(selectivity),
    "coherence": coherence,
    "largest field": smoothed(largest_field),
    "border score": smoothed(border_score),
    "grid score": smoothed(lambda rates, seconds: lattice_scores(autocorrelogram(rates), HEXAGONAL)),
    "square score": smoothed(lambda rates, seconds: lattice_scores(autocorrelogram(rates), SQUARE)),
}
"""Scores of maps of 20 x 20 bins."""
HEADING_SCORES: Mapping[str, Score] = {
    "mean vector length": mean_vector_length,
    "Rayleigh z": rayleigh_z,
    "heading information": information,
}
"""Scores of tuning curves of 36 bins, not smoothed."""
JOINT_SCORES: Mapping[str, Score] = {"conjunctive information": conjunctive_information}
"""Scores of maps of 8 headings and 10 x 10 bins, not smoothed."""


def place_bins(recording: CellRecording, bins: int = 20) -> PathBins:
    """The place bin of each step, of `bins` x `bins` over the box that the path fills."""
    flat = place_index(recording.truth, *arena_edges(recording.truth, bins))
    return PathBins(flat, (bins, bins), sample_seconds(recording.time))


def heading_bins(recording: CellRecording, bins: int = 36) -> PathBins:
    """The heading bin of each step."""
    return PathBins(heading_index(recording.truth, bins), (bins,), sample_seconds(recording.time))


def joint_bins(recording: CellRecording) -> PathBins:
    """The bin of heading and place of each step, 8 x 10 x 10."""
    place, turn = place_bins(recording, 10), heading_bins(recording, 8)
    flat = np.where((place.flat < 0) | (turn.flat < 0), -1, turn.flat * 100 + place.flat)
    return PathBins(flat, (8, 10, 10), place.seconds)


BINS: Mapping[Callable[[CellRecording], PathBins], Mapping[str, Score]] = {
    place_bins: PLACE_SCORES,
    heading_bins: HEADING_SCORES,
    joint_bins: JOINT_SCORES,
}
"""The scores of each kind of bins."""
