"""The paper's tuning of the matching threshold (Salman & Pearson 2016, III-F), for the classic method.

The injection energy is half of the iRat's; the threshold is raised over a grid. The rule takes the threshold
with the most correct re-localisations on the second and third lap, none incorrect and at least ten correct.
Before any map, the views alone show what a threshold can separate: the differences of two views of the same
place, and of two places.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.exm import base_end, experience_metric
from evaluation.papers.paper_sets import sweep_thresholds
from evaluation.papers.salman2016.paper_figures import draw_tuning
from evaluation.papers.trial_sessions import collect_session
from evaluation.studies.executor import run_tasks
from evaluation.studies.metrics import ViewDifferences, compare_views, lap_ends
from evaluation.studies.study_report import csv_text
from ratslam.classic.view_templates import TemplateConfig
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import Document, override, validate
from robot.sources.in_memory import InMemorySource, truncate_log
from tactile.base.errors import InputError

CLASSIC = ("backend=classic", "templates.energy=0.05")
"""The tuned method: half of the iRat's energy of 0.1 (III-F; the value is of Ball et al. 2013)."""
THRESHOLDS = tuple(np.round(np.arange(1, 33) * 0.005, 3).tolist())
LAPS = 3  # laps that are scored, the base set excepted
_ENOUGH = 10  # correct re-localisations that a threshold must give


class ThresholdScore(NamedTuple):
    """The laps after the base set at one threshold.

    Attributes:
        arr: re-localisations over steps. correct, incorrect: strict counts.
    """

    threshold: float
    arr: float
    correct: int
    incorrect: int


def tune_threshold(
    document: Document, folder: Path, workers: int = 1, output: Path | None = None
) -> Iterator[str]:
    """Tunes the threshold of a configuration.

    Args:
        folder: of the configuration file. workers: processes that share the grid. output: folder, created if
            missing, for threshold.png and threshold.csv.

    Yields:
        the differences of views, the score of each threshold, and the choice; then what was written.

    Raises:
        InputError: the source cannot be used, has no truth or no views, or never returns to its start.
    """
    config = validate(override(document, CLASSIC), RunConfig).with_absolute_paths(folder.resolve())
    config, log = collect_session(config)
    if config.templates.source == "labels" or not log.seen.all():
        raise InputError(log.name, "steps without a view", "a view at every step")
    base, ends = base_end(np.asarray(log.truth)), lap_ends(np.asarray(log.truth))[:LAPS]
    log = truncate_log(log, int(ends[-1]) + 1 if len(ends) == LAPS else log.length)
    differences = partial(view_differences, config.templates)
    views = compare_views(log.views, np.asarray(log.truth), log.time, differences, log.name)
    parts = [part for part in np.array_split(THRESHOLDS, workers) if len(part)]
    scored = run_tasks(_score_thresholds, [(config, log, base, part) for part in parts], workers=workers)
    scores = [score for part in scored for score in part]
    winner, reason = choose_threshold(scores, views)
    yield from _render(views, scores, winner, f"steps {base} to {log.length}")
    verdict = f"templates.threshold={winner.threshold:g}" if winner else "no threshold satisfies"
    yield f"\n{verdict}: {reason}"
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
        plot, table = output / "threshold.png", output / "threshold.csv"
        chosen = None if winner is None else winner.threshold
        counts = np.array([(one.threshold, one.correct, one.incorrect) for one in scores]).T
        draw_tuning(views, counts, chosen).savefig(plot)
        table.write_text(csv_text([score._asdict() for score in scores]), encoding="utf-8")
        yield f"\nwrote {plot} and {table}"


def choose_threshold(
    scores: Sequence[ThresholdScore], views: ViewDifferences
) -> tuple[ThresholdScore | None, str]:
    """The score that the rule takes, or None, and the reason."""
    enough = [score for score in scores if score.correct >= _ENOUGH]
    clean = [score for score in enough if not score.incorrect]
    if clean:
        best = max(clean, key=lambda score: score.correct)  # the lowest of equal ones
        return best, f"{len(clean)} thresholds give at least {_ENOUGH} correct and none incorrect"
    reason = f"all thresholds with {_ENOUGH} correct re-localisations have incorrect ones"
    if enough:
        least = min(enough, key=lambda score: score.incorrect)
        found = f"{least.threshold:g} has the fewest, {least.incorrect} beside {least.correct} correct"
    else:
        most = max(scores, key=lambda score: score.correct)
        reason = f"no threshold gives {_ENOUGH} correct re-localisations"
        found = f"{most.threshold:g} gives {most.correct}"
    half = views.quantile(views.same, 0.5)
    below = views.share_below(views.other, half)
    return None, (
        f"{reason}; {found}. A threshold of {half:.3f} accepts half of the view pairs of one place and "
        f"{below:.1%} of those of different places (AUC {views.auc:.3f})"
    )


def view_differences(config: TemplateConfig, views: np.ndarray, others: np.ndarray) -> np.ndarray:
    """[N, M] smallest mean absolute difference of views [N, R, C, K] from others [M, R, C, K] over all shifts
    that the classic method tries (`ratslam.classic.view_templates.match_view`)."""
    columns = views.shape[2]
    if config.panoramic:
        shifted = [np.roll(others, -o, axis=2) for o in range(0, columns, config.shift_step)]
    else:
        width = columns - 2 * config.shift
        offsets = range(0, 2 * config.shift + 1, config.shift_step)
        shifted = [others[:, :, o : o + width] for o in offsets]
        views = views[:, :, config.shift : config.shift + width]
    axes = (2, 3, 4)
    return np.min([np.abs(views[:, None] - other[None]).mean(axis=axes) for other in shifted], axis=0)


def _render(
    views: ViewDifferences, scores: Sequence[ThresholdScore], winner: ThresholdScore | None, steps: str
) -> Iterator[str]:
    """The lines about the differences of views, and the score of each threshold."""
    yield "before any map: mean absolute difference of two views"
    yield f"  {'':<18}{'5 %':>8}{'median':>8}{'95 %':>8}{'pairs':>10}"
    for name, counts in (("the same place", views.same), ("different places", views.other)):
        cells = "".join(f"{views.quantile(counts, share):>8.3f}" for share in (0.05, 0.5, 0.95))
        yield f"  {name:<18}{cells}{counts.sum():>10}"
    yield f"  AUC {views.auc:.3f} (1: the views separate places; 0.5: they do not)"
    yield f"\n{steps}, after the base set up to the end of lap {LAPS} (or of the session)"
    yield f"  {'threshold':>9}{'ARR':>8}{'correct':>9}{'incorrect':>11}"
    for one in scores:
        mark = "  <- the winner" if one is winner else ""
        yield f"  {one.threshold:>9.3f}{one.arr:>8.3f}{one.correct:>9}{one.incorrect:>11}{mark}"


def _score_thresholds(task: tuple[RunConfig, InMemorySource, int, np.ndarray]) -> list[ThresholdScore]:
    config, log, base, thresholds = task
    exm = config.score.experience_metric.model_copy(update={"base": base, "mode": "strict", "log": "step"})
    places = sweep_thresholds(config, log, thresholds)[0].place
    results = [experience_metric(place, np.asarray(log.truth), exm) for place in places]
    return [
        ThresholdScore(float(threshold), r.arr, r.correct, r.relocalisations - r.correct)
        for threshold, r in zip(thresholds, results, strict=True)
    ]
