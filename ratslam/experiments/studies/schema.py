"""What a study file may say."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, NonNegativeInt, field_validator, model_validator

from ratslam.experiments.studies.metrics import DIRECTIONS, MAIN
from tactile.base.config import Settings


def _known(name: str) -> str:
    if name not in DIRECTIONS:
        near = get_close_matches(name, DIRECTIONS, n=1)
        cure = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(MAIN)} and others"
        raise ValueError(f"no quantity of that name; {cure}")
    return name


def _directed(name: str) -> str:
    if DIRECTIONS[name] is None:
        raise ValueError("neither large nor small is better; list it in minimise or maximise")
    return name


Values = Annotated[tuple[Any, ...], Field(min_length=1)]
Seeds = Annotated[tuple[NonNegativeInt, ...], Field(min_length=1)]
Known = Annotated[str, AfterValidator(_known)]
Directed = Annotated[Known, AfterValidator(_directed)]


class Parameter(Settings):
    """A setting to choose: a number from `low` to `high`, whole if both are written whole, or a choice."""

    low: int | float | None = None
    """Smallest value."""
    high: int | float | None = None
    """Largest value."""
    log: bool = False
    """Whether orders of magnitude count alike."""
    choices: Annotated[tuple[bool | int | float | str, ...], Field(min_length=2)] | None = None
    """These values, in no order."""

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
    def whole(self) -> bool:
        """Whether it is a whole number."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @property
    def extremes(self) -> tuple[Any, ...]:
        """The ends, or all choices: what has to be possible."""
        return (self.low, self.high) if self.choices is None else self.choices


class TunePlan(Settings):
    """What `--tune` looks for."""

    trials: Annotated[int, Field(ge=1, le=100_000)] = 50
    """Sets of parameters to try."""
    parameters: Annotated[dict[str, Parameter], Field(min_length=1)]
    """Which settings to choose, by key path, and out of what."""
    objectives: tuple[Directed, ...] = ()
    """Quantities to better, of which it is known whether large or small is better."""
    minimise: tuple[Known, ...] = ()
    """Quantities to make small."""
    maximise: tuple[Known, ...] = ()
    """Quantities to make large."""
    sampler: Literal["tpe", "nsga2"] = "tpe"
    """Tree-structured Parzen estimators (Bergstra et al. 2011), or a genetic algorithm (Deb et al. 2002)."""
    population: Annotated[int, Field(ge=2, le=10_000)] = 16
    """Of the genetic algorithm."""
    batch: Annotated[int, Field(ge=1, le=1000)] = 4
    """Sets chosen at a time, before any of them has run. What is chosen depends on it, and not on how many
    workers there are."""
    seed: NonNegativeInt = 0
    """Of the sampler."""

    @model_validator(mode="after")
    def _some(self) -> TunePlan:
        every = (*self.objectives, *self.minimise, *self.maximise)
        if not every:
            raise ValueError("no objectives; name quantities in objectives, minimise or maximise")
        if len(set(every)) < len(every):
            raise ValueError("a quantity named twice in objectives, minimise and maximise")
        return self

    def directions(self) -> dict[str, Literal["minimize", "maximize"]]:
        """Each objective, and whether to `minimize` or `maximize` it."""
        high = {*self.maximise, *(name for name in self.objectives if DIRECTIONS[name] == "high")}
        every = (*self.objectives, *self.minimise, *self.maximise)
        return {name: "maximize" if name in high else "minimize" for name in every}


class StudyPlan(Settings):
    """A study: `python -m ratslam sweep study.yaml`."""

    base: Path
    """The configuration of a run that all is varied from; a relative path starts at the study file."""
    set: dict[str, Any] = Field(default_factory=dict)
    """Settings of all runs, by key path. Relative paths in them start at the base, as its own do."""
    rows: dict[str, dict[str, Any] | None] = Field(default_factory=dict)
    """Named settings to compare, each by key path."""
    vary: dict[str, Values] = Field(default_factory=dict)
    """Settings to combine, each with its values: all combinations are run, of every row."""
    seeds: int | Seeds = 1
    """How many seeds, from 0 on, or which: of what is simulated, or of the session where nothing is."""
    pace: Literal["replay", "live"] = "replay"
    """Whether steps are taken and timed one at a time, as live, or a chunk at a time."""
    tune: TunePlan | None = None
    """What `--tune` looks for, from the base and `set`; rows and combinations are not part of it."""

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
