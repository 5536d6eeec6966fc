"""Keyframes of places that look different by now."""

from __future__ import annotations

import numpy as np

from ratslam.core.checkpoint import Checkpointed


class OutdatedKeyframes(Checkpointed):
    """Which keyframes no longer count as ground for localisation; they stay in the map.

    A checkpoint without such keyframes has no array of them.
    """

    def __init__(self) -> None:
        self._flags = np.zeros(0, bool)

    def flags(self, count: int) -> np.ndarray:
        """[count] bool: the first `count` keyframes, numbered as they were taken."""
        flags = np.zeros(count, bool)
        known = self._flags[:count]
        flags[: len(known)] = known
        return flags

    def mark(self, frames: np.ndarray) -> None:
        """Marks keyframes [n], numbered as they were taken."""
        count = max(len(self._flags), int(frames.max(initial=-1)) + 1)
        self._flags = self.flags(count)
        self._flags[frames] = True

    def take(self, frames: np.ndarray) -> None:
        """Keeps only keyframes [n], ascending, which are numbered anew."""
        self._flags = self.flags(int(frames.max(initial=-1)) + 1)[frames]

    def arrays(self) -> dict[str, np.ndarray]:
        return {"flags": self._flags.copy()} if self._flags.any() else {}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        self._flags = arrays.get("flags", np.zeros(0, bool)).astype(bool)
