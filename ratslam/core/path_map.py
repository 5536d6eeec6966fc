"""The smallest map: the path of a backend's own estimates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ratslam.core.backend import Evidence, Map
from ratslam.core.checkpoint import Checkpointed
from ratslam.core.estimates import Estimate
from ratslam.core.growable_array import GrowableArray
from tactile.base.types import Observation


class PathMap(Checkpointed, Map):
    """A map for backends that estimate the pose in the map frame and have no graph."""

    def __init__(self) -> None:
        self._pose = GrowableArray((3,), np.float64)

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Adds the pose of a step."""
        self._pose.append(estimate.pose)
        return estimate

    def trajectory(self) -> np.ndarray:
        """[T, 3] the estimates of all steps."""
        return self._pose.rows.copy()

    def files(self) -> dict[str, Callable[[Path], None]]:
        """None."""
        return {}
