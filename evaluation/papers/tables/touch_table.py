"""The touch table: whisker sessions in mazes never used for tuning.

Each row is a condition, with the preset of the sensor and what the row changes; each session of it has its
own maze, so that an unlucky maze counts once. Values are medians over the sessions; a failure is an Energy
Metric (all pairs, m^2 + rad^2) of `_SUCCESS` or more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.exm import ExmConfig
from evaluation.metrics.run_metrics import energy_within_pieces, unjoined_share
from evaluation.papers.tables.comparison import (
    Compared,
    Measured,
    SessionLog,
    column,
    compare_runs,
    measured_rows,
)
from evaluation.papers.tables.markdown import count, markdown_header, markdown_row, select_rows
from evaluation.papers.trial_sessions import run_session, start_session
from evaluation.studies.growth import with_new_ground
from evaluation.studies.metrics import (
    FALSE_CLOSURE_DISTANCE,
    SessionResult,
    closure_errors,
    experience_metric_if_defined,
    touch_metrics,
)
from ratslam.core.session import Session
from ratslam.runs.build_session import open_observations
from ratslam.runs.settings.run_config import RunConfig
from robot.simulation.head.baseline import HALL_BASELINE
from robot.simulation.head.odometry_errors import OdometryConfig
from robot.sources.in_memory import InMemorySource, load_into_memory
from tactile.contact_threshold import ContactConfig

FIRST_MAZE = 31100
_SUCCESS = 0.25
TOLERANCE = 1.05
"""A map is worse than odometry if its Energy Metric is above odometry's times this."""
CHANGE = 0.3
"""Share of a session before the change of mazes."""
_RECOVERY_LIMIT = 45
"""Whisks within which a place should be recognised after a kidnap."""

MAIN: dict[str, Any] = {"motion": {"jitter": {"position": 0.005, "yaw_deg": 1.5, "speed": 0.05}}}
_ROUGH = {"motion": {"jitter": {"position": 0.010, "yaw_deg": 3.0, "speed": 0.10}}}
_MAX_ANGLE = {"image": {"transform": "max_angle"}}
KIDNAPS, _KIDNAPS_24 = ({"kidnaps": {"count": count, "ahead": 45.0}} for count in (8, 24))
_CARRIED = {"may_be_carried": True}
EXPLORATION, _LONG = {"path": {"explore": 1500}}, MAIN | {"path": {"explore": 5000}}
_OPEN_ARENA, _TREE = (MAIN | EXPLORATION | {"maze": maze} for maze in ({"share": 0.08}, {"kind": "tree"}))
NOISE = OdometryConfig()
_NOISE_X_2 = {"length": 2 * NOISE.length, "heading": 2 * NOISE.heading}
_POKES = MAIN | {"touch": "force"}
_TABLE = _POKES | EXPLORATION | {"maze": {"kind": "table", "share": 0.2}}
_OPEN_LOOP = {"whisking": {"mode": "open"}}


class TouchRow(NamedTuple):
    """A row: label, settings `simulation`, `touch` and `keyframes` of its sessions, their number, and if they
    enter no cell twice, their whisks."""

    label: str
    simulation: dict[str, Any] = {}  # noqa: RUF012
    touch: dict[str, Any] = {}  # noqa: RUF012
    keyframes: dict[str, Any] = {}  # noqa: RUF012
    sessions: int = 12
    new_ground: int = 0


def _head(*radii: float) -> dict[str, Any]:
    """The head with these base radii of its rings, m."""
    lengths, heights = (0.05, 0.11, 0.16), (0.082, 0.12, 0.165)
    parts = zip(lengths, radii, heights, strict=True)
    return {"rings": [{"length": a, "radius": b, "height": c} for a, b, c in parts]}


def _field(thresholds: float) -> dict[str, Any]:
    """Sessions in a field of so many contact thresholds."""
    field = thresholds * ContactConfig().contact_sds
    return MAIN | {"raw": True, "mechanics": {"baseline": {"field": field}}}


ROWS = {
    "main": TouchRow("main: ten circuits, 5 mm / 1.5 deg / 5 %", MAIN, sessions=40),
    "clean": TouchRow("clean: 2 mm / 0.5 deg"),
    "rough": TouchRow("rough: 10 mm / 3 deg / 10 %", _ROUGH),
    "rough, 3 % faults": TouchRow(
        "rough, 3 % contacts missed, 3 % spurious", _ROUGH | {"mechanics": {"missed": 0.03, "spurious": 0.03}}
    ),
    "open, max_angle": TouchRow("open loop, max_angle", _OPEN_LOOP, _MAX_ANGLE),
    "white": TouchRow("white odometry noise", {"odometry": {"noise": "white"}}, sessions=20),
    "telescoping": TouchRow("telescoping noise", {"odometry": {"noise": "telescoping"}}),
    "exploration": TouchRow("free exploration, 1500 whisks", EXPLORATION, sessions=40),
    "open arena": TouchRow("open arena, 8 % of the walls, free exploration", _OPEN_ARENA, sessions=20),
    "tree": TouchRow("maze without loops, free exploration", _TREE, sessions=20),
    "noise x 2": TouchRow("odometry noise x 2", MAIN | {"odometry": _NOISE_X_2}, sessions=20),
    "exploration, 3000": TouchRow("free exploration, 3000 whisks", {"path": {"explore": 3000}}),
    "exploration, 5000": TouchRow("free exploration, 5000 whisks", _LONG, sessions=5),
    "kidnaps, 5000": TouchRow("5000 whisks with 24 kidnaps", _LONG | _KIDNAPS_24, {}, _CARRIED, sessions=5),
    "new ground": TouchRow("3000 whisks that enter no cell twice", MAIN, sessions=5, new_ground=3000),
    "5 x 5": TouchRow("5 x 5 cells", {"maze": {"columns": 5, "rows": 5, "loop": 12}}),
    "12 x 8": TouchRow("12 x 8 cells", {"maze": {"columns": 12, "rows": 8, "loop": 32}}),
    "3 dead": TouchRow("3 dead whiskers", {}, {"head": {"dead": [7, 10, 14]}}),
    "15 mm/s": TouchRow("15 mm/s", {"motion": {"speed": 0.015}}),
    "radii + 20 %": TouchRow("base radii + 20 %", {}, {"head": _head(0.054, 0.078, 0.096)}),
    "radii - 20 %": TouchRow("base radii - 20 %", {}, {"head": _head(0.036, 0.052, 0.064)}),
    "rest 90": TouchRow("rest angle + 20 %", {}, {"head": {"rest_deg": 90.0}}),
    "rest 60": TouchRow("rest angle - 20 %", {}, {"head": {"rest_deg": 60.0}}),
    "radial channel": TouchRow("with the radial channel", {}, {"image": {"radial": True}}),
    "2 Hz": TouchRow("2 Hz whisking", {"whisking": {"rate": 2.0}}),
    "RCP, max_angle": TouchRow("RCP, max_angle", {}, _MAX_ANGLE),
    "1 dead": TouchRow("1 dead whisker", {}, {"head": {"dead": [10]}}),
    "6 dead": TouchRow("6 dead whiskers", {}, {"head": {"dead": [1, 6, 7, 10, 14, 17]}}),
    "noise 1e-3": TouchRow("sensor noise 1e-3 rad", {"mechanics": {"noise": 1e-3}}),
    "noise 1e-2": TouchRow("1e-2 rad", {"mechanics": {"noise": 1e-2}}),
    "raw": TouchRow("main from raw samples", MAIN | {"raw": True}),
    "drift": TouchRow(
        "main from raw samples with drift, colour and creep",
        MAIN | {"mechanics": {"baseline": HALL_BASELINE.model_dump()}},
    ),
    "field .5": TouchRow("main from raw samples, the Earth's field of half a contact threshold", _field(0.5)),
    "field 2": TouchRow("the Earth's field of two contact thresholds", _field(2.0)),
    "control: field 2": TouchRow(
        "control: two thresholds, the calibration's baseline", _field(2.0), {"baseline": None}
    ),
    "kidnaps": TouchRow("8 kidnaps of 45 s, `may_be_carried`", KIDNAPS, {}, _CARRIED),
    "pokes": TouchRow("pokes of an arm without a head", _POKES),
    "pokes on a table": TouchRow("pokes, a table with objects, exploration", _TABLE),
    "control: shuffled pokes": TouchRow("control: shuffled pokes", _POKES),
    "control: shuffled": TouchRow("control: shuffled images", MAIN),
    "control: no image": TouchRow("control: no images", MAIN),
    "control: other maze": TouchRow("control: later laps in another maze", MAIN | {"later_maze": CHANGE}),
    "open, contact_angle": TouchRow("open loop, contact_angle", _OPEN_LOOP),
    "noise 5e-3": TouchRow("sensor noise 5e-3 rad", {"mechanics": {"noise": 5e-3}}),
    "soft servo, open, max": TouchRow(
        "soft servo, open loop, max_angle", _OPEN_LOOP | {"mechanics": {"servo": 0.3}}, _MAX_ANGLE
    ),
    "soft servo, RCP, max": TouchRow("soft servo, RCP, max_angle", {"mechanics": {"servo": 0.3}}, _MAX_ANGLE),
}
DEFAULT_ROWS = tuple(ROWS)[:-4]
"""The rows printed if none are chosen."""
COMPARED = Compared(
    "EM", "em", "em_live", "em_odometry",
    worse=lambda error, odometry: error > TOLERANCE * odometry,
    failed=lambda error, _: error >= _SUCCESS,
    counts={"false / closures": ("false_closures", "closures")},
    medians={"revisits closed": "revisits_closed"},
)  # fmt: skip
"""Of two runs of the table."""
COLUMNS = (
    "condition", "EM (worst)", "live EM", "odometry", "failures [95 %]", "worse than odometry (worst ratio)",
    "through experiences", "ARR", "ARCR strict (worst), chain-free", "revisits closed", "false / closures",
)  # fmt: skip


class TouchTask(NamedTuple):
    """One session of a row: its maze number, which gives its seed too."""

    row: str
    maze: int
    backend: str = "recall"

    @property
    def seed(self) -> int:
        """Seed of the session: the last two digits of the maze."""
        return self.maze % 100


def touch_table(
    rows: Sequence[str] | None,
    first: int = FIRST_MAZE,
    sessions: int | None = None,
    workers: int = 0,
    backend: str = "recall",
    output: Path | None = None,
    against: Path | None = None,
) -> Iterator[str]:
    """The lines of the table, each as soon as its sessions are done.

    Args:
        rows: None: `DEFAULT_ROWS`. first: number of the first maze; each session has the next one. sessions:
            of each row; None: the row's own number. output, against: see `SessionLog`; the file is
            `touch.csv`.

    Raises:
        InputError: no such row, or a file cannot be used.
    """
    rows = select_rows(rows, ROWS, DEFAULT_ROWS)
    tasks = {
        row: {str(maze): TouchTask(row, maze, backend) for maze in range(first, first + number)}
        for row, number in ((row, sessions or ROWS[row].sessions) for row in rows)
    }
    log, notes = SessionLog("touch", output, against, tasks, backend), list[str]()
    yield markdown_header(COLUMNS)
    for row, found in measured_rows(_measure_session, tasks, workers, log):
        yield markdown_row([ROWS[row].label, *_cells(found)])
        notes += _notes(row, found)
    yield from ["", *notes] if notes else []
    yield from compare_runs(COMPARED, log, rows)


def _measure_session(task: TouchTask) -> Measured:
    """Runs and measures one session."""
    return run_and_measure(task)[1]


def run_and_measure(
    task: TouchTask, start: Callable[[RunConfig, InMemorySource], Session] = start_session
) -> tuple[SessionResult, Measured]:
    """Runs one session, and measures it.

    Args:
        start: makes the session from the completed configuration and its source.

    Returns:
        The result, and its figures: those of `TouchMetrics`, but `em_experiences` with steps without an
        experience at their own pose, and `arcr_chain_free` 0 without re-localisations. revisits_closed: share
        of the revisits with a true closure; NaN without revisits. em_live: EM of the poses given at each
        step. em_pieces: EM over pairs of steps in the same piece of the map. unjoined: share of the steps
        outside its largest piece. across: closures between the parts before and after `CHANGE`. kidnaps:
        their number. recovery: whisks from a kidnap to the first true closure, median. Shown are the `whisks`
        of each.
    """
    with open_observations(task_config(task)) as (config, source):
        kidnaps = np.flatnonzero(getattr(source, "source", source).kidnapped).tolist()  # type: ignore[union-attr]
        log = load_into_memory(source)
    if task.row.startswith("control: shuffled"):
        order = np.random.default_rng(task.seed).permutation(len(log.views))
        log = replace(log, views=log.views[order].copy())
    if task.row == "control: no image":
        log = replace(log, views=np.zeros_like(log.views))
    result = run_session(config, log, start(config, log))
    truth = result.truth
    true_closures = result.closures[closure_errors(result.truth, result.closures) <= FALSE_CLOSURE_DISTANCE]
    returned = experience_metric_if_defined(result) is not None  # else a quarter is the base set
    metrics = touch_metrics(result, ExmConfig(base=None if returned else len(truth) // 4))
    snapped = result.trajectory.copy()
    snapped[result.place >= 0] = result.node[result.place[result.place >= 0]]
    change = int(CHANGE * log.length)
    across = (result.closures[:, 0] >= change) & (result.closures[:, 1] < change)
    later, earlier = true_closures.T
    whisks = [int(min(later[(later >= k) & (earlier < k)] - k, default=log.length)) for k in kidnaps]
    figures = metrics._asdict() | {
        "em_experiences": energy_all_pairs(snapped, truth).total,
        "arcr_chain_free": float(np.nan_to_num(metrics.arcr_chain_free)),
        "revisits_closed": _share_of_revisits_closed(truth, true_closures),
        "em_live": energy_all_pairs(result.live, truth).total,
        "em_pieces": energy_within_pieces(result.trajectory, truth, result.piece).total,
        "unjoined": unjoined_share(result.piece),
        "across": int(across.sum()),
        "kidnaps": len(whisks),
        "recovery": _median(whisks),
    }
    return result, Measured(figures, {"whisks": whisks})


def task_config(task: TouchTask) -> RunConfig:
    """The configuration of a session."""
    _, simulation, touch, keyframes, _, new_ground = ROWS[task.row]
    parts = {"touch": touch, "keyframes": keyframes, "backend": task.backend}
    config = touch_config(task.maze, task.seed, simulation, **parts)
    return with_new_ground(config, new_ground) if new_ground else config


def touch_config(maze: int, seed: int, simulation: dict[str, Any], **parts: Any) -> RunConfig:
    """The configuration of a whisker session.

    Args:
        maze: seed of the maze. seed: of everything else. simulation: further settings of `simulation`; those
            of `maze` are added to its seed. parts: settings beside `simulation`.
    """
    simulation = simulation | {"seed": seed, "maze": {"seed": maze} | simulation.get("maze", {})}
    return RunConfig.model_validate({"simulation": simulation, **parts})


def _share_of_revisits_closed(truth: np.ndarray, true_closures: np.ndarray) -> float:
    """Share of the revisits, within 5 cm of the position more than 60 steps before, that a true closure has
    found."""
    closed = np.zeros(len(truth), bool)
    closed[true_closures[:, 0]] = True
    revisits = [
        k for k in range(61, len(truth)) if (np.hypot(*(truth[: k - 60, :2] - truth[k, :2]).T) < 0.05).any()
    ]
    return float(closed[revisits].mean()) if revisits else np.nan


def _median(values: Sequence[float] | np.ndarray) -> float:
    """Median of the known values; NaN without one."""
    return float(np.nanmedian(values)) if np.isfinite(values).any() else np.nan


def _cells(found: Sequence[Measured]) -> list[str]:
    def median(name: str, digits: int = 3) -> str:
        middle = _median(column(found, name))
        return "-" if np.isnan(middle) else f"{middle:.{digits}f}"

    em, odometry, strict = (column(found, name) for name in ("em", "em_odometry", "arcr"))
    ratio = em / odometry
    worst = np.nanmin(strict) if np.isfinite(strict).any() else np.nan
    return [
        f"{np.median(em):.3f} ({em.max():.2f})",
        median("em_live"),
        median("em_odometry", 2),
        count(em >= _SUCCESS),
        f"{count(ratio > TOLERANCE)} ({ratio.max():.2f})",
        median("em_experiences"),
        median("arr"),
        f"{median('arcr')} ({worst:.2f}), {median('arcr_chain_free')}" if np.isfinite(worst) else "-",
        median("revisits_closed", 2),
        f"{column(found, 'false_closures').sum()} / {column(found, 'closures').sum()}",
    ]


def _notes(row: str, found: Sequence[Measured]) -> list[str]:
    """Lines below the table for some rows: closures across a change of mazes; recovery and the error within
    pieces after kidnaps."""
    notes = []
    if row == "control: other maze":
        across, closures = (column(found, name).sum() for name in ("across", "closures"))
        notes.append(f"{row}: {across} of {closures} closures join the parts before and after the change.")
    recovery = np.array([whisks for one in found for whisks in one.shown["whisks"]])
    if len(recovery):
        notes.append(
            f"{row}: whisks to the first true closure, median {np.median(recovery):.0f}; "
            f"within {_RECOVERY_LIMIT}: {(recovery <= _RECOVERY_LIMIT).mean():.0%}."
        )
        em, unjoined = column(found, "em_pieces"), column(found, "unjoined")
        notes.append(
            f"{row}: EM within pieces of the map, median {np.nanmedian(em):.3f} ({np.nanmax(em):.2f}); "
            f"share of steps outside the largest piece, median {np.median(unjoined):.0%} "
            f"({unjoined.max():.0%})."
        )
    return notes
