"""A study of many networks of pose cells over one course: parameter sets, their scores, table and pictures.

Parameter sets come from stated ranges and are simulated in chunks, whose scores are kept on disk. Scores are
drift, decoding error and rate maps. The table has the best, the median and the worst set by drift and rank
correlations; the pictures show scores over the parameters, and rate maps.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
from pydantic import AfterValidator, Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from scipy.stats import qmc, rankdata

from evaluation.plots import style
from evaluation.plots.cell_plot import draw_rate_map
from evaluation.plots.style import BLUE, LABEL_GREY, WIDTH
from evaluation.studies.executor import Executor
from evaluation.studies.network_batch import SEGMENT, CellSets, CellTrack, walk
from evaluation.studies.study import preset_settings
from evaluation.studies.study_course import CELLS, StudyCourse, read_course
from evaluation.studies.study_report import csv_text, format_number, render_table, save_files
from ratslam.classic.config import rings, units
from ratslam.classic.pose_cells import Outcome
from ratslam.core.compilation import Precision, prepare_precision
from ratslam.runs.settings.run_config import load_config
from tactile.base.errors import os_errors_of
from tactile.base.files import flush_to_disk, write_atomically
from tactile.base.random_streams import stream
from tactile.base.settings import Settings

_Scores = dict[str, np.ndarray]
"""See `score_task`."""


def _score_tracks(study: StudyCourse, count: int, tracks: Iterable[CellTrack]) -> _Scores:
    """The scores of `count` networks, summed in float64 over the segments of their course."""
    ring, unit = rings(study.config, np.dtype(float)), units(study.config, np.dtype(float))
    place = len(study.y_edges) - 1, len(study.x_edges) - 1
    bins, cells, steps = place[0] * place[1], len(study.chosen), len(study.expected)
    before = np.tile(ring // 2, (count, 1))  # wrapped packets
    followed = before.copy()  # the same, followed round the torus
    squares, errors = np.zeros((count, 2)), np.zeros((count, 2))
    reseeded, larger = np.zeros(count), np.zeros(count)
    sums = np.zeros((count, cells * bins))

    def shortest(difference: np.ndarray) -> np.ndarray:
        return difference - ring * np.round(difference / ring)

    def lengths(error: np.ndarray) -> np.ndarray:
        """[..., 2] m and rad of differences [..., 3] in cells."""
        x, y, heading = np.moveaxis(error * unit, -1, 0)
        return np.stack([np.hypot(x, y), np.abs(heading)], axis=-1)

    for k, (pose, activity, outcome, level) in enumerate(tracks):
        rows = slice(k * SEGMENT, k * SEGMENT + outcome.shape[1])
        wrapped = np.concatenate([before[:, None], pose], axis=1)
        packet = followed[:, None] + np.cumsum(shortest(np.diff(wrapped, axis=1)), axis=1)
        before, followed = wrapped[:, -1], packet[:, -1]
        error = packet - study.expected[None, rows]
        drift = lengths(error)
        squares += (drift**2).sum(axis=1)
        errors += lengths(shortest(error)).sum(axis=1)
        reseeded += (outcome == Outcome.RESEEDED).sum(axis=1)
        larger += (level > 0).sum(axis=1)
        at = np.arange(cells) * bins + study.bin[rows, None]
        at = at[None] + np.arange(count)[:, None, None] * (cells * bins)
        weight = activity * study.seconds[None, rows, None]
        sums += np.bincount(at.ravel(), weight.ravel(), sums.size).reshape(sums.shape)
    seconds, maps = np.bincount(study.bin, study.seconds, bins), sums.reshape(count, -1, bins)
    mean = np.divide(maps, seconds, out=np.full_like(maps, np.nan), where=seconds > 0)
    rms, mean_error = np.sqrt(squares / steps), errors / steps
    return {
        "drift": rms[:, 0], "drift_heading": rms[:, 1],
        "drift_end": drift[:, -1, 0], "drift_heading_end": drift[:, -1, 1],
        "decoding": mean_error[:, 0], "decoding_heading": mean_error[:, 1],
        "reseeded": reseeded / steps, "larger": larger / steps,
        "maps": mean.astype(np.float32).reshape(*maps.shape[:2], *place),
    }  # fmt: skip


FOLDER = "sets"
"""Name of the folder of a study's chunks."""


def _in_order(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError("must begin with the lower end")
    return ends


Range = Annotated[tuple[NonNegativeFloat, NonNegativeFloat], AfterValidator(_in_order)]
Width = Annotated[tuple[PositiveFloat, PositiveFloat], AfterValidator(_in_order)]


class _CellPlan(Settings):
    """The settings of a study of many networks. Each range is [low, high]; equal ends fix a parameter."""

    sets: PositiveInt = 1000
    """Parameter sets: the first of a Halton sequence over the ranges, so that a larger study contains a
    smaller one."""
    views: bool = False  # whether views of the session inject energy; otherwise path integration alone
    steps: Annotated[int, Field(ge=2)] = 30_000  # most steps of the session to use
    excite_sigma: Width = (0.8, 1.2)  # standard deviation of excitation, cells
    inhibit_sigma: Width = (1.6, 2.4)  # standard deviation of inhibition, cells
    global_inhibition: Range = (0.0, 4e-5)  # activity subtracted from every cell at each sub-step
    energy: Range = (0.5, 2.0)  # factor on the energy that views inject
    speed_noise: Range = (0.0, 0.2)  # standard deviation of each step's motion, as a share of it
    heading_noise: Range = (0.0, 0.1)  # standard deviation of the heading, rad / sqrt(s)
    chosen: Annotated[tuple[NonNegativeInt, ...], Field(max_length=CELLS)] = ()
    """Cells whose rate maps are made, indices in the flattened network; none: eight on the way."""
    bins: Annotated[int, Field(ge=2, le=100)] = 20  # place bins along each side of the square round the path
    chunk: Annotated[int, Field(ge=1, le=1024)] = 32
    """Parameter sets of a job, whose scores are written together."""
    seed: NonNegativeInt = 0
    """Seed of the parameter sets and of the noise, which is the same for all sets apart from its size."""
    precision: Precision = "float32"  # floating-point type of the networks


PARAMETERS = ("excite_sigma", "inhibit_sigma", "global_inhibition", "energy", "speed_noise", "heading_noise")
"""Columns of parameter sets, and the ranges of a `_CellPlan`."""


class _CellStudy(NamedTuple):
    """A checked study, or a chunk of one: some of its parameter sets."""

    name: str
    plan: _CellPlan
    course: StudyCourse
    parameters: np.ndarray  # [sets, 6] in the order of `PARAMETERS`

    @property
    def key(self) -> str:
        """Hash of all that decides the scores, apart from the code."""
        plan = self.plan
        content = hashlib.sha256(f"{self.course.config!r} {plan.chunk} {plan.precision}".encode())
        for array in jax.tree.leaves((self.course[1:], self.parameters)):
            content.update(f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return content.hexdigest()[:16]


def cell_study(path: Path, overrides: Sequence[str] = ()) -> _CellStudy:
    """The study of a configuration file; reads its session.

    Args:
        overrides: each `a.b=value`: a key of `_CellPlan` where it is one, else of the configuration.

    Raises:
        InputError: a setting is invalid, or see `read_course`.
    """
    plan, others = preset_settings(_CellPlan, "cells", overrides)
    course = read_course(load_config(path, others), plan.steps, plan.views, plan.bins, plan.chosen, plan.seed)
    # Points of a scrambled Halton sequence (Owen 2017, arXiv:1706.02808).
    ends = np.array([getattr(plan, name) for name in PARAMETERS])
    share = qmc.Halton(len(PARAMETERS), rng=stream(plan.seed, "cells.sets")).random(plan.sets)
    parameters = ends[:, 0] + share * (ends[:, 1] - ends[:, 0])
    return _CellStudy(f"{path.stem}-cells", plan, course, parameters)


def run_cell_study(
    study: _CellStudy, folder: Path, executor: Executor, done: Callable[[int], object] = lambda sets: None
) -> _Scores:
    """The scores of all parameter sets, in their order; each chunk is on disk before it counts as done.

    Args:
        folder: of the study; chunks found in its `FOLDER` are not computed again. done: called with the
            number of sets of each chunk.

    Raises:
        InputError: the folder cannot be written to, or the process of a chunk was killed.
    """
    tasks = {folder / FOLDER / f"{task.key}.npz": task for task in tasks_of(study)}
    with os_errors_of(folder, "cannot be made", "a folder to write to"):
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    missing = [path for path in tasks if not path.exists()]
    for path in tasks.keys() - missing:
        done(len(tasks[path].parameters))
    with closing(executor.completed(score_task, [tasks[path] for path in missing])) as completed:
        for index, scores in completed:
            write_atomically(missing[index], partial(_save_scores, scores))
            done(len(tasks[missing[index]].parameters))
    parts = []
    for path in tasks:
        with np.load(path) as found:
            parts.append(dict(found))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def tasks_of(study: _CellStudy) -> list[_CellStudy]:
    """The chunks of a study."""
    size, rows = study.plan.chunk, study.parameters
    return [study._replace(parameters=rows[k : k + size]) for k in range(0, len(rows), size)]


def score_task(task: _CellStudy) -> _Scores:
    """Simulates the networks of a chunk over the course and scores them.

    A part of a chunk is filled up, so that its bits do not depend on the number. Memory does not depend on
    the length of the course, apart from the course itself. Drift is the packet, followed round the torus,
    minus the pose that it would have without drift. The decoding error is the same on the torus, the shortest
    way.

    Returns:
        By name of n networks, drift, drift_heading: [n] rms over the course, m and rad. drift_end,
            drift_heading_end: [n] after the last step, m and rad. decoding, decoding_heading: [n] mean over
            the course, m and rad. reseeded: [n] share of steps at which activity had died out. larger: [n]
            share of steps that needed more than the smallest window. maps: [n, C, H, W] float32 mean activity
            of the chosen cells in each place bin, NaN where the robot never was.
    """
    plan, study, count = task.plan, task.course, len(task.parameters)
    prepare_precision(plan.precision)
    rows = np.arange(plan.chunk).clip(max=count - 1)
    sets = CellSets(**dict(zip(PARAMETERS, task.parameters[rows].T, strict=True)))
    names, dtype = ("motion", "noise", "turned", "energy"), np.dtype(plan.precision)
    course = study.course._replace(**{name: np.asarray(getattr(study.course, name), dtype) for name in names})
    scores = _score_tracks(study, plan.chunk, walk(study.config, sets, course, study.chosen))
    return {name: column[:count] for name, column in scores.items()}


def _save_scores(scores: _Scores, path: Path) -> None:
    """Writes the scores of a chunk; they are on the disk when this returns."""
    np.savez_compressed(path, **scores)  # type: ignore[arg-type]
    flush_to_disk(path)


_PANEL, _GAP_ACROSS, _GAP_UP = 1.9, 0.62, 0.75  # inches: height of a panel, between panels
_COLUMNS = 3
_MAP_GAP = 0.12  # inches between rate maps


def _draw_scores(
    title: str, line: str, parameters: Mapping[str, np.ndarray], score: np.ndarray, label: str
) -> style.Figure:
    """Draws a score [B] against each parameter [B], a point for each network.

    Args:
        parameters: by label with unit. score: on a logarithmic axis if positive. label: with unit.
    """
    size = float(np.clip(40 / np.sqrt(len(score)), 4, 10))
    rows = -(-len(parameters) // _COLUMNS)
    height = style.TOP + rows * (_PANEL + _GAP_UP)
    figure = style.new_figure(height, title, line)
    width = (style.INNER - (_COLUMNS - 1) * _GAP_ACROSS) / _COLUMNS
    for k, (name, values) in enumerate(parameters.items()):
        row, column = divmod(k, _COLUMNS)
        left = style.LEFT + column * (width + _GAP_ACROSS)
        bottom = height - style.TOP - _PANEL - row * (_PANEL + _GAP_UP)
        axes = style.add_axes(figure, left, bottom, width, _PANEL)
        axes.plot(values, score, ".", color=BLUE, ms=size, mew=0, alpha=0.6)
        axes.grid(color=style.LINE_GREY, lw=0.7)
        if score.min() > 0:
            axes.set_yscale("log")
            style.log_ticks(axes.yaxis, (1, 2, 5))
            axes.set_ylim(0.5 * score.min(), 2 * score.max())
        axes.locator_params(axis="x", nbins=4)
        axes.ticklabel_format(axis="x", style="sci", scilimits=(-3, 4))
        style.name_axes(axes, name, label if column == 0 else "")
    return figure


def _draw_rate_maps(
    title: str, line: str, rows: Mapping[str, np.ndarray], x_edges: np.ndarray, y_edges: np.ndarray
) -> style.Figure:
    """Draws the rate maps of networks, a row for each and a column for each cell; each map has a colour scale
    of its own, from 0 to the value above it.

    Args:
        rows: by name, maps [C, H, W] of mean activity, NaN where the robot never was. x_edges, y_edges:
            [W + 1], [H + 1] edges of the place bins, m.
    """
    columns = max(map(len, rows.values()))
    side = (style.INNER - (columns - 1) * _MAP_GAP) / columns
    step = side + 0.5
    height = style.TOP + len(rows) * step + 0.1
    figure = style.new_figure(height, title, line)
    for k, (name, maps) in enumerate(rows.items()):
        bottom = height - style.TOP - side - 0.18 - k * step
        for column, rates in enumerate(maps):
            axes = style.add_axes(figure, style.LEFT + column * (side + _MAP_GAP), bottom, side, side)
            draw_rate_map(axes, rates, x_edges, y_edges)
            axes.set_title(f"{np.nanmax(rates):.2g}", fontsize=7, color=LABEL_GREY, pad=2)
        at = 0.5 * style.LEFT / WIDTH, (bottom + side / 2) / height
        figure.text(*at, name, rotation=90, fontsize=9, ha="center", va="center", color=style.INK)
    return figure


UNITS = {
    "excite_sigma": "cells", "inhibit_sigma": "cells", "global_inhibition": "", "energy": "",
    "speed_noise": "", "heading_noise": "rad / sqrt(s)", "drift": "m", "drift_heading": "rad",
    "drift_end": "m", "drift_heading_end": "rad", "decoding": "m", "decoding_heading": "rad",
    "reseeded": "", "larger": "",
}  # fmt: skip
"""Units of the columns of the table; '' for shares and numbers."""
NOTE = """\
drift: packet, followed round the torus, minus true pose, rms over the course; end: after the last step.
decoding: mean distance on the torus. reseeded: share of steps at which activity had died out. larger: share
of steps that needed more than the smallest window. Rank correlations are Spearman's, over all sets."""


def render_cells(study: _CellStudy, scores: _Scores) -> str:
    """Best, median and worst set by drift, and the rank correlations, as Markdown."""
    table = [["", "set", *(f"{name} {unit}".strip() for name, unit in UNITS.items())]]
    columns = _columns(study, scores)
    for name, k in _chosen(scores).items():
        table.append([name, str(k), *(format_number(float(column[k])) for column in columns.values())])
    links = [["rank correlation with", *PARAMETERS]]
    for name in ("drift", "drift_heading", "decoding", "decoding_heading"):
        link = [name]
        for parameter in PARAMETERS:
            a, b = columns[parameter], columns[name]
            known = np.ptp(a) and np.ptp(b)
            link.append(f"{np.corrcoef(rankdata(a), rankdata(b))[0, 1]:+.2f}" if known else "-")
        links.append(link)
    return "\n".join([render_table(table), "", render_table(links), "", NOTE, _describe(study)])


def save_cells(study: _CellStudy, scores: _Scores, folder: Path) -> list[Path]:
    """Writes table.csv with all sets, table.md, maps.npz with all rate maps, and the pictures drift.png,
    decoding.png and maps.png."""
    columns, line, name = _columns(study, scores), _describe(study), study.name
    edges: dict[str, Any] = {"x_edges": study.course.x_edges, "y_edges": study.course.y_edges}
    count = len(scores["drift"])
    rows = [{"set": k, **{each: float(column[k]) for each, column in columns.items()}} for k in range(count)]
    parameters = {f"{each} ({UNITS[each]})".removesuffix(" ()"): columns[each] for each in PARAMETERS}
    drift, decoding, maps = (scores[each] for each in ("drift", "decoding", "maps"))
    chosen = {each: maps[k] for each, k in _chosen(scores).items()}
    title = f"Decoding error: {name}"
    sets = f"Least, median and most drift of {count} sets; above each map its largest activity"
    files = {
        "table.csv": csv_text(rows),
        "table.md": f"{render_cells(study, scores)}\n",
        "maps.npz": partial(np.savez_compressed, maps=maps, cell=study.course.chosen, **edges),
        "drift.png": _draw_scores(f"Drift: {name}", line, parameters, drift, "drift, rms (m)"),
        "decoding.png": _draw_scores(title, line, parameters, decoding, "decoding error (m)"),
        "maps.png": _draw_rate_maps(f"Rate maps by drift: {name}", sets, chosen, **edges),
    }
    return save_files(folder, files)


def _chosen(scores: _Scores) -> dict[str, int]:
    """Indices of the best, the median and the worst set by drift."""
    order = np.argsort(scores["drift"], kind="stable")
    return {"best": int(order[0]), "median": int(order[len(order) // 2]), "worst": int(order[-1])}


def _columns(study: _CellStudy, scores: _Scores) -> dict[str, np.ndarray]:
    known = scores | dict(zip(PARAMETERS, study.parameters.T, strict=True))
    return {name: known[name] for name in UNITS}


def _describe(study: _CellStudy) -> str:
    course, config = study.course, study.course.config
    side = course.x_edges[-1] - course.x_edges[0]
    torus = config.cells_xy * config.cell_size
    how = "with views" if study.plan.views else "path integration"
    return (
        f"{len(study.parameters)} sets, {len(course.expected)} steps, {course.seconds.sum():.0f} s, {how}, "
        f"{study.plan.precision}; path {side:.2f} m across, torus {torus:.2f} m."
    )
