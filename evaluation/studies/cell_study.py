"""A study of many networks of pose cells over one course: parameter sets, their scores, table and pictures.

Parameter sets come from stated ranges and are simulated in chunks, whose scores are kept on disk. Scores are
drift, decoding error and rate maps. The table has the best, the median and the worst set by drift and rank
correlations; the pictures show scores over the parameters, and rate maps.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
from pydantic import AfterValidator, Field, NonNegativeInt, PositiveInt
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


class _Sums:
    """What is summed over the segments of a course, for B networks, in float64."""

    def __init__(self, study: StudyCourse, count: int) -> None:
        self._study = study
        self._ring, self._unit = rings(study.config, np.dtype(float)), units(study.config, np.dtype(float))
        self._bins = (len(study.y_edges) - 1) * (len(study.x_edges) - 1)
        self._before = np.tile(self._ring // 2, (count, 1))  # wrapped packets
        self._packet = self._before.copy()  # the same, followed round the torus
        self._last = np.zeros((count, 2))
        self._squares, self._errors = np.zeros((count, 2)), np.zeros((count, 2))
        self._reseeded, self._larger = np.zeros(count), np.zeros(count)
        self._maps = np.zeros((count, len(study.chosen) * self._bins))

    def add(self, first: int, track: CellTrack) -> None:
        """Adds a segment [B, S] that begins at step `first`."""
        pose, activity, outcome, level = track
        count, length = outcome.shape
        rows = slice(first, first + length)
        wrapped = np.concatenate([self._before[:, None], pose], axis=1)
        gone = self._shortest(np.diff(wrapped, axis=1))
        packet = self._packet[:, None] + np.cumsum(gone, axis=1)
        self._before, self._packet = wrapped[:, -1], packet[:, -1]
        error = packet - self._study.expected[None, rows]
        drift = self._lengths(error)
        self._last = drift[:, -1]
        self._squares += (drift**2).sum(axis=1)
        self._errors += self._lengths(self._shortest(error)).sum(axis=1)
        self._reseeded += (outcome == Outcome.RESEEDED).sum(axis=1)
        self._larger += (level > 0).sum(axis=1)
        cells = activity.shape[2]
        at = np.arange(cells) * self._bins + self._study.bin[rows, None]
        at = at[None] + np.arange(count)[:, None, None] * (cells * self._bins)
        weight = activity * self._study.seconds[None, rows, None]
        self._maps += np.bincount(at.ravel(), weight.ravel(), self._maps.size).reshape(self._maps.shape)

    def scores(self) -> _Scores:
        """The scores of all steps added."""
        study, steps = self._study, len(self._study.expected)
        seconds = np.bincount(study.bin, study.seconds, self._bins)
        maps = self._maps.reshape(len(self._maps), -1, self._bins)
        mean = np.divide(maps, seconds, out=np.full_like(maps, np.nan), where=seconds > 0)
        place = len(study.y_edges) - 1, len(study.x_edges) - 1
        rms, mean_error = np.sqrt(self._squares / steps), self._errors / steps
        return {
            "drift": rms[:, 0], "drift_heading": rms[:, 1],
            "drift_end": self._last[:, 0], "drift_heading_end": self._last[:, 1],
            "decoding": mean_error[:, 0], "decoding_heading": mean_error[:, 1],
            "reseeded": self._reseeded / steps, "larger": self._larger / steps,
            "maps": mean.astype(np.float32).reshape(*maps.shape[:2], *place),
        }  # fmt: skip

    def _shortest(self, difference: np.ndarray) -> np.ndarray:
        return difference - self._ring * np.round(difference / self._ring)

    def _lengths(self, error: np.ndarray) -> np.ndarray:
        """[..., 2] m and rad of differences [..., 3] in cells."""
        x, y, heading = np.moveaxis(error * self._unit, -1, 0)
        return np.stack([np.hypot(x, y), np.abs(heading)], axis=-1)


FOLDER = "sets"
"""Name of the folder of a study's chunks."""


def _in_order(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError("must begin with the lower end")
    return ends


Range = Annotated[
    tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]], AfterValidator(_in_order)
]
Width = Annotated[
    tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]], AfterValidator(_in_order)
]


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
        for array in jax.tree.leaves((self.course[2:], self.parameters)):
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
    files = {task.key: folder / FOLDER / f"{task.key}.npz" for task in tasks_of(study)}
    with os_errors_of(folder, "cannot be made", "a folder to write to"):
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    missing = []
    for task, path in zip(tasks_of(study), files.values(), strict=True):
        if path.exists():
            done(len(task.parameters))
        else:
            missing.append(task)
    with closing(executor.completed(score_task, missing)) as completed:
        for index, scores in completed:
            write_atomically(files[missing[index].key], partial(_save_scores, scores))
            done(len(missing[index].parameters))
    parts = []
    for path in files.values():
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
    precise = {
        name: np.asarray(getattr(study.course, name), np.dtype(plan.precision))
        for name in ("motion", "noise", "turned", "energy")
    }
    course = study.course._replace(**precise)
    sums = _Sums(study, plan.chunk)
    for k, track in enumerate(walk(study.config, sets, course, study.chosen)):
        sums.add(k * SEGMENT, track)
    return {name: column[:count] for name, column in sums.scores().items()}


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
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

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
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=30))
            axes.yaxis.set_minor_locator(NullLocator())
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.10g}"))
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
        figure.text(
            0.5 * style.LEFT / WIDTH, (bottom + side / 2) / height, name, rotation=90, fontsize=9,
            ha="center", va="center", color=style.INK,
        )  # fmt: skip
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
    columns, course = _columns(study, scores), study.course
    rows = [{name: float(column[k]) for name, column in columns.items()} for k in range(len(scores["drift"]))]
    arrays: dict[str, Any] = {"maps": scores["maps"], "cell": course.chosen}
    arrays |= {"x_edges": course.x_edges, "y_edges": course.y_edges}
    files = {
        "table.csv": csv_text([{"set": k} | row for k, row in enumerate(rows)]),
        "table.md": f"{render_cells(study, scores)}\n",
        "maps.npz": partial(np.savez_compressed, **arrays),
    }
    return save_files(folder, files | _figures(study, scores))


def _figures(study: _CellStudy, scores: _Scores) -> dict[str, style.Figure]:
    columns, line, course = _columns(study, scores), _describe(study), study.course
    parameters = {f"{name} ({UNITS[name]})".removesuffix(" ()"): columns[name] for name in PARAMETERS}
    rows = {name: scores["maps"][k] for name, k in _chosen(scores).items()}
    drift, decoding = (
        _draw_scores(f"{what}: {study.name}", line, parameters, scores[name], label)
        for name, what, label in (
            ("drift", "Drift", "drift, rms (m)"),
            ("decoding", "Decoding error", "decoding error (m)"),
        )
    )
    sets = f"Least, median and most drift of {len(scores['drift'])} sets; above each map its largest activity"
    title = f"Rate maps by drift: {study.name}"
    maps = _draw_rate_maps(title, sets, rows, course.x_edges, course.y_edges)
    return {"drift.png": drift, "decoding.png": decoding, "maps.png": maps}


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
