"""Rows: a robot that is carried away between two sessions, or kidnapped within one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.map_pieces import unjoined_share
from evaluation.papers.maps.joins import Join, judge_join, shown_paths
from evaluation.papers.maps.pictures import Panel, PathPanel, draw_panels
from evaluation.papers.maps.row import Line, MapRow, MapTask, count, spread
from evaluation.papers.maps.scenarios import REENTERED, carried_sessions, kidnapped, open_world
from evaluation.papers.maps.sessions import Recorded, record
from evaluation.papers.tables.comparison import Record
from evaluation.papers.trials.view_controls import apply_control

ENERGY = 0.15
"""Goal of the Energy Metric within pieces, m^2 + rad^2."""


class CarriedFigures(NamedTuple):
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


class KidnapFigures(NamedTuple):
    """One session with kidnaps.

    Attributes:
        pieces: of the map. within, over_all: Energy Metric over pairs in one piece and over all, m^2 + rad^2.
            unjoined: share of the steps outside the largest piece.
    """

    pieces: int
    within: float
    over_all: float
    unjoined: float


def measure_carried(task: MapTask) -> CarriedFigures:
    """Continues one map three times."""
    scenario = carried_sessions(task.seed)
    made = task.map_of(scenario.first)
    known, unknown = record(scenario.known), record(scenario.unknown)
    mixed = Recorded(known.config, apply_control(known.log, "shuffled", task.seed))
    earlier = len(made.arrays.truth)

    def extend(recorded: Recorded, entry: int) -> Join:
        return judge_join(task.methods.extend(made, recorded), earlier, entry)

    return CarriedFigures(
        task.seed,
        extend(known, scenario.entry),
        extend(unknown, 0),
        extend(mixed, scenario.entry),
        (made.arrays.truth[:, :2], known.truth[:, :2]),
    )


def measure_kidnaps(task: MapTask) -> KidnapFigures:
    """Maps a session with kidnaps."""
    arrays = task.map_of(kidnapped(task.seed)).arrays
    return KidnapFigures(
        len(np.unique(arrays.piece)), arrays.em_within_pieces, arrays.em, unjoined_share(arrays.piece)
    )


def carried_record(one: CarriedFigures) -> Record:
    """The figures of a carried robot by name; the error in m, where it was tied on."""
    return {
        "not_tied": not one.known.right,
        "wrong_tie": one.known.wrong or one.unknown.wrong,
        "tied_unknown": int(one.unknown.joined),  # no failure where it is right
        "error": float(one.known.error[0]) if one.known.joined else np.nan,
        "shuffled_tied": one.shuffled.joined,
    }


def kidnap_record(one: KidnapFigures) -> Record:
    """The figures of a kidnapped robot by name; Energy Metrics in m^2 + rad^2."""
    return {
        "above_goal": one.within > ENERGY,
        "em_within_pieces": one.within,
        "em": one.over_all,
        "unjoined": one.unjoined,
        "pieces": one.pieces,
    }


def carried_lines(found: Sequence[CarriedFigures]) -> Iterator[Line]:
    """The lines of carried robots."""
    n = len(found)
    yield Line(
        f"tied on rightly after {REENTERED} whisks in the known part",
        f"{int(np.ceil(0.9 * n))} of {n}",
        count([one.known.right for one in found]),
        f"{count([one.shuffled.right for one in found])} with shuffled images",
    )
    wrong = [one.known.wrong for one in found] + [one.unknown.wrong for one in found]
    yield Line(
        "wrong ties, known and unknown part",
        f"0 of {2 * n}",
        count(wrong),
        f"{count([one.shuffled.wrong for one in found])} with shuffled images",
    )
    yield Line(
        "ties in the unknown part, never re-entered", "-", count([one.unknown.joined for one in found]), "-"
    )
    errors = [one.known.error[0] for one in found if one.known.joined]
    yield Line("error of tied sessions, m, median (worst)", "-", spread(errors, 3), "-")


def kidnap_lines(found: Sequence[KidnapFigures]) -> Iterator[Line]:
    """The lines of kidnapped robots."""
    n = len(found)
    yield Line(
        f"EM within pieces up to {ENERGY}",
        f"{int(np.ceil(10 / 12 * n))} of {n}",
        count([one.within <= ENERGY for one in found]),
        f"{count([one.over_all <= ENERGY for one in found])} over all pairs",
    )
    yield Line(
        "EM within pieces, median (worst)",
        "-",
        spread([one.within for one in found], 3),
        f"{spread([one.over_all for one in found])} over all pairs",
    )
    yield Line("share outside the largest piece", "-", spread([one.unjoined for one in found]), "-")
    yield Line("pieces", "-", spread([one.pieces for one in found], 0), "-")


def draw_carried(found: Sequence[CarriedFigures], png: Path) -> None:
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


def draw_kidnaps(found: Sequence[KidnapFigures], png: Path) -> None:
    """Draws the errors of all sessions."""
    dots = {"within pieces": [one.within for one in found], "over all pairs": [one.over_all for one in found]}
    panel = Panel("Energy Metric, m² + rad²", "pairs of steps", dots=dots, limits={"goal": ENERGY})
    share = spread([one.unjoined for one in found])
    line = f"One dot a session. Share of the steps outside the largest piece, median (worst): {share}."
    draw_panels(png, "Eight kidnaps in ten circuits", line, None, panel)


CARRIED = MapRow(
    "Continue after being carried", 20, measure_carried, carried_record, carried_lines, draw_carried
)
KIDNAPS_ROW = MapRow("Eight kidnaps", 12, measure_kidnaps, kidnap_record, kidnap_lines, draw_kidnaps)
