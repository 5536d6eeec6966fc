"""When the grid filter resamples, and what follows a particle."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.methods.grid import GridOutcome
from tests.helpers.grid_world import drive, initial, report
from tests.ratslam.methods.grid_filters import CORRIDOR, FILTER, PRINTED


def test_maps_follow_their_particles():
    state = initial(CORRIDOR)
    names = jnp.arange(1.0, 1001.0)
    state = state._replace(
        maps=state.maps + 1e-6 * names[:, None, None, None],
        wall_directions=jnp.stack([names, -names], axis=1),
        particles=state.particles._replace(
            weight=-0.05 * names, session=1e-9 * jnp.stack([names, names], axis=1)
        ),
    )
    after, _, evidence = drive(CORRIDOR, state, [report(0.02, whiskers=2)])
    ancestor = evidence.ancestor[0]
    assert evidence.outcome[0] == GridOutcome.RESAMPLED
    assert 20 < len(np.unique(ancestor)) < 500
    assert np.array_equal(after.maps, state.maps[ancestor])
    assert np.array_equal(after.wall_directions, state.wall_directions[ancestor])
    assert np.array_equal(after.particles.session, state.particles.session[ancestor])
    assert np.array_equal(after.particles.pose, evidence.poses[0][ancestor])
    assert not np.any(after.particles.weight)
    # The weights reported are those before resampling.
    assert evidence.weights[0] == pytest.approx(np.exp(-0.05 * names) / np.exp(-0.05 * names).sum(), rel=0.05)
    assert evidence.effective_particles[0] == pytest.approx(40, rel=0.1)


def test_the_literal_filter_resamples_at_every_report_with_evidence():
    _, _, evidence = drive(
        PRINTED, initial(PRINTED), [report(0.02), report(0.02, touching=[1]), report(-0.05), report(turn=0.1)]
    )
    assert list(evidence.outcome) == [
        GridOutcome.RESAMPLED,
        GridOutcome.RESAMPLED,
        GridOutcome.OK,
        GridOutcome.RESAMPLED,
    ]
    assert np.array_equal(evidence.ancestor[2], np.arange(30))


def test_equal_weights_are_not_resampled():
    _, _, evidence = drive(FILTER, initial(FILTER), [report(0.02)] * 5)
    assert not evidence.outcome.any()
    assert (evidence.ancestor == np.arange(30)).all()
    assert evidence.weights.sum(axis=1) == pytest.approx(1)
