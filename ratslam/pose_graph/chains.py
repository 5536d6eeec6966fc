"""Chains of a pose graph: paths of nodes that have exactly two edges each.

Between loop closures odometry makes long chains, which hold most nodes of a long session. Measurements add up
along a chain, so it is equivalent to one edge between the two junctions at its ends, as springs in series are
equivalent to one spring. The reduced graph has only the junctions as nodes; the inner nodes follow from the
junctions afterwards.

    graph                                        reduced graph
                closure                                closure
          .---------------.                          .---------.
         |                 |                         |         |
    0 -- 1 -- 2 -- 3 -- 4 -- 5 -- 6             0 -- 1 ------- 5 -- 6
         J    o    o    o    J                       J  chain  J
         start  inner nodes  end

Here junctions (J) are nodes with other than two edges and node 0; 2, 3 and 4 are inner nodes of one chain of
four edges; 0-1, 1-5 (the closure) and 5-6 are direct edges between junctions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import depth_first_order


class Chains(NamedTuple):
    """The C chains of a graph of N nodes and E edges.

    A chain with k inner nodes has k + 1 edges. The arrays of length P list the edges of all chains, one chain
    after another; the arrays of length N - J list the inner nodes in the same order.

    Attributes:
        junctions: [J] int, nodes outside chains, node 0 first. inner: [N - J] int, the other nodes.
        edge: [P] int, edge numbers. sign: [P] 1.0 where an edge points along its chain, else -1.0.
        chain: [P] int, the chain of each edge, 0..C - 1. first: [C] int, the position in `edge` of the first
            edge of each chain. into: [N - J] int, the position in `edge` of the edge that leads to an inner
            node. direct: [L] int, edges between junctions.
        start, end: [C + L] int, positions in `junctions` of the ends of each edge of the reduced graph: the
            chains first, then the direct edges.
    """

    junctions: np.ndarray
    inner: np.ndarray
    edge: np.ndarray
    sign: np.ndarray
    chain: np.ndarray
    first: np.ndarray
    into: np.ndarray
    direct: np.ndarray
    start: np.ndarray
    end: np.ndarray

    def sums(self, values: np.ndarray) -> np.ndarray:
        """[..., C] the sum over each chain of values [..., P] of its edges."""
        if len(self.first) == 0:
            return values[..., :0]
        return np.add.reduceat(values, self.first, axis=-1)

    def inner_values(self, start: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """[..., N - J] values at the inner nodes, from those at the starts of the chains [..., C] and the
        differences over their edges [..., P]."""
        summed = np.cumsum(steps, axis=-1)
        before = summed[..., self.first] - steps[..., self.first]
        chain = self.chain[self.into]
        return (start - before)[..., chain] + summed[..., self.into]


def find_chains(count: int, i: np.ndarray, j: np.ndarray, reducible: np.ndarray) -> Chains:
    """The chains of a graph of nodes 0..count - 1 with edges from i [E] to j [E].

    Args:
        reducible: [E] bool. The ends of other edges are junctions, and so is node 0.
    """
    inner, head, last = _walk(count, i, j, reducible)
    into, out = _edges_in_order(_edge_pairs(count, i, j, inner), head, last)

    chain = np.cumsum(head) - 1
    place = np.arange(len(inner)) + chain
    first, final = place[head], place[last] + 1
    edge, sign = np.empty(len(inner) + len(first), np.int64), np.empty(len(inner) + len(first))
    edge[first], edge[place + 1] = into[head], out
    sign[first], sign[place + 1] = (
        np.where(j[into[head]] == inner[head], 1, -1),
        np.where(i[out] == inner, 1, -1),
    )
    start = np.where(sign[first] > 0, i[edge[first]], j[edge[first]])
    end = np.where(sign[final] > 0, j[edge[final]], i[edge[final]])

    is_junction, is_direct = np.ones(count, bool), np.ones(len(i), bool)
    is_junction[inner], is_direct[edge] = False, False
    number, direct = np.cumsum(is_junction) - 1, np.flatnonzero(is_direct)
    return Chains(
        junctions=np.flatnonzero(is_junction),
        inner=inner,
        edge=edge,
        sign=sign,
        chain=np.repeat(np.arange(len(first)), final - first + 1),
        first=first,
        into=place,
        direct=direct,
        start=number[np.concatenate([start, i[direct]])],
        end=number[np.concatenate([end, j[direct]])],
    )


def _edges_in_order(pair: np.ndarray, head: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each inner node, of its two edges [N - J, 2]: the one that leads to it and the one that leads on.

    Args:
        head, last: [N - J] bool, first and last inner nodes of chains.
    """
    into, out = pair[:, 0].copy(), pair[:, 1].copy()
    here = np.flatnonzero(~last)  # consecutive inner nodes share one edge
    common = (pair[here, :1] == pair[here + 1]).any(axis=1)
    out[here] = into[here + 1] = np.where(common, pair[here, 0], pair[here, 1])
    only = head & ~last
    into[only] = pair[only].sum(axis=1) - out[only]
    only = last & ~head
    out[only] = pair[only].sum(axis=1) - into[only]
    return into, out


def _walk(count: int, i: np.ndarray, j: np.ndarray, reducible: np.ndarray) -> tuple[np.ndarray, ...]:
    """The inner nodes in order along their chains, and bool: first of a chain, last of a chain."""
    between = np.bincount(i, minlength=count) + np.bincount(j, minlength=count) == 2
    between[0] = False
    fixed = ~reducible | (i == j)
    between[i[fixed]] = between[j[fixed]] = False
    both, one = between[i] & between[j], between[i] ^ between[j]
    ends = np.unique(np.where(between[i], i, j)[one])
    # An auxiliary node is connected to both ends of every chain: depth-first search from it visits each chain
    # from end to end. Isolated rings are not reached and are not chains.
    row = np.concatenate([np.full(len(ends), count), i[both], j[both]])
    column = np.concatenate([ends, j[both], i[both]])
    ties = csr_matrix((np.ones(len(row), np.int8), (row, column)), (count + 1, count + 1))
    order, before = depth_first_order(ties, count)
    inner = order[1:].astype(np.int64)
    head = before[inner] == count
    return inner, head, np.append(head[1:], True)[: len(inner)]


def _edge_pairs(count: int, i: np.ndarray, j: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """[N - J, 2] the two edges of each inner node."""
    place = np.full(count, -1)
    place[inner] = np.arange(len(inner))
    owner = place[np.concatenate([i, j])]
    order = np.argsort(owner, kind="stable")[np.count_nonzero(owner < 0) :]
    return order.reshape(-1, 2) % len(i) if len(i) else order.reshape(-1, 2)
