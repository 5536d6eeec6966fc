"""A session as a recipe, and the recorded session that it makes."""

from __future__ import annotations

from hashlib import sha256
from typing import Any, NamedTuple

import numpy as np

from evaluation.papers.trials.touch_trial import collect_session
from ratslam.runs.open_source import open_observations
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.in_memory import InMemorySource, cut_log, load_into_memory
from tactile.base.errors import InputError
from tactile.base.random_streams import stream


class Recipe(NamedTuple):
    """How a session is made: a configuration, and the steps of its source from `first` up to but without
    `last` (None: to the end)."""

    config: RunConfig
    first: int = 0
    last: int | None = None

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the recipe."""
        text = f"{self.config.model_dump_json()} {self.first} {self.last}"
        return sha256(text.encode()).hexdigest()


class Recorded(NamedTuple):
    """A recorded session.

    Attributes:
        config: completed by its source. log: of observations, with the true pose of each step, rows of NaN
            where it is not known.
    """

    config: RunConfig
    log: InMemorySource

    @property
    def truth(self) -> np.ndarray:
        """[T, 3] true poses (m, m, rad), NaN where unknown."""
        assert self.log.truth is not None
        return self.log.truth


def record(recipe: Recipe) -> Recorded:
    """The session of a recipe; the same recipe gives the same bits.

    Raises:
        InputError: the source cannot be read or simulated, or has no true poses.
    """
    if recipe.config.simulation is not None:
        config, log = collect_session(recipe.config)
    else:
        with open_observations(recipe.config) as (config, source):
            log = load_into_memory(source)
        if log.truth is None:
            raise InputError(log.name, "no true poses", "a recording with truth")
    return Recorded(config, cut_log(log, recipe.first, recipe.last))


def draw_seed(maze: int, name: str) -> int:
    """Seed of a further session of a maze; sessions of different names are independent."""
    return int(stream(maze, f"atlas.{name}").integers(1 << 31))


def touch_config(maze: int, seed: int, settings: dict[str, Any], keyframes: dict[str, Any]) -> RunConfig:
    """The configuration of a whisker session.

    Args:
        maze: seed of the maze. seed: of everything else. settings: further ones of `simulation`; those of
            `maze` are added to its seed. keyframes: settings of the map.
    """
    parts = settings | {"seed": seed, "maze": {"seed": maze} | settings.get("maze", {})}
    return RunConfig.model_validate({"simulation": parts, "keyframes": keyframes, "backend": "recall"})
