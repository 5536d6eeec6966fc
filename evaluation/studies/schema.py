"""The keys of a study file."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, NonNegativeInt, field_validator, model_validator

from evaluation.metrics.metric import Direction
from evaluation.studies.metrics import COLUMNS, METRICS
from ratslam.mapping.config import FULL, Ablation
from tactile.base.settings import Settings


def _known(name: str) -> str:
    if name not in METRICS:
        near = get_close_matches(name, METRICS, n=1)
        cure = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(COLUMNS['means'])} and others"
        raise ValueError(f"no quantity of that name; {cure}")
    return name


def _directed(name: str) -> str:
    if METRICS[name].direction is None:
        raise ValueError("neither large nor small is better; list it in minimise or maximise")
    return name


Values = Annotated[tuple[Any, ...], Field(min_length=1)]
Seeds = Annotated[tuple[NonNegativeInt, ...], Field(min_length=1)]
Copies = Annotated[int, Field(ge=0, le=10_000)]
Known = Annotated[str, AfterValidator(_known)]
Directed = Annotated[Known, AfterValidator(_directed)]


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


class RowPlan(Settings):
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
    rows: dict[str, RowPlan | None] = Field(default_factory=dict)
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

    def every_row(self) -> dict[str, RowPlan]:
        """The rows; one without a name where the study has none."""
        return {name: row or RowPlan() for name, row in (self.rows or {"": None}).items()}

    def every_copy(self, row: RowPlan) -> tuple[int, ...]:
        """Seeds of a row's perturbed copies; (0,): the session itself."""
        copies = self.copies if row.copies is None else row.copies
        return tuple(range(1, copies + 1)) or (0,)
