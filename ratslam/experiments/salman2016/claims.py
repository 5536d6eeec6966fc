"""What the figures say of the paper's claims: paired differences with bootstrap intervals, and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from evaluation.metrics.experience_metric import bootstrap
from ratslam.experiments.salman2016.protocols import METHODS, Claim, Protocol

ALIKE = 0.05
"""Shares that differ by less are about the same."""
SMALL = 0.1
"""A share below is nearly nothing."""
DECISIVE = 6
"""Sets from which on a difference of one sign in all of them is no accident (1 in 32)."""
RATIOS = ("em", "em_places", "em_odometry", "ratio", "apart")
"""Quantities that span powers of ten: compared by ratio, one false loop must not decide a mean."""
LABELS = {
    "arr": "ARR",
    "arcr": "ARCR, strict",
    "near": "ARCR without the chain",
    "em": "EM, all pairs (m2 + rad2)",
    "em_places": "EM through the experiences",
    "em_odometry": "EM of odometry",
    "ratio": "EM / dead reckoning's",
    "closures": "closures",
    "false": "closures > 0.1 m apart in truth",
    "experiences": "experiences",
    "counterparts": "first anticlockwise lap, rightly",
    "first_anticlockwise": "first anticlockwise lap associated",
    "last_anticlockwise": "last anticlockwise lap associated",
    "rightly": "of these within 0.1 m",
    "apart": "the two directions apart (m)",
    "across": "closures across the change",
    "across_share": "the same over those in one maze",
    "threshold": "threshold",
}


class Row(NamedTuple):
    """One session of a reproduction.

    Attributes:
        control: `as felt`, or what was done to the views beside the condition's own. number: of the set.
        values: fields of `TouchTrial` and extras.
    """

    condition: str
    method: str
    control: str
    number: int
    seed: int
    values: Mapping[str, float]


class Verdict(NamedTuple):
    """A claim held against one method's sessions.

    Attributes:
        found: mean difference, geometric mean ratio or mean, as `words` puts it. low, high: 95 % interval.
        word: `confirmed`, `refuted`, `not decided` or `cannot be told`.
    """

    found: float
    low: float
    high: float
    word: str
    words: str


def verdict(claim: Claim, here: np.ndarray, there: np.ndarray, seed: int = 0) -> Verdict:
    """Holds a claim against the values [S] of its two conditions over the same sets."""
    if claim.kind == "small":
        values, name, back = here, "mean", lambda x: x
    elif claim.quantity in RATIOS:
        with np.errstate(divide="ignore", invalid="ignore"):
            values, name, back = np.log(there / here), "ratio", np.exp
    else:
        values, name, back = there - here, "difference", lambda x: x
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return Verdict(np.nan, np.nan, np.nan, "cannot be told", "fewer than two sets have both figures")
    low, high = bootstrap(values, f"reproduce.{claim.text}", seed=seed)
    mean = float(values.mean())
    if claim.kind == "small":
        yes, no = high < SMALL, low >= SMALL
    elif claim.kind == "alike":
        yes, no = low > -ALIKE and high < ALIKE, low >= ALIKE or high <= -ALIKE
    else:
        yes, no = low > 0, high <= 0
    word = "confirmed" if yes else "refuted" if no else "not decided"
    found, low, high = (float(back(x)) for x in (mean, low, high))
    return Verdict(found, low, high, word, f"{name} {found:.3g} [{low:.3g}, {high:.3g}], {len(values)} sets")


def column(rows: Sequence[Row], condition: str, method: str, control: str, quantity: str) -> np.ndarray:
    """[S] the values of a quantity over the sets, NaN where a set is missing."""
    count = 1 + max((row.number for row in rows), default=-1)
    values = np.full(count, np.nan)
    for row in rows:
        if (row.condition, row.method, row.control) == (condition, method, control):
            values[row.number] = row.values.get(quantity, np.nan)
    return values


def table(protocol: Protocol, rows: Sequence[Row], sets: int) -> str:
    """Paper, classic, ours, spread over the sets, controls; then what became of each claim."""
    done = 1 + max((row.number for row in rows), default=-1)
    methods = [name for name in METHODS if any(row.method == name for row in rows)]
    columns = [(method, "as felt") for method in methods]
    if protocol.controls:
        columns += [(m, c) for c in ("shuffled", "blank") for m in methods if _there(rows, m, c)]
    heads = [_CONTROL.get(control, "") + method for method, control in columns]
    width = max(34, *(len(condition.name) + 4 for condition in protocol.conditions))
    lines = [f"{protocol.title} ({protocol.source}); {done} of {sets} sets: median (least-most)"]
    for quantity in protocol.quantities:
        lines += ["", _line(LABELS[quantity], width, "paper", heads)]
        for condition in protocol.conditions:
            stated = protocol.paper.get((condition.name, quantity))
            cells = [_cell(column(rows, condition.name, m, c, quantity)) for m, c in columns]
            lines.append(
                _line(f"  {condition.name}", width, "-" if stated is None else f"{stated:.4g}", cells)
            )
    lines += [""] + [line for claim in protocol.claims for line in _judged(claim, rows, methods)]
    if protocol.claims and 1 < done < DECISIVE:
        lines.append(
            f"Chance alone makes all {done} sets agree in {2.0 ** (1 - done):.0%} of cases; "
            f"--sets {DECISIVE} brings that to {2.0 ** (1 - DECISIVE):.0%}."
        )
    return "\n".join([*lines, *([protocol.note] if protocol.note else [])])


def _line(name: str, width: int, stated: str, cells: Sequence[str]) -> str:
    return f"{name:<{width}}{stated:>8}" + "".join(f"{cell:>24}" for cell in cells)


_CONTROL = {"shuffled": "shuffled, ", "blank": "no images, "}


def _there(rows: Sequence[Row], method: str, control: str) -> bool:
    return any(row.method == method and row.control == control for row in rows)


def _judged(claim: Claim, rows: Sequence[Row], methods: Sequence[str]) -> list[str]:
    lines = [f"claim: {claim.text} ({LABELS[claim.quantity]})"]
    for method in methods:
        here, there = (
            column(rows, name, method, "as felt", claim.quantity) for name in (claim.here, claim.there)
        )
        found = verdict(claim, here, there)
        lines.append(f"  {method:<8} {found.word.upper()}: {found.words}")
    return lines


def _cell(values: np.ndarray) -> str:
    values = values[np.isfinite(values)]
    if not len(values):
        return "-"
    middle, least, most = np.median(values), values.min(), values.max()
    spread = _short(least, 2), _short(most, 2)
    return _short(middle) if spread[0] == spread[1] else f"{_short(middle)} ({spread[0]}-{spread[1]})"


def _short(value: float, digits: int = 3) -> str:
    return f"{value:.0f}" if value == round(value) and abs(value) >= 1 else f"{value:.{digits}g}"
