"""A study: a configuration, what is varied of it, and the jobs that come of that."""

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
from ratslam.experiments.studies.schema import StudyPlan, TunePlan
from tactile.base.errors import InputError, InputErrors

MOST = 100_000
"""Jobs of a study."""


class Variant(NamedTuple):
    """One configuration of a study.

    Attributes:
        row: its name, '' where a study names none. varied: the combination, by key path. config: with whole
            paths, under some seed. hash: of the configuration without its seed, and of the files it names.
    """

    row: str
    varied: dict[str, Any]
    config: RunConfig
    hash: str


class Job(NamedTuple):
    """One run of a study; attributes as of a `Variant`, the configuration under this seed.

    Attributes:
        pace: `replay` or `live`.
    """

    row: str
    varied: dict[str, Any]
    config: RunConfig
    hash: str
    seed: int
    pace: str = "replay"

    @property
    def key(self) -> str:
        """The name of its result: two jobs of one key are the same."""
        return f"{self.hash}-{self.seed}"


class Study(NamedTuple):
    """A study that has been checked.

    Attributes:
        name: the file's, without its ending. plan: what the file says, overrides included. document: the
            same, with places. base: the base with `set` applied, with places. folder: of the base; its
            relative paths start there. variants: all configurations.
    """

    name: str
    plan: StudyPlan
    document: Document
    base: Document
    folder: Path
    variants: tuple[Variant, ...]


def read_study(path: str | Path, overrides: Sequence[str] = ()) -> Study:
    """The study in a file, every configuration of it checked.

    Args:
        overrides: each `a.b=value`: of the study itself where `a` is one of its keys, else of all runs.

    Raises:
        InputError: it cannot be read, or some configuration of it is none; nothing has run by then.
    """
    document = _overridden(load(path), overrides)
    plan = validate(document, StudyPlan)
    _unambiguous(plan, document)
    file = Path(path).parent / plan.base
    base = load(file)
    for key in outermost_first(plan.set):
        base = put(base, key, plan.set[key], document, ("set", key))
    study = Study(Path(path).stem, plan, document, base, file.parent, ())
    if plan.tune is not None:
        _check_tuning(study, plan.tune)
    return study._replace(variants=tuple(_variants(study)))


def jobs(study: Study) -> list[Job]:
    """All jobs of a study: rows, in each all combinations, in each all seeds."""
    return [job for variant in study.variants for job in seeded(variant, study.plan)]


def seeded(variant: Variant, plan: StudyPlan) -> list[Job]:
    """A configuration under every seed."""
    row, varied, config, digest = variant
    return [Job(row, varied, with_seed(config, seed), digest, seed, plan.pace) for seed in plan.every_seed()]


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
        InputError: that is no configuration.
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
    return Variant(row, varied or {}, config, digest_of(config, study.plan.pace))


def tuned(study: Study, parameters: dict[str, Any]) -> Variant:
    """The study's base with a choice of what it tunes, by key path.

    Raises:
        InputError: these cannot be together.
    """
    settings = [(key, value, ("tune", "parameters", key)) for key, value in parameters.items()]
    return variant_of(study, settings, "tune", parameters)


def made(directory: Path) -> None:
    """Makes a directory where there is none.

    Raises:
        InputError: it cannot be made.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        found = f"cannot be made ({error.strerror})"
        raise InputError(str(directory), found, "a folder to write to") from None


def _variants(study: Study) -> Iterator[Variant]:
    plan = study.plan
    rows = plan.rows or {"": {}}
    total = len(rows) * prod(map(len, plan.vary.values())) * len(plan.every_seed())
    if total > MOST:
        raise InputError(study.document.at_key(()), f"{total} jobs", f"at most {MOST}", "vary less at a time")
    wrong: dict[str, InputError] = {}
    for name, row in rows.items():
        row = row or {}
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


def _check_tuning(study: Study, plan: TunePlan) -> None:
    """Every parameter at the ends of what it may be, or at each of its choices; the others at their first."""
    first = {key: parameter.extremes[0] for key, parameter in plan.parameters.items()}
    for key, parameter in plan.parameters.items():
        for value in parameter.extremes:
            tuned(study, first | {key: value})


def _overridden(document: Document, overrides: Sequence[str]) -> Document:
    """The study with overrides; those of runs are put under `set`, in the place of what they replace."""
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
    """Refuses settings that would overwrite each other."""
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
        told = [json.dumps(value, sort_keys=True) for value in values]
        twice = next((k for k, text in enumerate(told) if text in told[:k]), None)
        if twice is not None:
            raise InputError(
                document.at_value(("vary", key, twice)), f"{told[twice]} given twice", "each once"
            )
    for key, _ in several:
        overridden = document.places.get(("set", key))
        if overridden and overridden.key == "--set":
            raise InputError(f"--set {key}", "varied by the study", "a setting of all runs")
