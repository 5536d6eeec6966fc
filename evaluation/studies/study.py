"""A study: a base configuration, its variations, and the runs that follow from them.

`StudyPlan` has the keys of a study file. Its settings are put into the base so that error messages name their
place in the study; a run is known by a hash of its configuration, by its seed and by its copy.
"""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import partial
from itertools import combinations, product
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeInt,
    field_validator,
    model_validator,
)

from evaluation.metrics.metric import Direction
from evaluation.studies.metrics import COLUMNS, METRICS
from ratslam.mapping.config import FULL, Ablation
from ratslam.runs.settings.packaged import find_config
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import Document, load, open_path, override, validate
from ratslam.runs.settings.yaml_document import Place
from tactile.base.errors import InputError, InputErrors, did_you_mean
from tactile.base.settings import KeyPath, Settings


def _quantity_name(name: str, *, directed: bool = False) -> str:
    """The name of a quantity, with `directed` of one of which large or small values are better."""
    if name not in METRICS:
        cure = did_you_mean(name, METRICS) or f"there are {', '.join(COLUMNS['means'])} and others"
        raise ValueError(f"no quantity of that name; {cure}")
    if directed and METRICS[name].direction is None:
        raise ValueError("neither large nor small is better; list it in minimise or maximise")
    return name


Values = Annotated[tuple[Any, ...], Field(min_length=1)]
Seeds = Annotated[tuple[NonNegativeInt, ...], Field(min_length=1)]
Copies = Annotated[int, Field(ge=0, le=10_000)]
Known = Annotated[str, AfterValidator(_quantity_name)]
Directed = Annotated[str, AfterValidator(partial(_quantity_name, directed=True))]


class Parameter(Settings):
    """Range of a searched setting: numbers from `low` to `high` (integers if both are), or `choices`."""

    low: int | float | None = None  # smallest value
    high: int | float | None = None  # largest value
    log: bool = False  # whether to sample the logarithm uniformly
    choices: Annotated[tuple[bool | int | float | str, ...], Field(min_length=2)] | None = None
    """Unordered values."""

    @model_validator(mode="after")
    def _either(self) -> Parameter:
        ends = [end for end in (self.low, self.high) if end is not None]
        if (self.choices is None) == (len(ends) < 2) or (self.choices is not None and ends):
            raise ValueError("give low and high, or choices")
        if ends and ends[0] >= ends[1]:
            raise ValueError(f"low {ends[0]:g} is not below high {ends[1]:g}")
        if self.log and (not ends or ends[0] <= 0):
            raise ValueError("log needs a low above 0")
        return self

    @property
    def extremes(self) -> tuple[Any, ...]:
        """The ends of the range, or all choices."""
        return (self.low, self.high) if self.choices is None else self.choices


class SearchPlan(Settings):
    """What `--search` optimises."""

    trials: Annotated[int, Field(ge=1, le=100_000)] = 50  # number of parameter sets to try
    parameters: Annotated[dict[str, Parameter], Field(min_length=1)]
    """Searched settings by key path, each with its range."""
    objectives: tuple[Directed, ...] = ()  # quantities to improve in their known direction
    minimise: tuple[Known, ...] = ()  # quantities to minimise
    maximise: tuple[Known, ...] = ()  # quantities to maximise
    sampler: Literal["tpe", "nsga2"] = "tpe"
    """Tree-structured Parzen estimators (Bergstra et al. 2011), or a genetic algorithm (Deb et al. 2002)."""
    population: Annotated[int, Field(ge=2, le=10_000)] = 16  # population of the genetic algorithm
    batch: Annotated[int, Field(ge=1, le=1000)] = 4
    """Parameter sets chosen at a time, before any of them has run. The choices depend on it, and not on the
    number of workers."""
    seed: NonNegativeInt = 0  # seed of the sampler

    @model_validator(mode="after")
    def _some(self) -> SearchPlan:
        every = (*self.objectives, *self.minimise, *self.maximise)
        if not every:
            raise ValueError("no objectives; name quantities in objectives, minimise or maximise")
        if len(set(every)) < len(every):
            raise ValueError("a quantity named twice in objectives, minimise and maximise")
        return self

    def directions(self) -> dict[str, Direction]:
        """The objectives, and which values of each are better."""
        given = {name: METRICS[name].direction for name in self.objectives}
        return given | dict.fromkeys(self.minimise, "low") | dict.fromkeys(self.maximise, "high")


class _RowPlan(Settings):
    """A row: settings by key path, and beside them two keys of its own."""

    model_config = ConfigDict(extra="allow")

    copies: Copies | None = None  # number of perturbed copies in place of the study's
    ablation: Ablation = FULL  # parts of the keyframe map that are on

    @property
    def settings(self) -> dict[str, Any]:
        """The settings alone."""
        return self.model_extra or {}


class StudyPlan(Settings):
    """A study: `python -m ratslam study CONFIG`."""

    base: Path  # configuration of all runs: a path, from the folder of the study file, or a packaged name
    set: dict[str, Any] = Field(default_factory=dict)
    """Settings of all runs, by key path. Relative paths in them start at the base, as its own do."""
    rows: dict[str, _RowPlan | None] = Field(default_factory=dict)
    """Named sets of settings to compare, by key path. A row may also hold `copies`, in place of the study's,
    and `ablation`: parts of the keyframe map that are off, such as {verify: false}."""
    vary: dict[str, Values] = Field(default_factory=dict)
    """Settings to combine, each with its values: every row runs with all combinations."""
    seeds: int | Seeds = 1
    """Number of seeds from 0 on, or a list of them: of the simulation, or of the session on a recording."""
    copies: Copies = 0
    """Number of perturbed copies of each session to run in place of the session itself; 0: the session."""
    pace: Literal["replay", "live"] = "replay"
    """`live`: steps are taken and timed one at a time; `replay`: a chunk at a time."""
    report: Literal["means", "medians", "differences", "costs", "tiers", "pareto"] = "means"
    """The table: means over seeds, medians over seeds, differences from the first row (of errors; of times),
    cost of simulation, or speed against error; for the last, runs are measured one at a time in processes of
    their own."""
    limit: float | None = None
    """Largest final ATE of a row that counts as kept in `differences`, m; default 1.25 of the first row's."""
    reference_tier: Literal["kinematic", "quasistatic", "dynamic"] | None = None
    """Fidelity of simulation whose images the images of each run are compared with."""
    tune: SearchPlan | None = None
    """What `--search` optimises, from the base and `set`; rows and combinations are not part of it."""

    @field_validator("seeds", mode="after")
    @classmethod
    def _some(cls, seeds: int | tuple[int, ...]) -> int | tuple[int, ...]:
        if isinstance(seeds, int):
            if not 1 <= seeds <= 10_000:
                raise ValueError("give a number from 1 to 10000, or a list of seeds")
        elif len(set(seeds)) < len(seeds):
            raise ValueError("a seed given twice")
        return seeds

    def every_seed(self) -> tuple[int, ...]:
        """The seeds themselves."""
        return tuple(range(self.seeds)) if isinstance(self.seeds, int) else self.seeds

    def every_row(self) -> dict[str, _RowPlan]:
        """The rows; one without a name where the study has none."""
        return {name: row or _RowPlan() for name, row in (self.rows or {"": None}).items()}

    def every_copy(self, row: _RowPlan) -> tuple[int, ...]:
        """Seeds of a row's perturbed copies; (0,): the session itself."""
        copies = self.copies if row.copies is None else row.copies
        return tuple(range(1, copies + 1)) or (0,)


Model = TypeVar("Model", bound=BaseModel)
Preset = TypeVar("Preset", bound=Settings)
MOST = 100_000  # largest number of jobs of a study
SEEDS = {part: f"{part}.seed" for part in ("simulation", "create_simulation", "rat_simulation")}
SEEDS |= {"recording": "session.seed"}
"""Key path that `seeds` sets, by kind of source."""


class Job(NamedTuple):
    """One run of a study."""

    row: str  # name of its row; '' if the study has no rows
    varied: dict[str, Any]  # combination of `vary`, by key path
    config: RunConfig  # with absolute paths
    hash: str = ""  # of the configuration without its seed, and of the files it names
    seed: int = 0
    copy_number: int = 0  # seed of the perturbed copy; 0: none
    pace: str = "replay"  # see `StudyPlan`
    reference_tier: str | None = None  # see `StudyPlan`
    ablation: Ablation = FULL  # parts of the keyframe map that are on

    @property
    def key(self) -> str:
        """Identifies the run: two jobs with one key are the same."""
        return run_key(self.hash, self.seed, self.copy_number)


_Setting = tuple[str, Any, KeyPath]
"""A dotted key of a configuration, its value, and the path in the study where that is written."""


class Study(NamedTuple):
    """A checked study."""

    name: str  # file name without its ending
    plan: StudyPlan  # content of the file with overrides
    document: Document  # the same, with places
    base: Document  # the base with `set` applied, with places
    folder: Path  # of the base, where its relative paths start
    overridden: Sequence[str]  # keys of `--set` that are settings of all runs
    jobs: tuple[Job, ...]  # by row, combination, seed and perturbed copy


def run_key(hash: str, seed: int, copy_number: int) -> str:
    """The key of a run."""
    return f"{hash}-{seed}-{copy_number}" if copy_number else f"{hash}-{seed}"


def read_study(path: str | Path, overrides: Sequence[str] = ()) -> Study:
    """The study in a file; see `check_study`."""
    return check_study(Path(path).stem, load(path), Path(path).parent, overrides)


def check_study(name: str, document: Document, folder: Path, overrides: Sequence[str] = ()) -> Study:
    """A study all of whose configurations are valid, else an `InputError`.

    Args:
        folder: start of a relative path of `base`. overrides: each `a.b=value`: a key of the study where `a`
            is one, else a setting of all runs.
    """
    document = override(document, [text for text in overrides if is_study_key(text)])
    plan = validate(document, StudyPlan)
    of_runs = [text for text in overrides if not is_study_key(text)]
    keys = [text.partition("=")[0] for text in of_runs]
    _check_unambiguous(plan, document, keys)
    file = find_config(plan.base, folder)
    base = load(file)
    for key in _outermost_first(plan.set):
        base = _put(base, (key, plan.set[key], ("set", key)), document)
    study = Study(name, plan, document, override(base, of_runs), file.parent, keys, ())
    parameters = plan.tune.parameters if plan.tune else {}
    first = {key: parameter.extremes[0] for key, parameter in parameters.items()}
    for key, parameter in parameters.items():
        for value in parameter.extremes:
            searched_jobs(study, first | {key: value})
    return study._replace(jobs=tuple(_jobs(study)))


def searched_jobs(study: Study, parameters: dict[str, Any]) -> list[Job]:
    """The runs of the study's base with parameters by key path; an `InputError` if they are contradictory."""
    found: list[_Setting] = [(key, value, ("tune", "parameters", key)) for key, value in parameters.items()]
    return list(_runs_of(study, found, "tune", _RowPlan(), parameters))


def _jobs(study: Study) -> Iterator[Job]:
    plan, rows = study.plan, study.plan.every_row()
    copies = sum(len(plan.every_copy(row)) for row in rows.values())
    total = copies * prod(map(len, plan.vary.values())) * len(plan.every_seed())
    if total > MOST:
        raise InputError(study.document.at_key(()), f"{total} jobs", f"at most {MOST}", "vary less at a time")
    alternatives: list[list[_Setting]] = []
    for key, values in plan.vary.items():
        alternatives.append([(key, value, ("vary", key, k)) for k, value in enumerate(values)])
    wrong: dict[str, InputError] = {}
    for name, row in rows.items():
        keys = _outermost_first(row.settings)
        fixed: list[_Setting] = [(key, row.settings[key], ("rows", name, key)) for key in keys]
        for varied in product(*alternatives):
            try:
                yield from _runs_of(study, [*fixed, *varied], name, row, {key: v for key, v, _ in varied})
            except InputError as error:
                each = error.errors if isinstance(error, InputErrors) else [error]
                wrong |= {str(one): one for one in each}
    if wrong:
        raise InputErrors(list(wrong.values()))


def _runs_of(
    study: Study, settings: Sequence[_Setting], name: str, row: _RowPlan, varied: dict[str, Any]
) -> Iterator[Job]:
    """The study's base with further settings, under every seed and copy."""
    plan, document = study.plan, study.base
    for setting in settings:
        document = _put(document, setting, study.document)
    config = validate(document, RunConfig).with_absolute_paths(study.folder.resolve())
    keys = {key: study.document.at_key(("set", key)) for key in plan.set}
    keys |= {key: f"--set {key}" for key in study.overridden}
    keys |= {key: study.document.at_key(_without_index(at)) for key, _, at in settings}
    if seed_key(config) in keys:
        raise InputError(keys[seed_key(config)], "a seed", "the study's `seeds`")
    parts = (plan.pace, plan.reference_tier, "" if row.ablation == FULL else repr(row.ablation))
    digest = _digest_of(config, " ".join(filter(None, parts)))
    for seed, copy_number in product(plan.every_seed(), plan.every_copy(row)):
        seeded = with_settings(config, {seed_key(config): seed})
        how = plan.pace, plan.reference_tier, row.ablation
        yield Job(name, varied, seeded, digest, seed, copy_number, *how)


def _put(document: Document, setting: _Setting, study: Document) -> Document:
    """The document with a setting of the study; raises an `InputError` if there is no such key."""
    key, value, at = setting
    where = study.at_key(at)
    if "=" in key or not all(key.split(".")):
        raise InputError(where, "not a key path", "names joined by dots, such as pose_cells.cells_xy")
    data = copy.deepcopy(document.data)
    section, path = open_path(data, key, where)
    section[path[-1]] = copy.deepcopy(value)
    key_place, value_place = (study.places[study.nearest(each)] for each in (_without_index(at), at))
    here = Place(key_place.key, value_place.value)
    places = {each: place for each, place in document.places.items() if each[: len(path)] != path}
    for length in range(1, len(path)):
        places.setdefault(path[:length], here)
    own = {(*path, *each[len(at) :]): place for each, place in study.places.items() if each[: len(at)] == at}
    return Document(data, places | own | {path: here})


def _without_index(at: KeyPath) -> KeyPath:
    """The path without the index of a value in a list."""
    return at[:-1] if isinstance(at[-1], int) else at


def _outermost_first(keys: Iterable[str]) -> list[str]:
    """Sections before their keys, so that the result does not depend on the order of writing."""
    return sorted(keys, key=lambda key: (key.count("."), key))


def is_study_key(assignment: str) -> bool:
    """Whether `a.b=value` sets a key of the study; else it is a setting of all runs."""
    return assignment.partition("=")[0].split(".")[0] in StudyPlan.model_fields


def preset_settings(plan: type[Preset], name: str, overrides: Sequence[str]) -> tuple[Preset, list[str]]:
    """The settings of a preset that is no study file, and the overrides `a.b=value` of the configuration:
    those that set no key of the preset."""
    own = [text for text in overrides if text.partition("=")[0] in plan.model_fields]
    empty = Document({}, {(): Place(f"--preset {name}", f"--preset {name}")})
    return validate(override(empty, own), plan), [text for text in overrides if text not in own]


def _check_unambiguous(plan: StudyPlan, document: Document, overridden: Collection[str]) -> None:
    """Raises an `InputError` if one key contains another, or a value is given twice.

    Args:
        overridden: keys of `--set` that are settings of all runs.
    """
    parameters = {key: ("tune", "parameters", key) for key in (plan.tune.parameters if plan.tune else ())}
    rows = [(key, ("rows", name, key)) for name, row in plan.every_row().items() for key in row.settings]
    vary = {key: ("vary", key) for key in plan.vary}
    pairs: list[Any] = [*combinations(vary.items(), 2), *combinations(parameters.items(), 2)]
    for (first, _), (second, at) in [*pairs, *product(vary.items(), rows)]:
        if f"{first}.".startswith(f"{second}.") or f"{second}.".startswith(f"{first}."):
            raise InputError(document.at_key(at), f"sets what {first!r} varies", "one or the other")
    for key, values in plan.vary.items():
        texts = [json.dumps(value, sort_keys=True) for value in values]
        twice = next((k for k, text in enumerate(texts) if text in texts[:k]), None)
        if twice is not None:
            where = document.at_value(("vary", key, twice))
            raise InputError(where, f"{texts[twice]} given twice", "each once")
        if key in overridden:
            raise InputError(f"--set {key}", "varied by the study", "a setting of all runs")


def with_settings(config: Model, settings: dict[str, Any]) -> Model:
    """The configuration with values at key paths, which are not validated."""
    for key, value in settings.items():
        name, _, rest = key.partition(".")
        inner = with_settings(getattr(config, name), {rest: value}) if rest else value
        config = config.model_copy(update={name: inner})
    return config


def seed_key(config: RunConfig) -> str:
    """The key path that `seeds` sets."""
    return next(key for part, key in SEEDS.items() if getattr(config, part) is not None)


def _digest_of(config: RunConfig, how: str) -> str:
    """Hash of a configuration with absolute paths, without its seed.

    It covers all values, which of them were given (others may be completed from the source), and the content
    of each file that the configuration names.
    """
    section, _, name = seed_key(config).partition(".")
    parts = [config.model_dump(), config.model_dump(exclude_unset=True)]
    for part in parts:
        part.get(section, {}).pop(name, None)
    text = json.dumps([*parts, how], sort_keys=True, default=_content)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


_CONTENT: dict[tuple[Path, int, int], str] = {}
"""Digests of files by path, time of modification and size."""


def _content(path: Path) -> str:
    """The sha256 of a file's content; the path of what is not a file."""
    try:
        stat = path.stat()
        if not path.is_file():
            return str(path)
        key = path, stat.st_mtime_ns, stat.st_size
        if key not in _CONTENT:
            with path.open("rb") as file:
                _CONTENT[key] = hashlib.file_digest(file, "sha256").hexdigest()
        return _CONTENT[key]
    except OSError:
        return str(path)
