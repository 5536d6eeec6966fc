"""Recorded pose cells with both methods that have them, and in both precisions, live and in replay."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import numpy as np
import pytest

from ratslam.classic.cell_probe import choose_cells
from ratslam.core.session import Session, Step
from ratslam.runs.build_session import build_session
from ratslam.runs.settings.run_config import LoopConfig
from robot.sources.in_memory import InMemorySource

STEPS, RATE = 96, 50.0
METHODS: dict[str, dict[str, Any]] = {
    "classic float32": {"backend": "classic", "session": {"precision": "float32"}},
    "recall float64": {"backend": "recall"},
}
CELLS = {"chosen": 400, "sums": {"bins": 4, "heading_bins": 8}}


def circles() -> InMemorySource:
    """Two circles, whose views come back."""
    angle = 4 * np.pi * np.arange(STEPS) / STEPS
    truth = np.stack([0.5 + 0.4 * np.cos(angle), 0.5 + 0.4 * np.sin(angle), angle + np.pi / 2], axis=1)
    motion = np.tile([0.4 * 4 * np.pi / STEPS, 0.0, 4 * np.pi / STEPS, 1 / RATE], (STEPS, 1))
    motion[0] = 0.0
    views = 0.5 + 0.5 * np.sin(np.arange(8) * (1 + np.arange(STEPS) // 6 % 8)[:, None])
    return InMemorySource(
        name="circles", digest="circles", time=np.arange(STEPS) / RATE, motion=motion,
        moved=np.ones(STEPS, bool), views=views[:, None, :, None], seen=np.arange(STEPS) % 3 == 0,
        label=np.full(STEPS, -1, np.int32), truth=truth,
    )  # fmt: skip


@pytest.fixture(params=["recall float64", pytest.param("classic float32", marks=pytest.mark.soak)])
def live(request: pytest.FixtureRequest) -> tuple[Session, InMemorySource, list[Step], np.ndarray]:
    """A session that records, its source, its steps one at a time, and the torus after each."""
    source = circles()
    session = build_session(LoopConfig.model_validate({**METHODS[request.param], "cells": CELLS}), source)
    cells = session.backend.probe()
    whole = jax.jit(partial(cells.each, chosen=np.arange(np.prod(cells.shape))))
    steps, torus = [], []
    for sample in source:
        steps.append(session.step(sample.reading))
        torus.append(np.asarray(whole(session.state)))
    return session, source, steps, np.array(torus)


def test_live_and_replay_record_the_activity_of_the_network(
    live: tuple[Session, InMemorySource, list[Step], np.ndarray],
) -> None:
    session, source, steps, torus = live
    drawn = np.array([step.probed for step in steps])
    assert drawn.dtype == np.float32
    assert drawn.shape == (STEPS, 400)
    assert (drawn > 0).any()
    chosen = choose_cells(400, session.backend.probe().shape, seed=0)
    np.testing.assert_allclose(drawn, torus[:, chosen], rtol=1e-5, atol=1e-9)
    session.restart()
    again = session.replay([sample.reading for sample in source])
    for one, other in zip(steps, again, strict=True):
        np.testing.assert_array_equal(one.probed, other.probed)
        jax.tree.map(np.testing.assert_array_equal, one.seldom, other.seldom)
