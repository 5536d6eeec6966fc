"""What the reproductions of both papers share: sets of sessions, rows of NAME.csv, sweeps of thresholds.

`reproduce` runs the sessions of a figure, writes each row as soon as it is measured, and draws and prints the
figure. `sweep_thresholds` runs the classic method at many matching thresholds over one session in one
compiled batch: the kernel decides which experience is current, so the Experience Metric needs no map.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from tqdm import tqdm

from evaluation.papers.trial_sessions import capacity_for
from evaluation.plots import style
from evaluation.studies.executor import run_tasks
from ratslam.core.compilation import prepare_precision
from ratslam.core.estimates import Estimate
from ratslam.methods.classic import ClassicBackend, ClassicEvidence
from ratslam.methods.config import ClassicBackendConfig
from ratslam.methods.method_registry import backend_settings
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.in_memory import InMemorySource
from robot.touch_source import observation_of
from tactile.base.errors import InputError
from tactile.base.files import require_new_file
from tactile.base.types import Array, Observation, stack

Task = TypeVar("Task")
Result = TypeVar("Result")


class ResultRow(NamedTuple):
    """A row of NAME.csv.

    Attributes:
        key: names of condition, method and so on. number: of the set. values: metrics; None or NaN where
            undefined. session: what figures need beside the metrics.
    """

    key: tuple[str, ...]
    number: int
    seed: int
    values: Mapping[str, Any]
    session: Any = None


class Paper(NamedTuple):
    """What differs between the reproductions of two papers.

    Attributes:
        protocols: of the figures, by name. key, fields: columns of NAME.csv: names, and metrics. plan: jobs
            from a protocol, the number of sets, a seed and overrides. run: rows in batches from the name of
            the figure, the jobs and the number of processes. draw: the figure from its name,
            the protocol and the rows. render: the table from the protocol, the rows and the number of sets.
    """

    protocols: Mapping[str, Any]
    key: tuple[str, ...]
    fields: tuple[str, ...]
    plan: Callable[[Any, int, int, Sequence[str]], Sequence[Any]]
    run: Callable[[str, Sequence[Any], int], Iterable[Sequence[ResultRow]]]
    draw: Callable[[str, Any, Sequence[ResultRow]], style.Figure]
    render: Callable[[Any, Sequence[ResultRow], int], str]


def reproduce(
    paper: Paper,
    name: str,
    directory: Path,
    sets: int = 3,
    workers: int = 0,
    seed: int = 0,
    assignments: Sequence[str] = (),
) -> tuple[str, bool]:
    """Runs a reproduction; writes NAME.csv, row by row, and NAME.png to a folder, created if missing.

    Args:
        sets: per condition or world. workers: processes; 0: one per core. seed: of all sets. assignments:
            overrides as `a.b=value`.

    Returns:
        the table, and whether the user interrupted (the table is then of the finished sessions).

    Raises:
        InputError: no such reproduction, NAME.csv exists, or a session cannot be simulated.
    """
    if name not in paper.protocols:
        raise InputError("NAME", repr(name), f"one of {', '.join(paper.protocols)}")
    protocol = paper.protocols[name]
    require_new_file(directory / f"{name}.png", parents=True)
    jobs = paper.plan(protocol, sets, seed, assignments)
    batches = paper.run(name, jobs, workers)
    rows, interrupted, table = list[ResultRow](), False, directory / f"{name}.csv"
    require_new_file(table, parents=True)
    table.parent.mkdir(parents=True, exist_ok=True)
    with table.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*paper.key, "set", "seed", *paper.fields])
        try:
            for batch in batches:
                for row in batch:
                    values = (row.values.get(field) for field in paper.fields)
                    cells = ("" if value is None or value != value else repr(value) for value in values)
                    writer.writerow([*row.key, row.number, row.seed, *cells])
                rows += batch
                file.flush()
        except KeyboardInterrupt:
            interrupted = True
    if rows and not interrupted:
        paper.draw(name, protocol, rows).savefig(directory / f"{name}.png")
    return paper.render(protocol, rows, sets), interrupted


def run_with_progress(
    function: Callable[[Task], Result], title: str, tasks: Sequence[Task], workers: int
) -> Iterator[Result]:
    """The results of tasks, in order, with a progress bar."""
    found = run_tasks(function, tasks, workers=workers)
    return iter(tqdm(found, title, len(tasks), unit="session", file=sys.stderr, mininterval=0.5))


def column(rows: Sequence[ResultRow], key: tuple[str, ...], field: str) -> np.ndarray:
    """[S] values over the sets of the rows whose key ends with `key`, NaN for missing sets."""
    values = np.full(1 + max((row.number for row in rows), default=-1), np.nan)
    for row in rows:
        if row.key[-len(key) :] == key and (value := row.values.get(field)) is not None:
            values[row.number] = value
    return values


def count_sets(rows: Sequence[ResultRow], first_only: bool = False) -> str:
    """The number of sets, for the subtitle of a figure."""
    sets = len({row.number for row in rows})
    count = f"{sets} set{'s' if sets > 1 else ''}"
    return f"the first of {count}" if first_only else count


def sweep_thresholds(
    config: RunConfig, log: InMemorySource, thresholds: np.ndarray
) -> tuple[Estimate, ClassicEvidence]:
    """Estimate and evidence of T steps with the classic method at thresholds [B]; leading axes [B, T].

    Raises:
        ValueError: the configuration has another method.
    """
    if config.backend != "classic":
        raise ValueError(f"backend: {config.backend}; a sweep of thresholds needs backend: classic")
    dtype = np.dtype(config.session.precision)
    prepare_precision(config.session.precision)
    readings = [observation_of(sample) for sample in log]
    padding = readings[-1:] * (capacity_for(log.length) - len(readings))  # cut off below
    chunk = stack(readings + padding)
    method = backend_settings("classic", config)
    assert isinstance(method, ClassicBackendConfig)
    found = _batch(method, log.view_shape, dtype.name, jnp.asarray(thresholds, dtype), chunk)
    return jax.tree.map(lambda column: np.asarray(column)[:, : log.length], found)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _batch(
    config: ClassicBackendConfig,
    shape: tuple[int, int, int],
    dtype: str,
    thresholds: Array,
    chunk: Observation,
) -> tuple[Estimate, ClassicEvidence]:
    rows = chunk.label.shape[0]

    def one(threshold: Array) -> tuple[Estimate, ClassicEvidence]:
        matching = config.templates.model_copy(update={"threshold": threshold})
        backend = ClassicBackend(config.model_copy(update={"templates": matching}), shape, np.dtype(dtype))

        def step(state: Any, observation: Observation) -> tuple[Any, tuple[Estimate, ClassicEvidence]]:
            state, estimate, evidence = backend.kernel(state, observation)
            return state, (estimate, evidence)

        return lax.scan(step, backend.init(None, rows), chunk)[1]

    return lax.map(one, thresholds)  # sequential; vmap would compute all branches of the network
