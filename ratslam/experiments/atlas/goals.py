"""Row: an emulated arm drives to goals on a map, and finds a wall in its way."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.localisation import RIGHT
from ratslam.experiments.atlas.goal_drives import (
    ClosedLoop,
    Drive,
    clearance,
    drive_blocked,
    drive_pairs,
    driven_map,
)
from ratslam.experiments.atlas.pictures import Panel, PathPanel, draw_panels
from ratslam.experiments.atlas.row import Line, MapRow, MapTask, count, spread
from ratslam.experiments.atlas.scenarios import open_world, ten_circuits
from robot.live.goal_drive import DriveState
from tactile.base.random_streams import stream

PAIRS, WALLS = 20, 5
"""Number of drives without and with a wall put in the way."""
RATIO, MINUTES = 1.15, 60
"""Goals: length of the paths over that of the shortest ways; duration of all drives."""


class GoalFigures(NamedTuple):
    """The drives on one map.

    Attributes:
        seed: of the maze. free, walled: drives without and with a wall put in the way. seconds: duration of
            all, by the arm. mapped: [n, 2] true path of the session that made the map, m. clearance: least
            distance of the head's axis from a wall on that path, m.
    """

    seed: int
    free: list[Drive]
    walled: list[Drive]
    seconds: float
    mapped: np.ndarray
    clearance: float


def measure_goals(task: MapTask) -> GoalFigures:
    """Drives on one map, each from where the last one ended."""
    return measure_drives(task, PAIRS, WALLS)


def measure_drives(task: MapTask, pairs: int, walls: int) -> GoalFigures:
    """The same with these numbers of drives."""
    recipe = ten_circuits(task.seed)
    made = driven_map(recipe, task.map_of(recipe))
    loop, random = ClosedLoop(made), stream(task.seed, "atlas.goals")
    mapped = made.stored.arrays.steps.truth[:, :2]
    return GoalFigures(
        seed=task.seed,
        free=list(drive_pairs(loop, made, pairs, random)),
        walled=list(drive_blocked(loop, made, walls, random)),
        seconds=loop.time,
        mapped=mapped,
        clearance=clearance(made.scene.surroundings.walls, mapped),
    )


def goal_lines(found: Sequence[GoalFigures]) -> Iterator[Line]:
    """The lines of drives to goals."""
    free, walled = all_free(found), all_walled(found)
    n, done = len(free), [one for one in free if one.said_reached]
    yield Line(
        f"reached (truly within {RIGHT.distance:g} m)",
        f"{n} of {n}",
        count([one.reached for one in free]),
        f"{count([one.reckoned <= RIGHT.distance for one in free])} by odometry alone, "
        f"{count([one.by_arm <= RIGHT.distance for one in free])} by the arm's exact motion alone",
    )
    yield Line(
        "said to be reached at a wrong place",
        f"0 of {n + len(walled)}",
        count([one.said_reached and not one.reached for one in free + walled]),
        "-",
    )
    yield Line(
        "error where reached, m, median (worst)",
        "-",
        spread([one.error for one in done], 3),
        f"{spread([one.reckoned for one in free], 3)} odometry, "
        f"{spread([one.by_arm for one in free], 3)} the arm's exact motion",
    )
    short = np.array([one.shortest for one in done])
    ratio = np.array([one.length for one in done]).sum() / max(short.sum(), 1e-9)
    yield Line("path over the shortest driven way, all reached", f"{RATIO:g}", f"{ratio:.2f}", "-")
    least = min((one.clearance for one in free + walled), default=np.nan)
    mapping = min(one.clearance for one in found)
    yield Line(
        "least distance of the head's axis from a wall, m",
        "-",
        f"{least:.3f}",
        f"{mapping:.3f} while mapping",
    )
    yield Line(
        "no whisker at rest inside a wall on the way",
        f"{n + len(walled)} of {n + len(walled)}",
        count([one.clear for one in free + walled]),
        "-",
    )
    minutes = max(one.seconds for one in found) / 60
    yield Line("duration of all drives, min", f"{MINUTES}", f"{minutes:.0f}", "-")
    yield _wall_line(free, walled)


def _wall_line(free: Sequence[Drive], walled: Sequence[Drive]) -> Line:
    new_way = [one.replans > 0 and one.reached for one in walled]
    blocked = [one.state is DriveState.BLOCKED for one in walled]
    return Line(
        "wall in the way: reached by a new way, or blocked",
        f"{len(walled)} of {len(walled)}",
        count(np.array(new_way, bool) | np.array(blocked, bool)),
        f"{sum(one.state is DriveState.BLOCKED for one in free)} of {len(free)} blocked without a wall",
    )


def all_free(found: Sequence[GoalFigures]) -> list[Drive]:
    """Drives without a wall in the way."""
    return [drive for one in found for drive in one.free]


def all_walled(found: Sequence[GoalFigures]) -> list[Drive]:
    """Drives with one."""
    return [drive for one in found for drive in one.walled]


def draw_goals(found: Sequence[GoalFigures], png: Path) -> None:
    """Draws the drives of one maze, and how far from the goals all of them ended."""
    one, free = found[0], all_free(found)
    paths = PathPanel(
        "drives to goals, without a wall in the way",
        open_world(one.seed).maze,
        {"map": one.mapped, "drives": _joined(one.free)},
        goals=np.array([drive.goal for drive in one.free]).reshape(-1, 2),
    )
    dots = {
        "whiskers": [drive.error for drive in free if drive.said_reached],
        "odometry": [drive.reckoned for drive in free],
        "exact arm": [drive.by_arm for drive in free],
    }
    panel = Panel("distance from the goal at the end, m", "", dots=dots, limits={"right": RIGHT.distance})
    line = f"One map, then goal after goal: reached {count([drive.reached for drive in free])}."
    draw_panels(png, "Driving to goals on a map of touch", line, paths, panel)


def _joined(drives: Sequence[Drive]) -> np.ndarray:
    """[n, 2] the paths with rows of NaN between them."""
    gap = np.full((1, 2), np.nan)
    return np.concatenate([gap, *(np.concatenate([drive.path, gap]) for drive in drives)])


GOALS = MapRow("Drive to goals on a map", 1, measure_goals, goal_lines, draw_goals)
