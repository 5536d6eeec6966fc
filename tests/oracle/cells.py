"""What every pose cell network here does alike: the attractor and the decoding of its packet (section 4).

The activity is P[heading, y, x]. Only a small part of it is ever active, so the attractor works on the block
of those layers, rows and columns that can become active; the cells left out are exactly zero throughout.
"""

from __future__ import annotations

from math import atan2, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.oracle.params import Params

Array = NDArray[np.float64]
HALF_BOX = 3  # the packet is decoded from the 7 x 7 x 7 box around its peak


class Pose(NamedTuple):
    """A place on the torus, in cells."""

    x: float
    y: float
    th: float


def gaussian(width: int, deviation: float) -> Array:
    """One axis of the normalised Gaussian on a cube of `width` cells, which is the product of three."""
    r = np.arange(width) - width // 2
    taps = np.exp(-(r**2) / (2 * deviation**2))
    return taps / taps.sum()


def circulant(taps: Array, n: int) -> Array:
    """The matrix that convolves a ring of n cells; a kernel wider than the ring overlaps itself."""
    matrix = np.zeros((n, n))
    cells = np.arange(n)
    for offset, tap in enumerate(taps, start=-(len(taps) // 2)):
        matrix[(cells + offset) % n, cells] += tap
    return matrix


def blur(block: Array, kernels: list[Array]) -> Array:
    """The block convolved along heading, y and x."""
    along_h, along_y, along_x = kernels
    return np.tensordot(along_h, along_y @ (block @ along_x.T), axes=1)


def reached(P: Array, reach: int) -> list[NDArray[np.intp]]:
    """Per axis the indices that lie within `reach` cells of an active one, round the ring."""
    spread = np.arange(-reach, reach + 1)
    active = [np.flatnonzero(P.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
    return [np.unique((a[:, None] + spread) % n) for a, n in zip(active, P.shape, strict=True)]


class Attractor:
    """Local excitation, local inhibition and global inhibition, which keep one packet of activity alive."""

    def __init__(self, params: Params) -> None:
        excite = gaussian(params.pc_w_e_dim, params.pc_w_e_var)
        inhibit = gaussian(params.pc_w_i_dim, params.pc_w_i_var)
        shape = (params.pc_dim_th, params.pc_dim_xy, params.pc_dim_xy)
        self.excite = [circulant(excite, n) for n in shape]
        self.inhibit = [circulant(inhibit, n) for n in shape]
        self.threshold = params.pc_global_inhib
        self.reach = params.pc_w_e_dim // 2 + params.pc_w_i_dim // 2

    def __call__(self, P: Array) -> tuple[Array, float]:
        """Steps a to c: the activity after excitation and both inhibitions, and its sum."""
        where = reached(P, self.reach)
        excited = blur(P[np.ix_(*where)], [m[np.ix_(i, i)] for m, i in zip(self.excite, where, strict=True)])
        inhibited = blur(excited, [m[np.ix_(i, i)] for m, i in zip(self.inhibit, where, strict=True)])
        left = excited - inhibited
        left = np.where(left >= self.threshold, left - self.threshold, 0.0)
        out = np.zeros_like(P)
        out[np.ix_(*where)] = left
        return out, float(left.sum())


def decode(P: Array, peak: tuple[int, ...]) -> Pose:
    """Circular means of the marginal sums over the box around `peak`, each in [0, n]; n by rounding only.

    The box visits cells twice where an axis is shorter than it.
    """
    span = np.arange(-HALF_BOX, HALF_BOX + 1)
    th, y, x = ((centre + span) % n for centre, n in zip(peak, P.shape, strict=True))
    box = P[np.ix_(th, y, x)]
    K, N, _ = P.shape
    return Pose(
        x=_circular_mean(box.sum(axis=(0, 1)), x, N),
        y=_circular_mean(box.sum(axis=(0, 2)), y, N),
        th=_circular_mean(box.sum(axis=(1, 2)), th, K),
    )


def _circular_mean(mass: Array, cells: NDArray[np.intp], n: int) -> float:
    angle = 2 * pi * (cells + 1) / n
    mean = atan2(mass @ np.sin(angle), mass @ np.cos(angle)) * n / (2 * pi) - 1
    while mean < 0:
        mean += n
    while mean > n:
        mean -= n
    return mean
