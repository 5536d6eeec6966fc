"""The estimate of a pose with its covariance, place and health, as users of the library get it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from evaluation.metrics.run_metrics import DOUBTED
from ratslam.core.session import Step


class Health(NamedTuple):
    """How far input and map can be believed, judged without truth.

    Attributes:
        doubt: probability that the map's error is worse than odometry's, which no warning changes; NaN if the
            method does not judge it, or no loop closure is accepted.
        reason: of a run, why it is NaN; else ''. warnings: about the input, a sentence each.
    """

    doubt: float = np.nan
    reason: str = ""
    warnings: tuple[str, ...] = ()

    @property
    def input(self) -> str:
        """The verdict on the input, `clean` or `warned`; one that is refused makes no result."""
        return "warned" if self.warnings else "clean"

    @property
    def doubted(self) -> bool:
        """Whether the map is more likely bad than the limit of `evaluation.metrics.run_metrics` allows; final
        trajectories are then odometry."""
        return self.doubt > DOUBTED


class PoseEstimate(NamedTuple):
    """The robot's pose after a step.

    Attributes:
        pose: [3] in the map frame at that time: x m, y m, heading rad.
        covariance: [3, 3] of the pose in the map frame, m², m rad, rad²: the spread of the backend's
            estimate, without the uncertainty of the map.
        place: id of the current place, -1 before the first and for methods without places.
        outcome: what the method did in this step, by name, as in `steps.csv`; "" before the first.
        health: of the map, judged some steps ago.
        lost: whether the method has lost track of the robot's position.
    """

    pose: np.ndarray
    covariance: np.ndarray
    place: int
    outcome: str
    health: Health
    lost: bool

    @classmethod
    def of_step(cls, step: Step, outcome: str, warnings: tuple[str, ...] = ()) -> PoseEstimate:
        """The estimate of a session's step.

        Args:
            outcome: name of the outcome in the step's evidence. warnings: about the input.
        """
        estimate = step.estimate
        pose = np.array(step.pose, np.float64)
        # The spread is along the axes of the backend's own frame, which may be turned against the map's.
        turn = pose[2] - float(estimate.pose[2])
        cos, sin = np.cos(turn), np.sin(turn)
        rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        spread = rotation * np.asarray(estimate.spread, np.float64)
        health = Health(float(step.doubt), warnings=warnings)
        return cls(pose, spread @ spread.T, int(estimate.place), outcome, health, bool(estimate.lost))

    def arrays(self) -> dict[str, np.ndarray]:
        """The estimate as arrays of a file."""
        named = self._asdict()
        named["doubt"] = named.pop("health").doubt
        return {name: np.array(value) for name, value in named.items()}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray]) -> PoseEstimate:
        """The estimate of `arrays`; that before the first step if there are none.

        Raises:
            KeyError, ValueError: arrays are missing or of other shapes.
        """
        if not arrays:
            return START
        for name, like in START.arrays().items():
            found = arrays[name]
            if found.shape != like.shape or found.dtype.kind != like.dtype.kind:
                raise ValueError(f"{name} of the estimate: {found.dtype} of shape {found.shape}")
        pose, covariance = np.array(arrays["pose"]), np.array(arrays["covariance"])
        place, outcome, doubt = int(arrays["place"]), str(arrays["outcome"]), float(arrays["doubt"])
        return cls(pose, covariance, place, outcome, Health(doubt), bool(arrays["lost"]))


START = PoseEstimate(np.zeros(3), np.zeros((3, 3)), -1, "", Health(), False)
"""The estimate before the first step."""
