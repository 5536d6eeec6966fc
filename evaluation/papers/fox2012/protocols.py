"""The protocols of Fox et al. 2012: worlds, mappers and two filters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import override, parse, validate

MAPPERS = {"blob": "none", "geometric": "geometric", "template": "template", "fused": "fused"}
"""`touch.reports.walls` of the paper's three mappers (II-E to II-G), and ours."""
PAPERS = ("blob", "geometric", "template")  # the paper's mappers from worst to best as printed (III)
METHODS: dict[str, tuple[str, ...]] = {
    "as printed": (
        "touch.reports.max_template_error=null",
        "grid.likelihood={model: literal}",
        "grid.resampling={schedule: always, scheme: multinomial, length: 0.0, heading: 0.0, scale: 0.0}",
        "grid.drift={session: 0.0, move: 0.0, heading: 0.0}",
        "grid.footprint={wall: edge, edge: 1.386, blob: 1.386, along: 0.25, free: 0.405, body: 0.405,"
        " max_log_odds: 3.5}",
        "grid.drawing={contact: 0.8, blob_sd: 0.05, edge_sd: 0.25, edge_sector: 0.2617993877991494}",
    ),
    "ours": (),
}
"""As printed (Algorithm 1, eq. 1 to 5), except where the printed form cannot work: each cell counts once in
eq. 2 and not as free where the contact is (`distinct_cells`), footprints are neutral far away, and
resampled particles have moved. Footprints are the log-odds of 0.8 and 0.4. All templates are used. Ours are
the defaults."""
FILTERED, RECKONED, TRUE = "filter", "dead reckoning", "true path"
"""Paths along which a method's marks are drawn: the filter's, a lower bound and an upper bound."""


class World(NamedTuple):
    """An arena and the odometry noise in it.

    Attributes:
        level: of the odometry noise; the printed filter uses it as the noise of each step.
        settings: overrides.
    """

    name: str
    level: float
    settings: tuple[str, ...] = ()


class Protocol(NamedTuple):
    """A figure of the paper.

    Attributes:
        source: section and figure. stops: numbers of reports after which the result is scored; 0: all.
            one_arena: whether all sets share an arena. note: printed below the table.
    """

    title: str
    source: str
    worlds: tuple[World, ...]
    note: str
    mappers: tuple[str, ...] = tuple(MAPPERS)
    methods: tuple[str, ...] = tuple(METHODS)
    stops: tuple[int, ...] = (0,)
    one_arena: bool = True


_SMALL = (World("1.25 m arena", 0.05),)
_LARGE = ("create_simulation.arena.side=2.5", "create_simulation.reports=1500")

PROTOCOLS = {
    "fox-fig4": Protocol(
        "Mean maps of three mappers",
        "Fox et al. 2012, III, Fig. 4",
        _SMALL,
        note="One arena, six minutes from a different start in each trial. The paper does not print its "
        "arena, whisker mounts and likelihood constants: compare rankings, not values.",
    ),
    "fox-fig5": Protocol(
        "Maps of single trials",
        "Fox et al. 2012, IV, Fig. 5",
        _SMALL,
        note="The trials of fox-fig4 with the same numbers.",
    ),
    "fox-fig6": Protocol(
        "A larger arena at two levels of odometry noise",
        "Fox et al. 2012, III, Fig. 6",
        (World("2 % noise", 0.02, _LARGE), World("5 % noise", 0.05, _LARGE)),
        note="The paper: tracked for 200 steps at 2 %, loops not closed at 5 %. The noise is one scale error "
        "for each straight line or turn; each set has its own arena.",
        mappers=("geometric",),
        stops=(200, 1500),
        one_arena=False,
    ),
}


def session_config(world: World, method: str, mapper: str, assignments: Sequence[str] = ()) -> RunConfig:
    """The configuration of a mapper in a world.

    Raises:
        InputError: an invalid assignment.
    """
    settings = [
        "backend=grid",
        f"create_simulation.wheels.level={world.level}",
        *world.settings,
        *METHODS[method],
    ]
    if method == "as printed":
        settings.append(f"grid.drift.step={world.level}")
    settings += [f"touch.reports.walls={MAPPERS[mapper]}", *assignments]
    return validate(override(parse("create_simulation: {}\n", "the reproduction"), settings), RunConfig)
