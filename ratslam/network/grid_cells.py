"""Grid cells: a sheet of cells that read the belief on a torus of their own, and tell it nothing.

The belief has mass v_ks at view cell (k, s), whose pose odometry has moved to p_ks since the last view, and
novelty nu, which is where the map has the robot, at p. The activity of a cell that prefers the place c is
what its tuning t is expected to be:

    a(c) = sum_ks v_ks t(p_ks - c) + nu t(p - c),    t(d) = exp(SHARP (mean_i cos(k_i d) - 1))

The waves k_i make t periodic. Three of them, 60 degrees apart, have the period of a twisted torus (Guanella,
Kiper & Verschure 2007, Int. J. Neural Syst. 17: 231), on which a turn along y shifts x by half a turn: fields
form the hexagonal lattice of entorhinal grid cells (Hafting et al. 2005). Two waves, 90 degrees apart, have
that of a square torus. Heading is summed over: these are pure grid cells, not conjunctive ones.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ratslam.network.config import SheetConfig
from ratslam.network.pose_cells import ViewCells
from tactile.base.types import Array

SIDE, ROWS = 15, 13
"""Cells of a sheet along x, and along y where it is twisted: 13 / 15 is within 0.1 % of sqrt(3) / 2."""
MOST, LEAST = 2048, 1e-6
"""Most view cells that a sheet reads, and the least mass of one: nearly all others have none, and reading
them would take ten times the time. What they have counts as novelty."""
SHARP = 2.5
"""Sharpness of the tuning: fields with a standard deviation of 0.12 spacings."""


def sheet_shape(sheet: SheetConfig) -> tuple[int, int, int]:
    """(1, H, W) cells over heading, y and x; fewer along y than along x where the sheet is twisted."""
    return 1, ROWS if sheet.twisted else SIDE, SIDE


def sheet_waves(sheet: SheetConfig) -> np.ndarray:
    """[n, 2] wave vectors of the tuning, rad/m."""
    angle = np.radians([30, 90, 150] if sheet.twisted else [0, 90])
    length = 2 * np.pi / (sheet.spacing * (np.cos(np.pi / 6) if sheet.twisted else 1))
    return length * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def sheet_activity(
    sheet: SheetConfig, mass: Array, cells: ViewCells, motion: Array, here: Array, chosen: Array
) -> Array:
    """[n] float32 activity of cells of the sheet, 1 for a belief that is certain of a cell's place.

    Args:
        mass: v [S, C] after the last view. cells: the view cells [S, C], where they were then. motion: [3]
            odometry since, m, m, rad. here: [3] the robot's pose in the map now, m, m, rad. chosen: [n]
            indices in the flattened sheet.
    """
    (dx, dy, _), (here_x, here_y, _) = motion.astype(jnp.float32), here.astype(jnp.float32)
    size = min(mass.size, MOST)
    (held,) = jnp.nonzero(mass.reshape(-1) > LEAST, size=size, fill_value=mass.size)
    x, y, cosine, sine, weight = (
        each.reshape(-1).at[held].get(mode="fill", fill_value=0)
        for each in (cells.x, cells.y, cells.cosine, cells.sine, mass)
    )
    x, y = x + cosine * dx - sine * dy, y + sine * dx + cosine * dy
    at = jnp.stack([jnp.append(x, here_x), jnp.append(y, here_y)])
    weight = jnp.append(weight, jnp.maximum(1 - jnp.sum(weight), 0.0))
    row, column = jnp.divmod(jnp.asarray(chosen), SIDE)
    own = jnp.stack([column, row]).astype(jnp.float32) * (sheet.spacing / SIDE)
    waves = sheet_waves(sheet).astype(np.float32)
    there, preferred = waves @ at, waves @ own
    likeness = jnp.cos(preferred).T @ jnp.cos(there) + jnp.sin(preferred).T @ jnp.sin(there)
    return jnp.exp(SHARP * (likeness / len(waves) - 1)) @ weight
