"""What is reproduced of Fox et al. 2012: worlds, mappers, and two ways to filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import override, parse, validate

MAPPERS = {
    "blob": ("touch.reports.walls=none",),
    "geometric": ("touch.reports.walls=geometric",),
    "template": ("touch.reports.walls=template",),
    "fused": ("touch.reports.walls=fused",),
}
"""The paper's three, which differ in what they know of walls (II-E to II-G), and ours."""
PAPERS = ("blob", "geometric", "template")
"""Of these, the paper's, from the worst to the best as printed (III)."""
METHODS: dict[str, tuple[str, ...]] = {
    "as printed": (
        "touch.reports.flat=null",
        "grid.likelihood.model=distinct",
        "grid.resampling.when=always",
        "grid.resampling.how=multinomial",
        "grid.resampling.length=0.0",
        "grid.resampling.heading=0.0",
        "grid.resampling.scale=0.0",
        "grid.drift.run=0.0",
        "grid.drift.move=0.0",
        "grid.drift.heading=0.0",
        "grid.stamps.wall=edge",
        "grid.stamps.edge=1.386",
        "grid.stamps.blob=1.386",
        "grid.stamps.along=0.25",
        "grid.stamps.free=0.405",
        "grid.stamps.body=0.405",
        "grid.stamps.most=3.5",
        "grid.drawing.contact=0.8",
        "grid.drawing.blob_sd=0.05",
        "grid.drawing.edge_sd=0.25",
        "grid.drawing.edge_fan=0.2617993877991494",
    ),
    "ours": (),
}
"""As printed (Algorithm 1, eq. 1 to 5) but for what cannot work: a contact's own cell does not deny it, marks
are neutral far from where they are made, and those resampled have moved. Its stamps are the log-odds of 0.8
and 0.4. Every template is believed. Ours are the defaults."""
FILTERED, RECKONED, TRUE = "filter", "dead reckoning", "true path"
"""Along which a method's marks are drawn: the filter's path, and two that no filter found: what filtering
must beat, and what it can reach."""
PATHS = (FILTERED, RECKONED, TRUE)


class World(NamedTuple):
    """Where and how the robot goes.

    Attributes:
        level: of the odometry's noise; the printed filter takes it for the noise of each step.
    """

    name: str
    level: float
    sets: tuple[str, ...] = ()


class Protocol(NamedTuple):
    """A figure of the paper.

    Attributes:
        source: where. stops: numbers of reports after which is judged; 0: all. one_arena: of all sets; else
            each has its own. note: what to know when reading it.
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
        note="One arena, six minutes from another start each time. The paper's arena, its whiskers' mounts "
        "and its likelihoods' constants are not printed: compare orders, not values.",
    ),
    "fox-fig5": Protocol(
        "Maps of single trials",
        "Fox et al. 2012, IV, Fig. 5",
        _SMALL,
        note="The trials of fox-fig4 by the same numbers.",
    ),
    "fox-fig6": Protocol(
        "A larger arena at two levels of odometry noise",
        "Fox et al. 2012, III, Fig. 6",
        (World("2 % noise", 0.02, _LARGE), World("5 % noise", 0.05, _LARGE)),
        note="The paper: tracked for 200 steps at 2 %, loops not closed at 5 %. Noise is one scale error for "
        "each straight line or turn; every set has an arena of its own.",
        mappers=("geometric",),
        stops=(200, 1500),
        one_arena=False,
    ),
}


def session_config(world: World, method: str, mapper: str, assignments: Sequence[str] = ()) -> RunConfig:
    """The configuration of a mapper in a world.

    Raises:
        InputError: an assignment that cannot be.
    """
    level = (f"create_simulation.wheels.level={world.level}",)
    believed = (f"grid.drift.step={world.level}",) if method == "as printed" else ()
    every = ("backend=grid", *level, *world.sets, *METHODS[method], *believed, *MAPPERS[mapper], *assignments)
    return validate(override(parse("create_simulation: {}\n", "the reproduction"), every), RunConfig)
