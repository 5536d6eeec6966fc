"""A wide circle that a robot drives again and again, with recall written by hand."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.mapping.acceptance import AcceptByOdds
from ratslam.mapping.appearance import LabelAppearance
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.map import KeyframeMap
from tactile.base.types import Odometry, observation

CELL = 0.5
LAP = 200
"""Keyframes of a lap."""
STEP = 0.4 * CELL
BIAS = 0.01
"""Heading bias of the odometry, rad/m."""
NOTHING = (-1, 0.0)
"""No candidate: match and log-likelihood ratio."""


class Seen(NamedTuple):
    """Evidence of one step, as recall gives it."""

    keyframe: int
    match: int
    shift: int
    posterior: float
    log_ratio: float


class Pose(NamedTuple):
    """The part of an estimate that the map changes."""

    place: int
    previous: int
    action: int


def new_map(acceptance=AcceptByOdds, find_tie=None, **settings):
    config = KeyframeMapConfig.model_validate(settings)
    return KeyframeMap(config, CELL, LabelAppearance(), acceptance, find_tie=find_tie)


def drive(map, recalled, first=0, last=LAP + 60, bias=BIAS):
    """Drives keyframes first to last - 1. recalled: match and log ratio by keyframe."""
    turn = 2 * np.pi / LAP - bias * STEP
    for k in range(first, last):
        match, ratio = recalled.get(k, NOTHING)
        odometry = Odometry(STEP, 0.0, turn, 0.1) if k else Odometry(0.0, 0.0, 0.0, 0.1)
        seen = Seen(k, match, 0, float(match >= 0), ratio)
        map.update(observation(odometry, None, view_shape=(1, 1, 1), label=k), Pose(-1, -1, 0), seen)
    return map


def sequence(start, match, length, ratio):
    """Candidates of a sequence that goes on as odometry does."""
    return {start + n: (match + n, ratio) for n in range(length)}


TRUE = sequence(LAP + 2, 2, 12, 4.0)
"""The beginning of the lap, seen where it is."""
