"""Systematic errors of wheel odometry from a record without true poses: the calibration that its map finds.

The keyframe map solves for a heading bias and an error of turns with its poses (`ratslam.keyframes`), because
loops do not close without them. A scale of all distances changes the size of the map and closes every loop as
well: revisits do not tell it.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import load
from ratslam.pipeline.build_session import build_session
from ratslam.pipeline.source import open_observations
from robot.touch_source import observation_of


class RevisitFit(NamedTuple):
    """What the map of a record knows of the odometry, each as (value, standard deviation).

    Attributes:
        heading_bias: rad/m. turn_scale: true turn over that of the odometry; None where the map has no error
            of turns. doubt: probability that the map is worse than the odometry. closures: number of accepted
        loop closures.
    """

    heading_bias: tuple[float, float]
    turn_scale: tuple[float, float] | None
    doubt: float
    closures: int


def fit_revisits(config: RunConfig) -> RevisitFit | None:
    """Maps the record of a configuration; None if the map closes no loops, is doubted or has no calibration.

    Raises:
        InputError: the record cannot be mapped.
    """
    with open_observations(config) as (completed, source):
        session = build_session(completed, source)
        for _ in session.replay(observation_of(sample) for sample in source):
            pass
    write = session.map.files().get("calibration.yaml")
    closures = len(session.map.closures())
    if write is None or not closures:
        return None
    with TemporaryDirectory() as folder:
        file = Path(folder) / "calibration.yaml"
        write(file)
        found = load(file).data["keyframes"]["calibration"]
    turn = (1 + found["turn_error"], found["turn_error_sd"]) if "turn_error" in found else None
    bias = found["heading_bias"], found["heading_bias_sd"]
    return RevisitFit(bias, turn, float(session.map.final_doubt()), closures)
