"""Headings first, then positions: each is linear once the other is known.

Sources: Carlone et al. 2014 (headings, then positions); Martinec & Pajdla 2007, Carlone et al. 2015 (turns
as complex numbers, which know no branches).
"""

from __future__ import annotations

import numpy as np

from ratslam.pose_graph.chains import Chains, chains
from ratslam.pose_graph.edges import Edges, diagonal
from ratslam.pose_graph.sparsity import Pattern, unreached
from tactile.base.se2 import wrap


def linear(count: int, edges: Edges, first: np.ndarray | None = None) -> np.ndarray:
    """Poses [count, 3] by sparse linear solves over the forks of the graph: exact for small noise.

    Which way round a closure turns is found by a solve for (cos, sin) of all headings beforehand, so drift
    beyond pi does not put it on the wrong branch. Node 0 is put at `first` [3] (None: the origin), and so is
    the first node of every part of the graph that is not tied to it.
    """
    first = np.zeros(3) if first is None else np.asarray(first, float)
    weight = diagonal(edges.information)
    heavy, light = weight[:, 2], weight[:, :2].mean(axis=1)
    found = chains(count, edges.i, edges.j, (heavy > 0) & (light > 0))
    folded = _Folded(found, Pattern(len(found.forks), found.a, found.b))

    rough = folded.turned(heavy, edges.motion[:, 2])
    at, to = rough[found.a], rough[found.b]
    turn = folded.change(edges.motion[:, 2])
    turn += 2 * np.pi * np.round((to - at - turn) / (2 * np.pi))
    heading = folded.spread(count, heavy, edges.motion[:, 2:], turn[:, None])[:, 0] + first[2]
    c, s = np.cos(heading[edges.i]), np.sin(heading[edges.i])
    x, y = edges.motion[:, 0], edges.motion[:, 1]
    moved = np.stack([c * x - s * y, s * x + c * y], axis=1)
    position = folded.spread(count, light, moved) + first[:2]
    return np.column_stack([position, wrap(heading)])


class _Folded:
    """The graph of forks: what its edges measure and how much that counts."""

    def __init__(self, found: Chains, pattern: Pattern) -> None:
        self.found, self.pattern = found, pattern

    def change(self, measured: np.ndarray) -> np.ndarray:
        """[..., R + L] differences b - a from those measured over all edges [..., E]."""
        found = self.found
        total = found.total(found.sign * measured[..., found.edge])
        return np.concatenate([total, measured[..., found.loose]], axis=-1)

    def weight(self, weight: np.ndarray) -> np.ndarray:
        """[R + L] from those of all edges [E]: along a chain variances add up."""
        found = self.found
        return np.concatenate([1 / found.total(1 / weight[found.edge]), weight[found.loose]])

    def turned(self, weight: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """[F] headings, in (-pi, pi], of the complex numbers z that best meet z_b = z_a exp(i turn)."""
        found, weight = self.found, self.weight(weight)
        pull = weight * np.exp(1j * self.change(turns))
        entries = np.concatenate([weight, weight, -pull.conj(), -pull])
        right = np.zeros(len(found.forks), complex)
        for here, there, pulled in ((found.a, found.b, pull), (found.b, found.a, pull.conj())):
            known = (here == 0) & (there > 0)
            np.add.at(right, there[known], pulled[known])
        held = self._held(weight)
        right[held] += 1.0
        z = self.pattern.solve(entries, held, right[:, None])
        return np.zeros(len(right)) if z is None else np.angle(z[:, 0]) * (np.arange(len(right)) > 0)

    def spread(
        self, count: int, weight: np.ndarray, measured: np.ndarray, change: np.ndarray | None = None
    ) -> np.ndarray:
        """[count, D] values whose differences j - i best equal those measured [E, D]; 0 at node 0.

        Args:
            change: [R + L, D] in place of what the measured ones add up to along chains.
        """
        found, stiff = self.found, self.weight(weight)
        change = self.change(measured.T).T if change is None else change
        pull = stiff[:, None] * change
        size = len(found.forks)
        right = np.stack(
            [np.bincount(found.b, p, size) - np.bincount(found.a, p, size) for p in pull.T], axis=1
        )
        at = self.pattern.solve(np.concatenate([stiff, stiff, -stiff, -stiff]), self._held(stiff), right)
        values = np.zeros((count, measured.shape[1]))
        if at is None:
            return values
        values[found.forks] = at
        chained = len(found.first)
        a, b = at[found.a[:chained]], at[found.b[:chained]]
        tension = stiff[:chained, None] * (b - a - change[:chained])
        own = found.sign[:, None] * measured[found.edge]
        # A whole turn more or less belongs to the chain, not to any of its edges.
        own[found.first] += change[:chained] - found.total(own.T).T
        steps = own + tension[found.chain] / weight[found.edge, None]
        values[found.inner] = found.along(a.T, steps.T).T
        return values

    def _held(self, weight: np.ndarray) -> np.ndarray:
        tied = weight > 0
        return unreached(len(self.found.forks), self.found.a[tied], self.found.b[tied])
