"""The figures of Salman & Pearson 2016: all conditions, methods and controls of a protocol over the same
sets, its claims tested, its table and its figure.

A set is a maze, a path with its jitter and the errors of the odometry, all from one seed. All conditions and
methods of a reproduction run on the same sets, so their differences are paired.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from evaluation.metrics.energy_metric import energy, energy_all_pairs
from evaluation.metrics.exm import experience_metric
from evaluation.metrics.statistics import bootstrap
from evaluation.metrics.trajectory import align, successive_pairs
from evaluation.papers import paper_sets
from evaluation.papers.paper_sets import Paper, ResultRow, column, run_with_progress
from evaluation.papers.salman2016 import paper_figures, protocols
from evaluation.papers.salman2016.protocols import BY_MAZE, THRESHOLDS, Claim, Condition, Protocol
from evaluation.papers.trial_sessions import Control, apply_control, collect_session, run_session
from evaluation.plots import style
from evaluation.studies.metrics import (
    SessionResult,
    TouchMetrics,
    experience_metric_if_defined,
    lap_ends,
    touch_metrics,
)
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import override, parse, validate
from robot.sources.in_memory import truncate_log
from tactile.base.random_streams import stream
from tactile.base.se2 import compose

KEY = ("condition", "method", "control")
_ADDED = (*BY_MAZE[2:], "em_ratio", *protocols.DIRECTION_METRICS, "across_share", "threshold")
FIELDS = (*TouchMetrics._fields, *_ADDED)
"""Columns of metrics in NAME.csv."""

Rows = Sequence[ResultRow]

ALIKE = 0.05  # shares that differ by less count as equal
SMALL = 0.1  # a share below counts as nearly zero
_DECISIVE = 6  # number of sets from which a difference of one sign in all sets is significant (1 in 32)
_RATIOS = ("em", "em_experiences", "em_odometry", "em_ratio", "directions_apart")
"""Quantities that span powers of ten, compared by ratio so that one false loop does not decide a mean."""
LABELS = {
    "arr": "ARR",
    "arcr": "ARCR, strict",
    "arcr_chain_free": "ARCR without the chain",
    "em": "EM, all pairs (m2 + rad2)",
    "em_experiences": "EM through the experiences",
    "em_position": "EM, m2",
    "em_heading": "EM, rad2",
    "em_successive": "EM, successive",
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


def judge_claim(claim: Claim, here: np.ndarray, there: np.ndarray) -> tuple[str, str]:
    """Tests a claim with the values [S] of its two conditions over the same sets.

    Returns:
        `confirmed`, `refuted`, `not decided` or `undefined`; the mean difference, geometric mean ratio or
        mean, with its 95 % interval.
    """
    if claim.kind == "small":
        values, name, back = here, "mean", lambda x: x
    elif claim.quantity in _RATIOS:
        with np.errstate(divide="ignore", invalid="ignore"):
            values, name, back = np.log(there / here), "ratio", np.exp
    else:
        values, name, back = there - here, "difference", lambda x: x
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return "undefined", "fewer than two sets have both figures"
    low, high = bootstrap(values, f"reproduce.{claim.text}")
    if claim.kind == "small":
        yes, no = high < SMALL, low >= SMALL
    elif claim.kind == "alike":
        yes, no = low > -ALIKE and high < ALIKE, low >= ALIKE or high <= -ALIKE
    else:
        yes, no = low > 0, high <= 0
    word = "confirmed" if yes else "refuted" if no else "not decided"
    estimate, low, high = (float(back(x)) for x in (float(values.mean()), low, high))
    return word, f"{name} {estimate:.3g} [{low:.3g}, {high:.3g}], {len(values)} sets"


def render_claims(protocol: Protocol, rows: Sequence[ResultRow], sets: int) -> str:
    """For each quantity the paper's value and the sessions' by method and control; then the claims."""
    done = 1 + max((row.number for row in rows), default=-1)
    columns = _series(protocol, rows)
    methods = [method for method, control in columns if control == "none"]
    named = {"none": "", "shuffled": "shuffled, ", "blank": "no images, "}
    heads = [named[control] + method for method, control in columns]
    width = max(34, *(len(condition.name) + 4 for condition in protocol.conditions))
    wide = max(24, *(len(head) + 2 for head in heads))
    lines = [f"{protocol.title} ({protocol.source}); {done} of {sets} sets: median (least-most)"]
    for quantity in protocol.quantities:
        lines += ["", _line(LABELS[quantity], width, "paper", heads, wide)]
        for condition in protocol.conditions:
            paper = protocol.paper.get((condition.name, quantity))
            cells = [_cell(column(rows, (condition.name, *key), quantity)) for key in columns]
            printed = "-" if paper is None else f"{paper:.4g}"
            lines.append(_line(f"  {condition.name}", width, printed, cells, wide))
    if len(protocol.methods) > len(Protocol._field_defaults["methods"]):
        lines += ["", *_render_mazes(protocol, rows)]
    lines.append("")
    for claim in protocol.claims:
        lines.append(f"claim: {claim.text} ({LABELS[claim.quantity]})")
        for method in methods:
            keys = ((name, method, "none") for name in (claim.here, claim.there))
            here, there = (column(rows, key, claim.quantity) for key in keys)
            word, text = judge_claim(claim, here, there)
            lines.append(f"  {method:<20} {word.upper()}: {text}")
    if protocol.claims and 1 < done < _DECISIVE:
        lines.append(
            f"By chance all {done} sets agree in {2.0 ** (1 - done):.0%} of cases; "
            f"--sets {_DECISIVE} lowers that to {2.0 ** (1 - _DECISIVE):.0%}."
        )
    return "\n".join([*lines, *([protocol.note] if protocol.note else [])])


def _render_mazes(protocol: Protocol, rows: Rows) -> list[str]:
    """ARR and ARCR of each maze beside the paper's, and the parts of EM."""
    shown = [row for row in rows if row.key[1] in protocol.methods and row.key[2] == "none"]
    names = [f"  {row.key[0]}, {row.key[1]}, seed {row.seed}" for row in shown]
    width = max(map(len, names), default=0) + 2
    lines = [_line("Each maze", width, "paper", [LABELS[quantity] for quantity in BY_MAZE], 15)]
    for condition in protocol.conditions:
        paper = protocol.paper.get((condition.name, "arr"), np.nan)
        for method in protocol.methods:
            alike, of = 0, 0
            for name, row in zip(names, shown, strict=True):
                if row.key[:2] == (condition.name, method):
                    cells = [_cell(column([row], row.key, quantity)) for quantity in BY_MAZE]
                    lines.append(_line(name, width, _cell(np.array([paper])), cells, 15))
                    alike, of = alike + (abs(row.values["arr"] - paper) < ALIKE), of + 1
            if of and np.isfinite(paper):
                lines.append(f"    ARR within {ALIKE} of the paper's: {alike} of {of}")
    return lines


def _series(protocol: Protocol, rows: Sequence[ResultRow]) -> list[tuple[str, str]]:
    """Pairs of method and control with rows: first without controls, then the controls of the protocol."""
    there = {row.key[1:] for row in rows}
    methods = [method for method in protocols.METHODS if any(row.key[1] == method for row in rows)]
    controls = [(m, c) for c in ("shuffled", "blank") for m in methods if (m, c) in there]
    return [(method, "none") for method in methods] + (controls if protocol.controls else [])


def _line(name: str, width: int, paper: str, cells: Sequence[str], column: int) -> str:
    return f"{name:<{width}}{paper:>8}" + "".join(f"{cell:>{column}}" for cell in cells)


def _cell(values: np.ndarray) -> str:
    values = values[np.isfinite(values)]
    if not len(values):
        return "-"
    low, high = _short(values.min(), 2), _short(values.max(), 2)
    middle = _short(np.median(values))
    return middle if low == high else f"{middle} ({low}-{high})"


def _short(value: float, digits: int = 3) -> str:
    return f"{value:.0f}" if value == round(value) and abs(value) >= 1 else f"{value:.{digits}g}"


def _draw_reproduction(name: str, protocol: Protocol, rows: Rows) -> style.Figure:
    """The figure of a reproduction: metrics over all sets, or sessions of the first set."""
    title, first_only = f"{name}: {protocol.title}", name in ("fig2", "fig3", "fig5")
    line = f"{protocol.source}  ·  {paper_sets.count_sets(rows, first_only)}"
    first = [row for row in rows if row.session is not None]
    if name == "fig2":
        paths: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        for row in first:
            laps, result = row.session
            odometry = compose(result.truth[0], result.odometry)
            lap = protocols.lap_of_step(result.truth, len(laps))
            paths.setdefault(row.key[0], (result.truth[:, :2], odometry[:, :2], lap))
        return paper_figures.draw_drift(title, line, paths)
    if name == "fig3":
        runs = ((row.key[1], row.session[1]) for row in first)
        histories = {method: (run.place, experience_metric_if_defined(run)) for method, run in runs}
        return paper_figures.draw_experiences(title, line, histories)
    if name == "fig5":
        maps = {}
        for row in sorted(first, key=lambda row: row.key[1]):
            laps, result = row.session
            position = compose(align(result.trajectory, result.truth), result.trajectory)[:, :2]
            maps[f"{row.key[0]}, {row.key[1]}"] = position, protocols.clockwise_steps(result.truth, laps)
        return paper_figures.draw_directions(title, line, maps)
    return (_curves if protocol.swept else _dots)(title, line, protocol, rows)


def _dots(title: str, line: str, protocol: Protocol, rows: Rows) -> style.Figure:
    names = [condition.name for condition in protocol.conditions]
    labels = {"none": "", "shuffled": ", shuffled", "blank": ", no images"}
    shown = [(m, c) for m, c in _series(protocol, rows) if c == "none" or m == "ours"]
    measured = []
    for quantity in ("arr", "arcr", "em"):
        values = {
            m + labels[c]: np.array([column(rows, (name, m, c), quantity) for name in names])
            for m, c in shown
        }
        paper = np.array([protocol.paper.get((name, quantity), np.nan) for name in names])
        measured.append((LABELS[quantity], values, paper, quantity in _RATIOS))
    return paper_figures.draw_measured(title, line, names, measured)


def _curves(title: str, line: str, protocol: Protocol, rows: Rows) -> style.Figure:
    curves: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    for condition in protocol.conditions:
        name, noise = condition.name.rsplit(", ", 1)
        these = [row for row in rows if (row.key[0], row.key[2]) == (condition.name, "sweep")]
        numbers = sorted({row.number for row in these})
        sets = [[row.values for row in these if row.number == number] for number in numbers]
        if numbers:
            arcr, arr = (np.array([[v[q] for v in values] for values in sets]) for q in ("arcr", "arr"))
            curves.setdefault(noise, {})[name] = (arcr, arr)
    return paper_figures.draw_curves(title, line, curves)


class _TrialJob(NamedTuple):
    """One session of a reproduction.

    Attributes:
        key: names in `KEY`. number, seed: of the set. control: change of the views. laps: direction of each
            lap, C or A. cut: whether to end the session after these laps.
    """

    key: tuple[str, str, str]
    number: int
    seed: int
    config: RunConfig
    control: Control
    laps: str
    cut: bool


def plan_jobs(protocol: Protocol, sets: int, seed: int, assignments: Sequence[str] = ()) -> list[_TrialJob]:
    """All sessions of a reproduction, set by set.

    Raises:
        InputError: an invalid assignment.
    """
    jobs = []
    for number in range(sets):
        set_seed = int(stream(seed, f"reproduce.set.{number}").integers(2**31))
        for method in ["classic"] if protocol.swept else protocol.methods:
            # Without images the classic method matches all steps; it is compared with its chance level only.
            controls: tuple[Control, ...]
            controls = ("none", "shuffled", "blank") if method == "ours" else ("none", "shuffled")
            for condition in protocol.conditions:
                config = session_config(condition, method, set_seed, assignments)
                assert config.simulation is not None
                laps = config.simulation.path.circuits[: condition.laps or None]
                for control in controls if protocol.controls else controls[:1]:
                    key = (condition.name, method, control)
                    change = condition.control if control == "none" else control
                    jobs.append(_TrialJob(key, number, set_seed, config, change, laps, condition.laps > 0))
    return jobs


def session_config(
    condition: Condition, method: str, seed: int, assignments: Sequence[str] = ()
) -> RunConfig:
    """The configuration of a condition's session with a method."""
    settings = [f"simulation.seed={seed}", *protocols.COMMON, *protocols.METHODS[method]]
    if method != "ours":
        (views,) = (views for views in THRESHOLDS if f"touch.image.transform={views}" in condition.settings)
        settings.append(f"templates.threshold={THRESHOLDS[views]}")
    document = parse("simulation: {}\n", "the reproduction")
    return validate(override(document, [*settings, *condition.settings, *assignments]), RunConfig)


def match_thresholds(rows: Sequence[ResultRow]) -> dict[str, ResultRow]:
    """Chooses one threshold for each condition so that the conditions have matched strict ARCR.

    The level is the highest ARCR that all conditions reach; chosen is the threshold with the most
    re-localisations among those at or above it. Conditions without re-localisations are left out.

    Args:
        rows: of the sweeps of one set.
    """
    sweeps: dict[str, list[ResultRow]] = {}
    for row in rows:
        if np.isfinite(row.values["arcr"]):
            sweeps.setdefault(row.key[0], []).append(row)
    level = min((max(row.values["arcr"] for row in found) for found in sweeps.values()), default=0.0)
    return {
        name: max((row for row in found if row.values["arcr"] >= level), key=lambda row: row.values["arr"])
        for name, found in sweeps.items()
    }


def _run_job(job: _TrialJob) -> ResultRow:
    """Runs one session.

    Raises:
        InputError: its source cannot be used.
    """
    config, log = collect_session(job.config)
    log = apply_control(log, job.control, job.seed)
    if job.cut:
        log = truncate_log(log, int(lap_ends(np.asarray(log.truth))[len(job.laps) - 1]) + 1)
    result = run_session(config, log)
    metrics = touch_metrics(result, job.config.score.experience_metric)
    ratio = metrics.em / metrics.em_odometry if metrics.em_odometry else np.nan
    values = {**metrics._asdict(), **parts_of_em(result), "em_ratio": ratio}
    values |= protocols.direction_metrics(result, job.laps, protocols.LATER_MAZE_START)
    drawn = (job.laps, result) if job.number == 0 and job.key[2] == "none" else None
    return ResultRow(job.key, job.number, job.seed, values, drawn)


def parts_of_em(result: SessionResult) -> dict[str, float]:
    """EM over all pairs in m2 and in rad2, and EM from each experience to the next one that is active."""
    parts = energy_all_pairs(result.trajectory, result.truth)
    place = result.place
    entered = np.flatnonzero((np.diff(place, prepend=-1) != 0) & (place >= 0))
    nodes = result.node[place[entered]]
    successive = energy(nodes, result.truth[entered], successive_pairs(len(entered)))
    return dict(zip(BY_MAZE[2:], (parts.trans2, parts.rot2, successive.total), strict=True))


def _sweep_job(job: _TrialJob) -> list[ResultRow]:
    """The Experience Metric of the classic method at the thresholds `SWEPT`, without maps."""
    config, log = collect_session(job.config)
    rows = []
    places = paper_sets.sweep_thresholds(config, log, np.array(protocols.SWEPT))[0].place
    for threshold, place in zip(protocols.SWEPT, places, strict=True):
        metric = experience_metric(place, np.asarray(log.truth), config.score.experience_metric)
        names = "arr", "arcr", "arcr_chain_free", "relocalisations"
        values = {"threshold": threshold} | {name: getattr(metric, name) for name in names}
        rows.append(ResultRow((*job.key[:2], "sweep"), job.number, job.seed, values))
    return rows


def _run_figure(name: str, jobs: Sequence[_TrialJob], workers: int) -> Iterator[list[ResultRow]]:
    if protocols.PROTOCOLS[name].swept:
        yield from _run_sweeps(name, jobs, workers)
        return
    unchanged = 0.0  # closures across the change of mazes in the set's session without one
    for row in run_with_progress(_run_job, name, jobs, workers):
        share = {"across_share": row.values["across"] / unchanged} if unchanged else {}
        if row.key[0] == "unchanged":
            share, unchanged = {}, row.values["across"]
        yield [row._replace(values={**row.values, **share})]


def _run_sweeps(name: str, jobs: Sequence[_TrialJob], workers: int) -> Iterator[list[ResultRow]]:
    """First the sweeps over all thresholds, then a session at the matched threshold of each condition."""
    swept: list[ResultRow] = []
    for rows in run_with_progress(_sweep_job, f"{name}, thresholds", jobs, workers):
        swept += rows
        yield rows
    chosen = []
    for job in jobs:
        noise = job.key[0].partition(", ")[2]
        alike = [row for row in swept if row.number == job.number and row.key[0].endswith(f", {noise}")]
        best = match_thresholds(alike).get(job.key[0])
        if best is not None:
            templates = job.config.templates.model_copy(update={"threshold": best.values["threshold"]})
            chosen.append(job._replace(config=job.config.model_copy(update={"templates": templates})))
    matched = run_with_progress(_run_job, f"{name}, matched", chosen, workers)
    for job, row in zip(chosen, matched, strict=True):
        yield [row._replace(values={**row.values, "threshold": job.config.templates.threshold})]


PAPER = Paper(protocols.PROTOCOLS, KEY, FIELDS, plan_jobs, _run_figure, _draw_reproduction, render_claims)
