"""A run in words: whether to believe its map, how it compares with the truth, and the five lines that end the
command `run` (what was done, error, closures, warnings, health)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from evaluation.artifacts.run_reader import count_closures, read_manifest, read_run
from evaluation.metrics.run_metrics import DOUBTED, NOT_JUDGED, UNFINISHED, path_length
from evaluation.metrics.scorecard import Scorecard, render_error, render_health, render_warnings

CAUTION = 1 - DOUBTED
"""Probability of being worse than odometry above which a map is to be taken with care."""


class Verdict(NamedTuple):
    """Whether to believe a map.

    Attributes:
        level: its kind. headline: a few words. reason: a sentence.
    """

    level: Literal["believed", "uncertain", "doubted", "unjudged"]
    headline: str
    reason: str


def judge_map(doubt: float, unjudged: str = NOT_JUDGED) -> Verdict:
    """The verdict on a map.

    Args:
        doubt: probability that its error is worse than odometry's; NaN if there is none. unjudged: why.
    """
    if np.isnan(doubt) and unjudged == NOT_JUDGED:
        reason = "This method does not say how far its map can be trusted."
        return Verdict("unjudged", "The map is not judged", reason)
    if np.isnan(doubt) and unjudged == UNFINISHED:
        return Verdict("unjudged", "The map is not judged yet", "It is judged when the run has ended.")
    if np.isnan(doubt):
        reason = f"{unjudged[:1].upper()}{unjudged[1:]}: nothing corrects its drift."
        return Verdict("unjudged", "This map is the odometry", reason)
    worse, better = _percent(doubt), _percent(1 - doubt)
    if doubt > DOUBTED:
        reason = f"It is {worse} likely worse than odometry, so odometry is given, without closures."
        return Verdict("doubted", "Do not believe this map", reason)
    if doubt > CAUTION:
        reason = f"It is {better} likely no worse than odometry; that leaves {worse} that it is worse."
        return Verdict("uncertain", "Take this map with care", reason)
    return Verdict("believed", "Believe this map", f"It is {better} likely no worse than odometry.")


def describe_score(card: Scorecard) -> str:
    """The position error in a sentence, or that the truth is unknown."""
    error = card.position_error
    if error.value is None:
        return "The truth is unknown, so there is no score."
    of = " within the pieces of the map" * ("ate_within_pieces" in card.quantities)
    text = f"Against the truth, the root mean square position error{of} is {error.value:.3g} {error.unit}"
    if error.odometry is None:
        return f"{text}."
    factor = ""
    if min(error.value, error.odometry) > 0:
        more = error.odometry / error.value
        off = f": the map is {1 / more:.2g} times as far off"
        factor = f", {more:.2g} times as much" if more > 1 else off
        factor = ", the same" if max(more, 1 / more) < 1.05 else factor
    worse = ", worse than odometry" * card.is_worse
    return f"{text}; that of odometry is {error.odometry:.3g} {error.unit}{factor}{worse}."


def _percent(probability: float) -> str:
    """A probability in percent; one that is not quite certain is not called certain."""
    if 0.995 <= probability < 1:
        return "over 99%"
    return "under 1%" if 0 < probability < 0.005 else f"{probability:.0%}"


def summarise(directory: Path, card: Scorecard, method: str) -> str:
    """The lines on a run directory; one more for each further warning about the input.

    Args:
        method: name of the backend.
    """
    run, source, closures = read_run(directory), read_manifest(directory).source, count_closures(directory)
    extent = f"{run.time[-1] - run.time[0]:.3g} s, {path_length(run.odometry):.3g} m by odometry"
    accepted = f"{closures.accepted} of {closures.proposed} proposed were accepted" if closures else "none"
    first = f"{directory}: {len(run.time)} steps of {source} by {method}, {extent}"
    warnings = render_warnings(card) or ["warnings: none"]
    return "\n".join([first, render_error(card), f"closures: {accepted}", *warnings, render_health(card)])
