"""Figures of lesions and of sizes: what of its network `backend: recall` cannot do without.

A lesion replaces functions of `ratslam.network.pose_cells` from outside while a session runs, so that the
product has no setting for it. Sessions are those of the table of whisker mazes (`reproduce tables touch`)
and, where the real recordings are at hand, Intel's laser recording. The control is the intact network.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np

from evaluation.papers.cells.panels import name_panel, panel_grid, time_call
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables import buildings
from evaluation.papers.tables.comparison import Measured, column
from evaluation.papers.tables.markdown import table_lines
from evaluation.papers.tables.touch_table import TouchTask, run_and_measure, task_config
from evaluation.papers.trial_sessions import closure_claims, collect_session, new_session, run_recording
from evaluation.plots import style
from evaluation.studies.executor import run_tasks
from evaluation.studies.metrics import FALSE_CLOSURE_DISTANCE, closure_errors
from ratslam.core.backend import Backend
from ratslam.core.session import Session
from ratslam.methods.recall import RecallBackend
from ratslam.network import pose_cells
from ratslam.network.config import Network, PoseCellConfig
from ratslam.network.pose_cells import Belief, Ties, ViewCells
from ratslam.recall import filter
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.in_memory import InMemorySource
from robot.touch_source import observation_of
from tactile.base.random_streams import stream
from tactile.base.types import Array

INTACT, EXCHANGED = "intact (control)", "activity of another session"
ROWS = ("main", "exploration")
"""Rows of the touch table."""
USUAL = 2
"""Mazes; each gives the seed of its lesions too."""
AWAY = 50
"""From the number of a maze to that of the maze whose activity replaces its own."""
EVERY = 16
"""View cells after which the activity of another session is taken anew."""
SPAN = 2.0
"""Side of the square over which random ties are spread, m."""
SILENT = (0.05, 0.1, 0.2, 0.3)
"""Shares of silent cells."""
INTEL = buildings.ROWS["intel"]
COLOURS = (style.VERMILLION, style.BLUE)
COLUMNS = (
    "lesion", "sessions", "revisits closed", "closures, false", "of the intact closures", "EM", "ARR",
    "true closures on Intel",
)  # fmt: skip

Functions = Mapping[str, Callable[..., Any]]
"""Functions of `pose_cells` by name."""


def _predict_constant(
    network: Network, belief: Belief, cells: ViewCells, motion: Array
) -> tuple[Array, Array]:
    """Every view cell is reached by the same share of the activity, wherever that is."""
    del network, motion
    share = jnp.sum(belief.activity) / jnp.maximum(jnp.sum(cells.used), 1.0)
    return share * cells.used, jnp.zeros_like(share)


@cache
def _order(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """A permutation of the cells of a network."""
    return stream(seed, f"cells.permuted.{'x'.join(map(str, shape))}").permutation(int(np.prod(shape)))


def _permuted_together(seed: int) -> Functions:
    """Cells change places, and all that is tied to them goes with them: a network of other names."""
    tie, excite = pose_cells.tie, pose_cells.excite

    def tie_moved(network: Network, shape: tuple[int, ...], cells: ViewCells) -> Ties:
        index, weight = tie(network, shape, cells)
        return jnp.asarray(_order(seed, shape), jnp.int32)[index], weight

    def excite_moved(network: Network, activity: Array) -> Array:
        order = _order(seed, activity.shape)
        sheet = activity.reshape(-1)[order].reshape(activity.shape)
        return excite(network, sheet).reshape(-1)[np.argsort(order)].reshape(activity.shape)

    return {"tie": tie_moved, "excite": excite_moved}


def _after_views(change: Callable[[Array, ViewCells], Array]) -> Functions:
    """After every view the activity [H, Y, X] is changed; the ties stay."""
    anchor = pose_cells.anchor

    def anchor_changed(network: Network, belief: Belief, cells: ViewCells, mass: Array) -> Belief:
        belief = anchor(network, belief, cells, mass)
        return belief._replace(activity=change(belief.activity, cells))

    return {"anchor": anchor_changed}


def _permuted_ties(seed: int) -> Functions:
    """Every view cell is tied to the cells around a random pose, always the same; the cells stay."""
    predict, anchor = pose_cells.predict, pose_cells.anchor

    def elsewhere(cells: ViewCells) -> ViewCells:
        rows = stream(seed, "cells.random_ties").random((cells.x.shape[1], 3))
        x, y, heading = (
            jnp.broadcast_to(jnp.asarray(row, cells.x.dtype), cells.x.shape)
            for row in (rows * [SPAN, SPAN, 2 * np.pi]).T
        )
        return ViewCells(x, y, heading, jnp.cos(heading), jnp.sin(heading), cells.used)

    return {
        "predict": lambda network, belief, cells, motion: predict(network, belief, elsewhere(cells), motion),
        "anchor": lambda network, belief, cells, mass: anchor(network, belief, elsewhere(cells), mass),
    }


def _silent_cells(share: float, seed: int) -> Functions:
    """A random share of the cells never becomes active."""

    def silence(sheet: Array, _: ViewCells) -> Array:
        lively = stream(seed, "cells.silent").random(sheet.shape) >= share
        return sheet * lively.astype(np.float32)

    return _after_views(silence)


def foreign_activity(recorded: np.ndarray) -> Functions:
    """After every view the activity is that of another session at about as many view cells.

    Args:
        recorded: [n, H, Y, X] its activity, each after `EVERY` steps; repeated over a larger network.
    """

    def exchange(sheet: Array, cells: ViewCells) -> Array:
        at = jnp.minimum(jnp.sum(cells.used[0]).astype(jnp.int32) // EVERY, len(recorded) - 1)
        rows = [np.arange(n) % size for n, size in zip(sheet.shape, recorded.shape[1:], strict=True)]
        return jnp.asarray(recorded)[at][np.ix_(*rows)]

    return _after_views(exchange)


LESIONS: dict[str, Callable[[int], Functions]] = {
    INTACT: lambda seed: {},
    "prediction constant": lambda seed: {"predict": _predict_constant},
    "cells and ties permuted together": _permuted_together,
    "cells permuted alone": lambda seed: _after_views(
        lambda sheet, _: sheet.reshape(-1)[_order(seed, sheet.shape)].reshape(sheet.shape)
    ),
    "ties permuted alone": _permuted_ties,
    # Odometry moves no cell.
    "no path integration": lambda seed: {"integrate_path": lambda cells, motion: cells},
    **{f"{share:.0%} silent": partial(_silent_cells, share) for share in SILENT},
}
"""The lesions by name; `EXCHANGED` needs a session of its own. Each makes functions from a seed."""
GOALS = {
    "prediction constant": "no closure",
    "cells and ties permuted together": "those of the intact network",
    "cells permuted alone": "no closure",
    "ties permuted alone": "no closure",
    EXCHANGED: "no closure",
    "no path integration": "ARR below 0.1",
}


_Lesioned = tuple[Measured | None, float, int]
"""Figures of a session, None for Intel; share of the closures of the intact network that are in it too, pair
for pair, NaN if there are none; number of its closures that are true."""
_Lesions = Mapping[tuple[str, str], list[_Lesioned]]
"""The mazes by lesion and row of the touch table; row "": Intel's recording."""


def measure_lesions(
    task: Task, lesions: Sequence[str] = (*LESIONS, EXCHANGED), rows: Sequence[str] = ROWS
) -> _Lesions:
    """The figures of the sessions of all lesions, `INTACT` among them; those on Intel where it is at hand."""
    tasks = [(lesion, row, maze) for row in rows for maze in task.seeds(USUAL) for lesion in lesions]
    if not INTEL.missing():
        tasks += [(lesion, "", task.first) for lesion in lesions if lesion != EXCHANGED]
    runs = dict(zip(tasks, run_tasks(_run_lesion, tasks, workers=task.workers), strict=True))
    found: dict[tuple[str, str], list[_Lesioned]] = {}
    for (lesion, row, maze), (figures, closures, true) in runs.items():
        _, intact, _ = runs[INTACT, row, maze]
        same = len(closures & intact) / len(intact) if intact else np.nan
        found.setdefault((lesion, row), []).append((figures, same, true))
    return found


def _run_lesion(task: tuple[str, str, int]) -> tuple[Measured | None, set[tuple[int, ...]], int]:
    """Runs one session with its lesion: its figures, its closures, and how many of them are true."""
    lesion, row, maze = task
    if lesion == EXCHANGED:
        functions = foreign_activity(_record_activity(TouchTask(row, maze + AWAY)))
    else:
        functions = LESIONS[lesion](maze)
    with replaced(functions):
        if not row:
            _, session, run = run_recording(INTEL.configuration())
            claims = closure_claims(session.map, run.truth)
            true = int((claims.accepted & (claims.distance <= buildings.FALSE_DISTANCE)).sum())
            return None, {(step,) for step in np.flatnonzero(claims.accepted).tolist()}, true
        result, figures = run_and_measure(TouchTask(row, maze), new_session)
    true = int((closure_errors(result.truth, result.closures) <= FALSE_CLOSURE_DISTANCE).sum())
    return figures, set(map(tuple, result.closures.tolist())), true


@contextmanager
def replaced(functions: Functions) -> Iterator[None]:
    """Functions of `pose_cells` replaced; what is compiled within has them."""
    with ExitStack() as stack:
        for name, function in functions.items():
            stack.enter_context(patch.object(pose_cells, name, function))
        yield


def _record_activity(task: TouchTask) -> np.ndarray:
    """[n, H, Y, X] activity of the intact network after every `EVERY` steps of a session."""
    config, log = collect_session(task_config(task))
    session = new_session(config, log)
    recorded: list[np.ndarray] = []
    for k, sample in enumerate(log):
        session.step(observation_of(sample))
        if (k + 1) % EVERY == 0:
            recorded.append(np.array(session.state.belief.activity))
    return np.stack([one for one in recorded if one.shape == recorded[-1].shape])


def _lesions_and_rows(result: _Lesions) -> tuple[list[str], list[str]]:
    """The lesions, and the rows of the touch table."""
    lesions, rows = (dict.fromkeys(each) for each in zip(*result, strict=True))
    return list(lesions), [row for row in rows if row]


def _table_lesions(result: _Lesions) -> list[str]:
    lesions, names = _lesions_and_rows(result)
    rows = []
    for row, lesion in product(names, lesions):
        figures = [one for one, _, _ in result[lesion, row] if one is not None]
        same = [share for _, share, _ in result[lesion, row]]
        intel = result.get((lesion, ""))
        of_intact = f"{np.nanmedian(same):.0%}" if np.isfinite(same).any() else "-"
        true = intel[0][2] if intel else "-"
        rows.append([lesion, row, *_closed(figures), of_intact, *_errors(figures), true])
    mazes = len(result[INTACT, names[0]])
    goals = "; ".join(f"{lesion}: {goal}" for lesion, goal in GOALS.items() if lesion in lesions)
    above = f"Medians over {mazes} mazes a row, closures are sums. Goal: {goals}."
    below = (
        "Not shown: cells that fall silent in an intact network learn nothing new here, because the ties are"
        " computed from the map; EM without closures is that of odometry. Intel's recording is one session,"
        " and `-` means that RATSLAM_DATA is not set."
    )
    return table_lines([above], COLUMNS, rows, [below])


def _closed(sessions: Sequence[Measured]) -> tuple[str, str]:
    """Median share of revisits closed; sums of closures and of false ones."""
    closures, false = (column(sessions, name).sum() for name in ("closures", "false_closures"))
    return f"{np.nanmedian(column(sessions, 'revisits_closed')):.2f}", f"{closures}, {false}"


def _errors(sessions: Sequence[Measured]) -> list[str]:
    """Medians of EM and ARR."""
    return [f"{np.median(column(sessions, name)):.3f}" for name in ("em", "arr")]


def _draw_lesions(result: _Lesions, png: Path) -> None:
    """Share of revisits closed, and EM, of every lesion."""
    lesions, rows = _lesions_and_rows(result)
    panels = ("revisits closed", "share", "revisits_closed"), ("EM", "m² + rad²", "em")
    line = f"Median, dots: mazes. {lesions[0]}: the network as it is."
    figure, axes = panel_grid("Lesions of the network", line, 1, 2, height=3.0)
    at = np.arange(len(lesions))
    for panel, (title, across, name) in zip(axes[0], panels, strict=True):
        for k, row in enumerate(rows):
            colour = COLOURS[k % len(COLOURS)]
            sessions = ([one for one, _, _ in result[lesion, row] if one is not None] for lesion in lesions)
            found = [column(each, name) for each in sessions]
            up = at + 0.2 - 0.4 * k
            panel.barh(up, np.nanmedian(found, axis=1), 0.36, color=colour, alpha=0.35, label=row)
            for y, group in zip(up, found, strict=True):
                panel.plot(group, [y] * len(group), "o", ms=3.5, mew=0, color=colour, alpha=0.7)
        panel.set_ylim(len(lesions) - 0.5, -0.5)
        panel.set_yticks([])
        name_panel(panel, title, across, "")
    for y, lesion in enumerate(lesions):
        inside = axes[0][0].get_yaxis_transform()
        axes[0][0].text(0.02, y, lesion, transform=inside, va="center", fontsize=7, color=style.INK)
    axes[0][1].set_xscale("log")
    style.add_legend(figure, axes[0][0]).savefig(png)


CELL, SIDE = 0.05, 21
"""Size of a cell, m, and cells along x and y in sessions of the touch table."""
SIDES = (7, 11, 15, 21, 31, 42)
"""Cells along x and along y."""
SIZES = (0.025, 0.035, 0.07, 0.1)
"""Of a cell, m, each with the sides that cover what the usual network covers."""
CALLS = 20
"""Of which the fastest counts."""


_Network = tuple[int, float, bool]
"""Cells along x and y, size of a cell, m, and whether the network grows with the map."""
_Sized = tuple[Measured, tuple[int, int], float]
"""Figures of a session; cells along x and y at its end; time of the network's part of an update with the
keyframes at its end, us."""
_Sizes = Mapping[_Network, list[_Sized]]


def measure_sizes(
    task: Task, row: str = "exploration", sides: Sequence[int] = SIDES, sizes: Sequence[float] = SIZES
) -> _Sizes:
    """The figures of networks of all sides, growing and not, and of all sizes of a cell, growing; each by the
    sessions of its mazes."""
    chosen: list[_Network] = [(side, CELL, grows) for grows in (False, True) for side in sides]
    chosen += [(int(np.ceil(SIDE * CELL / size)), size, True) for size in sizes]
    tasks = [(network, maze) for network in dict.fromkeys(chosen) for maze in task.seeds(1)]
    found: dict[_Network, list[_Sized]] = {}
    runs = run_tasks(partial(_run_size, row), tasks, workers=task.workers)
    for (network, _), sized in zip(tasks, runs, strict=True):
        found.setdefault(network, []).append(sized)
    return found


def _run_size(row: str, task: tuple[_Network, int]) -> _Sized:
    """Runs one session of a row and maze. Only the network has other cells: the lengths of recall and of the
    map, which the product counts in cells, stay what they are with the usual ones."""
    (side, size, grows), maze = task
    unit = CELL / size  # so much longer is a length in the network's cells
    sessions: list[Session] = []

    def change(backend: Backend) -> None:
        assert isinstance(backend, RecallBackend)
        assert backend.cell == CELL
        cells = PoseCellConfig(cells_xy=side, cell_size=size)
        backend.network = backend.network._replace(cells=cells, excite=backend.network.excite * unit)
        sd, rate = backend.recall.local_sd * unit, backend.recall.local_heading_rate / unit
        backend.recall = backend.recall.model_copy(update={"local_sd": sd, "local_heading_rate": rate})

    def start(config: RunConfig, log: InMemorySource) -> Session:
        sessions.append(new_session(config, log, change))
        return sessions[-1]

    functions: Functions = {} if grows else {"sides_for": lambda network, poses: (side, side)}
    with replaced(functions), patch.object(filter, "BASIN", filter.BASIN * unit):
        _, figures = run_and_measure(TouchTask(row, maze), start)
    _, y, x = sessions[0].state.belief.activity.shape
    return figures, (x, y), _update_time(sessions[0])


def _update_time(session: Session) -> float:
    """Processor time of the network's part of an update, us: the least of `CALLS`."""
    backend, memory, belief = session.backend, session.state.memory, session.state.belief
    assert isinstance(backend, RecallBackend)
    cells = filter.view_cells(backend.recall, memory)

    @jax.jit
    def update(belief: Belief, cells: ViewCells, motion: Array) -> Belief:
        found, lost = pose_cells.predict(backend.network, belief, cells, motion)
        mass, _ = pose_cells.inhibit(found, lost + jnp.float32(0.01))
        return pose_cells.anchor(backend.network, belief, cells, mass)

    run = partial(update, belief, cells, memory.motion)
    jax.block_until_ready(run())
    return 1e6 * min(time_call(lambda: jax.block_until_ready(run()))[0] for _ in range(CALLS))


def _table_sizes(result: _Sizes) -> list[str]:
    columns = (
        "cells a side", "cell, m", "grows", "cells at the end", "revisits closed", "closures, false", "EM",
        "ARR", "us per update",
    )  # fmt: skip
    rows = []
    for (side, size, grows), sessions in result.items():
        figures, ends, updates = zip(*sessions, strict=True)
        network = [side, f"{size:g}", "yes" if grows else "no", " x ".join(map(str, ends[0]))]
        rows.append([*network, *_closed(figures), *_errors(figures), f"{np.median(updates):.0f}"])
    mazes = len(next(iter(result.values())))
    above = (
        f"Free exploration, {mazes} maze{'s' * (mazes > 1)}: medians, closures are sums. The usual network"
        f" has {SIDE} cells of {CELL:g} m and grows. Goal: fewer cells than the map needs close less; finer"
        " cells close as much."
    )
    below = (
        "An update's time is of the network alone, of all threads, the least of"
        f" {CALLS} calls. Not shown: other headings; maps of several hundred metres."
    )
    return table_lines([above], columns, rows, [below])


def _draw_sizes(result: _Sizes, png: Path) -> None:
    """Share of revisits closed against the cells a side and against the time of an update."""
    groups = {
        f"{CELL:g} m, fixed": {key: one for key, one in result.items() if not key[2]},
        f"{CELL:g} m, grows": {key: one for key, one in result.items() if key[1] == CELL and key[2]},
        "other cells, grows": {key: one for key, one in result.items() if key[1] != CELL},
    }
    line = f"The usual network has {SIDE} cells of {CELL:g} m along x and y, and grows."
    figure, axes = panel_grid("Numbers and sizes of cells", line, 1, 2, height=2.6)
    for (label, group), colour in zip(groups.items(), COLOURS + (style.GREEN,), strict=True):
        closed = [
            np.nanmedian(column([one for one, *_ in each], "revisits_closed")) for each in group.values()
        ]
        update = [np.median([time for *_, time in each]) for each in group.values()]
        axes[0][0].plot([side for side, *_ in group], closed, "o-", ms=4, color=colour, label=label)
        axes[0][1].plot(update, closed, "o", ms=5, color=colour)
    for panel, across in zip(axes[0], ("cells a side", "time of an update (us)"), strict=True):
        panel.set_ylim(bottom=0)
        style.name_axes(panel, across, "revisits closed")
    axes[0][1].set_xscale("log")
    style.add_legend(figure, axes[0][0]).savefig(png)


LESIONS_FIGURE = Figure("Lesions of the belief network", measure_lesions, _table_lesions, _draw_lesions)
SCALE_FIGURE = Figure("Numbers and sizes of cells", measure_sizes, _table_sizes, _draw_sizes)
