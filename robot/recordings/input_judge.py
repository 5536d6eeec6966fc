"""The judge of the input: what of a recording or of a robot's motion cannot be believed."""

from __future__ import annotations

import numpy as np


def judge_motion(time: np.ndarray, motion: np.ndarray, where: str) -> list[str]:
    """Warnings about the odometry of a session, a sentence each.

    Args:
        time: [N] s. motion: [N, 4] dx m, dy m, dtheta rad, dt s. where: the source, for the sentences.
    """
    return []
