"""The seam: what a SLAM method has to provide.

A backend is a pure kernel and a map that folds what the kernel reports. The kernel never sees the map and
the map never sees the kernel's state, so the kernel can be scanned, batched and replayed bit for bit. One way
leads back: at fixed counts of steps the map gives its feedback, a plain record, and the state takes it up.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import networkx
import numpy as np

from ratslam.core.types import Estimate
from tactile.base.types import Array, Observation

State = Any
"""A pytree of arrays of fixed shapes and dtypes."""
Evidence = Any
"""The backend's own fixed-shape record of one step, a NamedTuple of arrays."""
Feedback = Any
"""What the kernel receives of the map: a record of host arrays, or None."""


class Map(Protocol):
    """The host side: folds one step at a time and answers in the map frame."""

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Folds one step; returns the estimate with what only the map knows (places it has confirmed)."""

    def feedback(self) -> Feedback:
        """What the kernel may know of the map as it is now."""

    def pose(self, estimate: Estimate) -> np.ndarray:
        """[3] the robot's present pose in the map frame: x m, y m, heading rad."""

    def trajectory(self) -> np.ndarray:
        """[T, 3] every folded step as the map sees it now."""

    def online_trajectory(self) -> np.ndarray:
        """[T, 3] the same, unsettled: what the robot acts on at this moment."""

    def closures(self) -> np.ndarray:
        """[M, 2] steps that the map takes to be at one place: the later and the earlier of each pair."""

    def graph(self) -> networkx.DiGraph:
        """The map as a graph (empty for maps without nodes)."""

    def files(self) -> dict[str, Callable[[Path], None]]:
        """What the map leaves in a run directory: names, and how each is written."""

    def arrays(self) -> dict[str, np.ndarray]:
        """All of its state, for a checkpoint."""

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""


class Backend(Protocol):
    """A SLAM method."""

    def init(self, key: Array, capacity: int) -> State:
        """The state before the first step, with room for `capacity` rows of whatever grows."""

    def rows(self, state: State) -> int:
        """Rows in use of whatever grows most; a step adds one at most."""

    def grow(self, state: State, capacity: int) -> State:
        """The same state with more room."""

    def apply_map_feedback(self, state: State, feedback: Feedback) -> State:
        """The state that has taken up what the map told; same shapes and dtypes."""

    def kernel(self, state: State, observation: Observation) -> tuple[State, Estimate, Evidence]:
        """One step, pure: it can be jitted, scanned and vmapped."""

    def new_map(self) -> Map:
        """An empty map."""
