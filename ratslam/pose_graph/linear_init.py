"""Linear initialization of a pose graph: headings first, then positions, each by a linear solve.

Sources: Carlone et al. 2014 (headings, then positions); Martinec & Pajdla 2007, Carlone et al. 2015 (headings
as complex numbers, which have no branches).
"""

from __future__ import annotations

import numpy as np

from ratslam.pose_graph.chains import Chains, find_chains
from ratslam.pose_graph.edges import Edges, information_diagonals
from ratslam.pose_graph.sparsity import SparseEquations, component_roots
from tactile.base.se2 import wrap


def linear_initialization(count: int, edges: Edges, first: np.ndarray | None = None) -> np.ndarray:
    """[count, 3] poses by sparse linear solves over the junctions of the graph: exact for small noise.

    The number of full turns in each closure follows from a solve for (cos, sin) of all headings, so drift
    beyond pi does not select the wrong branch. Node 0 is placed at `first` [3] (None: the origin), and so is
    the first node of every component that is not connected to it.
    """
    first = np.zeros(3) if first is None else np.asarray(first, float)
    weight = information_diagonals(edges.information)
    heavy, light = weight[:, 2], weight[:, :2].mean(axis=1)
    chains = find_chains(count, edges.i, edges.j, (heavy > 0) & (light > 0))
    reduced = _ReducedGraph(chains, SparseEquations(len(chains.junctions), chains.start, chains.end))

    rough = reduced.complex_headings(heavy, edges.motion[:, 2])
    at, to = rough[chains.start], rough[chains.end]
    turn = reduced.differences(edges.motion[:, 2])
    turn += 2 * np.pi * np.round((to - at - turn) / (2 * np.pi))
    heading = reduced.solve(count, heavy, edges.motion[:, 2:], turn[:, None])[:, 0] + first[2]
    c, s = np.cos(heading[edges.i]), np.sin(heading[edges.i])
    x, y = edges.motion[:, 0], edges.motion[:, 1]
    moved = np.stack([c * x - s * y, s * x + c * y], axis=1)
    position = reduced.solve(count, light, moved) + first[:2]
    return np.column_stack([position, wrap(heading)])


class _ReducedGraph:
    """The graph of junctions: measurements and weights of its edges, and solves over it."""

    def __init__(self, chains: Chains, equations: SparseEquations) -> None:
        self.chains, self.equations = chains, equations

    def differences(self, measured: np.ndarray) -> np.ndarray:
        """[..., C + L] differences end - start from those measured over all edges [..., E]."""
        chains = self.chains
        total = chains.sums(chains.sign * measured[..., chains.edge])
        return np.concatenate([total, measured[..., chains.direct]], axis=-1)

    def reduce_weight(self, weight: np.ndarray) -> np.ndarray:
        """[C + L] weights from those of all edges [E]; along a chain variances add up."""
        chains = self.chains
        return np.concatenate([1 / chains.sums(1 / weight[chains.edge]), weight[chains.direct]])

    def complex_headings(self, weight: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """[J] headings in (-pi, pi]: arguments of the least-squares solution of z_end = z_start e^it."""
        chains, weight = self.chains, self.reduce_weight(weight)
        pull = weight * np.exp(1j * self.differences(turns))
        entries = np.concatenate([weight, weight, -pull.conj(), -pull])
        right = np.zeros(len(chains.junctions), complex)
        for here, there, pulled in (
            (chains.start, chains.end, pull),
            (chains.end, chains.start, pull.conj()),
        ):
            known = (here == 0) & (there > 0)
            np.add.at(right, there[known], pulled[known])
        fixed = self._roots(weight)
        right[fixed] += 1.0
        z = self.equations.solve(entries, fixed, right[:, None])
        return np.zeros(len(right)) if z is None else np.angle(z[:, 0]) * (np.arange(len(right)) > 0)

    def solve(
        self, count: int, weight: np.ndarray, measured: np.ndarray, change: np.ndarray | None = None
    ) -> np.ndarray:
        """[count, D] least-squares values for measured differences j - i [E, D]; 0 at node 0.

        Args:
            change: [C + L, D] replaces the sums of the measured differences along chains.
        """
        chains, stiff = self.chains, self.reduce_weight(weight)
        change = self.differences(measured.T).T if change is None else change
        pull = stiff[:, None] * change
        size = len(chains.junctions)
        right = np.stack(
            [np.bincount(chains.end, p, size) - np.bincount(chains.start, p, size) for p in pull.T], axis=1
        )
        at = self.equations.solve(np.concatenate([stiff, stiff, -stiff, -stiff]), self._roots(stiff), right)
        values = np.zeros((count, measured.shape[1]))
        if at is None:
            return values
        values[chains.junctions] = at
        chained = len(chains.first)
        a, b = at[chains.start[:chained]], at[chains.end[:chained]]
        tension = stiff[:chained, None] * (b - a - change[:chained])
        own = chains.sign[:, None] * measured[chains.edge]
        # A full turn is added to the chain as a whole, not to one of its edges.
        own[chains.first] += change[:chained] - chains.sums(own.T).T
        steps = own + tension[chains.chain] / weight[chains.edge, None]
        values[chains.inner] = chains.inner_values(a.T, steps.T).T
        return values

    def _roots(self, weight: np.ndarray) -> np.ndarray:
        tied = weight > 0
        return component_roots(len(self.chains.junctions), self.chains.start[tied], self.chains.end[tied])
