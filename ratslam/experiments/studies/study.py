"""A study: a base configuration, its variations, and the runs that follow from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import Document, load, override, validate
from ratslam.experiments.studies.config_hash import digest_of, seed_key, with_seed
from ratslam.experiments.studies.overrides import (
    Setting,
    check_unambiguous,
    is_study_key,
    outermost_first,
    put,
    without_index,
)
from ratslam.experiments.studies.schema import RowPlan, SearchPlan, StudyPlan
from ratslam.keyframes.config import FULL, Ablation
from tactile.base.errors import InputError, InputErrors

MOST = 100_000
"""Largest number of jobs of a study."""


class Job(NamedTuple):
    """One run of a study.

    Attributes:
        row: name of its row; '' if the study has no rows. varied: combination of `vary`, by key path.
        config: with absolute paths. hash: of the configuration without its seed, and of the files it names.
        copy_number: seed of the perturbed copy; 0: none. pace, reference_tier: see `StudyPlan`. ablation:
            parts of the keyframe map that are on.
    """

    row: str
    varied: dict[str, Any]
    config: RunConfig
    hash: str = ""
    seed: int = 0
    copy_number: int = 0
    pace: str = "replay"
    reference_tier: str | None = None
    ablation: Ablation = FULL

    @property
    def key(self) -> str:
        """Identifies the run: two jobs with one key are the same."""
        return run_key(self.hash, self.seed, self.copy_number)


class Study(NamedTuple):
    """A checked study.

    Attributes:
        name: file name without its ending. plan: content of the file with overrides. document: the same, with
            places. base: the base with `set` applied, with places. folder: folder of the base, where its
            relative paths start. overridden: keys of `--set` that are settings of all runs. jobs: by row,
            combination, seed and perturbed copy.
    """

    name: str
    plan: StudyPlan
    document: Document
    base: Document
    folder: Path
    overridden: Sequence[str]
    jobs: tuple[Job, ...]


def run_key(hash: str, seed: int, copy_number: int) -> str:
    """The key of a run."""
    return f"{hash}-{seed}-{copy_number}" if copy_number else f"{hash}-{seed}"


def read_study(path: str | Path, overrides: Sequence[str] = ()) -> Study:
    """The study in a file; see `check_study`."""
    return check_study(Path(path).stem, load(path), Path(path).parent, overrides)


def check_study(name: str, document: Document, folder: Path, overrides: Sequence[str] = ()) -> Study:
    """A study all of whose configurations are valid.

    Args:
        folder: start of a relative path of `base`. overrides: each `a.b=value`: a key of the study where `a`
            is one, else a setting of all runs.

    Raises:
        InputError: the file, the base or one of the configurations is invalid.
    """
    document = override(document, [text for text in overrides if is_study_key(text)])
    plan = validate(document, StudyPlan)
    of_runs = [text for text in overrides if not is_study_key(text)]
    keys = [text.partition("=")[0] for text in of_runs]
    check_unambiguous(plan, document, keys)
    file = folder / plan.base
    base = load(file)
    for key in outermost_first(plan.set):
        base = put(base, Setting(key, plan.set[key], ("set", key)), document)
    study = Study(name, plan, document, override(base, of_runs), file.parent, keys, ())
    if plan.tune is not None:
        _check_search(study, plan.tune)
    return study._replace(jobs=tuple(_jobs(study)))


def searched_jobs(study: Study, parameters: dict[str, Any]) -> list[Job]:
    """The runs of the study's base with chosen parameters, by key path.

    Raises:
        InputError: they contradict each other.
    """
    settings = [Setting(key, value, ("tune", "parameters", key)) for key, value in parameters.items()]
    return list(_runs_of(study, settings, "tune", RowPlan(), parameters))


def _jobs(study: Study) -> Iterator[Job]:
    plan, rows = study.plan, study.plan.every_row()
    copies = sum(len(plan.every_copy(row)) for row in rows.values())
    total = copies * prod(map(len, plan.vary.values())) * len(plan.every_seed())
    if total > MOST:
        raise InputError(study.document.at_key(()), f"{total} jobs", f"at most {MOST}", "vary less at a time")
    wrong: dict[str, InputError] = {}
    for name, row in rows.items():
        fixed = [
            Setting(key, row.settings[key], ("rows", name, key)) for key in outermost_first(row.settings)
        ]
        for chosen in product(*(range(len(values)) for values in plan.vary.values())):
            varied = [
                Setting(key, plan.vary[key][k], ("vary", key, k))
                for key, k in zip(plan.vary, chosen, strict=True)
            ]
            try:
                yield from _runs_of(study, [*fixed, *varied], name, row, {key: v for key, v, _ in varied})
            except InputError as error:
                each = error.errors if isinstance(error, InputErrors) else [error]
                wrong |= {str(one): one for one in each}
    if wrong:
        raise InputErrors(list(wrong.values()))


def _runs_of(
    study: Study, settings: Sequence[Setting], name: str, row: RowPlan, varied: dict[str, Any]
) -> Iterator[Job]:
    """The study's base with further settings, under every seed and copy."""
    plan, document = study.plan, study.base
    for setting in settings:
        document = put(document, setting, study.document)
    config = validate(document, RunConfig).with_absolute_paths(study.folder.resolve())
    keys = {key: study.document.at_key(("set", key)) for key in plan.set}
    keys |= {key: f"--set {key}" for key in study.overridden}
    keys |= {each.key: study.document.at_key(without_index(each.at)) for each in settings}
    if seed_key(config) in keys:
        raise InputError(keys[seed_key(config)], "a seed", "the study's `seeds`")
    parts = (plan.pace, plan.reference_tier, "" if row.ablation == FULL else repr(row.ablation))
    digest = digest_of(config, " ".join(filter(None, parts)))
    for seed, copy_number in product(plan.every_seed(), plan.every_copy(row)):
        yield Job(
            name, varied, with_seed(config, seed), digest, seed, copy_number,
            plan.pace, plan.reference_tier, row.ablation,
        )  # fmt: skip


def _check_search(study: Study, plan: SearchPlan) -> None:
    """Validates each parameter at its extremes, with the others at their first."""
    first = {key: parameter.extremes[0] for key, parameter in plan.parameters.items()}
    for key, parameter in plan.parameters.items():
        for value in parameter.extremes:
            searched_jobs(study, first | {key: value})
