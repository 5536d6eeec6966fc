"""Tests of the paper's claims: paired differences with bootstrap intervals; the table of a reproduction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evaluation.metrics.statistics import bootstrap
from ratslam.experiments.salman2016.protocols import METHODS, Claim, Protocol
from ratslam.experiments.trials.reproduction import ResultRow, column

ALIKE = 0.05  # shares that differ by less count as equal
SMALL = 0.1  # a share below counts as nearly zero
DECISIVE = 6  # number of sets from which a difference of one sign in all sets is significant (1 in 32)
RATIOS = ("em", "em_experiences", "em_odometry", "em_ratio", "directions_apart")
"""Quantities that span powers of ten, compared by ratio so that one false loop does not decide a mean."""
LABELS = {
    "arr": "ARR",
    "arcr": "ARCR, strict",
    "arcr_chain_free": "ARCR without the chain",
    "em": "EM, all pairs (m2 + rad2)",
    "em_experiences": "EM through the experiences",
    "em_odometry": "EM of odometry",
    "em_ratio": "EM / dead reckoning's",
    "closures": "closures",
    "false_closures": "closures > 0.1 m apart in truth",
    "experiences": "experiences",
    "first_anticlockwise_correct": "first anticlockwise lap, correctly",
    "first_anticlockwise": "first anticlockwise lap associated",
    "last_anticlockwise": "last anticlockwise lap associated",
    "associated_correct": "of these within 0.1 m",
    "directions_apart": "the two directions apart (m)",
    "across": "closures across the change",
    "across_share": "the same over those in one maze",
    "threshold": "threshold",
}
CONTROL_LABELS = {"none": "", "shuffled": "shuffled, ", "blank": "no images, "}


class Verdict(NamedTuple):
    """The test of a claim with the sessions of one method.

    Attributes:
        estimate: mean difference, geometric mean ratio or mean, named in `text`. low, high: 95 % interval.
        word: `confirmed`, `refuted`, `not decided` or `undefined`.
    """

    estimate: float
    low: float
    high: float
    word: str
    text: str


def judge_claim(claim: Claim, here: np.ndarray, there: np.ndarray, seed: int = 0) -> Verdict:
    """Tests a claim with the values [S] of its two conditions over the same sets."""
    if claim.kind == "small":
        values, name, back = here, "mean", lambda x: x
    elif claim.quantity in RATIOS:
        with np.errstate(divide="ignore", invalid="ignore"):
            values, name, back = np.log(there / here), "ratio", np.exp
    else:
        values, name, back = there - here, "difference", lambda x: x
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return Verdict(np.nan, np.nan, np.nan, "undefined", "fewer than two sets have both figures")
    low, high = bootstrap(values, f"reproduce.{claim.text}", seed=seed)
    if claim.kind == "small":
        yes, no = high < SMALL, low >= SMALL
    elif claim.kind == "alike":
        yes, no = low > -ALIKE and high < ALIKE, low >= ALIKE or high <= -ALIKE
    else:
        yes, no = low > 0, high <= 0
    word = "confirmed" if yes else "refuted" if no else "not decided"
    estimate, low, high = (float(back(x)) for x in (float(values.mean()), low, high))
    text = f"{name} {estimate:.3g} [{low:.3g}, {high:.3g}], {len(values)} sets"
    return Verdict(estimate, low, high, word, text)


def render_claims(protocol: Protocol, rows: Sequence[ResultRow], sets: int) -> str:
    """For each quantity the paper's value and the sessions' by method and control; then the claims."""
    done = 1 + max((row.number for row in rows), default=-1)
    columns = series(protocol, rows)
    methods = [method for method, control in columns if control == "none"]
    heads = [CONTROL_LABELS[control] + method for method, control in columns]
    width = max(34, *(len(condition.name) + 4 for condition in protocol.conditions))
    lines = [f"{protocol.title} ({protocol.source}); {done} of {sets} sets: median (least-most)"]
    for quantity in protocol.quantities:
        lines += ["", _line(LABELS[quantity], width, "paper", heads)]
        for condition in protocol.conditions:
            paper = protocol.paper.get((condition.name, quantity))
            cells = [_cell(column(rows, (condition.name, *key), quantity)) for key in columns]
            lines.append(_line(f"  {condition.name}", width, "-" if paper is None else f"{paper:.4g}", cells))
    lines.append("")
    for claim in protocol.claims:
        lines.append(f"claim: {claim.text} ({LABELS[claim.quantity]})")
        for method in methods:
            keys = ((name, method, "none") for name in (claim.here, claim.there))
            here, there = (column(rows, key, claim.quantity) for key in keys)
            verdict = judge_claim(claim, here, there)
            lines.append(f"  {method:<8} {verdict.word.upper()}: {verdict.text}")
    if protocol.claims and 1 < done < DECISIVE:
        lines.append(
            f"By chance all {done} sets agree in {2.0 ** (1 - done):.0%} of cases; "
            f"--sets {DECISIVE} lowers that to {2.0 ** (1 - DECISIVE):.0%}."
        )
    return "\n".join([*lines, *([protocol.note] if protocol.note else [])])


def series(protocol: Protocol, rows: Sequence[ResultRow]) -> list[tuple[str, str]]:
    """Pairs of method and control with rows: first without controls, then the controls of the protocol."""
    there = {row.key[1:] for row in rows}
    methods = [method for method in METHODS if any(row.key[1] == method for row in rows)]
    controls = [(m, c) for c in ("shuffled", "blank") for m in methods if (m, c) in there]
    return [(method, "none") for method in methods] + (controls if protocol.controls else [])


def _line(name: str, width: int, paper: str, cells: Sequence[str]) -> str:
    return f"{name:<{width}}{paper:>8}" + "".join(f"{cell:>24}" for cell in cells)


def _cell(values: np.ndarray) -> str:
    values = values[np.isfinite(values)]
    if not len(values):
        return "-"
    low, high = _short(values.min(), 2), _short(values.max(), 2)
    middle = _short(np.median(values))
    return middle if low == high else f"{middle} ({low}-{high})"


def _short(value: float, digits: int = 3) -> str:
    return f"{value:.0f}" if value == round(value) and abs(value) >= 1 else f"{value:.{digits}g}"
