"""Stand-in for the functions of `import ratslam` that the examples use, until the package has them."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.scorecard import Scorecard
from ratslam.backends.registry import BACKENDS
from ratslam.config import run_config
from ratslam.config.completion import complete
from ratslam.config.run_config import RunConfig
from ratslam.pipeline.run import run as run_to_directory
from ratslam.pipeline.runner import build_session
from ratslam.pipeline.source import open_source as open_source
from robot.sources.source import Sample, Source
from robot.touch_source import observation_of, open_touch_source


class Result(NamedTuple):
    """What `run` returns."""

    scorecard: Scorecard


def load_config(path: str, assignments: Sequence[str] = ()) -> RunConfig:
    """As `ratslam.load_config`."""
    return run_config.load_config(Path(__file__).parents[2] / "configs" / f"{path}.yaml", assignments)


def run(config: RunConfig) -> Result:
    """As `ratslam.run`."""
    with tempfile.TemporaryDirectory() as folder:
        return Result(run_to_directory(config, Path(folder) / "run")[0])


class PoseEstimate(NamedTuple):
    """What `Slam.step` returns."""

    pose: np.ndarray
    outcome: str


class Slam:
    """As `ratslam.Slam`, for a source of readings whose front end turns each into an observation."""

    def __init__(self, config: RunConfig, info: Source) -> None:
        self.config = complete(config, info)
        observed = open_touch_source(info, self.config.touch)
        self.session = build_session(self.config, observed)
        self._observe = observed._start().observe  # type: ignore[attr-defined]

    def step(self, reading: Sample) -> PoseEstimate:
        """As `ratslam.Slam.step`."""
        step = self.session.step(observation_of(reading._replace(reading=self._observe(reading.reading))))
        outcomes = BACKENDS.get(self.config.backend, "backend").outcomes
        return PoseEstimate(step.pose, outcomes(int(step.evidence.outcome)).name.lower())
