"""A study of many networks: parameter sets over stated ranges, in chunks whose scores are kept on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import numpy as np
from pydantic import AfterValidator, Field, NonNegativeInt, PositiveInt
from scipy.stats import qmc

from evaluation.studies.executor import Executor
from evaluation.studies.set_scores import SetScores, score_sets
from evaluation.studies.study_course import CELLS, StudyCourse, read_course
from ratslam.classic.batch import Network
from ratslam.classic.cell_batch import CellSets
from ratslam.core.precision import Precision, prepare_precision
from ratslam.runs.settings.run_config import load_config
from ratslam.runs.settings.strict_yaml import Document, override, validate
from ratslam.runs.settings.strict_yaml.document import Place
from tactile.base.atomic_write import flush_to_disk, write_atomically
from tactile.base.errors import os_errors_of
from tactile.base.random_streams import stream
from tactile.base.settings import Settings

FOLDER = "sets"
"""Name of the folder of a study's chunks."""


def _in_order(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError("must begin with the lower end")
    return ends


Range = Annotated[
    tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]], AfterValidator(_in_order)
]
Width = Annotated[
    tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]], AfterValidator(_in_order)
]


class CellPlan(Settings):
    """The settings of a study of many networks. Each range is [low, high]; equal ends fix a parameter."""

    sets: PositiveInt = 1000
    """Parameter sets: the first of a Halton sequence over the ranges, so that a larger study contains a
    smaller one."""
    views: bool = False
    """Whether views of the session inject energy; otherwise path integration alone."""
    steps: Annotated[int, Field(ge=2)] = 30_000
    """Most steps of the session to use."""
    excite_sigma: Width = (0.8, 1.2)
    """Standard deviation of excitation, cells."""
    inhibit_sigma: Width = (1.6, 2.4)
    """Standard deviation of inhibition, cells."""
    global_inhibition: Range = (0.0, 4e-5)
    """Activity subtracted from every cell at each sub-step."""
    energy: Range = (0.5, 2.0)
    """Factor on the energy that views inject."""
    speed_noise: Range = (0.0, 0.2)
    """Standard deviation of each step's motion, as a share of it."""
    heading_noise: Range = (0.0, 0.1)
    """Standard deviation of the heading, rad / sqrt(s)."""
    chosen: Annotated[tuple[NonNegativeInt, ...], Field(max_length=CELLS)] = ()
    """Cells whose rate maps are made, indices in the flattened network; none: eight on the way."""
    bins: Annotated[int, Field(ge=2, le=100)] = 20
    """Place bins along each side of the square round the path."""
    chunk: Annotated[int, Field(ge=1, le=1024)] = 32
    """Parameter sets of a job, whose scores are written together."""
    seed: NonNegativeInt = 0
    """Seed of the parameter sets and of the noise, which is the same for all sets apart from its size."""
    precision: Precision = "float32"
    """Floating-point type of the networks."""


PARAMETERS = ("excite_sigma", "inhibit_sigma", "global_inhibition", "energy", "speed_noise", "heading_noise")
"""Columns of parameter sets, and the ranges of a `CellPlan`."""


class CellStudy(NamedTuple):
    """A checked study. parameters: [sets, 6] in the order of `PARAMETERS`."""

    name: str
    plan: CellPlan
    course: StudyCourse
    parameters: np.ndarray


class CellTask(NamedTuple):
    """A chunk of n parameter sets [n, 6]. size: sets of a whole chunk, which are simulated together."""

    course: StudyCourse
    parameters: np.ndarray
    size: int
    precision: Precision

    @property
    def key(self) -> str:
        """Hash of all that decides the scores, apart from the code."""
        content = hashlib.sha256(f"{self.course.config!r} {self.size} {self.precision}".encode())
        for array in jax.tree.leaves((self.course[2:], self.parameters)):
            content.update(f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return content.hexdigest()[:16]


def cell_study(path: Path, overrides: Sequence[str] = ()) -> CellStudy:
    """The study of a configuration file; reads its session.

    Args:
        overrides: each `a.b=value`: a key of `CellPlan` where it is one, else of the configuration.

    Raises:
        InputError: a setting is invalid, or see `read_course`.
    """
    own = [text for text in overrides if text.partition("=")[0] in CellPlan.model_fields]
    empty = Document({}, {(): Place("--preset cells", "--preset cells")})
    plan = validate(override(empty, own), CellPlan)
    config = load_config(path, [text for text in overrides if text not in own])
    course = read_course(config, plan.steps, plan.views, plan.bins, plan.chosen, plan.seed)
    return CellStudy(f"{path.stem}-cells", plan, course, parameter_sets(plan))


def parameter_sets(plan: CellPlan) -> np.ndarray:
    """[sets, 6] parameters in the order of `PARAMETERS`: points of a scrambled Halton sequence (Owen 2017,
    arXiv:1706.02808)."""
    ends = np.array([getattr(plan, name) for name in PARAMETERS])
    share = qmc.Halton(len(PARAMETERS), rng=stream(plan.seed, "cells.sets")).random(plan.sets)
    return ends[:, 0] + share * (ends[:, 1] - ends[:, 0])


def run_cell_study(
    study: CellStudy, folder: Path, executor: Executor, done: Callable[[int], object] = lambda sets: None
) -> SetScores:
    """The scores of all parameter sets, in their order; each chunk is on disk before it counts as done.

    Args:
        folder: of the study; chunks found in its `FOLDER` are not computed again. done: called with the
            number of sets of each chunk.

    Raises:
        InputError: the folder cannot be written to, or the process of a chunk was killed.
    """
    files = {task.key: folder / FOLDER / f"{task.key}.npz" for task in tasks_of(study)}
    with os_errors_of(folder, "cannot be made", "a folder to write to"):
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    missing = []
    for task, path in zip(tasks_of(study), files.values(), strict=True):
        if path.exists():
            done(len(task.parameters))
        else:
            missing.append(task)
    with closing(executor.completed(score_task, missing)) as completed:
        for index, scores in completed:
            _write(files[missing[index].key], scores)
            done(len(missing[index].parameters))
    parts = [_read(path) for path in files.values()]
    return SetScores(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def tasks_of(study: CellStudy) -> list[CellTask]:
    """The chunks of a study."""
    plan = study.plan
    first = range(0, len(study.parameters), plan.chunk)
    rows = [study.parameters[k : k + plan.chunk] for k in first]
    return [CellTask(study.course, each, plan.chunk, plan.precision) for each in rows]


def score_task(task: CellTask) -> SetScores:
    """The scores of a chunk; a part of one is filled up, so that its bits do not depend on the number."""
    prepare_precision(task.precision)
    rows = np.arange(task.size).clip(max=len(task.parameters) - 1)
    columns = dict(zip(PARAMETERS, task.parameters[rows].T, strict=True))
    noise = columns.pop("speed_noise"), columns.pop("heading_noise")
    scores = score_sets(task.course, CellSets(Network(**columns), *noise), np.dtype(task.precision))
    return SetScores(*(column[: len(task.parameters)] for column in scores))


def _write(path: Path, scores: SetScores) -> None:
    def write(temporary: Path) -> None:
        np.savez_compressed(temporary, **scores._asdict())
        flush_to_disk(temporary)

    write_atomically(path, write)


def _read(path: Path) -> SetScores:
    with np.load(path) as found:
        return SetScores(**found)
