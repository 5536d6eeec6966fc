"""A pose outlives a place that has changed, and no more than that."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.places.hypotheses import LONGEST, NOTHING_CHANGED, SHARE, continue_states, summed

NOWHERE = np.zeros(1)


def follow(odds: list[float], elsewhere: float = 0.0) -> np.ndarray:
    """The log-odds after each keyframe."""
    states, found = NOTHING_CHANGED[None], []
    for one in odds:
        states = continue_states(states, np.array([one]), np.array([elsewhere]))
        found.append(summed(states)[0])
    return np.array(found)


def test_keyframes_that_agree_count_nearly_in_full() -> None:
    assert follow([1.0] * 50)[-1] == pytest.approx(50.0, abs=0.1)


@pytest.mark.parametrize("strength", [-3.0, -30.0, -3000.0])
def test_a_short_contradiction_costs_its_prior_however_strong_it_is(strength: float) -> None:
    found = follow([1.0] * 20 + [strength] * LONGEST + [1.0] * 20)
    assert found[19] - found[-21] == pytest.approx(-np.log(SHARE / LONGEST), abs=0.5)
    assert found[-1] > found[19]


@pytest.mark.parametrize("strength", [-3.0, -30.0])
def test_a_lasting_contradiction_costs_without_end(strength: float) -> None:
    found = follow([strength] * (4 * (LONGEST + 1)))
    falls = -np.diff(found[:: LONGEST + 1])
    assert (falls > -np.log(SHARE) / 2).all()


def test_views_of_another_place_do_not_pass_for_changed_ground() -> None:
    odds = [1.0] * 20 + [-3.0] * LONGEST
    assert follow(odds, elsewhere=1.0)[-1] < follow(odds)[-1] - 0.9 * LONGEST


def test_poses_do_not_depend_on_each_other() -> None:
    odds = np.random.default_rng(0).normal(0.0, 3.0, (30, 4))
    together = np.tile(NOTHING_CHANGED, (4, 1))
    for row in odds:
        together = continue_states(together, row, np.zeros(4))
    alone = [follow(column.tolist())[-1] for column in odds.T]
    np.testing.assert_allclose(summed(together), alone)
