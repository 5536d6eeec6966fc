"""A study: a base configuration, its variations, and the runs that follow from them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import combinations, product
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import Document, load, override, validate
from ratslam.config.strict_yaml.document import KeyPath, Place
from ratslam.config.strict_yaml.reader import Reader
from ratslam.experiments.studies.config_hash import digest_of, seed_key, with_seed
from ratslam.experiments.studies.overrides import named, outermost_first, overlap, put
from ratslam.experiments.studies.records import run_key
from ratslam.experiments.studies.schema import SearchPlan, StudyPlan
from ratslam.keyframes.config import FULL, Ablation
from tactile.base.errors import InputError, InputErrors

MOST = 100_000
"""Largest number of jobs of a study."""
ROW_KEYS = ("copies", "ablation")
"""Keys of a row that are not settings."""


class Variant(NamedTuple):
    """One configuration of a study.

    Attributes:
        row: name of its row; '' if the study has no rows. varied: combination of `vary`, by key path.
        config: with absolute paths, under any seed. hash: of the configuration without its seed, and of the
            files it names.
    """

    row: str
    varied: dict[str, Any]
    config: RunConfig
    hash: str


class Job(NamedTuple):
    """One run of a study: a `Variant` with a seed.

    Attributes:
        copy_number: seed of the perturbed copy; 0: none. pace, reference_tier: see `StudyPlan`. ablation:
            parts of the keyframe map that are on.
    """

    row: str
    varied: dict[str, Any]
    config: RunConfig
    hash: str
    seed: int
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
            relative paths start. variants: all configurations.
    """

    name: str
    plan: StudyPlan
    document: Document
    base: Document
    folder: Path
    variants: tuple[Variant, ...]


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
    document = _overridden(document, overrides)
    plan = validate(document, StudyPlan)
    _unambiguous(plan, document)
    file = folder / plan.base
    base = load(file)
    for key in outermost_first(plan.set):
        base = put(base, key, plan.set[key], document, ("set", key))
    study = Study(name, plan, document, base, file.parent, ())
    if plan.tune is not None:
        _check_search(study, plan.tune)
    return study._replace(variants=tuple(_variants(study)))


def list_jobs(study: Study) -> list[Job]:
    """All jobs of a study: by row, combination, seed and perturbed copy."""
    return [job for variant in study.variants for job in jobs_of(variant, study.plan)]


def jobs_of(variant: Variant, plan: StudyPlan) -> list[Job]:
    """A configuration under every seed and copy."""
    row, varied, config, digest = variant
    how = plan.pace, plan.reference_tier, plan.ablation(row)
    return [
        Job(row, varied, with_seed(config, seed), digest, seed, copy_number, *how)
        for seed in plan.every_seed()
        for copy_number in plan.every_copy(row)
    ]


def variant_of(
    study: Study,
    settings: Sequence[tuple[str, Any, KeyPath]],
    row: str = "",
    varied: dict[str, Any] | None = None,
) -> Variant:
    """The study's base with further settings.

    Args:
        settings: key path, value, and where in the study file that was written.

    Raises:
        InputError: the result is not a valid configuration.
    """
    document = study.base
    for key, value, at in settings:
        document = put(document, key, value, study.document, at)
    config = validate(document, RunConfig).with_absolute_paths(study.folder.resolve())
    everywhere: list[tuple[str, Any, KeyPath]] = [
        (key, value, ("set", key)) for key, value in study.plan.set.items()
    ]
    for key, _, at in [*everywhere, *settings]:
        if key == seed_key(config):
            raise InputError(study.document.at_key(named(at)), "a seed", "the study's `seeds`")
    ablation = study.plan.ablation(row)
    parts = (study.plan.pace, study.plan.reference_tier, "" if ablation == FULL else repr(ablation))
    how = " ".join(filter(None, parts))
    return Variant(row, varied or {}, config, digest_of(config, how))


def searched_variant(study: Study, parameters: dict[str, Any]) -> Variant:
    """The study's base with chosen parameters, by key path.

    Raises:
        InputError: they contradict each other.
    """
    settings = [(key, value, ("tune", "parameters", key)) for key, value in parameters.items()]
    return variant_of(study, settings, "tune", parameters)


def _variants(study: Study) -> Iterator[Variant]:
    plan = study.plan
    rows = plan.rows or {"": {}}
    copies = sum(len(plan.every_copy(name)) for name in rows)
    total = copies * prod(map(len, plan.vary.values())) * len(plan.every_seed())
    if total > MOST:
        raise InputError(study.document.at_key(()), f"{total} jobs", f"at most {MOST}", "vary less at a time")
    wrong: dict[str, InputError] = {}
    for name, row in rows.items():
        row = {key: value for key, value in (row or {}).items() if key not in ROW_KEYS}
        fixed = [(key, row[key], ("rows", name, key)) for key in outermost_first(row)]
        for chosen in product(*(range(len(values)) for values in plan.vary.values())):
            picked = dict(zip(plan.vary, chosen, strict=True))
            varied = {key: plan.vary[key][k] for key, k in picked.items()}
            here: list[tuple[str, Any, KeyPath]] = [
                (key, varied[key], ("vary", key, k)) for key, k in picked.items()
            ]
            try:
                variant = variant_of(study, [*fixed, *here], name, varied)
            except InputError as error:
                each = error.errors if isinstance(error, InputErrors) else [error]
                wrong |= {str(one): one for one in each}
            else:
                yield variant
    if wrong:
        raise InputErrors(list(wrong.values()))


def _check_search(study: Study, plan: SearchPlan) -> None:
    """Validates each parameter at its extremes, with the others at their first."""
    first = {key: parameter.extremes[0] for key, parameter in plan.parameters.items()}
    for key, parameter in plan.parameters.items():
        for value in parameter.extremes:
            searched_variant(study, first | {key: value})


def _overridden(document: Document, overrides: Sequence[str]) -> Document:
    """The study with overrides; those of runs replace settings under `set`."""
    own = [text for text in overrides if text.partition("=")[0].split(".")[0] in StudyPlan.model_fields]
    document = override(document, own)
    runs = [text for text in overrides if text not in own]
    if not runs:
        return document
    settings = dict(validate(document, StudyPlan).set)
    places = document.places | {("set",): document.places.get(("set",), Place("--set", "--set"))}
    for assignment in runs:
        key, equals, text = assignment.partition("=")
        if not equals or not key:
            raise InputError(f"--set {key}", "no key and value", "key=value such as seeds=3")
        for other in [each for each in settings if f"{each}.".startswith(f"{key}.")]:
            del settings[other]
            places = {at: place for at, place in places.items() if at[:2] != ("set", other)}
        reader = Reader(text, lambda line, column: "--set", ("set", key))
        settings[key] = reader.read()
        places |= reader.places
    return Document(document.data | {"set": settings}, places)


def _unambiguous(plan: StudyPlan, document: Document) -> None:
    """Refuses settings that overwrite each other."""
    tuned = plan.tune.parameters if plan.tune else {}
    rows = {name: row or {} for name, row in plan.rows.items()}
    several: list[tuple[str, KeyPath]] = [(key, ("vary", key)) for key in plan.vary]
    pairs = list(combinations(several, 2))
    parameters: list[tuple[str, KeyPath]] = [(key, ("tune", "parameters", key)) for key in tuned]
    pairs += combinations(parameters, 2)
    for name, row in rows.items():
        in_row: list[tuple[str, KeyPath]] = [(key, ("rows", name, key)) for key in row]
        pairs += [(mine, other) for mine in several for other in in_row]
    for (first, _), (second, at) in pairs:
        if overlap(first, second):
            raise InputError(document.at_key(at), f"sets what {first!r} varies", "one or the other")
    for key, values in plan.vary.items():
        texts = [json.dumps(value, sort_keys=True) for value in values]
        twice = next((k for k, text in enumerate(texts) if text in texts[:k]), None)
        if twice is not None:
            raise InputError(
                document.at_value(("vary", key, twice)), f"{texts[twice]} given twice", "each once"
            )
    for key, _ in several:
        overridden = document.places.get(("set", key))
        if overridden and overridden.key == "--set":
            raise InputError(f"--set {key}", "varied by the study", "a setting of all runs")
