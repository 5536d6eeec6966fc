"""Grid filters of several settings, and what tests read of their states."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ratslam.grid import particles
from ratslam.grid.particles import EVIDENCE
from tests.helpers.grid_world import BLANK, STEADY, filter_of, initial, report, settings

FILTER = filter_of(settings())
MOST = FILTER.config.footprint.max_log_odds
AS_PRINTED = {
    "likelihood": {"model": "literal"},
    "footprint": {"wall": "edge"},
    "resampling": {"schedule": "always", "scheme": "multinomial"},
}
PRINTED = filter_of(settings(**AS_PRINTED))
SINGLE = filter_of(settings(), dtype=np.float32)
CORRIDOR = filter_of(
    settings(
        particles=1000, cell=0.1, body=0.0, footprint=BLANK, drift=STEADY | {"step": 0.3},
        resampling={"length": 0.0, "heading": 0.0, "scale": 0.0},
        likelihood={"free": 0.3, "contact": 1.0},
    ),
    whiskers=2,
    side=1.6,
)  # fmt: skip
ALL = range(4)


def placed(backend, pose, point):
    """[N, K, 2] points [K, 2] of base_link in cells of the map."""
    pose, point = np.asarray(pose, float), np.asarray(point, float)
    c, s = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
    x = pose[:, :1] + c * point[:, 0] - s * point[:, 1]
    y = pose[:, 1:2] + s * point[:, 0] + c * point[:, 1]
    return np.asarray(particles.to_cells(np.stack([x, y], axis=2), backend.config.cell, backend.side))


def evidence_at(backend, state, point, layer=EVIDENCE):
    """[N, K] the layer of each particle's map at points [K, 2] of base_link."""
    place = placed(backend, state.particles.pose, point).astype(backend.dtype)
    return np.asarray(particles.interpolate(state.maps, layer, place))


def column_of_wall(backend, x, *, before=-3.0, wall=4.0, width=0.1):
    """[S, S] evidence: free before x, a wall there, unexplored behind it, m."""
    at = (np.arange(backend.side) - (backend.side - 1) / 2) * backend.config.cell
    row = np.where(at < x - width / 2, before, np.where(at < x + width / 2, wall, 0.0))
    return np.tile(row, (backend.side, 1))


def scatter(backend):
    """A state of separate particles, each with its own map."""
    stream, state = np.random.default_rng(0), initial(backend)
    pose = stream.normal(0, [0.1, 0.1, 1.0], state.particles.pose.shape)
    maps = stream.normal(0, 2.0, state.maps[:, EVIDENCE].shape)
    return state._replace(
        maps=state.maps.at[:, EVIDENCE].set(maps), particles=state.particles._replace(pose=jnp.asarray(pose))
    )


def equal(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def without_contacts(state):
    """The state without the contacts of the last report, which only affect the next one."""
    return state._replace(touched=0)


# Hard cases, in single precision


def circuit(count):
    return [report(turn=0.3) if k % 5 == 4 else report(0.05) for k in range(count)]
