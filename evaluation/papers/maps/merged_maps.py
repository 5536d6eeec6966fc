"""Figures: maps merged of sessions of one maze, of two mazes, of ten sessions and of buildings in two halves.

Merging is judged by whether sessions are joined in one piece, and rightly, and by the errors of the whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, Self

import numpy as np

from evaluation.papers.figure import Figure
from evaluation.papers.maps import localisation_metrics as metrics
from evaluation.papers.maps import scenarios
from evaluation.papers.maps.operations import MapTask
from evaluation.papers.maps.pictures import PathPanel, at_least, draw_panels, spread, table
from evaluation.papers.maps.scenarios import Recipe, record
from evaluation.papers.maps.stored_maps import MapArrays, StoredMap
from evaluation.papers.tables.comparison import Measured, column
from evaluation.papers.tables.markdown import count
from evaluation.papers.tables.recordings import metres
from ratslam.runs.settings.packaged import find_config
from ratslam.runs.settings.run_config import load_config
from tactile.base.random_streams import stream
from tactile.base.se2 import between, compose, integrate, inverse

REVISIT = metrics.Tolerance(metrics.RIGHT.distance, float(metrics.SAME_HEADING))
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

    @classmethod
    def of(cls, arrays: MapArrays, earlier: int, entry: int = 0, revisits: bool = False) -> Self:
        """Compares the steps after the first `earlier` ones with these.

        Args:
            entry: number of later steps that are left out first. revisits: whether to compare revisits alone
                (`REVISIT`).
        """
        first, last = slice(earlier), slice(earlier + entry, None)
        piece = _most_common(arrays.piece[first])
        inside = arrays.piece[first] == piece
        steps = metrics.MapSteps.known(arrays.trajectory[first][inside], arrays.truth[first][inside])
        pose, truth = arrays.trajectory[last], arrays.truth[last]
        if revisits:
            again = steps.revisited(truth, REVISIT)
            pose, truth = pose[again], truth[again]
        error = steps.errors(pose, truth, metrics.RIGHT.distance)
        known = np.isfinite(error).all(axis=1)
        middle = np.median(error[known], axis=0) if known.any() else np.full(2, np.nan)
        path = steps.align(arrays.trajectory[earlier:])[:, :2]
        return cls(piece == _most_common(arrays.piece[last]), middle, path)

    @property
    def right(self) -> bool:
        """Joined, and not off by more than `WRONG`."""
        return self.joined and not self.wrong

    @property
    def wrong(self) -> bool:
        """Joined, and off by more than `WRONG`."""
        return self.joined and bool(metrics.WRONG.exceeded(self.error[None])[0])

    @property
    def off(self) -> float:
        """Error of position, m; NaN if not joined."""
        return float(self.error[0]) if self.joined else np.nan

    def paths(self, first: np.ndarray, second: np.ndarray) -> dict[str, np.ndarray]:
        """Paths [.., 2] (m) of two sessions by label: of true poses [.., 3], and, if they are joined, that of
        the second one in the map of the first."""
        paths = {"first session": first[:, :2], "second, true": second[:, :2]}
        return paths | {"second, in the map": self.path} if self.joined else paths


def _most_common(pieces: np.ndarray) -> int:
    values, counts = np.unique(pieces, return_counts=True)
    return int(values[np.argmax(counts)])


UNION = 1.5
"""Goal: the Energy Metric of a merged map, over that of one session over the same cells."""
GROWTH, FRAMES = 1.2, 1.3
"""Goals of ten sessions merged, over one: Energy Metric and keyframes."""
SESSIONS = 10
"""Number of sessions that are merged one by one."""


def _measure_overlap(task: MapTask) -> Measured:
    """Merges one pair of sessions, beside one session over both; Energy Metrics in m^2 + rad^2, and the error
    in m, where they are joined."""
    one, other, both = (task.map_of(recipe) for recipe in scenarios.overlapping_sessions(task.seed))
    arrays = _merge(task, one, other)
    join = Join.of(arrays, len(one.arrays.truth), revisits=True)
    figures = {
        "not_joined": not join.right,
        "wrong_join": join.wrong,
        "em_union": arrays.em if join.joined else np.nan,
        "em_alone": both.arrays.em,
        "error": join.off,
    }
    paths = join.paths(one.arrays.truth, other.arrays.truth)
    panel = PathPanel("two sessions that share half their cells", scenarios.open_world(task.seed)[0], paths)
    return Measured(figures, {"joined": join.joined, "paths": panel})


def _measure_different(task: MapTask) -> Measured:
    """Merges the sessions of two mazes, and two of one maze."""
    one = task.map_of(scenarios.ten_circuits(task.seed))
    other, again = (
        Join.of(_merge(task, one, task.map_of(recipe)), len(one.arrays.truth)).joined
        for recipe in (scenarios.ten_circuits(task.seed + 1), scenarios.same_maze(task.seed, 1))
    )
    return Measured({"mazes_joined": other, "maze_not_joined": not again}, {})


def _measure_ten(task: MapTask) -> Measured:
    """Merges ten sessions of one maze one by one: Energy Metric (m^2 + rad^2) and keyframes of the map after
    each, beside those of the sessions by themselves and without merging."""
    maps = [task.map_of(scenarios.same_maze(task.seed, number)) for number in range(SESSIONS)]
    merged = [maps[0]]
    with TemporaryDirectory() as folder:
        for number, one in enumerate(maps[1:], 1):
            merged.append(task.methods.merge([merged[-1], one], Path(folder) / str(number)))
    union = np.array([one.arrays.em for one in merged])
    frames = np.array([one.arrays.frames for one in merged])
    alone = np.array([one.arrays.em for one in maps])
    separate = np.cumsum([one.arrays.frames for one in maps])
    figures = {
        "not_joined": len(np.unique(merged[-1].arrays.piece)) != 1,
        "em_union": float(union[-1]),
        "em_growth": float(union[-1] / union[0]),
        "frames_growth": float(frames[-1] / frames[0]),
    }
    controls = {"em_alone": np.median(alone) / alone[0], "frames_separate": separate[-1] / separate[0]}
    return Measured(figures, {"union": union / union[0], "frames": frames / frames[0], **controls})


def _overlap_lines(found: Sequence[Measured]) -> list[str]:
    n, joined = len(found), column(found, "joined")
    union, alone = (column(found, name)[joined] for name in ("em_union", "em_alone"))
    ratio = np.median(union) / np.median(alone) if joined.any() else np.nan
    return table(
        f"joined rightly | {at_least(0.9, n)} | {count(~column(found, 'not_joined'))} | row of two mazes",
        f"wrong joins | 0 of {n} | {count(column(found, 'wrong_join'))} | row of two mazes",
        f"EM of the union, median (worst), of joined | - | {spread(union, 3)} | {spread(alone, 3)} of one"
        " session over both",
        f"ratio of the medians | {UNION} | {ratio:.2f} | {spread(union / alone)} of each pair",
    )


def _different_lines(found: Sequence[Measured]) -> list[str]:
    different, same = column(found, "mazes_joined"), ~column(found, "maze_not_joined")
    return table(f"joined | 0 of {len(found)} | {count(different)} | {count(same)} of one maze")


def _ten_lines(found: Sequence[Measured]) -> list[str]:
    return table(
        f"all sessions in one piece | - | {count(~column(found, 'not_joined'))} | -",
        f"EM after ten sessions, over that after one | {GROWTH} | {spread(column(found, 'em_growth'))} |"
        f" {spread(column(found, 'em_alone'))} sessions by themselves",
        f"keyframes after ten sessions, over those after one | {FRAMES} |"
        f" {spread(column(found, 'frames_growth'))} | {spread(column(found, 'frames_separate'))} without"
        " merging",
    )


def _draw_overlap(found: Sequence[Measured], png: Path) -> None:
    """Draws one pair of sessions, joined if there is one, and the Energy Metric of all."""
    one = next((each for each in found if each.shown["joined"]), found[0])
    line = f"Joined rightly: {count(~column(found, 'not_joined'))}."
    title, names = "Two sessions of one maze, merged", ("Energy Metric, m² + rad²", "")
    dots = {"merged": column(found, "em_union"), "one session": column(found, "em_alone")}
    draw_panels(png, title, line, names, dots=dots, paths=one.shown["paths"])


def _draw_different(found: Sequence[Measured], png: Path) -> None:
    """Draws the shares of pairs that were joined."""
    different, same = column(found, "mazes_joined"), ~column(found, "maze_not_joined")
    line = f"Joined: {count(different)} of two mazes, {count(same)} of one."
    dots = {"two mazes": [100 * different.mean()], "one maze": [100 * same.mean()]}
    draw_panels(png, "Sessions of two mazes", line, ("pairs that were joined, %", ""), dots=dots)


def _draw_ten(found: Sequence[Measured], png: Path) -> None:
    """Draws keyframes and Energy Metric over the sessions."""
    growth, frames = (spread(column(found, name)) for name in ("em_growth", "frames_growth"))
    title = "Ten sessions of one maze, merged one by one"
    line = f"After ten, over one, median (worst): EM {growth}, keyframes {frames}."
    names = "over that of one session", "sessions merged"
    curves = {"Energy Metric": column(found, "union"), "keyframes": column(found, "frames")}
    limits = {"goal, Energy Metric": GROWTH, "goal, keyframes": FRAMES}
    draw_panels(png, title, line, names, curves=curves, limits=limits)


def _merge(task: MapTask, *maps: StoredMap) -> MapArrays:
    with TemporaryDirectory() as folder:
        return task.methods.merge(maps, Path(folder) / "merged").arrays


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


def split_recording(name: str) -> tuple[Recipe, Recipe, Recipe]:
    """The recording of a configuration, and its two halves.

    Raises:
        InputError: the recording is missing or has no truth.
    """
    whole = Recipe(load_config(find_config(name)))
    middle = record(whole).log.length // 2
    return whole, whole._replace(last=middle), whole._replace(first=middle)


def _measure_halves(task: MapTask) -> Measured:
    """One recording: ATEs, m, of the whole and of its merged halves, and shares of the second half in the map
    of the first: of revisits that are found, and of found steps that are off (`BUILDING`) after the alignment
    of the map, or against its nearest step.

    Controls: a perfect localiser, which is off where the map is; views or place labels in random order;
    odometry that starts at the truth.
    """
    name = RECORDINGS[task.seed]
    recipes = split_recording(name)
    whole, first, second = (task.map_of(recipe) for recipe in recipes)
    recorded, steps = record(recipes[2]), first.arrays.steps
    truth = recorded.truth
    merged = _merge(task, first, second)
    localised = task.methods.localise(first, recorded)
    log, label, views = recorded.log, recorded.log.label.copy(), recorded.log.views.copy()
    random = stream(0, "atlas.halves.shuffled")
    seen, given = np.flatnonzero(log.seen), np.flatnonzero(label >= 0)
    views[seen] = views[random.permutation(seen)]
    label[given] = label[random.permutation(given)]
    log = replace(log, digest=f"{log.digest}+shuffled", views=views, label=label)
    mixed = task.methods.localise(first, scenarios.Recorded(recorded.config, log))
    again, at = steps.revisited(truth, metrics.BUILDING), localised.found

    def shares(found: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
        off = metrics.BUILDING.exceeded(metrics.pose_errors(steps.align(pose), truth))
        return float(found[again].mean()), float(off[found].mean()) if found.any() else 0.0

    said = steps.align(localised.pose)
    found, off = shares(at, localised.pose)
    shuffled_found, shuffled_off = shares(mixed.found, mixed.pose)
    nearby = steps.errors(localised.pose, truth, metrics.BUILDING.distance)
    nearest = steps.nearest(truth, metrics.BUILDING.distance)
    perfect = compose(steps.pose[nearest], between(steps.truth[nearest], truth))
    # Odometry from the first step with a true pose on.
    known = np.isfinite(truth).all(axis=1)
    true, path = truth[known], integrate(recorded.log.motion[:, :3])[known]
    path = compose(compose(true[0], inverse(path[0])), path)
    figures = {
        "not_joined": len(np.unique(merged.piece)) != 1,
        "ate_merged": merged.ate,
        "ate_whole": whole.arrays.ate,
        "found": found,
        "off": off,
        "off_by_map": shares(at, perfect)[1],
        "off_nearby": float(metrics.BUILDING.exceeded(nearby)[at].mean()) if at.any() else 0.0,
        "off_by_odometry": float(metrics.BUILDING.exceeded(metrics.pose_errors(path, true)).mean()),
        "shuffled_found": shuffled_found,
        "shuffled_off": shuffled_off,
    }
    paths = {
        "first half": steps.truth[:, :2],
        "second, true": truth[:, :2],
        "second, found": np.where(at[:, None], said[:, :2], np.nan),
    }
    error = np.where(at, metrics.pose_errors(said, truth)[:, 0], np.nan)
    return Measured(figures, {"name": name, "revisited": int(again.sum()), "paths": paths, "error": error})


def _halves_lines(found: Sequence[Measured]) -> list[str]:
    rows = []
    for one, shown in found:
        name, joined = shown["name"], ", halves not joined" if one["not_joined"] else ""
        ratio = f"{metres(one['ate_merged'])} m, {one['ate_merged'] / one['ate_whole']:.2f} times"
        rows += [
            f"{name}: ATE of the merged halves | {RATIO} times | {ratio + joined} |"
            f" {metres(one['ate_whole'])} m whole",
            f"{name}: found at {shown['revisited']} revisits | {FOUND:.0%} | {one['found']:.1%} |"
            f" {one['shuffled_found']:.1%} in random order",
            f"{name}: found and off by 2 m or 30 degrees | {OFF:.0%} | {one['off']:.1%} |"
            f" {one['off_by_map']:.1%} a perfect localiser there; {one['shuffled_off']:.1%} in random order;"
            f" {one['off_by_odometry']:.1%} odometry from the true start",
            f"{name}: the same against the nearest step of the map | - | {one['off_nearby']:.1%} | -",
        ]
    return table(*rows)


def _draw_halves(found: Sequence[Measured], png: Path) -> None:
    """Draws the recording in which the robot is found most, and the errors while found in all."""
    most = max(found, key=lambda each: each.record["found"]).shown
    errors = {shown["name"]: shown["error"] for _, shown in found}
    revisits, off = (" and ".join(f"{each.record[name]:.1%}" for each in found) for name in ("found", "off"))
    title = "Buildings, each recording in two halves"
    line = f"Found at {revisits} of the revisits; off by 2 m or 30 degrees at {off} of the found steps."
    names = "error while found, m", "time in the second half, %"
    limits = {"wrong": metrics.BUILDING.distance}
    curves = {name: [each[np.linspace(0, len(each) - 1, 100).astype(int)]] for name, each in errors.items()}
    paths = PathPanel(f"{most['name']}: the second half in the map of the first", None, most["paths"])
    draw_panels(png, title, line, names, curves=curves, limits=limits, paths=paths)


HALVES = Figure("Buildings in two halves", _measure_halves, _halves_lines, _draw_halves, RECORDINGS)
