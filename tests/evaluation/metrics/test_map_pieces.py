"""Metrics of a map in pieces."""

from __future__ import annotations

import re
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics.energy_metric import energy, energy_all_pairs
from evaluation.metrics.run_arrays import RunArrays
from evaluation.metrics.run_metrics import energy_within_pieces, unjoined_share
from evaluation.metrics.scorecard import score_run
from tactile.base.se2 import compose, integrate

law = settings(derandomize=True, deadline=None, max_examples=60)


@st.composite
def maps_in_pieces(draw):
    """Estimate [T, 3], truth [T, 3] and piece [T]."""
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    count = draw(st.integers(2, 25))
    truth = np.cumsum(random.normal(size=(count, 3)), axis=0)
    piece = random.integers(0, draw(st.integers(1, 4)), count)
    return truth + random.normal(0, 0.3, truth.shape), truth, piece


@law
@given(maps_in_pieces())
def test_only_pairs_within_a_piece_count(found):
    estimate, truth, piece = found
    pairs = np.array([(i, j) for i, j in combinations(range(len(piece)), 2) if piece[i] == piece[j]])
    expected = energy(estimate, truth, pairs.reshape(-1, 2))
    assert energy_within_pieces(estimate, truth, piece) == pytest.approx(
        expected, rel=1e-6, abs=1e-9, nan_ok=True
    )


@law
@given(maps_in_pieces())
def test_in_one_piece_the_energy_is_that_of_all_pairs(found):
    estimate, truth, _ = found
    assert energy_within_pieces(estimate, truth, np.full(len(truth), 3)) == energy_all_pairs(estimate, truth)
    assert unjoined_share(np.full(len(truth), 3)) == 0


@law
@given(maps_in_pieces())
def test_the_place_of_a_piece_does_not_matter(found):
    estimate, truth, piece = found
    moved = estimate.copy()
    moved[piece == piece[0]] = compose(np.array([3.0, -2.0, 1.0]), moved[piece == piece[0]])
    assert energy_within_pieces(moved, truth, piece) == pytest.approx(
        energy_within_pieces(estimate, truth, piece), rel=1e-6, abs=1e-9, nan_ok=True
    )


@law
@given(maps_in_pieces())
def test_the_unjoined_share_is_the_rest_of_the_largest_piece(found):
    *_, piece = found
    share = unjoined_share(piece)
    assert 0 <= share < 1
    assert share * len(piece) == pytest.approx(len(piece) - max((piece == one).sum() for one in piece))


def test_without_steps_nothing_is_defined():
    none = np.zeros((0, 3))
    assert np.isnan(unjoined_share(np.zeros(0, int)))
    assert energy_within_pieces(none, none, np.zeros(0, int)).pairs == 0


def walked(seed: int, steps: int = 80) -> np.ndarray:
    """[steps, 3] a walk of steps of up to 0.1 m."""
    rng = np.random.default_rng(seed)
    motion = np.column_stack([rng.uniform(0, 0.1, steps), np.zeros(steps), rng.normal(0, 0.3, steps)])
    return integrate(motion)


def jump(online: np.ndarray, odometry: np.ndarray) -> tuple[float, float] | None:
    """Distance and time, s, of the jump that a scorecard notes of a run with a step a second."""
    rows = len(online)
    none = np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 2), int)
    run = RunArrays(np.arange(float(rows)), odometry, online, odometry, odometry, np.full(rows, -1), *none)
    note = score_run(run).quantities["ate_online"].note
    found = re.match(r"with a jump of (\S+) m at t = (\S+) s", note)
    return (float(found[1]), float(found[2])) if found else None


@law
@given(seed=st.integers(0, 99), at=st.integers(1, 79), apart=st.floats(50, 1000))
def test_a_piece_that_is_tied_jumps(seed, at, apart):
    odometry = walked(seed)
    online = odometry.copy()
    online[:at, 0] += apart
    assert jump(online, odometry) == (pytest.approx(apart, abs=0.2), at)


@law
@given(seed=st.integers(0, 99), at=st.integers(1, 79), share=st.floats(0, 1))
def test_a_correction_within_a_piece_is_no_tie(seed, at, share):
    """It moves a pose by the drift at most, which is not more than dead reckoning went."""
    odometry = walked(seed)
    online = odometry.copy()
    online[at:, :2] -= share * odometry[at, :2]
    assert jump(online, odometry) is None
    assert jump(odometry[:at], odometry[:at]) is None
