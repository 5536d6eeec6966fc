"""The Energy Metric: the error of relative motions in a map (Kuemmerle et al. 2009).

    energy = mean over pairs (i, j) of  trans(delta_ij (-) delta*_ij)^2 + rot(delta_ij (-) delta*_ij)^2

(Salman & Pearson 2016, eq. 1 and 2.) The paper does not specify the pairs and adds m^2 to rad^2, so the pairs
are an argument here and both parts are given separately. Only the ratio of two energies over the same pairs
can be compared with the paper.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.trajectory import interpolate, motion_errors
from tactile.base.bounded import read_text_table
from tactile.base.errors import InputError
from tactile.base.se2 import between, wrap

_RELATIONS = {name: () for name in ("t1", "t2", "x", "y", "z", "roll", "pitch", "yaw")}


class Energy(NamedTuple):
    """The two parts of the energy, means over `pairs` pairs (NaN without pairs).

    Attributes:
        trans2: mean squared translation error, m^2. rot2: mean squared rotation error, rad^2.
    """

    trans2: float
    rot2: float
    pairs: int

    @property
    def total(self) -> float:
        """The paper's value: the sum of m^2 and rad^2."""
        return self.trans2 + self.rot2


class Relations(NamedTuple):
    """True relative motions between two times of a recording, as published with the benchmark.

    Attributes:
        start: [P] s. end: [P] s. motion: [P, 3] pose at `end` relative to that at `start`, m, m, rad.
    """

    start: np.ndarray
    end: np.ndarray
    motion: np.ndarray


def energy(estimate: np.ndarray, truth: np.ndarray, pairs: np.ndarray) -> Energy:
    """Energy over the given pairs.

    Args:
        estimate: [N, 3] poses. truth: [N, 3] true poses of the same rows.
        pairs: [P, 2] row indices: `successive_pairs(...)`, the links of a map, or any others.
    """
    if len(pairs) == 0:
        return Energy(np.nan, np.nan, 0)
    x, y, turn = motion_errors(estimate, truth, pairs).T
    return Energy(float(np.mean(x * x + y * y)), float(np.mean(turn * turn)), len(pairs))


def energy_all_pairs(estimate: np.ndarray, truth: np.ndarray) -> Energy:
    """Energy over every pair i < j, in O(N log N) time and O(N) memory.

    Positions as complex numbers z (estimate) and w (truth). The translation error of a pair is
    |a_i (z_j - z_i) - (w_j - w_i)|, where a_i rotates the estimated to the true heading at row i, so the sum
    of its squares over j follows from four running sums. The rotation error is the wrapped difference of the
    two rows' heading errors; with those sorted, running sums also correct the pairs that need wrapping.

    Args:
        estimate: [N, 3] poses. truth: [N, 3] true poses of the same rows.
    """
    count = len(estimate)
    pairs = count * (count - 1) // 2
    if pairs == 0:
        return Energy(np.nan, np.nan, 0)
    z = (estimate[:, 0] - estimate[:, 0].mean()) + 1j * (estimate[:, 1] - estimate[:, 1].mean())
    w = (truth[:, 0] - truth[:, 0].mean()) + 1j * (truth[:, 1] - truth[:, 1].mean())
    a = np.exp(1j * (truth[:, 2] - estimate[:, 2]))
    here = a * z - w
    squares = _after(np.abs(z) ** 2 + np.abs(w) ** 2) - 2 * (a * _after(z * w.conj())).real
    cross = (here.conj() * (a * _after(z) - _after(w))).real
    trans2 = np.sum(squares - 2 * cross + np.arange(count)[::-1] * np.abs(here) ** 2)
    # The sum over i < j of wrap(angle_j - angle_i)^2 for heading errors within one turn: without wrapping,
    # plus the correction of the pairs that lie more than half a turn apart.
    angle = wrap(estimate[:, 2] - truth[:, 2])
    angle = np.sort(angle - angle.mean())
    far = np.searchsorted(angle, angle - np.pi)  # for each, how many lie more than half a turn below
    below = np.concatenate([[0.0], np.cumsum(angle)])[far]
    plain = len(angle) * np.sum(angle**2) - np.sum(angle) ** 2
    turn = 2 * np.pi
    rot2 = float(plain + np.sum(far * turn**2 - 2 * turn * (far * angle - below)))
    # rounding of the running sums may put a perfect estimate below zero
    return Energy(max(0.0, float(trans2)) / pairs, max(0.0, rot2) / pairs, pairs)


def read_relations(path: str | Path) -> Relations:
    """A relations file, `t1 t2 x y z roll pitch yaw` a line (z, roll and pitch are ignored).

    Raises:
        InputError: the file cannot be read or a line is malformed.
    """
    start, end, x, y, _, _, _, yaw = read_text_table(path, _RELATIONS)[0].T
    return Relations(start, end, np.stack([x, y, yaw], axis=1))


def relation_errors(
    time: np.ndarray, pose: np.ndarray, relations: Relations
) -> tuple[float, float, int, int]:
    """Mean absolute error of a trajectory's motions against true ones (Kuemmerle et al. 2009, unsquared).

    Args:
        time: [N] s, increasing. pose: [N, 3]; interpolated at both ends of each relation.

    Returns:
        Errors of translation, m, and of rotation, degrees; number of relations inside and outside the
        recording.

    Raises:
        InputError: no relation lies inside the recording.
    """
    found = between(interpolate(time, pose, relations.start), interpolate(time, pose, relations.end))
    inside = np.isfinite(found).all(axis=1)
    if not inside.any():
        raise InputError("relations", "none inside the recording", f"times from {time[0]} to {time[-1]} s")
    error = between(relations.motion[inside], found[inside])
    used, rotation = int(inside.sum()), float(np.degrees(np.mean(np.abs(error[:, 2]))))
    translation = float(np.mean(np.hypot(error[:, 0], error[:, 1])))
    return translation, rotation, used, len(inside) - used


def _after(values: np.ndarray) -> np.ndarray:
    """For each row, the sum over the rows after it: [N]."""
    return np.cumsum(values[::-1])[::-1] - values
