"""The network as an explicit hidden Markov model, by dense matrices of double precision, and random cases.

States are the pose cells and novelty; every pose cell goes to the view cells that its excitation reaches, or
to novelty. Nothing here comes from `ratslam.network` but its records.
"""

from collections import namedtuple

import jax
import jax.numpy as jnp
import numpy as np

from ratslam.network.config import Network, PoseCellConfig
from ratslam.network.pose_cells import Belief, ViewCells, anchor, predict
from tactile.base.se2 import compose, inverse

CELL = 0.125
anchored, predictor = (jax.jit(function, static_argnums=0) for function in (anchor, predict))


Case = namedtuple("Case", "network shape belief poses used motion")
"""A network with sides `shape`, a belief, view cells at poses [S, C, 3], and a motion [3]."""


def network_of(heading=12, xy=11, *, excite=0.5, excite_heading=0.4, miss=0.02, leak=0.003, cell=CELL):
    cells = PoseCellConfig(cells_xy=xy, cells_heading=heading, cell_size=cell)
    return Network(cells, excite, excite_heading, miss, leak)


def cells_at(poses, used=None):
    """View cells at poses [S, C, 3]; headings may be of any turn."""
    x, y, heading = np.moveaxis(np.asarray(poses, float), -1, 0)
    used = np.ones(x.shape) if used is None else used
    values = x, y, heading, np.cos(heading), np.sin(heading), used
    return ViewCells(*(jnp.asarray(value, jnp.float32) for value in values))


def held(network, shape, poses, mass, used=None):
    """The belief that view cells at poses [S, C, 3] of mass [S, C] give."""
    mass = jnp.asarray(mass, jnp.float32)
    silent = Belief(jnp.zeros(shape, jnp.float32), jnp.zeros_like(mass))
    return anchored(network, silent, cells_at(poses, used), mass)


def random_case(seed):
    """A network in the middle of a session: short rings, poses some laps away from the origin, headings of
    several turns, few to many view cells, of which some are not used. Four networks take turns, because
    functions are compiled for each."""
    stream = np.random.default_rng(seed)
    network, shape, views = KINDS[seed % len(KINDS)]
    place = stream.uniform(-3, 3, 2) * [shape[2], shape[1]] * CELL
    poses = stream.normal(0, 2 * CELL, (*views, 3))
    poses[..., :2] += place
    poses[..., 2] = stream.uniform(-9, 9, views)
    used = (stream.random(views) < 0.8).astype(float)
    mass = stream.dirichlet(np.full(views[0] * views[1] + 1, 0.5))[:-1].reshape(views) * used
    motion = stream.normal(0, [2 * CELL, CELL, 0.8])
    return Case(network, shape, held(network, shape, poses, mass, used), poses, used, motion)


KINDS = [
    (network_of(7, 7, excite=0.3, excite_heading=0.2), (7, 7, 7), (1, 2)),
    (network_of(12, 11), (12, 9, 11), (3, 40)),
    (network_of(9, 13, excite=1.5, excite_heading=1.0, leak=0.2, miss=0.4), (9, 13, 13), (2, 20)),
    (network_of(13, 8, excite=1.0, excite_heading=0.5, leak=0.0, miss=0.1), (13, 10, 8), (1, 60)),
]
"""Networks, their sides, and the numbers of their view cells."""


def apart(at, cells):
    """[cells, ...] distance along a ring, in cells, of every cell from positions [...]."""
    cell = np.arange(cells).reshape(-1, *np.ones(np.ndim(at), int))
    return np.abs((at - cell + cells / 2) % cells - cells / 2)


def tie_matrix(network, shape, poses, used):
    """[H, Y, X, S C] the trilinear shares of pose cells at poses [S, C, 3]."""
    x, y, heading = np.moveaxis(poses, -1, 0)
    sizes = 2 * np.pi / shape[0], network.cells.cell_size, network.cells.cell_size
    around = zip((heading, y, x), sizes, shape, strict=True)
    hats = [np.maximum(1 - apart(value / size, cells), 0) for value, size, cells in around]
    return (np.einsum("hsc,ysc,xsc->hyxsc", *hats) * used).reshape(*shape, -1)


def excited(network, activity):
    """[H, Y, X, ...] an activity after local excitation."""
    heading = network.excite_heading * activity.shape[0] / (2 * np.pi)
    for axis, sd in enumerate((heading, network.excite, network.excite)):
        cells = activity.shape[axis]
        distance = apart(np.arange(cells), cells)
        weights = np.maximum(1 - (distance / sd) ** 2 / 8, 0) ** 4
        weights[distance > (cells - 1) // 2] = 0
        activity = np.moveaxis(np.tensordot(weights, activity, axes=(1, axis)), 0, axis)
    return activity


def predicted(case):
    """Prior mass [S, C] of the view cells, and that of novelty, by the transition from pose cells to view
    cells: in proportion to what reaches each, `miss` being what reaches none."""
    network, views = case.network, case.used.shape
    moved = compose(case.poses, inverse(case.motion))
    moved[..., 2] = case.poses[..., 2] - case.motion[2]  # not wrapped
    reaches = excited(network, tie_matrix(network, case.shape, moved, case.used))
    transition = reaches / (reaches.sum(axis=-1, keepdims=True) + network.miss)
    activity = np.asarray(case.belief.activity, float)
    found = (1 - network.leak) * np.tensordot(activity, transition, axes=3)
    return found.reshape(views), activity.sum() - found.sum()


def driven(case, mass):
    """[H, Y, X] the activity that view cells of mass [S, C] give."""
    return tie_matrix(case.network, case.shape, case.poses, case.used) @ np.ravel(mass)
