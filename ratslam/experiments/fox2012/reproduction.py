"""Runs a protocol: each session through all mappers and methods.

A set is a session: an arena, a start, the behaviour of the robot and the errors of its odometry, all from one
seed. All mappers and methods run on the same sets, so their differences are paired.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from ratslam.experiments.fox2012.metrics import FIELDS
from ratslam.experiments.fox2012.plots import draw_reproduction
from ratslam.experiments.fox2012.protocols import PROTOCOLS, Protocol, World, session_config
from ratslam.experiments.fox2012.report import render_results
from ratslam.experiments.fox2012.trials import MapperResult, SessionJob, run_job
from ratslam.experiments.studies.executor import run_tasks
from ratslam.experiments.trials.csv_output import find_protocol, format_cells, progress_bar, write_rows
from tactile.base.random_streams import stream

HEADING = ("world", "method", "mapper", "along", "set", "seed", "reports", *FIELDS)
"""Columns of NAME.csv."""


def reproduce(
    name: str,
    directory: Path,
    *,
    sets: int = 3,
    workers: int = 0,
    seed: int = 0,
    assignments: Sequence[str] = (),
) -> tuple[str, bool]:
    """As `ratslam.experiments.salman2016.reproduction.reproduce`, with sets per world."""
    protocol = find_protocol(name, PROTOCOLS)
    jobs = plan_jobs(protocol, sets, seed, assignments)
    found: list[MapperResult] = []

    def batches() -> Iterator[Iterator[list[object]]]:
        with progress_bar(name, len(jobs)) as bar:
            for results in run_tasks(run_job, jobs, workers=workers):
                found.extend(results)
                yield map(_row, results)
                bar.update()

    interrupted = write_rows(directory / f"{name}.csv", HEADING, batches())
    if found and not interrupted:
        draw_reproduction(name, protocol, found).savefig(directory / f"{name}.png")
    return render_results(protocol, found, sets), interrupted


def plan_jobs(protocol: Protocol, sets: int, seed: int, assignments: Sequence[str] = ()) -> list[SessionJob]:
    """All sessions of a reproduction, set by set.

    Raises:
        InputError: an invalid assignment.
    """
    return [
        _job(protocol, world, number, seed, assignments)
        for number in range(sets)
        for world in protocol.worlds
    ]


def _job(protocol: Protocol, world: World, number: int, seed: int, assignments: Sequence[str]) -> SessionJob:
    own = int(stream(seed, f"arenas.set.{number}").integers(2**31))
    arena = seed if protocol.one_arena else own
    seeds = (f"create_simulation.seed={own}", f"create_simulation.arena.seed={arena}", f"session.seed={own}")
    variants = {
        (method, mapper): session_config(world, method, mapper, (*seeds, *assignments))
        for method in protocol.methods
        for mapper in protocol.mappers
    }
    return SessionJob(world.name, number, own, seed, protocol.stops, variants)


def _row(one: MapperResult) -> list[object]:
    keys = (one.world, one.method, one.mapper, one.along, one.number, one.seed, one.reports)
    return [*keys, *format_cells(one.values, FIELDS)]
