"""The loop closures of a run as the page needs them: columns of plain numbers, and views of 8 bits."""

from __future__ import annotations

from base64 import b64encode
from typing import Any

import numpy as np

from evaluation.artifacts.closure_table import ClosureTable
from evaluation.artifacts.closure_views import ClosureViews
from evaluation.metrics.run_arrays import RunArrays

VIEW_BYTES = 2_000_000
"""Most bytes of views in a page, before their encoding adds a third; larger views lose resolution."""
LABELS = {
    "shift": "turn between the views, columns",
    "posterior": "posterior",
    "log_ratio": "log-likelihood ratio to a new place",
    "sequence": "sequence",
    "distance": "squared Mahalanobis distance",
    "weight": "robust weight",
    "log_odds": "log odds of the sequence",
}
"""What the columns of evidence are; others are named as in the file."""
_LEFT_OUT = ("keyframe", "match")  # they say the same as the steps
WORDS = {"accepted": "accepted", "open": "not accepted", "undone": "undone"}
"""Verdicts as the page names them; others are named as in the file."""


def closure_records(table: ClosureTable, run: RunArrays) -> dict[str, Any]:
    """The closures in columns: the steps that each joins, their times (s from the first step), how far they
    are apart in truth (m; None where unknown), verdict and evidence."""
    inside = (table.steps >= 0) & (table.steps < len(run.time))
    rows = np.where(inside, table.steps, 0)
    time = np.where(inside, run.time[rows] - run.time[0], np.nan)
    apart = np.full(len(rows), np.nan)
    if run.truth is not None and len(rows):
        ends = np.where(inside[..., None], run.truth[rows][..., :2], np.nan)
        apart = np.hypot(*(ends[:, 0] - ends[:, 1]).T)
    evidence = {name: column for name, column in table.evidence.items() if name not in _LEFT_OUT}
    return {
        "steps": table.steps.tolist(),
        "times": [plain_numbers(row) for row in time],
        "apart": plain_numbers(apart),
        "verdicts": [WORDS.get(verdict, verdict) for verdict in table.verdicts],
        "evidence": [
            {"name": name, "label": LABELS.get(name, name), "values": plain_numbers(column)}
            for name, column in evidence.items()
        ],
    }


def view_records(views: ClosureViews | None) -> dict[str, Any] | None:
    """The views as one string of bytes; those of too many bytes are reduced, see `VIEW_BYTES`."""
    if views is None:
        return None
    image, shape = views.view, views.view.shape[1:]
    while image.size > VIEW_BYTES and max(image.shape[1:]) > 1:
        image = halve(image)
    gain = display_gain(image)
    image = np.minimum(np.ceil(image * gain), 255).astype(np.uint8)
    return {
        "steps": views.step.tolist(),
        "gain": gain,
        "rows": image.shape[1],
        "columns": image.shape[2],
        "shape": list(shape),
        "pixels": b64encode(np.ascontiguousarray(image).tobytes()).decode(),
    }


def display_gain(image: np.ndarray) -> float:
    """The factor, at least 1, that makes the brightest hundredth of the non-zero pixels [n, R, C] white.

    Views of a room that is small beside the range of the sensor would be black otherwise.
    """
    seen = image[image > 0]
    return max(255 / float(np.quantile(seen, 0.99)), 1.0) if seen.size else 1.0


def halve(image: np.ndarray) -> np.ndarray:
    """Images [n, R, C] at half the resolution along their longer side: means of two neighbours; the last
    pixel of an odd side has no neighbour and stays."""
    axis = 1 + int(image.shape[2] >= image.shape[1])
    starts = np.arange(0, image.shape[axis], 2)
    count = np.minimum(2, image.shape[axis] - starts)
    total = np.add.reduceat(image.astype(np.uint16), starts, axis)
    return (total // np.expand_dims(count, (0, 3 - axis))).astype(np.uint8)


def plain_numbers(values: np.ndarray) -> list[float | str | None]:
    """Values [n] of 5 digits for JSON; NaN as None, infinity as "inf"."""
    return [_plain(value) for value in np.asarray(values, float).tolist()]


def _plain(value: float) -> float | str | None:
    if np.isnan(value):
        return None
    return float(f"{value:.5g}") if np.isfinite(value) else f"{value}"
