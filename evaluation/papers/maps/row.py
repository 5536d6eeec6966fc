"""One row of the table of saved maps: its sessions, its lines, its picture.

The pictures of the rows: paths in a maze or building on the left, figures of all sessions on the right.

The operations of this program on saved maps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from evaluation.metrics.statistics import wilson_interval
from evaluation.papers.maps.scenarios import Recipe, Recorded
from evaluation.papers.maps.stored_maps import STEPS, MapArrays, StoredMap, store_map
from evaluation.papers.tables.comparison import Record
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.papers.trial_sessions import capacity_for
from evaluation.plots import style
from evaluation.plots.map_plot import draw_walls
from ratslam.core.session import Session
from ratslam.places.localiser import Localisation, Localiser
from ratslam.runs.build_session import build_session
from ratslam.runs.localise import localising
from ratslam.runs.merge import merge_maps
from ratslam.runs.run_directory import changes_of
from ratslam.runs.saved_map import read_map
from robot.touch_source import observation_of
from robot.world.maze import Maze, wall_boxes
from tactile.base.random_streams import stream

COLUMNS = ("figure", "goal", "measured", "control")


class Localised(NamedTuple):
    """A session of T steps in a map that does not change.

    Attributes:
        found: [T] bool, whether the robot says that it knows where it is. foreign: [T] bool, whether it says
            that it is not in this map. pose: [T, 3] in the map (m, m, rad).
    """

    found: np.ndarray
    foreign: np.ndarray
    pose: np.ndarray


class Methods(NamedTuple):
    """Operations on saved maps; functions of a module, so that other processes can import them.

    Attributes:
        localise: a session in a map. extend: the map of a session and then another one, whose robot may stand
            anywhere: its arrays are over the steps of both, in this order. merge: one map of several, written
            to a new path, and its arrays over the steps of all, in the order of the arguments. changes:
            places [n, 2] of a map (m) where a session says that it no longer agrees, the surest first.
    """

    localise: Callable[[StoredMap, Recorded], Localised]
    extend: Callable[[StoredMap, Recorded], MapArrays]
    merge: Callable[[Sequence[StoredMap], Path], StoredMap]
    changes: Callable[[StoredMap, Recorded], np.ndarray]


class MapTask(NamedTuple):
    """One session of a row.

    Attributes:
        seed: of its maze; in rows of recordings, the number of the recording. folder: for maps. methods: what
            is measured.
    """

    seed: int
    folder: Path
    methods: Methods

    def map_of(self, recipe: Recipe) -> StoredMap:
        """The map of a session, made once for all rows."""
        return store_map(recipe, self.folder)


class Line(NamedTuple):
    """A line of a row's table: a figure, its goal, what was measured, and the same of the control."""

    figure: str
    goal: str
    measured: str
    control: str


class MapRow(NamedTuple):
    """A row.

    Attributes:
        title: one line. sessions: their usual number. measure: the figures of one session. record: these by
            name, each a number, or whether the session fails in something. lines: of the figures of all.
            draw: draws these into a new PNG file. recordings: names of the recordings that are used instead
            of mazes.
    """

    title: str
    sessions: int
    measure: Callable[[MapTask], Any]
    record: Callable[[Any], Record]
    lines: Callable[[Sequence[Any]], Iterable[Line]]
    draw: Callable[[Sequence[Any], Path], None]
    recordings: tuple[str, ...] = ()

    def seeds(self, first: int, sessions: int | None) -> range:
        """The seeds of its tasks, from that of the first maze and the number of sessions (None: the
        usual)."""
        if self.recordings:
            return range(len(self.recordings))[:sessions]
        return range(first, first + (sessions or self.sessions))

    def table(self, found: Sequence[Any]) -> list[str]:
        """The lines of a Markdown table."""
        return [markdown_header(COLUMNS), *(markdown_row(line) for line in self.lines(found))]


def median(values: np.ndarray) -> float:
    """Median of values [n]; NaN of none."""
    return float(np.median(values)) if len(values) else np.nan


def count(happened: Sequence[bool] | np.ndarray) -> str:
    """How many of the sessions [n] bool, with the 95 % interval of the rate in percent."""
    number, total = int(np.sum(happened)), len(happened)
    if not total:
        return "-"
    low, high = wilson_interval(number, total)
    return f"{number} of {total} [{100 * low:.0f}-{100 * high:.0f} %]"


def spread(values: Sequence[float] | np.ndarray, digits: int = 2) -> str:
    """Median and largest of values; `-` without a finite one."""
    known = np.asarray(values, float)
    known = known[~np.isnan(known)]
    if not len(known):
        return "-"
    return f"{np.median(known):.{digits}f} ({known.max():.{digits}f})"


COLOURS = (style.GREY, style.BLUE, style.VERMILLION, style.GREEN, style.PURPLE)
HEIGHT = 4.6
"""Of a picture, inches."""
TOP, BOTTOM = 1.05, 0.75
"""Margins of the panels, inches."""
SPREAD = 0.18
"""Half the width over which the dots of one group are spread."""
NOWHERE = np.zeros((0, 2))


class PathPanel(NamedTuple):
    """Paths [.., 2] (m) by label, over the walls of a maze if there is one; rows of NaN interrupt a path.

    Attributes:
        changed, named, goals: [n, 2] places that truly changed, that were named, and that were driven to, m.
    """

    title: str
    maze: Maze | None
    paths: Mapping[str, np.ndarray]
    changed: np.ndarray = NOWHERE
    named: np.ndarray = NOWHERE
    goals: np.ndarray = NOWHERE


class Panel(NamedTuple):
    """Figures of all sessions: dots in named groups, or named groups of curves over steps.

    Attributes:
        up, across: labels of the axes with units. limits: values at which lines are drawn, by label.
    """

    up: str
    across: str
    dots: Mapping[str, Sequence[float]] = MappingProxyType({})
    curves: Mapping[str, Sequence[np.ndarray]] = MappingProxyType({})
    limits: Mapping[str, float] = MappingProxyType({})


def draw_panels(png: Path, title: str, line: str, paths: PathPanel | None, panel: Panel) -> None:
    """Draws a picture into a new PNG file.

    Args:
        line: the result in one sentence.
    """
    figure = style.new_figure(HEIGHT, title, line)
    left = style.LEFT
    if paths is not None:
        wide = 0.58 * style.WIDTH - left
        _draw_paths(figure, paths, (left, BOTTOM, wide, HEIGHT - TOP - BOTTOM))
        left += wide + 0.95
    axes = style.add_axes(figure, left, BOTTOM, style.WIDTH - left - style.RIGHT, HEIGHT - TOP - BOTTOM)
    _draw_panel(axes, panel)
    figure.savefig(png)


def _draw_paths(figure: style.Figure, panel: PathPanel, box: tuple[float, float, float, float]) -> None:
    axes = style.add_axes(figure, *box)
    axes.set_aspect("equal", anchor="W")
    if panel.maze is not None:
        walls = wall_boxes(panel.maze, stream(0, "maze.heights"))
        draw_walls(axes, np.column_stack([walls.box, walls.height]))
    for number, (label, path) in enumerate(panel.paths.items()):
        width, order = (1.6, 2 + number) if number else (1.0, 1)
        axes.plot(*path.T, color=COLOURS[number], lw=width, label=label, zorder=order)
    if len(panel.changed):
        x, y = panel.changed.T
        axes.plot(
            x, y, "o", ms=15, mfc="none", mec=style.VERMILLION, mew=1.8, label="truly changed", zorder=8
        )
    if len(panel.named):
        axes.plot(*panel.named.T, "x", ms=8, mew=2, color=style.BLUE, label="named", zorder=9)
    if len(panel.goals):
        axes.plot(*panel.goals.T, "o", ms=6, mfc=style.VERMILLION, mec="white", label="goals", zorder=9)
    axes.set_title(panel.title, fontsize=9.5, color=style.INK, loc="left")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.legend(
        loc="upper left", bbox_to_anchor=(0, -0.01), ncol=3, frameon=False, fontsize=8.5, labelcolor=style.INK
    )


def _draw_panel(axes: style.Axes, panel: Panel) -> None:
    for number, values in enumerate(panel.dots.values()):
        known = np.sort(np.asarray(values, float))
        known = known[np.isfinite(known)]
        beside = np.linspace(-SPREAD, SPREAD, len(known)) if len(known) > 1 else np.zeros(len(known))
        axes.plot(number + beside, known, "o", ms=5, color=COLOURS[1 + number % 4], alpha=0.8)
        if len(known):
            axes.plot([number - 0.3, number + 0.3], 2 * [np.median(known)], color=style.INK, lw=1.4)
    if panel.dots:
        axes.set_xticks(range(len(panel.dots)), list(panel.dots))
        axes.set_xlim(-0.6, len(panel.dots) - 0.4)
    for number, (label, curves) in enumerate(panel.curves.items()):
        for curve in curves:
            steps = 1 + np.arange(len(curve))
            axes.plot(steps, curve, color=COLOURS[1 + number % 4], lw=1.1, alpha=0.6, label=label)
            label = ""
    if len(panel.curves) > 1:
        axes.legend(
            frameon=False, fontsize=8.5, labelcolor=style.INK,
            loc="lower right", bbox_to_anchor=(1, 1), ncols=len(panel.curves),
        )  # fmt: skip
    for label, limit in panel.limits.items():
        axes.axhline(limit, color=style.VERMILLION, lw=1.0, ls="--", zorder=0.8)
        across = axes.get_yaxis_transform()
        axes.text(
            1, limit, label, transform=across, ha="right", va="bottom", fontsize=8, color=style.VERMILLION
        )
    axes.set_ylim(0, 1.1 * max(axes.get_ylim()[1], *panel.limits.values(), 0.0))
    axes.grid(axis="y", color=style.LINE_GREY, lw=0.8)
    style.name_axes(axes, panel.across, panel.up)


def localise(made: StoredMap, recorded: Recorded) -> Localised:
    """A session in a map, with `backend: localise`; poses are those given at each step.

    Raises:
        InputError: the session is not one of the map's sensor.
    """
    session = _session_in(made.path, capacity_for(recorded.log.length))
    session.restart(recorded.config.session.seed)
    steps = list(session.replay(observation_of(sample) for sample in recorded.log))
    localiser = session.map
    assert isinstance(localiser, Localiser)
    states = localiser.states()
    pose = np.array([step.pose for step in steps])
    return Localised(states == Localisation.FOUND, states == Localisation.NOT_THIS_MAP, pose)


def extend(made: StoredMap, recorded: Recorded) -> MapArrays:
    """The map of a session and then another one, which begins a new piece of it.

    Raises:
        InputError: the session is not one of the map's sensor.
    """
    session = read_map(made.path).open_session()
    session.begin_piece()
    for _ in session.replay(observation_of(sample) for sample in recorded.log):
        pass
    return MapArrays.of_session(session, np.concatenate([made.arrays.truth, recorded.truth]))


def merge(maps: Sequence[StoredMap], path: Path) -> StoredMap:
    """One map of several, in a new folder; steps in the order of the arguments.

    Raises:
        InputError: the maps cannot be merged.
    """
    merged = merge_maps([made.path for made in maps], path)
    begins = np.cumsum([0, *merged.steps[:-1]]).tolist()
    begin = {at.parent: first for at, first in zip(merged.maps, begins, strict=True)}
    order = np.concatenate([begin[made.path] + made.order for made in maps])
    session = read_map(path).open_session()
    truth = np.concatenate([made.arrays.truth for made in maps])
    whole = MapArrays.of_session(session, truth)
    arrays = whole._replace(trajectory=whole.trajectory[order], piece=whole.piece[order])
    np.savez(path / STEPS, **arrays._asdict())
    return StoredMap(path, arrays, order)


def changes(made: StoredMap, recorded: Recorded) -> np.ndarray:
    """Places [n, 2] of a map (m) where a session says that it no longer agrees, the surest first."""
    localise(made, recorded)
    localiser = _session_in(made.path, capacity_for(recorded.log.length)).map
    assert isinstance(localiser, Localiser)
    found = changes_of(localiser, recorded.config.touch)
    return np.array([change.position for change in found]).reshape(-1, 2)


@lru_cache(maxsize=1)
def _session_in(path: Path, reserve: int) -> Session:
    """A session of any state in a map; the last one that was compiled is used again."""
    saved = read_map(path)
    config = localising(saved.config, saved)
    rows = config.session.model_copy(update={"reserve": reserve})
    return build_session(config.model_copy(update={"session": rows}), saved.source)


PRODUCT = Methods(localise, extend, merge, changes)
