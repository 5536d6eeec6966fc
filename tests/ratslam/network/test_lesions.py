"""Lesions of the network, in a session: loops are closed by what its pose cells do, and by nothing else."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.network import pose_cells
from tests.ratslam.network import alike_places
from tests.ratslam.network.alike_places import PLACES

LAPS = 6


class Decisions(NamedTuple):
    """What a session decided: match [T], posterior [T], pairs of steps [M, 2] joined by loop closures."""

    match: np.ndarray
    posterior: np.ndarray
    closures: np.ndarray


def decisions():
    """Those of a session that is compiled with the network as it is now."""
    session = alike_places.session()
    found = [step.evidence for step in session.replay(alike_places.laps(LAPS))]
    match, posterior = np.array([(one.match, one.posterior) for one in found]).T
    return Decisions(match.astype(int), posterior, session.map.closures())


@cache
def intact():
    return decisions()


@cache
def shuffled(size):
    """[size] a fixed order."""
    return np.random.default_rng(0).permutation(size).astype(np.int32)


def test_the_intact_network_closes_every_loop():
    found = intact()
    assert len(found.closures) > (LAPS - 2) * PLACES
    apart = (found.closures[:, 0] - found.closures[:, 1]) % PLACES
    assert np.isin(apart, [0, 1, PLACES - 1]).all()
    assert (apart == 0).mean() > 0.98
    assert (found.posterior > 0.5).sum() > (LAPS - 2) * PLACES


def nothing_predicted(network, belief, cells, motion):
    return jnp.zeros_like(cells.used), jnp.sum(belief.activity)


def all_predicted_alike(network, belief, cells, motion):
    return cells.used / jnp.maximum(jnp.sum(cells.used), 1.0), jnp.float32(0.0)


@pytest.mark.parametrize("step", [nothing_predicted, all_predicted_alike])
def test_no_loop_is_closed_where_the_step_of_the_network_is_a_constant(monkeypatch, step):
    monkeypatch.setattr(pose_cells, "predict", step)
    assert len(decisions().closures) == 0


def test_no_loop_is_closed_without_path_integration(monkeypatch):
    monkeypatch.setattr(pose_cells, "integrate_path", lambda cells, motion: cells)
    assert len(decisions().closures) == 0


def test_no_loop_is_closed_without_the_activity_that_views_drive(monkeypatch):
    monkeypatch.setattr(pose_cells, "anchor", lambda network, belief, cells, mass: belief)
    assert len(decisions().closures) == 0


def test_where_cells_lie_in_memory_does_not_matter(monkeypatch):
    """Cells in another order, with their ties: which ones excite each other stays."""
    tie, excite = pose_cells.tie, pose_cells.excite

    def tie_elsewhere(network, shape, cells):
        index, weight = tie(network, shape, cells)
        return jnp.asarray(shuffled(int(np.prod(shape))))[index], weight

    def excite_neighbours(network, activity):
        order = shuffled(activity.size)
        lattice = activity.reshape(-1)[order].reshape(activity.shape)
        excited = excite(network, lattice).reshape(-1)
        return jnp.zeros_like(excited).at[order].set(excited).reshape(activity.shape)

    monkeypatch.setattr(pose_cells, "tie", tie_elsewhere)
    monkeypatch.setattr(pose_cells, "excite", excite_neighbours)
    found = decisions()
    assert np.array_equal(found.match, intact().match)
    assert found.posterior == pytest.approx(intact().posterior, abs=1e-5)
    assert np.array_equal(found.closures, intact().closures)


def test_no_loop_is_closed_by_cells_in_another_order_than_their_ties(monkeypatch):
    anchor = pose_cells.anchor

    def anchor_elsewhere(*given):
        belief = anchor(*given)
        activity = belief.activity.reshape(-1)[shuffled(belief.activity.size)]
        return belief._replace(activity=activity.reshape(belief.activity.shape))

    monkeypatch.setattr(pose_cells, "anchor", anchor_elsewhere)
    assert len(decisions().closures) == 0


def test_no_loop_is_closed_by_ties_to_other_view_cells(monkeypatch):
    """View cells read at the poses of others."""
    predict = pose_cells.predict

    def predict_others(network, belief, cells, motion):
        order = shuffled(cells.x.shape[1])
        return predict(network, belief, jax.tree.map(lambda value: value[:, order], cells), motion)

    monkeypatch.setattr(pose_cells, "predict", predict_others)
    assert len(decisions().closures) == 0
