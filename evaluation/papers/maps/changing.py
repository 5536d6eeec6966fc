"""Rows: a wall that was moved, a door that was closed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.papers.maps.localisation_metrics import true_places
from evaluation.papers.maps.localising import Judged, judge
from evaluation.papers.maps.pictures import Panel, PathPanel, draw_panels
from evaluation.papers.maps.row import Line, MapRow, MapTask, count, spread
from evaluation.papers.maps.scenarios import (
    LOCALISED,
    Change,
    closed_door,
    moved_wall,
    open_world,
    same_maze,
    ten_circuits,
    unknown_start,
)
from evaluation.papers.maps.sessions import Recipe, record
from evaluation.papers.tables.comparison import Record
from robot.world.maze import CELL_SIDE


class ChangeFigures(NamedTuple):
    """One changed maze.

    Attributes:
        seed: of the maze. before, after: sessions in the map, before and after the change. distance: [n] from
            each place that was named to the nearest true one, m, the surest first. named: [n, 2] these places
            in the frame of the truth. places: [m, 2] true ones. unchanged: number of places named in a
            session as long without a change. path: [T, 2] true path after the change.
    """

    seed: int
    before: Judged
    after: Judged
    distance: np.ndarray
    named: np.ndarray
    places: np.ndarray
    unchanged: int
    path: np.ndarray

    @property
    def is_named(self) -> bool:
        """Whether the surest place is within a cell of a true one."""
        return bool(len(self.distance)) and bool(self.distance[0] <= CELL_SIDE)


def measure_change(change: Callable[[int], Change], task: MapTask) -> ChangeFigures:
    """One changed maze in the map of ten circuits."""
    made, scenario = task.map_of(ten_circuits(task.seed)), change(task.seed)
    before, after = record(unknown_start(task.seed)), record(scenario.after)
    again = record(Recipe(same_maze(task.seed, 1).config, 0, after.log.length))
    steps, methods = made.arrays.steps, task.methods
    named = true_places(steps, methods.changes(made, after).reshape(-1, 2))
    return ChangeFigures(
        seed=task.seed,
        before=judge(steps, methods.localise(made, before), before.truth),
        after=judge(steps, methods.localise(made, after), after.truth),
        distance=np.hypot(*(named[:, None] - scenario.places).transpose(2, 0, 1)).min(axis=1),
        named=named,
        places=scenario.places,
        unchanged=len(methods.changes(made, again)),
        path=after.truth[:, :2],
    )


def change_record(one: ChangeFigures) -> Record:
    """The figures of a changed maze by name."""
    return {
        "missed": one.after.whisks > LOCALISED,
        "sure_and_wrong": bool(one.after.wrong.any()),
        "missed_before": one.before.whisks > LOCALISED,
        "sure_and_wrong_before": bool(one.before.wrong.any()),
        "not_named": not one.is_named,
        "far_places": int((one.distance > CELL_SIDE).sum()),
        "false_alarm": one.unchanged > 0,
    }


def change_lines(found: Sequence[ChangeFigures]) -> Iterator[Line]:
    """The lines of changed mazes."""
    n = len(found)
    before, after = (
        [getattr(one, name).whisks <= LOCALISED for one in found] for name in ("before", "after")
    )
    yield Line(
        f"found and right within {LOCALISED} whisks after the change",
        f"{int(np.ceil(0.9 * n))} of {n}",
        count(after),
        f"{count(before)} before it",
    )
    yield Line(
        "sure and wrong at some whisk after the change",
        "-",
        count([bool(one.after.wrong.any()) for one in found]),
        f"{count([bool(one.before.wrong.any()) for one in found])} before it",
    )
    yield Line(
        "surest place named within a cell of the change",
        f"{int(np.ceil(0.8 * n))} of {n}",
        count([one.is_named for one in found]),
        f"{count([one.unchanged > 0 for one in found])} name a place in an unchanged maze",
    )
    farther = [float((one.distance > CELL_SIDE).sum()) for one in found]
    yield Line(
        "places named farther away, median (worst)",
        "-",
        spread(farther, 0),
        f"{spread([one.unchanged for one in found], 0)} in an unchanged maze",
    )


def draw_change(title: str, found: Sequence[ChangeFigures], png: Path) -> None:
    """Draws one changed maze with the places named, and their distances in all."""
    one = found[0]
    paths = PathPanel(
        "maze of the map, path after the change",
        open_world(one.seed).maze,
        {"path": one.path},
        one.places,
        one.named,
    )
    dots = {
        "surest": [each.distance[0] for each in found if len(each.distance)],
        "others": [value for each in found for value in each.distance[1:]],
    }
    panel = Panel("distance from the true change, m", "places named", dots=dots, limits={"a cell": CELL_SIDE})
    line = f"Surest place within a cell of the change: {count([each.is_named for each in found])}."
    draw_panels(png, title, line, paths, panel)


WALL = MapRow(
    "A wall moved",
    10,
    partial(measure_change, moved_wall),
    change_record,
    change_lines,
    partial(draw_change, "A wall moved"),
)
DOOR = MapRow(
    "A door closed",
    10,
    partial(measure_change, closed_door),
    change_record,
    change_lines,
    partial(draw_change, "A door closed"),
)
