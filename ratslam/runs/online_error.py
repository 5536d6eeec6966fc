"""The error of the online pose while a run proceeds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evaluation.metrics.trajectory import current_error
from ratslam.core.session import CHUNK, Session


class OnlineErrorLog:
    """Position error of the current pose after the online trajectory is aligned with the truth.

    It is computed at the end of a chunk, less often as the trajectory grows, because each value aligns the
    whole trajectory.

    Args:
        skipped: steps of the session's map that have no truth here: those of the run that it continues.

    Attributes:
        errors: values so far, m.
    """

    def __init__(self, skipped: int = 0) -> None:
        self.errors: list[float] = []
        self._skipped, self._due = skipped, skipped

    def update(self, session: Session, truth: Sequence[np.ndarray] | np.ndarray) -> float | None:
        """The error now, m; None between two values or if the last row of the truth [steps, 3] is NaN."""
        if session.steps < self._due or session.steps % CHUNK or not np.isfinite(truth[-1]).all():
            return None
        self._due = session.steps + max(CHUNK, session.steps // 256)
        true = np.asarray(truth)
        known = np.isfinite(true).all(axis=1)
        error = current_error(session.map.online_trajectory()[self._skipped :][known], true[known])
        self.errors.append(error)
        return error
