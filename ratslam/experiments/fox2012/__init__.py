"""The figures of Fox et al. 2012 made again on simulated sessions, beside baselines nobody had to touch for.

A set is a session: an arena, a start, what the robot did in it and the odometry's errors, all from one seed;
every mapper and method sees the same sets, so their differences are paired.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from ratslam.experiments.fox2012.metrics import FIELDS
from ratslam.experiments.fox2012.plots import picture
from ratslam.experiments.fox2012.protocols import PROTOCOLS, Protocol, World, configured
from ratslam.experiments.fox2012.tables import table
from ratslam.experiments.fox2012.trials import Job, Result, results
from ratslam.experiments.studies.executor import run_tasks
from ratslam.experiments.trials.csv_output import cells, filled, named, progress
from tactile.base.random_streams import stream

HEADING = ("world", "method", "mapper", "along", "set", "seed", "reports", *FIELDS)
"""Of NAME.csv."""


def reproduce(
    name: str,
    directory: Path,
    *,
    sets: int = 3,
    workers: int = 0,
    seed: int = 0,
    assignments: Sequence[str] = (),
) -> tuple[str, bool]:
    """Runs a reproduction; leaves NAME.csv (rows as soon as they are known) and NAME.png in a folder.

    Args:
        name: of a protocol. directory: made where there is none. sets: of each world. workers:
            processes; 0: as many as there are cores. seed: of all sets. assignments: overrides for all, as
            `a.b=value`.

    Returns:
        the table, and whether the user interrupted (it then tells of what was finished).

    Raises:
        InputError: no such reproduction, it is there already, or a session cannot be simulated.
    """
    protocol = named(name, PROTOCOLS)
    jobs = jobs_of(protocol, sets, seed, assignments)
    found: list[Result] = []

    def sessions() -> Iterator[Iterator[list[object]]]:
        with progress(name, len(jobs)) as bar:
            for new in run_tasks(results, jobs, workers=workers):
                found.extend(new)
                yield map(_row, new)
                bar.update()

    interrupted = filled(directory / f"{name}.csv", HEADING, sessions())
    if found and not interrupted:
        picture(name, protocol, found).savefig(directory / f"{name}.png")
    return table(protocol, found, sets), interrupted


def jobs_of(protocol: Protocol, sets: int, seed: int, assignments: Sequence[str] = ()) -> list[Job]:
    """All sessions of a reproduction, a set after the other.

    Raises:
        InputError: an assignment that cannot be.
    """
    return [
        _job(protocol, world, number, seed, assignments)
        for number in range(sets)
        for world in protocol.worlds
    ]


def _job(protocol: Protocol, world: World, number: int, seed: int, assignments: Sequence[str]) -> Job:
    own = int(stream(seed, f"arenas.set.{number}").integers(2**31))
    place = seed if protocol.one_arena else own
    seeds = (f"roving.seed={own}", f"roving.arena.seed={place}", f"session.seed={own}")
    variants = {
        (method, mapper): configured(protocol, world, method, mapper, (*seeds, *assignments))
        for method in protocol.methods
        for mapper in protocol.mappers
    }
    return Job(world.name, number, own, seed, protocol.stops, variants)


def _row(one: Result) -> list[object]:
    which = (one.world, one.method, one.mapper, one.along, one.number, one.seed, one.reports)
    return [*which, *cells(one.values, FIELDS)]
