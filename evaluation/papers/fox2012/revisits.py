"""Errors of a path with known start, without alignment, and of the offsets between visits of one place."""

from __future__ import annotations

import numpy as np

from evaluation.metrics.trajectory import position_error
from tactile.base.se2 import wrap

REVISIT_DISTANCE = 0.1
"""A report this near to an earlier one is a revisit, m: two cells."""
LEAVE_DISTANCE = 0.5
"""Distance that the robot must have been away in between, m."""
CLOSED_GAP = 0.1
"""A revisit is closed if the path gives the offset of the two visits to this error, m."""


def path_metrics(online: np.ndarray, path: np.ndarray, truth: np.ndarray) -> dict[str, float | None]:
    """Metrics of online, final and true poses [T, 3].

    Returns:
        online_error, final_error: mean position errors, m. online_heading_error_deg: mean, degrees. revisits:
        number of reports at an earlier place. revisits_closed: share of these whose offset from the earlier
        visit the path gives to `CLOSED_GAP`. revisit_gap: mean error of that offset, m.
    """
    later, earlier = find_revisits(truth).T
    gap = np.hypot(*((path[later] - path[earlier]) - (truth[later] - truth[earlier]))[:, :2].T)
    return {
        "online_error": position_error(online, truth),
        "final_error": position_error(path, truth),
        "online_heading_error_deg": float(np.degrees(np.abs(wrap(online[:, 2] - truth[:, 2])).mean())),
        "revisits": len(gap),
        "revisits_closed": float((gap < CLOSED_GAP).mean()) if len(gap) else None,
        "revisit_gap": float(gap.mean()) if len(gap) else None,
    }


def find_revisits(truth: np.ndarray) -> np.ndarray:
    """[L, 2] each report at an earlier place, and the nearest of the earlier reports there."""
    found = []
    for k, here in enumerate(truth[:, :2]):
        apart = np.hypot(*(truth[:k, :2] - here).T)
        left = np.flatnonzero(apart > LEAVE_DISTANCE)
        before = apart[: left[-1]] if len(left) else apart[:0]
        if len(before) and before.min() < REVISIT_DISTANCE:
            found.append((k, int(before.argmin())))
    return np.array(found, int).reshape(-1, 2)
