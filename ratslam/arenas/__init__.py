"""The figures of Fox et al. 2012 made again on simulated sessions, beside baselines nobody had to touch for.

A set is a session: an arena, a start, what the robot did in it and the odometry's errors, all from one seed;
every mapper and method sees the same sets, so their differences are paired.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from tqdm import tqdm

from ratslam.arenas.figures import FIELDS
from ratslam.arenas.pictures import picture
from ratslam.arenas.protocols import PROTOCOLS, Protocol, World, configured
from ratslam.arenas.tables import table
from ratslam.arenas.trials import Job, Result, results
from ratslam.trials.workers import shared_out
from tactile.errors import InputError
from tactile.streams import stream


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
    if name not in PROTOCOLS:
        raise InputError("NAME", repr(name), f"one of {', '.join(PROTOCOLS)}")
    protocol = PROTOCOLS[name]
    jobs = jobs_of(protocol, sets, seed, assignments)
    path = directory / f"{name}.csv"
    if path.exists():
        raise InputError(str(path), "exists", "a folder without it", "choose another folder with -o")
    directory.mkdir(parents=True, exist_ok=True)
    found: list[Result] = []
    interrupted = False
    bar = tqdm(total=len(jobs), unit="session", desc=name, file=sys.stderr, mininterval=0.5)
    with path.open("w", encoding="utf-8", newline="") as file, bar as progress:
        writer = csv.writer(file)
        writer.writerow(("world", "method", "mapper", "along", "set", "seed", "reports", *FIELDS))
        try:
            for new in shared_out(results, jobs, workers):
                _write(writer, file, new)
                found += new
                progress.update()
        except KeyboardInterrupt:
            interrupted = True
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


def _write(writer: Any, file: IO[str], found: list[Result]) -> None:
    for one in found:
        cells = ("" if value is None else repr(value) for value in (one.values.get(f) for f in FIELDS))
        writer.writerow(
            (one.world, one.method, one.mapper, one.along, one.number, one.seed, one.reports, *cells)
        )
    file.flush()
