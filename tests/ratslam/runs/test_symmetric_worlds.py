"""Worlds that look the same in the mirror: a loop is closed there as in others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ratslam.core.session import Session
from ratslam.mapping.loop_closures import Verdict
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from robot.sources.in_memory import InMemorySource
from tests.helpers import scenes

CORRIDOR = ([(scenes.STEP, 0.0)] * 120 + [(-scenes.STEP, 0.0)] * 120) * 2
"""There and back, twice, never turning."""
ROUND = [(scenes.STEP, 2 * np.pi / 150)] * 150 * 3
"""Three laps of a circle whose turns between keyframes are too small to tell from those in the mirror."""


def symmetric(log: InMemorySource) -> InMemorySource:
    """The same path between walls that look alike on both sides."""
    return replace(log, views=(log.views + log.views[:, :, ::-1]) / 2)


@pytest.fixture(scope="module")
def session():
    cells = {"pose_cells": {"cells_xy": 11, "cell_size": scenes.CELL}}
    config = RecallBackendConfig.model_validate(cells)
    return Session(RecallBackend(config, (3, 6, 1), np.dtype("float64")), reserve=512)


def replayed(session, log):
    """The map of a session."""
    session.restart()
    for _ in session.replay(sample.reading for sample in log):
        pass
    return session.map


@pytest.mark.parametrize(
    "moves", [CORRIDOR, pytest.param(ROUND, marks=pytest.mark.soak)], ids=["corridor", "round"]
)
def test_a_symmetric_loop_is_closed_with_high_odds(session, moves):
    log = scenes.sensed(scenes.followed(moves), 1)
    plain = replayed(session, log)
    assert longest(plain)[1] > 100

    found = replayed(session, symmetric(log))
    verdict, odds = longest(found)
    assert verdict == Verdict.ACCEPTED
    assert odds > 10
    assert len(found.closures()) == pytest.approx(len(plain.closures()), rel=0.05)


def longest(map):
    """Verdict and log odds of the longest sequence."""
    table = map.candidates()
    sequence = np.bincount(table[:, 5].astype(int)).argmax()
    row = table[table[:, 5] == sequence][0]
    return Verdict(int(row[7])), row[9]
