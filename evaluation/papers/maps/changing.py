"""Figures: a wall that was moved, a door that was closed, and a robot that was carried away or kidnapped.

A robot is carried away between two sessions, of which the second continues the map of the first, and
kidnapped within one session.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from evaluation.metrics.run_metrics import unjoined_share
from evaluation.papers.figure import Figure
from evaluation.papers.maps import scenarios
from evaluation.papers.maps.localising import Judged
from evaluation.papers.maps.merged_maps import Join
from evaluation.papers.maps.operations import MapTask
from evaluation.papers.maps.pictures import PathPanel, at_least, draw_panels, spread, table
from evaluation.papers.maps.scenarios import LOCALISED, REENTERED, Recipe, Recorded, record
from evaluation.papers.tables.comparison import Measured, column
from evaluation.papers.tables.markdown import count
from evaluation.papers.trial_sessions import apply_control
from robot.world.maze import CELL_SIDE


def _measure_change(change: Callable[[int], tuple[Recipe, np.ndarray]], task: MapTask) -> Measured:
    """One changed maze in the map of ten circuits: a session before the change, one after it, and one as
    long without a change, in which no place should be named."""
    made, (changed, places) = task.map_of(scenarios.ten_circuits(task.seed)), change(task.seed)
    started, driven = record(scenarios.unknown_start(task.seed)), record(changed)
    again = record(Recipe(scenarios.same_maze(task.seed, 1).config, 0, driven.log.length))
    steps, methods = made.arrays.steps, task.methods
    named = steps.true_places(methods.changes(made, driven).reshape(-1, 2))  # the surest first
    distance = np.hypot(*(named[:, None] - places).transpose(2, 0, 1)).min(axis=1)
    before = Judged.of(steps, methods.localise(made, started), started.truth)
    after = Judged.of(steps, methods.localise(made, driven), driven.truth)
    unchanged = len(methods.changes(made, again))
    figures = {
        "missed": after.whisks > LOCALISED,
        "sure_and_wrong": bool(after.wrong.any()),
        "missed_before": before.whisks > LOCALISED,
        "sure_and_wrong_before": bool(before.wrong.any()),
        "not_named": not (distance[:1] <= CELL_SIDE).any(),
        "far_places": int((distance > CELL_SIDE).sum()),
        "false_alarm": unchanged > 0,
    }
    maze, marks = scenarios.open_world(task.seed)[0], [("truly changed", places), ("named", named)]
    path = {"path": driven.truth[:, :2]}
    paths = PathPanel("maze of the map, path after the change", maze, path, marks)
    return Measured(figures, {"unchanged": unchanged, "distance": distance, "paths": paths})


def _change_lines(found: Sequence[Measured]) -> list[str]:
    n = len(found)
    return table(
        f"found and right within {LOCALISED} whisks after the change | {at_least(0.9, n)} |"
        f" {count(~column(found, 'missed'))} | {count(~column(found, 'missed_before'))} before it",
        f"sure and wrong at some whisk after the change | - | {count(column(found, 'sure_and_wrong'))} |"
        f" {count(column(found, 'sure_and_wrong_before'))} before it",
        f"surest place named within a cell of the change | {at_least(0.8, n)} |"
        f" {count(~column(found, 'not_named'))} | {count(column(found, 'false_alarm'))} name a place in an"
        " unchanged maze",
        f"places named farther away, median (worst) | - | {spread(column(found, 'far_places'), 0)} |"
        f" {spread(column(found, 'unchanged'), 0)} in an unchanged maze",
    )


def _draw_change(title: str, found: Sequence[Measured], png: Path) -> None:
    """Draws one changed maze with the places named, and their distances in all."""
    distances = [one.shown["distance"] for one in found]
    line = f"Surest place within a cell of the change: {count(~column(found, 'not_named'))}."
    names = "distance from the true change, m", "places named"
    others = [value for each in distances for value in each[1:]]
    dots = {"surest": [each[0] for each in distances if len(each)], "others": others}
    limits, paths = {"a cell": CELL_SIDE}, found[0].shown["paths"]
    draw_panels(png, title, line, names, dots=dots, limits=limits, paths=paths)


WALL, DOOR = (
    Figure(title, partial(_measure_change, change), _change_lines, partial(_draw_change, title), 10)
    for title, change in (("A wall moved", scenarios.moved_wall), ("A door closed", scenarios.closed_door))
)


ENERGY = 0.15
"""Goal of the Energy Metric within pieces, m^2 + rad^2."""


def _measure_carried(task: MapTask) -> Measured:
    """One map, continued in its known part, in an unknown part, and in the known part with images in random
    order; the error in m, where it was tied on."""
    first, entered, away, entry = scenarios.carried_sessions(task.seed)
    made, inside = task.map_of(first), record(entered)
    mixed = Recorded(inside.config, apply_control(inside.log, "shuffled", task.seed))

    def extend(recorded: Recorded, entry: int) -> Join:
        return Join.of(task.methods.extend(made, recorded), len(made.arrays.truth), entry)

    known, unknown, shuffled = extend(inside, entry), extend(record(away), 0), extend(mixed, entry)
    figures = {
        "not_tied": not known.right,
        "wrong_tie": known.wrong or unknown.wrong,
        "tied_unknown": int(unknown.joined),  # no failure where it is right
        "error": known.off,
        "shuffled_tied": shuffled.joined,
    }
    paths = known.paths(made.arrays.truth, inside.truth)
    panel = PathPanel("a second session in the map of the first", scenarios.open_world(task.seed)[0], paths)
    return Measured(figures, {"known": known, "unknown": unknown, "shuffled": shuffled, "paths": panel})


def _measure_kidnaps(task: MapTask) -> Measured:
    """Maps a session with kidnaps; Energy Metrics in m^2 + rad^2."""
    arrays = task.map_of(scenarios.kidnapped(task.seed)).arrays
    within = arrays.em_within_pieces
    figures = {
        "above_goal": within > ENERGY,
        "em_within_pieces": within,
        "em": arrays.em,
        "unjoined": unjoined_share(arrays.piece),
        "pieces": len(np.unique(arrays.piece)),
    }
    return Measured(figures, {})


def _carried_lines(found: Sequence[Measured]) -> list[str]:
    n = len(found)
    known, unknown, shuffled = ([one.shown[name] for one in found] for name in PARTS)
    return table(
        f"tied on rightly after {REENTERED} whisks in the known part | {at_least(0.9, n)} |"
        f" {count([one.right for one in known])} | {count([one.right for one in shuffled])} with shuffled"
        " images",
        f"wrong ties, known and unknown part | 0 of {2 * n} |"
        f" {count([one.wrong for one in known + unknown])} | {count([one.wrong for one in shuffled])} with"
        " shuffled images",
        f"ties in the unknown part, never re-entered | - | {count([one.joined for one in unknown])} | -",
        f"error of tied sessions, m, median (worst) | - | {spread(column(found, 'error'), 3)} | -",
    )


def _kidnap_lines(found: Sequence[Measured]) -> list[str]:
    within, over_all = column(found, "em_within_pieces"), column(found, "em")
    return table(
        f"EM within pieces up to {ENERGY} | {at_least(10 / 12, len(found))} | {count(within <= ENERGY)} |"
        f" {count(over_all <= ENERGY)} over all pairs",
        f"EM within pieces, median (worst) | - | {spread(within, 3)} | {spread(over_all)} over all pairs",
        f"share outside the largest piece | - | {spread(column(found, 'unjoined'))} | -",
        f"pieces | - | {spread(column(found, 'pieces'), 0)} | -",
    )


PARTS = ("known", "unknown", "shuffled")
"""In which a carried session continues; the last is the known one with images in random order."""


def _draw_carried(found: Sequence[Measured], png: Path) -> None:
    """Draws one session that was carried and, if there is one, tied on, and the errors of all."""
    one = next((each for each in found if each.shown["known"].joined), found[0])
    wrong = sum(each.shown[name].wrong for each in found for name in ("known", "unknown"))
    right = count(~column(found, "not_tied"))
    line = f"Tied on rightly after {REENTERED} whisks in the known part: {right}; wrong ties: {wrong}."
    names = "error of tied sessions, m", "part in which the session continues"
    dots = {name: [each.shown[name].off for each in found] for name in PARTS}
    draw_panels(png, "Carried away, and continued", line, names, dots=dots, paths=one.shown["paths"])


def _draw_kidnaps(found: Sequence[Measured], png: Path) -> None:
    """Draws the errors of all sessions."""
    dots = {"within pieces": column(found, "em_within_pieces"), "over all pairs": column(found, "em")}
    share = spread(column(found, "unjoined"))
    line = f"One dot a session. Share of the steps outside the largest piece, median (worst): {share}."
    names = "Energy Metric, m² + rad²", "pairs of steps"
    draw_panels(png, "Eight kidnaps in ten circuits", line, names, dots=dots, limits={"goal": ENERGY})


CARRIED = Figure("Continue after being carried", _measure_carried, _carried_lines, _draw_carried, 20)
KIDNAPS_ROW = Figure("Eight kidnaps", _measure_kidnaps, _kidnap_lines, _draw_kidnaps, 12)
