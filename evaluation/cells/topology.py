"""Holes in the states of a population: the topology of a sheet, by persistent homology.

The activity of grid cells of one module lies on a torus, which has two loops and one void (Gardner et al.
2022, Nature 602:123). Ripser finds loops and voids that live over a range of scales (Bauer 2021, J. Appl.
Comput. Topol. 5:391; ripser.py, MIT, extra [topology]). A control shifts each cell in time, as in
`evaluation.cells.shuffling`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from evaluation.cells.shuffling import SHORTEST_SHIFT
from tactile.base.errors import InputError
from tactile.base.random_streams import stream

STATES, LANDMARKS, COMPONENTS = 3000, 200, 6
"""States of a session, evenly spread; of these the ones whose holes are sought; principal components kept."""
NEIGHBOUR, DENSE = 20, 0.9
"""A state is as sparse as this neighbour is far; the share of states that is kept, the densest."""


class Holes(NamedTuple):
    """Lifetimes of the holes of a population, between states of length 1, longest first.

    Attributes:
        loops: [n] one-dimensional. voids: [m] two-dimensional.
    """

    loops: np.ndarray
    voids: np.ndarray


def find_holes(activity: np.ndarray) -> Holes:
    """The holes of the states [T, C] of C cells.

    Of `STATES` states the directions in the space of the first principal components, each of variance 1, are
    compared: the three waves of a torus of grid cells then count alike, and a packet that is wide and low is
    the state of a narrow one. The densest are kept, because few wrong ones fill a hole, and of these the
    `LANDMARKS` that are farthest from each other.

    Raises:
        InputError: ripser is not installed, or there are too few states.
    """
    try:
        from ripser import ripser
    except ImportError:
        cure = "pip install 'ratslam[topology]'"
        raise InputError("topology", "ripser is not installed", "the extra 'topology'", cure) from None
    rows = np.unique(np.linspace(0, len(activity) - 1, STATES).astype(int))
    if len(rows) * DENSE < LANDMARKS:
        raise InputError("activity", f"{len(rows)} states", f"at least {round(LANDMARKS / DENSE)}")
    states = np.asarray(activity[rows], np.float64)
    states -= states.mean(axis=0)
    states = np.linalg.svd(states, full_matrices=False)[0][:, :COMPONENTS]  # of equal variance
    states /= np.linalg.norm(states, axis=1, keepdims=True)
    sparse = np.sort(cdist(states, states), axis=1)[:, NEIGHBOUR]
    states = states[np.argsort(sparse, kind="stable")[: round(DENSE * len(states))]]
    chosen, apart = [0], cdist(states[:1], states)[0]
    while len(chosen) < LANDMARKS:
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, cdist(states[chosen[-1:]], states)[0])
    _, loops, voids = ripser(states[chosen], maxdim=2)["dgms"]
    return Holes(*(np.sort(bars[:, 1] - bars[:, 0])[::-1] for bars in (loops, voids)))


def shuffled_holes(activity: np.ndarray, rate: float, shuffles: int, seed: int) -> list[Holes]:
    """The holes of as many populations whose cells are each shifted in time by 20 s or more.

    Args:
        activity: [T, C]. rate: of its samples, Hz. seed: of the stream "shuffled holes".

    Raises:
        InputError: see `find_holes`; or the session is shorter than two such shifts.
    """
    least, random = round(SHORTEST_SHIFT * rate), stream(seed, "shuffled holes")
    if len(activity) <= 2 * least:
        found = f"{len(activity) / rate:.3g} s"
        raise InputError("activity", found, f"more than {2 * SHORTEST_SHIFT:g} s", "record longer")
    shifts = random.integers(least, len(activity) - least + 1, (shuffles, activity.shape[1]))
    return [
        find_holes(np.stack([np.roll(*pair) for pair in zip(activity.T, row, strict=True)], axis=1))
        for row in shifts
    ]
