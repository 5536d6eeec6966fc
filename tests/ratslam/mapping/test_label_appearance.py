"""Laws of given ids of keyframes."""

from __future__ import annotations

import numpy as np

from ratslam.mapping.odometry_calibration import NO_ESTIMATE
from tests.ratslam.mapping.appearance_cases import SILENT, alone, labelled, no_pairs


def test_ids_fit_frames_with_the_same_id():
    frames = labelled([4, 5, 4, 6])
    assert frames.least_misfit(2, *alone(0)) == 0
    assert frames.least_misfit(2, *alone(1)) == 1
    assert frames.least_misfit(2, np.array([1, 3, 0]), np.zeros(3, bool)) == 0
    assert frames.metric().scale == frames.metric().angle == 0
    assert frames.learn(SILENT, no_pairs) == NO_ESTIMATE
