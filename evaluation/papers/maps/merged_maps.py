"""Figures: maps merged of sessions of one maze, of two mazes, of ten sessions and of buildings in two halves.

Merging is judged by whether sessions are joined in one piece, and rightly, and by the errors of the whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from evaluation.metrics.trajectory import align
from evaluation.papers.figure import Figure
from evaluation.papers.maps.localisation_metrics import (
    BUILDING,
    RIGHT,
    SAME_HEADING,
    WRONG,
    Tolerance,
    aligned_errors,
    exceeds,
    is_revisited,
    known_steps,
    localisation_errors,
    nearest_steps,
)
from evaluation.papers.maps.operations import MapTask
from evaluation.papers.maps.pictures import HEADER, Panel, PathPanel, count, draw_panels, spread, table_line
from evaluation.papers.maps.scenarios import (
    Recipe,
    Recorded,
    open_world,
    overlapping_sessions,
    record,
    same_maze,
    ten_circuits,
)
from evaluation.papers.maps.stored_maps import MapArrays, StoredMap
from evaluation.papers.tables.comparison import Record
from evaluation.papers.tables.recordings import metres
from ratslam.runs.settings.packaged import find_config
from ratslam.runs.settings.run_config import load_config
from tactile.base.random_streams import stream
from tactile.base.se2 import between, compose, integrate, inverse, wrap

REVISIT = Tolerance(RIGHT.distance, float(SAME_HEADING))
"""A later step is a revisit of an earlier one that is as near as this."""


class Join(NamedTuple):
    """How the later session lies in the map of the earlier one.

    Attributes:
        joined: whether most steps of both are in one piece. error: [2] median error of the later session's
            poses against the earlier steps (m, rad), NaN without a step to compare. path: [T, 2] positions of
            the later session (m) after the alignment of the earlier one to the truth.
    """

    joined: bool
    error: np.ndarray
    path: np.ndarray

    @property
    def right(self) -> bool:
        """Joined, and not off by more than `WRONG`."""
        return self.joined and not exceeds(self.error[None], WRONG)[0]

    @property
    def wrong(self) -> bool:
        """Joined, and off by more than `WRONG`."""
        return self.joined and bool(exceeds(self.error[None], WRONG)[0])


def shown_paths(first: np.ndarray, second: np.ndarray, join: Join) -> dict[str, np.ndarray]:
    """Paths [.., 2] (m) of two sessions by label: the true ones, and that of the second one in the map of the
    first if they are joined."""
    paths = {"first session": first, "second, true": second}
    return paths | {"second, in the map": join.path} if join.joined else paths


def judge_join(arrays: MapArrays, earlier: int, entry: int = 0, revisits: bool = False) -> Join:
    """Compares the steps after the first `earlier` ones with these.

    Args:
        entry: number of later steps that are left out first. revisits: whether to compare revisits alone
            (`REVISIT`).
    """
    first, last = slice(earlier), slice(earlier + entry, None)
    piece = _most_common(arrays.piece[first])
    joined = piece == _most_common(arrays.piece[last])
    inside = arrays.piece[first] == piece
    steps = known_steps(arrays.trajectory[first][inside], arrays.truth[first][inside])
    pose, truth = arrays.trajectory[last], arrays.truth[last]
    if revisits:
        again = is_revisited(steps, truth, REVISIT)
        pose, truth = pose[again], truth[again]
    error = localisation_errors(steps, pose, truth, RIGHT.distance)
    known = np.isfinite(error).all(axis=1)
    middle = np.median(error[known], axis=0) if known.any() else np.full(2, np.nan)
    shown = compose(align(steps.pose, steps.truth), arrays.trajectory[earlier:])
    return Join(joined, middle, shown[:, :2])


def _most_common(pieces: np.ndarray) -> int:
    values, counts = np.unique(pieces, return_counts=True)
    return int(values[np.argmax(counts)])


UNION = 1.5
"""Goal: the Energy Metric of a merged map, over that of one session over the same cells."""
GROWTH, FRAMES = 1.2, 1.3
"""Goals of ten sessions merged, over one: Energy Metric and keyframes."""
SESSIONS = 10
"""Number of sessions that are merged one by one."""


class _OverlapFigures(NamedTuple):
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

    def record(self) -> Record:
        """The figures of two sessions that overlap by name; Energy Metrics in m^2 + rad^2, the error in m,
        where they are joined."""
        return {
            "not_joined": not self.join.right,
            "wrong_join": self.join.wrong,
            "em_union": self.union if self.join.joined else np.nan,
            "em_alone": self.alone,
            "error": float(self.join.error[0]) if self.join.joined else np.nan,
        }


class _DifferentFigures(NamedTuple):
    """Sessions of two mazes, and control sessions of the first maze.

    Attributes:
        joined: whether the two mazes were joined. same: whether two sessions of one maze were.
    """

    joined: bool
    same: bool

    def record(self) -> Record:
        """The figures of two mazes by name."""
        return {"mazes_joined": self.joined, "maze_not_joined": not self.same}


class _TenFigures(NamedTuple):
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

    def record(self) -> Record:
        """The figures of ten sessions by name; the Energy Metric in m^2 + rad^2."""
        (growth,), (frames,) = _growth([self])
        return {
            "not_joined": not self.joined,
            "em_union": float(self.union[-1]),
            "em_growth": growth,
            "frames_growth": frames,
        }


def _measure_overlap(task: MapTask) -> _OverlapFigures:
    """Merges one pair of sessions."""
    scenario = overlapping_sessions(task.seed)
    one, other = task.map_of(scenario.one), task.map_of(scenario.other)
    arrays = _merge(task, one, other)
    return _OverlapFigures(
        task.seed,
        judge_join(arrays, len(one.arrays.truth), revisits=True),
        arrays.em,
        task.map_of(scenario.both).arrays.em,
        (one.arrays.truth[:, :2], other.arrays.truth[:, :2]),
    )


def _measure_different(task: MapTask) -> _DifferentFigures:
    """Merges the sessions of two mazes, and two of one maze."""
    one = task.map_of(ten_circuits(task.seed))
    earlier = len(one.arrays.truth)
    other, again = task.map_of(ten_circuits(task.seed + 1)), task.map_of(same_maze(task.seed, 1))
    return _DifferentFigures(
        judge_join(_merge(task, one, other), earlier).joined,
        judge_join(_merge(task, one, again), earlier).joined,
    )


def _measure_ten(task: MapTask) -> _TenFigures:
    """Merges ten sessions of one maze one by one."""
    maps = [task.map_of(same_maze(task.seed, number)) for number in range(SESSIONS)]
    merged = [maps[0]]
    with TemporaryDirectory() as folder:
        for number, one in enumerate(maps[1:], 1):
            merged.append(task.methods.merge([merged[-1], one], Path(folder) / str(number)))
    return _TenFigures(
        union=np.array([one.arrays.em for one in merged]),
        frames=np.array([one.arrays.frames for one in merged]),
        alone=np.array([one.arrays.em for one in maps]),
        separate=np.cumsum([one.arrays.frames for one in maps]),
        joined=len(np.unique(merged[-1].arrays.piece)) == 1,
    )


def _overlap_lines(found: Sequence[_OverlapFigures]) -> Iterator[str]:
    """The lines of sessions that overlap."""
    yield HEADER
    n = len(found)
    goal = f"{int(np.ceil(0.9 * n))} of {n}"
    yield table_line("joined rightly", goal, count([one.join.right for one in found]), "row of two mazes")
    yield table_line("wrong joins", f"0 of {n}", count([one.join.wrong for one in found]), "row of two mazes")
    joined = [one for one in found if one.join.joined]
    yield table_line(
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
    yield table_line("ratio of the medians", f"{UNION}", f"{ratio:.2f}", f"{spread(each)} of each pair")


def _different_lines(found: Sequence[_DifferentFigures]) -> Iterator[str]:
    """The lines of two mazes."""
    yield HEADER
    same = count([one.same for one in found])
    yield table_line(
        "joined", f"0 of {len(found)}", count([one.joined for one in found]), f"{same} of one maze"
    )


def _ten_lines(found: Sequence[_TenFigures]) -> Iterator[str]:
    """The lines of ten sessions."""
    yield HEADER
    yield table_line("all sessions in one piece", "-", count([one.joined for one in found]), "-")
    growth, frames = _growth(found)
    yield table_line(
        "EM after ten sessions, over that after one",
        f"{GROWTH}",
        spread(growth),
        f"{spread([np.median(one.alone) / one.alone[0] for one in found])} sessions by themselves",
    )
    yield table_line(
        "keyframes after ten sessions, over those after one",
        f"{FRAMES}",
        spread(frames),
        f"{spread([one.separate[-1] / one.separate[0] for one in found])} without merging",
    )


def _draw_overlap(found: Sequence[_OverlapFigures], png: Path) -> None:
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


def _draw_different(found: Sequence[_DifferentFigures], png: Path) -> None:
    """Draws the shares of pairs that were joined."""
    dots = {
        "two mazes": [100 * float(np.mean([one.joined for one in found]))],
        "one maze": [100 * float(np.mean([one.same for one in found]))],
    }
    different, same = count([one.joined for one in found]), count([one.same for one in found])
    panel = Panel("pairs that were joined, %", "", dots=dots)
    line = f"Joined: {different} of two mazes, {same} of one."
    draw_panels(png, "Sessions of two mazes", line, None, panel)


def _draw_ten(found: Sequence[_TenFigures], png: Path) -> None:
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


def _growth(found: Sequence[_TenFigures]) -> tuple[list[float], list[float]]:
    """Energy Metric and keyframes after the last session, over those after the first."""
    return (
        [float(one.union[-1] / one.union[0]) for one in found],
        [float(one.frames[-1] / one.frames[0]) for one in found],
    )


OVERLAP = Figure(
    "Merge two sessions that share half their cells", _measure_overlap, _overlap_lines, _draw_overlap, 20
)
DIFFERENT = Figure("Merge sessions of two mazes", _measure_different, _different_lines, _draw_different, 20)
TEN = Figure("Merge ten sessions one by one", _measure_ten, _ten_lines, _draw_ten, 3)


RECORDINGS = ("intel_laser", "tuc_lecture_hall")
"""Configurations of the recordings; both need `RATSLAM_DATA`."""
RATIO = 1.2
"""Goal: ATE of the merged map, over that of the whole recording."""
FOUND, OFF = 0.8, 0.01
"""Goals: least share of revisited steps at which the robot is found; largest share of found steps that are
off."""


class _HalvesFigures(NamedTuple):
    """One recording.

    Attributes:
        name: of its configuration. whole, merged: ATE, m. joined: whether the halves are in one piece.
            revisited: number of steps of the second half that are revisits. found: share of these at which
            the robot was found. off: share of the found steps that are off (`BUILDING`) after the alignment
            of the map. off_by_map: share at which the map itself is, and so would be a perfect localiser.
            off_nearby: as `off`, against the nearest step of the map. shuffled: `found` and `off` with the
            second half's views or labels in random order. reckoned: share of steps that are off by odometry
            that starts at the truth. paths: true positions of the first half; true and found ones of the
            second. error: [T] error after the alignment while found, m, NaN else.
    """

    name: str
    whole: float
    merged: float
    joined: bool
    revisited: int
    found: float
    off: float
    off_by_map: float
    off_nearby: float
    shuffled: tuple[float, float]
    reckoned: float
    paths: tuple[np.ndarray, np.ndarray, np.ndarray]
    error: np.ndarray

    def record(self) -> Record:
        """The figures of a recording by name: ATEs, m, and shares."""
        return {
            "not_joined": not self.joined,
            "ate_merged": self.merged,
            "ate_whole": self.whole,
            "found": self.found,
            "off": self.off,
            "off_by_map": self.off_by_map,
            "off_nearby": self.off_nearby,
            "off_by_odometry": self.reckoned,
            "shuffled_found": self.shuffled[0],
            "shuffled_off": self.shuffled[1],
        }


def split_recording(name: str) -> tuple[Recipe, Recipe, Recipe]:
    """The recording of a configuration, and its two halves.

    Raises:
        InputError: the recording is missing or has no truth.
    """
    whole = Recipe(load_config(find_config(name)))
    middle = record(whole).log.length // 2
    return whole, whole._replace(last=middle), whole._replace(first=middle)


def _measure_halves(task: MapTask) -> _HalvesFigures:
    """One recording."""
    name = RECORDINGS[task.seed]
    recipes = split_recording(name)
    whole, first, second = (task.map_of(recipe) for recipe in recipes)
    recorded, steps = record(recipes[2]), first.arrays.steps
    truth = recorded.truth
    with TemporaryDirectory() as folder:
        merged = task.methods.merge([first, second], Path(folder) / "merged").arrays
    localised = task.methods.localise(first, recorded)
    # The control: views and place labels of the second half in random order.
    log, label, views = recorded.log, recorded.log.label.copy(), recorded.log.views.copy()
    random = stream(0, "atlas.halves.shuffled")
    seen, given = np.flatnonzero(log.seen), np.flatnonzero(label >= 0)
    views[seen] = views[random.permutation(seen)]
    label[given] = label[random.permutation(given)]
    log = replace(log, digest=f"{log.digest}+shuffled", views=views, label=label)
    mixed = task.methods.localise(first, Recorded(recorded.config, log))
    again = is_revisited(steps, truth, BUILDING)

    def shares(found: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
        off = exceeds(aligned_errors(steps, pose, truth), BUILDING)
        return float(found[again].mean()), float(off[found].mean()) if found.any() else 0.0

    error = aligned_errors(steps, localised.pose, truth)[:, 0]
    said = compose(align(steps.pose, steps.truth), localised.pose)
    found = shares(localised.found, localised.pose)
    nearby = localisation_errors(steps, localised.pose, truth, BUILDING.distance)
    nearest = nearest_steps(steps, truth, BUILDING.distance)
    perfect = compose(steps.pose[nearest], between(steps.truth[nearest], truth))
    at = localised.found
    # Odometry from the first step with a true pose on.
    known = np.isfinite(truth).all(axis=1)
    true, path = truth[known], integrate(recorded.log.motion[:, :3])[known]
    path = compose(compose(true[0], inverse(path[0])), path)
    drifted = np.column_stack([np.hypot(*(path - true)[:, :2].T), np.abs(wrap(path[:, 2] - true[:, 2]))])
    return _HalvesFigures(
        name=name,
        whole=whole.arrays.ate,
        merged=merged.ate,
        joined=len(np.unique(merged.piece)) == 1,
        revisited=int(again.sum()),
        found=found[0],
        off=found[1],
        off_by_map=shares(at, perfect)[1],
        off_nearby=float(exceeds(nearby, BUILDING)[at].mean()) if at.any() else 0.0,
        shuffled=shares(mixed.found, mixed.pose),
        reckoned=float(exceeds(drifted, BUILDING).mean()),
        paths=(steps.truth[:, :2], truth[:, :2], np.where(localised.found[:, None], said[:, :2], np.nan)),
        error=np.where(localised.found, error, np.nan),
    )


def _halves_lines(found: Sequence[_HalvesFigures]) -> Iterator[str]:
    """The lines of each recording."""
    yield HEADER
    for one in found:
        ratio = f"{metres(one.merged)} m, {one.merged / one.whole:.2f} times"
        joined = "" if one.joined else ", halves not joined"
        yield table_line(
            f"{one.name}: ATE of the merged halves",
            f"{RATIO} times",
            ratio + joined,
            f"{metres(one.whole)} m whole",
        )
        yield table_line(
            f"{one.name}: found at {one.revisited} revisits",
            f"{FOUND:.0%}",
            f"{one.found:.1%}",
            f"{one.shuffled[0]:.1%} in random order",
        )
        yield table_line(
            f"{one.name}: found and off by 2 m or 30 degrees",
            f"{OFF:.0%}",
            f"{one.off:.1%}",
            f"{one.off_by_map:.1%} a perfect localiser there; {one.shuffled[1]:.1%} in random order; "
            f"{one.reckoned:.1%} odometry from the true start",
        )
        yield table_line(
            f"{one.name}: the same against the nearest step of the map", "-", f"{one.off_nearby:.1%}", "-"
        )


def _draw_halves(found: Sequence[_HalvesFigures], png: Path) -> None:
    """Draws the recording in which the robot is found most, and the errors while found in all."""
    one = max(found, key=lambda each: each.found)
    paths = PathPanel(
        f"{one.name}: the second half in the map of the first",
        None,
        {"first half": one.paths[0], "second, true": one.paths[1], "second, found": one.paths[2]},
    )
    curves = {each.name: [each.error[np.linspace(0, len(each.error) - 1, 100).astype(int)]] for each in found}
    limits = {"wrong": BUILDING.distance}
    panel = Panel("error while found, m", "time in the second half, %", curves=curves, limits=limits)
    revisits, off = (
        " and ".join(f"{getattr(each, name):.1%}" for each in found) for name in ("found", "off")
    )
    line = f"Found at {revisits} of the revisits; off by 2 m or 30 degrees at {off} of the found steps."
    draw_panels(png, "Buildings, each recording in two halves", line, paths, panel)


HALVES = Figure("Buildings in two halves", _measure_halves, _halves_lines, _draw_halves, RECORDINGS)
