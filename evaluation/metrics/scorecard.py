"""The scorecard of a run: all metrics in one record, and as a text table."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Literal

import numpy as np

from evaluation.metrics.energy_metric import Relations
from evaluation.metrics.exm import DEFAULT_EXM, ExmConfig
from evaluation.metrics.metric import MISSING_TRUTH, Finding, Metric, Quantity
from evaluation.metrics.run_metrics import (
    DOUBTED,
    PIECES,
    RUN_METRICS,
    RunArrays,
    experience_findings,
    path_length,
    run_data,
)
from tactile.base.errors import printable
from tactile.base.settings import Settings

REGISTERED = "Registered metrics"
"""Heading of the metrics of other packages."""
MOST_WARNINGS = 10
"""Largest number of warnings that are printed."""
WORSE = 1.01
"""Ratio to the error of odometry above which a map is called worse."""


class HealthCard(Settings):
    """How far input and map of a run can be believed, judged without truth."""

    input: Literal["clean", "warned"] = "clean"
    """One that is refused makes no run."""
    warnings: tuple[str, ...] = ()
    """About the input, a sentence each."""
    worse_than_odometry: float | None = None
    """Probability that the map's error is worse than odometry's, whatever the input; None if unknown."""
    reason: str = ""
    """Why it is None."""


class Scorecard(Settings):
    """All quantities of one run by name; `model_dump_json` gives `scorecard.json`."""

    name: str
    """Name of the run."""
    exm: ExmConfig
    """Thresholds and base set of the Experience Metric (all modes and kinds of log are scored)."""
    quantities: dict[str, Quantity]
    """In the order of the table."""
    health: HealthCard | None = None
    """Of a run; None (null) for the log of another system."""

    @property
    def position_error(self) -> Quantity:
        """The ATE of the final trajectory, within its pieces if there are several."""
        return self.quantities.get("ate_within_pieces", self.quantities["ate_final"])

    @property
    def is_worse(self) -> bool:
        """Whether the map is farther from the truth than odometry, whatever its health says."""
        error = self.position_error
        return error.value is not None and error.odometry is not None and error.value > WORSE * error.odometry

    def lines(self) -> dict[str, list[tuple[str, str, str, str, str]]]:
        """The lines of the table under the heading of each section: label, value, unit, value of odometry
        ("" without one), note ("as above" for one that repeats)."""
        known = {metric.name: metric.section for metric in RUN_METRICS}
        sections: dict[str, list[tuple[str, str, str, str, str]]] = {}
        for section in dict.fromkeys(known.get(name, REGISTERED) for name in self.quantities):
            sections[section], above = [], ""
            for name, found in self.quantities.items():
                if known.get(name, REGISTERED) == section:
                    raw = "" if found.odometry is None else _text(found.odometry)
                    note = "as above" if found.note and found.note == above else found.note
                    sections[section].append((found.label, _text(found.value), found.unit, raw, note))
                    above = found.note
        return sections


def score_run(
    run: RunArrays,
    name: str = "run",
    *,
    exm: ExmConfig = DEFAULT_EXM,
    relations: Relations | None = None,
    metrics: Sequence[Metric] = (),
) -> Scorecard:
    """Scores one run; a quantity that is undefined (without truth, for example) is None with a reason.

    Args:
        relations: true relative motions of the recording, if any. metrics: computed besides `RUN_METRICS`.

    Raises:
        InputError: the arrays do not fit each other.
    """
    run.check()
    data = run_data(run, exm, relations)
    known = bool(np.isfinite(run.doubt))
    health = HealthCard(
        input="warned" if run.warnings else "clean", warnings=run.warnings,
        worse_than_odometry=float(run.doubt) if known else None, reason="" if known else run.unjudged,
    )  # fmt: skip
    quantities = {}
    for metric in (*RUN_METRICS, *metrics):
        unused = metric.section == PIECES and not run.has_pieces
        if not unused and (relations is not None or not metric.name.startswith("relations_")):
            quantities[metric.name] = metric.quantity(metric.compute(data) or MISSING_TRUTH)
    return Scorecard(name=name, exm=exm, quantities=quantities, health=health)


def score_log(
    log: tuple[np.ndarray, np.ndarray, np.ndarray], name: str = "log", *, exm: ExmConfig = DEFAULT_EXM
) -> Scorecard:
    """Scores the experience log of any SLAM system (`read_experience_log`) by the Experience Metric."""
    time, experience, truth = log
    findings = {
        "steps": Finding(len(time)),
        "duration": Finding(float(time[-1] - time[0])),
        "path": Finding(path_length(truth)),
        "experiences": Finding(len(np.unique(experience[experience != -1]))),
        **experience_findings(experience, truth, exm),
    }
    metrics = [metric for metric in RUN_METRICS if metric.name in findings]
    quantities = {metric.name: metric.quantity(findings[metric.name]) for metric in metrics}
    return Scorecard(name=name, exm=exm, quantities=quantities)


def render_scorecard(card: Scorecard) -> str:
    """The scorecard as a text table: quantity, value, unit, value of odometry, note."""
    width = max(len(quantity.label) for quantity in card.quantities.values()) + 2
    lines = [f"{printable(card.name):<{width + 2}}{'value':>9}  {'unit':<8} {'odometry':>9}"]
    for section, shown in card.lines().items():
        lines += ["", section]
        for label, value, unit, odometry, note in shown:
            lines.append(f"  {label:<{width}}{value:>9}  {unit:<8} {odometry:>9}  {note}".rstrip())
    return "\n".join(lines)


def scorecard_html(card: Scorecard) -> str:
    """The scorecard as an HTML table with the same columns; its texts are escaped."""
    rows = [_html_row("th", (card.name, "value", "unit", "odometry", ""))]
    for section, shown in card.lines().items():
        rows += [_html_row("th", (section, "", "", "", "")), *(_html_row("td", line) for line in shown)]
    return f"<table>{''.join(rows)}</table>"


def render_health(card: Scorecard) -> str:
    """The health of input and map in one line; "" for the log of another system."""
    health = card.health
    if health is None:
        return ""
    count, doubt = len(health.warnings), health.worse_than_odometry
    given = f"input {health.input}" + (f" ({count} warning{'s' * (count > 1)})" if count else "")
    if doubt is None:
        reason = health.reason
        found = f"map {reason}" if reason.startswith("not judged") else reason
    elif doubt > DOUBTED:
        found = f"map_doubted, {doubt:.0%} likely worse than odometry, which is given instead"
    else:
        found = f"map {1 - doubt:.0%} likely no worse than odometry"
    return f"health: {given}; {found}"


def render_warnings(card: Scorecard) -> list[str]:
    """The warnings about the input, a line each; the number of further ones if they are many."""
    lines = [f"warning: {sentence}" for sentence in (card.health.warnings if card.health else ())]
    more = [f"and {len(lines) - MOST_WARNINGS} more, which scorecard.json lists"]
    return lines if len(lines) <= MOST_WARNINGS else lines[:MOST_WARNINGS] + more


def render_error(card: Scorecard) -> str:
    """The position error beside that of odometry in one line, with a word where the map is worse."""
    error = card.position_error
    if error.value is None:
        return "ATE (RMS): unknown, no truth"
    raw = "" if error.odometry is None else f", odometry {error.odometry:.3g} {error.unit}"
    worse = "; against the truth the map is worse than odometry" if card.is_worse else ""
    return f"{error.label} (RMS): {error.value:.3g} {error.unit}{raw}{worse}"


def _html_row(cell: str, texts: tuple[str, ...]) -> str:
    return f"<tr>{''.join(f'<{cell}>{escape(text)}</{cell}>' for text in texts)}</tr>"


def _text(value: float | int | None) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}" if isinstance(value, int) or abs(value) >= 1000 else f"{value:.4g}"
