"""Laps of a circle whose places look alike: a view names five of its 40 places, so that only the path between
views tells where the robot is."""

from __future__ import annotations

import numpy as np

from ratslam.core.session import Session
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from tactile.base.se2 import between
from tactile.base.types import Observation
from tests.helpers import scenes

PLACES, LOOKS = 40, 8
STEP = 1.8 * scenes.CELL
"""Way between two views, m: more than the excitation of a packet reaches."""


def laps(count: int, seed: int = 1) -> list[Observation]:
    """Readings of a robot that drives laps, one at each place."""
    stream = np.random.default_rng(seed)
    path = scenes.followed([(STEP, 2 * np.pi / PLACES)] * (PLACES * count - 1))
    motion = np.zeros((len(path), 4))
    motion[1:, :3] = between(path[:-1], path[1:])
    motion[1:] += stream.normal(0, [0.02 * STEP, 0.0, 0.003, 0.0], (len(path) - 1, 4))
    motion[:, 3] = 0.5
    look = stream.permutation(np.arange(PLACES) % LOOKS)[np.arange(len(path)) % PLACES]
    views = stream.random((LOOKS, 18))[look] + stream.normal(0, 0.012, (len(path), 18))
    log = scenes.recorded(path, motion, np.clip(views, 0, 1))
    return [sample.reading for sample in log]


def session(cells: int = 21, **settings) -> Session:
    """A session of recall with so many pose cells along x and along y at first; 21 cover the circle."""
    sections = {"pose_cells": {"cells_xy": cells, "cell_size": scenes.CELL}}
    config = RecallBackendConfig.model_validate(sections)
    return Session(RecallBackend(config, (3, 6, 1), np.dtype(float)), **settings)
