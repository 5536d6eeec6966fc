"""Many runs of one recording side by side: parts turned off, numbers varied, inputs perturbed.

A trial keeps no run directory; it answers with a handful of figures. Trials share a few worker processes, and
their results come in order, whichever is done first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel

from evaluation.metrics.trajectory import ate
from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import Document, load, override, validate
from ratslam.core.session import CHUNK, Session
from ratslam.experiments.trials.process_pool import shared_out
from ratslam.keyframes.ablation import FULL, Ablation
from ratslam.pipeline.online_error import OnlineErrorLog
from ratslam.pipeline.runner import build_session
from ratslam.pipeline.source import open_observations, read_observations
from robot.sources.in_memory import InMemorySource, load_into_memory
from robot.sources.perturbation import perturb
from tactile.base.errors import InputError
from tactile.base.se2 import integrate

SAME_PLACE = 2.5
"""Cells up to which two frames are the same place: farther apart in truth, a closure is false."""


class Variant(NamedTuple):
    """What differs from the configuration: overrides as `a.b=value`, and parts of the map turned off."""

    sets: tuple[str, ...] = ()
    ablation: Ablation = FULL


PARTS = {
    "nothing (all parts on)": Variant(),
    "Bayesian recall (classic backend instead)": Variant(("backend=classic",)),
    "sector shifts": Variant(("recall.shifts=0",)),
    "negative evidence of common views": Variant(("recall.common=0.0",)),
    "the map's pose as a hypothesis": Variant(("recall.local=0.0",)),
    "verification against the map": Variant(ablation=Ablation(verify=False)),
    "closure sequences (single candidates)": Variant(("keyframes.min_length=1",)),
    "robust weights": Variant(ablation=Ablation(robust=False)),
    "heading bias in the map": Variant(ablation=Ablation(heading_bias=False)),
    "heading bias from the views": Variant(("keyframes.bias_from_views=false",)),
    "both": Variant(("keyframes.bias_from_views=false",), Ablation(heading_bias=False)),
    "odometry breaks": Variant(("keyframes.breaks=false",)),
    "injection into the pose cells": Variant(("recall.energy=1.0e-12",)),
    "closures (odometry alone)": Variant(("experience.closures=false",)),
}
"""What `ablate` turns off, and how."""


class Trial(NamedTuple):
    """One run in figures; NaN where the recording has no truth.

    Attributes:
        final, told: ATE of the final map and of the poses told at the time, m. odometry: the same of raw
            odometry. anytime, late: median, and root mean square of the second half, of the present pose's
            error in the map so far, m. closures, false: how many, and how many farther apart than
            `SAME_PLACE`. lost: share of steps.
    """

    final: float
    told: float
    odometry: float
    anytime: float
    late: float
    closures: int
    false: float
    lost: float


def trial(config: RunConfig, folder: Path, seed: int = 0, ablation: Ablation = FULL) -> Trial:
    """Runs once; a seed above 0 perturbs the recording, or what was simulated, first.

    Raises:
        InputError: the recording cannot be used, or cannot be perturbed because it is not read as a whole.
    """
    with open_observations(config.with_absolute_paths(folder.resolve())) as (config, source):
        if seed:
            if config.simulation is not None:
                source = load_into_memory(source)
            if not isinstance(source, InMemorySource):
                raise InputError("recording.file", "a recording that is streamed", "a CSV or .npz recording")
            source = perturb(source, seed)
        session = build_session(config, source, ablation)
        truth: list[np.ndarray] = []
        motion: list[list[float]] = []
        told: list[np.ndarray] = []
        lost: list[bool] = []
        present = OnlineErrorLog()
        rows = read_observations(source)
        while chunk := list(islice(rows, CHUNK)):
            steps = list(session.replay([reading for _, reading in chunk]))
            truth += [np.full(3, np.nan) if sample.truth is None else sample.truth for sample, _ in chunk]
            motion += [[o.odometry.dx, o.odometry.dy, o.odometry.dtheta] for _, o in chunk]
            told += [step.pose for step in steps]
            lost += [bool(step.estimate.lost) for step in steps]
            present.update(session, truth)
    return _figures(config, session, present, np.array(truth), np.array(motion), np.array(told), lost)


def _figures(
    config: RunConfig,
    session: Session,
    present: OnlineErrorLog,
    truth: np.ndarray,
    motion: np.ndarray,
    told: np.ndarray,
    lost: list[bool],
) -> Trial:
    known = np.isfinite(truth).all(axis=1)
    closures = session.map.closures()
    apart = np.hypot(*(truth[closures[:, 0]] - truth[closures[:, 1]])[:, :2].T)
    reckoned = integrate(motion)

    def error(path: np.ndarray) -> float:
        return ate(path[known], truth[known]) if known.any() else np.nan

    anytime = present.summary()
    return Trial(
        final=error(session.map.trajectory()),
        told=error(told),
        odometry=error(reckoned),
        anytime=anytime.median,
        late=anytime.late,
        closures=len(closures),
        false=float((apart > SAME_PLACE * config.pose_cells.cell_size).sum()) if known.any() else np.nan,
        lost=float(np.mean(lost)),
    )


def compare(
    path: Path, assignments: Sequence[str], variants: Sequence[tuple[Variant, int]], workers: int = 0
) -> Iterator[Trial]:
    """Trials of one configuration file, in the order of the variants.

    Args:
        assignments: overrides for all, as `a.b=value`. variants: what differs in each, and the seed
            of its perturbation (0: none). workers: processes; 0: as many as there are cores.
    """
    for variant, _ in variants:  # complain before anything runs
        validate(override(load(path), [*assignments, *variant.sets]), RunConfig)
    tasks = [(path, tuple(assignments), variant, seed) for variant, seed in variants]
    return shared_out(_try, tasks, workers)


def _try(task: tuple[Path, tuple[str, ...], Variant, int]) -> Trial:
    path, assignments, variant, seed = task
    config = validate(override(load(path), [*assignments, *variant.sets]), RunConfig)
    return trial(config, path.parent, seed, variant.ablation)


def numbers(config: RunConfig) -> list[tuple[str, float | int]]:
    """Every number of the unified filter and its map, by key path: what `vary` varies."""
    found: list[tuple[str, float | int]] = []

    def walk(model: BaseModel, path: str) -> None:
        for name in type(model).model_fields:
            value = getattr(model, name)
            if isinstance(value, BaseModel):
                walk(value, f"{path}{name}.")
            elif isinstance(value, int | float) and not isinstance(value, bool):
                found.append((path + name, value))

    walk(config.recall, "recall.")
    walk(config.keyframes, "keyframes.")
    return found


def varied(value: float | int, factor: float) -> float | int:
    """The value times the factor; whole numbers move by one at least."""
    if isinstance(value, int):
        moved = round(value * factor)
        return moved if moved != value else value + (1 if factor > 1 else -1)
    return value * factor


def variations(document: Document, by: float) -> list[tuple[str, float | int]]:
    """Every number moved down and up by a share, as (key path, value); values that cannot be are left out."""
    found = []
    for name, value in numbers(validate(document, RunConfig)):
        for moved in (varied(value, 1 - by), varied(value, 1 + by)):
            try:
                validate(override(document, [f"{name}={moved!r}"]), RunConfig)
            except InputError:
                continue
            if moved != value:
                found.append((name, moved))
    return found


COLUMNS = {
    "final": 9,
    "odometry": 10,
    "told": 9,
    "anytime": 9,
    "late": 9,
    "closures": 10,
    "false": 7,
    "lost": 8,
}
HEADER = " " * 42 + "".join(f"{name:>{width}}" for name, width in COLUMNS.items())
"""Of the table that `row` fills: m, m, m, m, m, counts, share of steps."""


def row(name: str, trials: Sequence[Trial]) -> str:
    """One line of the table: medians over the trials, and the largest final error if there are several."""
    middle = Trial(*(float(np.median(column)) for column in zip(*trials, strict=True)))  # type: ignore[arg-type]
    cells = "".join(f"{_short(getattr(middle, column)):>{width}}" for column, width in COLUMNS.items())
    most = f"  final at most {max(each.final for each in trials):.3g}" if len(trials) > 1 else ""
    return f"{name:<42}{cells}{most}"


def _short(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
