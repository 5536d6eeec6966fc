"""Rows: sessions of one maze merged, of two mazes, and ten of one maze one by one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from evaluation.papers.maps.joins import Join, judge_join, shown_paths
from evaluation.papers.maps.pictures import Panel, PathPanel, draw_panels
from evaluation.papers.maps.row import Line, MapRow, MapTask, count, spread
from evaluation.papers.maps.scenarios import open_world, overlapping_sessions, same_maze, ten_circuits
from evaluation.papers.maps.stored_maps import MapArrays, StoredMap
from evaluation.papers.tables.comparison import Record

UNION = 1.5
"""Goal: the Energy Metric of a merged map, over that of one session over the same cells."""
GROWTH, FRAMES = 1.2, 1.3
"""Goals of ten sessions merged, over one: Energy Metric and keyframes."""
SESSIONS = 10
"""Number of sessions that are merged one by one."""


class OverlapFigures(NamedTuple):
    """Two sessions that share half their cells.

    Attributes:
        seed: of the maze. join: how the second lies in the map of the first. union: Energy Metric of the
            merged map, m^2 + rad^2. alone: that of one session over both. paths: true positions of both [..,
            2].
    """

    seed: int
    join: Join
    union: float
    alone: float
    paths: tuple[np.ndarray, np.ndarray]


class DifferentFigures(NamedTuple):
    """Sessions of two mazes, and control sessions of the first maze.

    Attributes:
        joined: whether the two mazes were joined. same: whether two sessions of one maze were.
    """

    joined: bool
    same: bool


class TenFigures(NamedTuple):
    """Ten sessions merged one by one.

    Attributes:
        union: [10] Energy Metric of the map after each session, m^2 + rad^2. frames: [10] its keyframes.
            alone: [10] Energy Metric of each session by itself. separate: [10] keyframes of the sessions so
            far without merging. joined: whether all steps are in one piece at the end.
    """

    union: np.ndarray
    frames: np.ndarray
    alone: np.ndarray
    separate: np.ndarray
    joined: bool


def measure_overlap(task: MapTask) -> OverlapFigures:
    """Merges one pair of sessions."""
    scenario = overlapping_sessions(task.seed)
    one, other = task.map_of(scenario.one), task.map_of(scenario.other)
    arrays = _merge(task, one, other)
    return OverlapFigures(
        task.seed,
        judge_join(arrays, len(one.arrays.truth), revisits=True),
        arrays.em,
        task.map_of(scenario.both).arrays.em,
        (one.arrays.truth[:, :2], other.arrays.truth[:, :2]),
    )


def measure_different(task: MapTask) -> DifferentFigures:
    """Merges the sessions of two mazes, and two of one maze."""
    one = task.map_of(ten_circuits(task.seed))
    earlier = len(one.arrays.truth)
    other, again = task.map_of(ten_circuits(task.seed + 1)), task.map_of(same_maze(task.seed, 1))
    return DifferentFigures(
        judge_join(_merge(task, one, other), earlier).joined,
        judge_join(_merge(task, one, again), earlier).joined,
    )


def measure_ten(task: MapTask) -> TenFigures:
    """Merges ten sessions of one maze one by one."""
    maps = [task.map_of(same_maze(task.seed, number)) for number in range(SESSIONS)]
    merged = [maps[0]]
    with TemporaryDirectory() as folder:
        for number, one in enumerate(maps[1:], 1):
            merged.append(task.methods.merge([merged[-1], one], Path(folder) / str(number)))
    return TenFigures(
        union=np.array([one.arrays.em for one in merged]),
        frames=np.array([one.arrays.frames for one in merged]),
        alone=np.array([one.arrays.em for one in maps]),
        separate=np.cumsum([one.arrays.frames for one in maps]),
        joined=len(np.unique(merged[-1].arrays.piece)) == 1,
    )


def overlap_record(one: OverlapFigures) -> Record:
    """The figures of two sessions that overlap by name; Energy Metrics in m^2 + rad^2, the error in m, where
    they are joined."""
    return {
        "not_joined": not one.join.right,
        "wrong_join": one.join.wrong,
        "em_union": one.union if one.join.joined else np.nan,
        "em_alone": one.alone,
        "error": float(one.join.error[0]) if one.join.joined else np.nan,
    }


def different_record(one: DifferentFigures) -> Record:
    """The figures of two mazes by name."""
    return {"mazes_joined": one.joined, "maze_not_joined": not one.same}


def ten_record(one: TenFigures) -> Record:
    """The figures of ten sessions by name; the Energy Metric in m^2 + rad^2."""
    (growth,), (frames,) = _growth([one])
    return {
        "not_joined": not one.joined,
        "em_union": float(one.union[-1]),
        "em_growth": growth,
        "frames_growth": frames,
    }


def overlap_lines(found: Sequence[OverlapFigures]) -> Iterator[Line]:
    """The lines of sessions that overlap."""
    n = len(found)
    goal = f"{int(np.ceil(0.9 * n))} of {n}"
    yield Line("joined rightly", goal, count([one.join.right for one in found]), "row of two mazes")
    yield Line("wrong joins", f"0 of {n}", count([one.join.wrong for one in found]), "row of two mazes")
    joined = [one for one in found if one.join.joined]
    yield Line(
        "EM of the union, median (worst), of joined",
        "-",
        spread([one.union for one in joined], 3),
        f"{spread([one.alone for one in joined], 3)} of one session over both",
    )
    ratio = (
        np.median([one.union for one in joined]) / np.median([one.alone for one in joined])
        if joined
        else np.nan
    )
    each = [one.union / one.alone for one in joined]
    yield Line("ratio of the medians", f"{UNION}", f"{ratio:.2f}", f"{spread(each)} of each pair")


def different_lines(found: Sequence[DifferentFigures]) -> Iterator[Line]:
    """The lines of two mazes."""
    same = count([one.same for one in found])
    yield Line("joined", f"0 of {len(found)}", count([one.joined for one in found]), f"{same} of one maze")


def ten_lines(found: Sequence[TenFigures]) -> Iterator[Line]:
    """The lines of ten sessions."""
    yield Line("all sessions in one piece", "-", count([one.joined for one in found]), "-")
    growth, frames = _growth(found)
    yield Line(
        "EM after ten sessions, over that after one",
        f"{GROWTH}",
        spread(growth),
        f"{spread([np.median(one.alone) / one.alone[0] for one in found])} sessions by themselves",
    )
    yield Line(
        "keyframes after ten sessions, over those after one",
        f"{FRAMES}",
        spread(frames),
        f"{spread([one.separate[-1] / one.separate[0] for one in found])} without merging",
    )


def draw_overlap(found: Sequence[OverlapFigures], png: Path) -> None:
    """Draws one pair of sessions, joined if there is one, and the Energy Metric of all."""
    one = next((each for each in found if each.join.joined), found[0])
    paths = PathPanel(
        "two sessions that share half their cells",
        open_world(one.seed).maze,
        shown_paths(*one.paths, one.join),
    )
    dots = {
        "merged": [each.union for each in found if each.join.joined],
        "one session": [each.alone for each in found],
    }
    panel = Panel("Energy Metric, m² + rad²", "", dots=dots)
    line = f"Joined rightly: {count([each.join.right for each in found])}."
    draw_panels(png, "Two sessions of one maze, merged", line, paths, panel)


def draw_different(found: Sequence[DifferentFigures], png: Path) -> None:
    """Draws the shares of pairs that were joined."""
    dots = {
        "two mazes": [100 * float(np.mean([one.joined for one in found]))],
        "one maze": [100 * float(np.mean([one.same for one in found]))],
    }
    different, same = count([one.joined for one in found]), count([one.same for one in found])
    panel = Panel("pairs that were joined, %", "", dots=dots)
    line = f"Joined: {different} of two mazes, {same} of one."
    draw_panels(png, "Sessions of two mazes", line, None, panel)


def draw_ten(found: Sequence[TenFigures], png: Path) -> None:
    """Draws keyframes and Energy Metric over the sessions."""
    curves = {
        "Energy Metric": [one.union / one.union[0] for one in found],
        "keyframes": [one.frames / one.frames[0] for one in found],
    }
    growth, frames = _growth(found)
    line = f"After ten, over one, median (worst): EM {spread(growth)}, keyframes {spread(frames)}."
    limits = {"goal, Energy Metric": GROWTH, "goal, keyframes": FRAMES}
    panel = Panel("over that of one session", "sessions merged", curves=curves, limits=limits)
    draw_panels(png, "Ten sessions of one maze, merged one by one", line, None, panel)


def _merge(task: MapTask, *maps: StoredMap) -> MapArrays:
    with TemporaryDirectory() as folder:
        return task.methods.merge(maps, Path(folder) / "merged").arrays


def _growth(found: Sequence[TenFigures]) -> tuple[list[float], list[float]]:
    """Energy Metric and keyframes after the last session, over those after the first."""
    return (
        [float(one.union[-1] / one.union[0]) for one in found],
        [float(one.frames[-1] / one.frames[0]) for one in found],
    )


OVERLAP = MapRow(
    "Merge two sessions that share half their cells",
    20,
    measure_overlap,
    overlap_record,
    overlap_lines,
    draw_overlap,
)
DIFFERENT = MapRow(
    "Merge sessions of two mazes", 20, measure_different, different_record, different_lines, draw_different
)
TEN = MapRow("Merge ten sessions one by one", 3, measure_ten, ten_record, ten_lines, draw_ten)
