"""Plot of the experience history: the current experience at each step (Salman & Pearson 2016, Fig. 3)."""

from __future__ import annotations

import numpy as np

from evaluation.metrics.exm import ExperienceMetric, experience_metric
from evaluation.metrics.run_metrics import RunArrays
from evaluation.metrics.scorecard import Scorecard
from evaluation.plots import style
from evaluation.plots.style import BLUE, GREY, INK, LINE_GREY, VERMILLION
from tactile.base.errors import InputError

_TALL, _BOTTOM = 3.25, 1.05  # inches


def draw_experience_history(run: RunArrays, card: Scorecard) -> style.Figure:
    """Draws experience against step, the end of the base set and the strict verdict on each re-localisation.

    Without truth or a return to the start there are no verdicts; then all steps look the same.
    """
    rows = run.truth_rows if len(run.truth_rows) else np.arange(len(run.time))
    judged, reason = _judge(run, card, rows)
    rows = rows[run.experience[rows] >= 0]
    experience = run.experience[rows]
    line = reason
    if judged is not None:
        arr = f"ARR {judged.arr:.2f} ({judged.relocalisations} of {judged.entries} steps after it)"
        arcr = f"ARCR {judged.arcr:.2f} ({judged.correct} of {judged.relocalisations} correct, strict mode)"
        parts = (f"base set of {judged.base} steps", arr, arcr)
        line = "  ·  ".join(part for part in parts if "nan" not in part)
    figure, axes = style.new_chart(_TALL, _BOTTOM, card.name, line)
    counted = np.zeros(len(rows), bool) if judged is None else judged.counted
    right = counted if judged is None else judged.right
    free = ~counted
    coarse = min(2.5, max(1.0, np.sqrt(600 / max(1, len(rows)))))  # larger markers for few steps
    for some, color, mark, size, name in (
        (free, GREY, "o", 2.2, "no re-localisation" if judged else "experience"),
        (right, BLUE, "o", 2.6, "correct re-localisation"),
        (counted & ~right, VERMILLION, "x", 3.4, "incorrect re-localisation"),
    ):
        if some.any():
            label = name if some is free else f"{name} ({some.sum()})"
            axes.plot(rows[some], experience[some], mark, ms=coarse * size, mew=0.9 if mark == "x" else 0,
                      color=color, label=label, zorder=3)  # fmt: skip
    if judged is not None and judged.base < len(rows):
        axes.axvline(rows[judged.base] - 0.5, color=INK, lw=1.1, ls=(0, (2, 2)), zorder=2,
                     label="end of the base set")  # fmt: skip
    last = max(1, len(run.time) - 1)
    axes.set(xlim=(-0.01 * last, 1.01 * last), ylim=(-0.02 * max(1, len(run.nodes)), None))
    axes.locator_params(integer=True)
    axes.grid(color=LINE_GREY, lw=0.7)
    style.name_axes(axes, "step", "experience, in order of creation")
    return style.add_legend(figure, axes, columns=2)


def _judge(run: RunArrays, card: Scorecard, rows: np.ndarray) -> tuple[ExperienceMetric | None, str]:
    """The strict Experience Metric of the steps `rows`, or None and the reason."""
    if run.truth is None or len(run.truth_rows) == 0:
        return None, "no ground truth: re-localisations cannot be judged"
    if (run.experience[rows] < 0).all():
        return None, "no experiences"
    base = None if card.exm.base is None else int(np.searchsorted(rows, card.exm.base))
    config = card.exm.model_copy(update={"mode": "strict", "log": "step", "base": base})
    try:
        return experience_metric(run.experience[rows], run.truth[rows], config), ""
    except InputError as error:
        return None, f"no verdicts: {error.where} {error.found}"
