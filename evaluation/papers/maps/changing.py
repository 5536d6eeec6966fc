"""Figures: a wall that was moved, a door that was closed, and a robot that was carried away or kidnapped.

A robot is carried away between two sessions, of which the second continues the map of the first, and
kidnapped within one session.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.run_metrics import unjoined_share
from evaluation.papers.figure import Figure
from evaluation.papers.maps.localisation_metrics import true_places
from evaluation.papers.maps.localising import Judged, judge
from evaluation.papers.maps.merged_maps import Join, judge_join, shown_paths
from evaluation.papers.maps.operations import MapTask
from evaluation.papers.maps.pictures import HEADER, Panel, PathPanel, count, draw_panels, spread, table_line
from evaluation.papers.maps.scenarios import (
    LOCALISED,
    REENTERED,
    Change,
    Recipe,
    Recorded,
    carried_sessions,
    closed_door,
    kidnapped,
    moved_wall,
    open_world,
    record,
    same_maze,
    ten_circuits,
    unknown_start,
)
from evaluation.papers.tables.comparison import Record
from evaluation.papers.trial_sessions import apply_control
from robot.world.maze import CELL_SIDE


class _ChangeFigures(NamedTuple):
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

    def record(self) -> Record:
        """The figures of a changed maze by name."""
        return {
            "missed": self.after.whisks > LOCALISED,
            "sure_and_wrong": bool(self.after.wrong.any()),
            "missed_before": self.before.whisks > LOCALISED,
            "sure_and_wrong_before": bool(self.before.wrong.any()),
            "not_named": not self.is_named,
            "far_places": int((self.distance > CELL_SIDE).sum()),
            "false_alarm": self.unchanged > 0,
        }


def _measure_change(change: Callable[[int], Change], task: MapTask) -> _ChangeFigures:
    """One changed maze in the map of ten circuits."""
    made, scenario = task.map_of(ten_circuits(task.seed)), change(task.seed)
    before, after = record(unknown_start(task.seed)), record(scenario.after)
    again = record(Recipe(same_maze(task.seed, 1).config, 0, after.log.length))
    steps, methods = made.arrays.steps, task.methods
    named = true_places(steps, methods.changes(made, after).reshape(-1, 2))
    return _ChangeFigures(
        seed=task.seed,
        before=judge(steps, methods.localise(made, before), before.truth),
        after=judge(steps, methods.localise(made, after), after.truth),
        distance=np.hypot(*(named[:, None] - scenario.places).transpose(2, 0, 1)).min(axis=1),
        named=named,
        places=scenario.places,
        unchanged=len(methods.changes(made, again)),
        path=after.truth[:, :2],
    )


def _change_lines(found: Sequence[_ChangeFigures]) -> Iterator[str]:
    """The lines of changed mazes."""
    yield HEADER
    n = len(found)
    before, after = (
        [getattr(one, name).whisks <= LOCALISED for one in found] for name in ("before", "after")
    )
    yield table_line(
        f"found and right within {LOCALISED} whisks after the change",
        f"{int(np.ceil(0.9 * n))} of {n}",
        count(after),
        f"{count(before)} before it",
    )
    yield table_line(
        "sure and wrong at some whisk after the change",
        "-",
        count([bool(one.after.wrong.any()) for one in found]),
        f"{count([bool(one.before.wrong.any()) for one in found])} before it",
    )
    yield table_line(
        "surest place named within a cell of the change",
        f"{int(np.ceil(0.8 * n))} of {n}",
        count([one.is_named for one in found]),
        f"{count([one.unchanged > 0 for one in found])} name a place in an unchanged maze",
    )
    farther = [float((one.distance > CELL_SIDE).sum()) for one in found]
    yield table_line(
        "places named farther away, median (worst)",
        "-",
        spread(farther, 0),
        f"{spread([one.unchanged for one in found], 0)} in an unchanged maze",
    )


def _draw_change(title: str, found: Sequence[_ChangeFigures], png: Path) -> None:
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


WALL = Figure(
    "A wall moved",
    partial(_measure_change, moved_wall),
    _change_lines,
    partial(_draw_change, "A wall moved"),
    10,
)
DOOR = Figure(
    "A door closed",
    partial(_measure_change, closed_door),
    _change_lines,
    partial(_draw_change, "A door closed"),
    10,
)


ENERGY = 0.15
"""Goal of the Energy Metric within pieces, m^2 + rad^2."""


class _CarriedFigures(NamedTuple):
    """One map, continued in its known part and in an unknown part.

    Attributes:
        seed: of the maze. known, unknown: how the sessions lie in the map. shuffled: that in the known part
            with its images in random order. paths: true positions of the first and of the second session [..,
            2].
    """

    seed: int
    known: Join
    unknown: Join
    shuffled: Join
    paths: tuple[np.ndarray, np.ndarray]

    def record(self) -> Record:
        """The figures of a carried robot by name; the error in m, where it was tied on."""
        return {
            "not_tied": not self.known.right,
            "wrong_tie": self.known.wrong or self.unknown.wrong,
            "tied_unknown": int(self.unknown.joined),  # no failure where it is right
            "error": float(self.known.error[0]) if self.known.joined else np.nan,
            "shuffled_tied": self.shuffled.joined,
        }


class _KidnapFigures(NamedTuple):
    """One session with kidnaps.

    Attributes:
        pieces: of the map. within, over_all: Energy Metric over pairs in one piece and over all, m^2 + rad^2.
            unjoined: share of the steps outside the largest piece.
    """

    pieces: int
    within: float
    over_all: float
    unjoined: float

    def record(self) -> Record:
        """The figures of a kidnapped robot by name; Energy Metrics in m^2 + rad^2."""
        return {
            "above_goal": self.within > ENERGY,
            "em_within_pieces": self.within,
            "em": self.over_all,
            "unjoined": self.unjoined,
            "pieces": self.pieces,
        }


def _measure_carried(task: MapTask) -> _CarriedFigures:
    """Continues one map three times."""
    scenario = carried_sessions(task.seed)
    made = task.map_of(scenario.first)
    known, unknown = record(scenario.known), record(scenario.unknown)
    mixed = Recorded(known.config, apply_control(known.log, "shuffled", task.seed))
    earlier = len(made.arrays.truth)

    def extend(recorded: Recorded, entry: int) -> Join:
        return judge_join(task.methods.extend(made, recorded), earlier, entry)

    return _CarriedFigures(
        task.seed,
        extend(known, scenario.entry),
        extend(unknown, 0),
        extend(mixed, scenario.entry),
        (made.arrays.truth[:, :2], known.truth[:, :2]),
    )


def _measure_kidnaps(task: MapTask) -> _KidnapFigures:
    """Maps a session with kidnaps."""
    arrays = task.map_of(kidnapped(task.seed)).arrays
    return _KidnapFigures(
        len(np.unique(arrays.piece)), arrays.em_within_pieces, arrays.em, unjoined_share(arrays.piece)
    )


def _carried_lines(found: Sequence[_CarriedFigures]) -> Iterator[str]:
    """The lines of carried robots."""
    yield HEADER
    n = len(found)
    yield table_line(
        f"tied on rightly after {REENTERED} whisks in the known part",
        f"{int(np.ceil(0.9 * n))} of {n}",
        count([one.known.right for one in found]),
        f"{count([one.shuffled.right for one in found])} with shuffled images",
    )
    wrong = [one.known.wrong for one in found] + [one.unknown.wrong for one in found]
    yield table_line(
        "wrong ties, known and unknown part",
        f"0 of {2 * n}",
        count(wrong),
        f"{count([one.shuffled.wrong for one in found])} with shuffled images",
    )
    yield table_line(
        "ties in the unknown part, never re-entered", "-", count([one.unknown.joined for one in found]), "-"
    )
    errors = [one.known.error[0] for one in found if one.known.joined]
    yield table_line("error of tied sessions, m, median (worst)", "-", spread(errors, 3), "-")


def _kidnap_lines(found: Sequence[_KidnapFigures]) -> Iterator[str]:
    """The lines of kidnapped robots."""
    yield HEADER
    n = len(found)
    yield table_line(
        f"EM within pieces up to {ENERGY}",
        f"{int(np.ceil(10 / 12 * n))} of {n}",
        count([one.within <= ENERGY for one in found]),
        f"{count([one.over_all <= ENERGY for one in found])} over all pairs",
    )
    yield table_line(
        "EM within pieces, median (worst)",
        "-",
        spread([one.within for one in found], 3),
        f"{spread([one.over_all for one in found])} over all pairs",
    )
    yield table_line("share outside the largest piece", "-", spread([one.unjoined for one in found]), "-")
    yield table_line("pieces", "-", spread([one.pieces for one in found], 0), "-")


def _draw_carried(found: Sequence[_CarriedFigures], png: Path) -> None:
    """Draws one session that was carried and, if there is one, tied on, and the errors of all."""
    one = next((each for each in found if each.known.joined), found[0])
    paths = PathPanel(
        "a second session in the map of the first",
        open_world(one.seed).maze,
        shown_paths(*one.paths, one.known),
    )
    dots = {
        name: [getattr(each, name).error[0] for each in found if getattr(each, name).joined]
        for name in ("known", "unknown", "shuffled")
    }
    panel = Panel("error of tied sessions, m", "part in which the session continues", dots=dots)
    right = count([each.known.right for each in found])
    wrong = sum(each.known.wrong + each.unknown.wrong for each in found)
    line = f"Tied on rightly after {REENTERED} whisks in the known part: {right}; wrong ties: {wrong}."
    draw_panels(png, "Carried away, and continued", line, paths, panel)


def _draw_kidnaps(found: Sequence[_KidnapFigures], png: Path) -> None:
    """Draws the errors of all sessions."""
    dots = {"within pieces": [one.within for one in found], "over all pairs": [one.over_all for one in found]}
    panel = Panel("Energy Metric, m² + rad²", "pairs of steps", dots=dots, limits={"goal": ENERGY})
    share = spread([one.unjoined for one in found])
    line = f"One dot a session. Share of the steps outside the largest piece, median (worst): {share}."
    draw_panels(png, "Eight kidnaps in ten circuits", line, None, panel)


CARRIED = Figure("Continue after being carried", _measure_carried, _carried_lines, _draw_carried, 20)
KIDNAPS_ROW = Figure("Eight kidnaps", _measure_kidnaps, _kidnap_lines, _draw_kidnaps, 12)
