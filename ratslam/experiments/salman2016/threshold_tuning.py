"""The paper's tuning made definite (Salman & Pearson 2016, III-F), for the classic matcher.

The energy of injection is half of the iRat's; the matching threshold is raised over a grid; wanted is the one
with the most correct re-localisations on the second and third lap, none incorrect and at least ten correct.
Before any of that, the views themselves say what a threshold can tell apart: how unlike two views of one
place are, and two of different places.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.experience_metric import base_end, experience_metric
from evaluation.plots.paper_figures import draw_tuning
from ratslam.classic.view_templates import TemplateConfig
from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import Document, override, validate
from ratslam.experiments.trials.process_pool import shared_out
from ratslam.experiments.trials.threshold_sweep import classics
from ratslam.experiments.trials.touch_trial import first, lap_ends, session_log, whole
from robot.sources.in_memory import Log
from tactile.base.errors import InputError
from tactile.base.se2 import wrap

CLASSIC = ("backend=classic", "templates.energy=0.05")
"""What is tuned: half of iRat's 0.1 (III-F; the value is Ball et al. 2013's)."""
THRESHOLDS = tuple(np.round(np.arange(1, 33) * 0.005, 3).tolist())
"""The grid."""
LAPS = 3
"""Up to the end of this one."""
ENOUGH = 10
"""Correct re-localisations that a threshold must bring."""
SAME, SAME_HEADING = 0.05, np.radians(15)
"""Views taken so near each other are of the same place, m and rad,"""
ANOTHER_VISIT = 60.0
"""if so much time lies between them, s."""
OTHER = 0.3
"""Views taken farther apart are of different places, m."""
BINS = 60
"""Of the histograms."""
ROWS = 64
"""Views compared with all others at a time."""


class Likeness(NamedTuple):
    """How unlike views are, as the classic matcher measures it.

    Attributes:
        edge: [BINS + 1] of the histograms. same, other: [BINS] pairs of views of one place, of two.
        auc: chance that two views of different places are less alike than two of the same; 0.5: views tell
            nothing.
    """

    edge: np.ndarray
    same: np.ndarray
    other: np.ndarray
    auc: float


class Tried(NamedTuple):
    """What a threshold led to on the laps after the base set.

    Attributes:
        arr: re-localisations over steps. correct, incorrect: their numbers, by strict reading.
    """

    threshold: float
    arr: float
    correct: int
    incorrect: int


class Tuning(NamedTuple):
    """Attributes:
    winner: the threshold, None where none satisfies. why: a sentence on either. likeness: of the views.
    tried: in the order of the grid. steps: that were judged, from and to.
    """

    winner: Tried | None
    why: str
    likeness: Likeness
    tried: list[Tried]
    steps: tuple[int, int]


def tune(document: Document, folder: Path, workers: int = 1) -> Tuning:
    """Tunes the threshold of a configuration.

    Args:
        folder: of the configuration file. workers: processes that share out the grid.

    Raises:
        InputError: the source cannot be used, has no truth or no views, or never returns to its start.
    """
    config = whole(validate(override(document, CLASSIC), RunConfig), folder)
    config, log = session_log(config)
    if config.templates.source == "labels" or not log.seen.all():
        raise InputError(log.name, "steps without a view", "a view at every step")
    log, base = _judged_part(log)
    likeness = compared(config.templates, log)
    parts = [part for part in np.array_split(THRESHOLDS, workers) if len(part)]
    found = shared_out(_tried, [(config, log, base, part) for part in parts], workers)
    tried = [each for part in found for each in part]
    winner, why = chosen(tried, likeness)
    return Tuning(winner, why, likeness, tried, (base, log.length))


def chosen(tried: Sequence[Tried], likeness: Likeness) -> tuple[Tried | None, str]:
    """The threshold that the rule takes, and a sentence on why, or on why there is none."""
    clean = [each for each in tried if not each.incorrect and each.correct >= ENOUGH]
    if clean:
        best = max(clean, key=lambda each: each.correct)  # the lowest of equals
        return best, f"{len(clean)} thresholds bring at least {ENOUGH} correct and none incorrect"
    enough = [each for each in tried if each.correct >= ENOUGH]
    if not enough:
        most = max(tried, key=lambda each: each.correct)
        why = (
            f"no threshold brings {ENOUGH} correct re-localisations; {most.threshold:g} brings {most.correct}"
        )
    else:
        least = min(enough, key=lambda each: each.incorrect)
        why = (
            f"every threshold with {ENOUGH} correct re-localisations has incorrect ones; "
            f"{least.threshold:g} has the fewest, {least.incorrect} beside {least.correct} correct"
        )
    return None, f"{why}. {_ambiguity(likeness)}"


def compared(config: TemplateConfig, log: Log) -> Likeness:
    """How unlike the views of a session are, of the same place and of different ones.

    Raises:
        InputError: no place was seen on two visits.
    """
    truth, views = np.asarray(log.truth), log.views
    same, other = [np.zeros(0)], [np.zeros(0)]
    for start in range(0, len(views), ROWS):
        rows = slice(start, start + ROWS)
        later = np.arange(len(views)) > np.arange(len(views))[rows, None]
        apart = np.hypot(*(truth[None, :, :2] - truth[rows, None, :2]).transpose(2, 0, 1))
        turned = np.abs(wrap(truth[None, :, 2] - truth[rows, None, 2]))
        again = np.abs(log.time - log.time[rows, None]) >= ANOTHER_VISIT
        unlike = differences(config, views[rows], views)
        same.append(unlike[later & again & (apart < SAME) & (turned < SAME_HEADING)])
        other.append(unlike[later & (apart > OTHER)])
    a, b = np.concatenate(same), np.concatenate(other)
    if not len(a) or not len(b):
        raise InputError(
            log.name,
            "no place that is seen on two visits" if len(b) else "a path that stays at one place",
            "a path that returns to where it has been",
        )
    edge = np.linspace(0.0, max(a.max(), b.max(), 1e-9), BINS + 1)
    return Likeness(edge, np.histogram(a, edge)[0], np.histogram(b, edge)[0], auc(a, b))


def differences(config: TemplateConfig, views: np.ndarray, others: np.ndarray) -> np.ndarray:
    """[N, M] mean absolute difference of views [N, R, C, K] from others [M, R, C, K], over all shifts that
    the matcher tries the least (`ratslam.classic.view_templates.match_view`)."""
    columns = views.shape[2]
    if config.panoramic:
        shifted = [np.roll(others, -o, axis=2) for o in range(0, columns, config.shift_step)]
        seen = views
    else:
        width = columns - 2 * config.shift
        offsets = range(0, 2 * config.shift + 1, config.shift_step)
        shifted = [others[:, :, o : o + width] for o in offsets]
        seen = views[:, :, config.shift : config.shift + width]
    axes = (2, 3, 4)
    return np.min([np.abs(seen[:, None] - other[None]).mean(axis=axes) for other in shifted], axis=0)


def auc(same: np.ndarray, other: np.ndarray) -> float:
    """The chance that one of `other` exceeds one of `same`, ties counted half (Mann & Whitney 1947)."""
    ordered = np.sort(other)
    below = np.searchsorted(ordered, same, "left")
    up_to = np.searchsorted(ordered, same, "right")
    return float(1 - (below + up_to).mean() / 2 / len(other))


def report(tuning: Tuning) -> str:
    """The tuning as plain text."""
    likeness, (start, stop) = tuning.likeness, tuning.steps
    lines = [
        "before any map: how unlike two views are (mean absolute difference)",
        f"  {'':<18}{'5 %':>8}{'median':>8}{'95 %':>8}{'pairs':>10}",
        _spread("the same place", likeness.edge, likeness.same),
        _spread("different places", likeness.edge, likeness.other),
        f"  AUC {likeness.auc:.3f} (1: views tell places apart; 0.5: they tell nothing)",
        "",
        f"steps {start} to {stop}, after the base set up to the end of lap {LAPS} (or of the session)",
        f"  {'threshold':>9}{'ARR':>8}{'correct':>9}{'incorrect':>11}",
    ]
    for each in tuning.tried:
        mark = "  <- the winner" if each is tuning.winner else ""
        lines.append(f"  {each.threshold:>9.3f}{each.arr:>8.3f}{each.correct:>9}{each.incorrect:>11}{mark}")
    verdict = (
        f"templates.threshold={tuning.winner.threshold:g}" if tuning.winner else "no threshold satisfies"
    )
    return "\n".join([*lines, "", f"{verdict}: {tuning.why}"])


def save(tuning: Tuning, directory: Path) -> list[Path]:
    """The tuning as a picture and a table in a folder, made where there is none."""
    directory.mkdir(parents=True, exist_ok=True)
    picture, table = directory / "tune.png", directory / "tune.csv"
    threshold, _, correct, incorrect = (np.array(column) for column in zip(*tuning.tried, strict=True))
    taken = None if tuning.winner is None else tuning.winner.threshold
    edge, same, other, area = tuning.likeness
    draw_tuning(edge, same, other, area, threshold, correct, incorrect, taken).savefig(picture)
    lines = [",".join(Tried._fields), *(",".join(map(repr, each)) for each in tuning.tried)]
    table.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [picture, table]


def _judged_part(log: Log) -> tuple[Log, int]:
    """The session up to the end of its third lap, if it has so many, and the steps of the base set."""
    truth = np.asarray(log.truth)
    base, ends = base_end(truth), lap_ends(truth)[:LAPS]
    return first(log, int(ends[-1]) + 1 if len(ends) == LAPS else log.length), base


def _tried(task: tuple[RunConfig, Log, int, np.ndarray]) -> list[Tried]:
    config, log, base, thresholds = task
    exm = config.score.experience_metric.model_copy(update={"base": base, "mode": "strict", "log": "step"})
    batch = classics(config, log, thresholds)
    results = [experience_metric(place, np.asarray(log.truth), exm) for place in batch.place]
    return [
        Tried(float(threshold), r.arr, r.correct, r.relocalisations - r.correct)
        for threshold, r in zip(thresholds, results, strict=True)
    ]


def _ambiguity(likeness: Likeness) -> str:
    """Why a threshold cannot do: what share of different places look more alike than half the same ones."""
    half = _quantile(likeness.edge, likeness.same, 0.5)
    within = np.interp(half, likeness.edge, np.concatenate([[0], np.cumsum(likeness.other)]))
    return (
        f"A threshold of {half:.3f}, which half of the views of one place pass, lets pass "
        f"{within / likeness.other.sum():.1%} of the views of different places (AUC {likeness.auc:.3f})"
    )


def _quantile(edge: np.ndarray, count: np.ndarray, share: float) -> float:
    return float(np.interp(share * count.sum(), np.concatenate([[0], np.cumsum(count)]), edge))


def _spread(name: str, edge: np.ndarray, count: np.ndarray) -> str:
    cells = "".join(f"{_quantile(edge, count, share):>8.3f}" for share in (0.05, 0.5, 0.95))
    return f"  {name:<18}{cells}{count.sum():>10}"
