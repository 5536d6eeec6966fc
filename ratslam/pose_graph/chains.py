"""Chains: runs of nodes of which each is tied to the one before and the one after, and to nothing else.

Between two closures odometry makes such runs, most of a long session. Along a run measurements add up, so it
is as good as one edge between the nodes it hangs on, the forks; what these are moved by is then shared out
along the run. Springs in series do the same.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import depth_first_order


class Chains(NamedTuple):
    """The chains of a graph of N nodes and E edges.

    A chain of k inner nodes has k + 1 edges; all edges of chains stand behind one another, P in number.

    Attributes:
        forks: [F] nodes that are in no chain, node 0 first. inner: [N - F] the others, along their chains.
        edge: [P] edges, along their chains. sign: [P] 1.0 where an edge points along its chain, else -1.0.
        chain: [P] which chain an edge is of, 0..R - 1. first: [R] where a chain's edges begin.
        into: [N - F] the place, 0..P - 1, of the edge that leads to an inner node.
        loose: [L] edges between forks.
        a, b: [R + L] forks, 0..F - 1, that an edge of the folded graph ties: chains come first, then what is
            loose.
    """

    forks: np.ndarray
    inner: np.ndarray
    edge: np.ndarray
    sign: np.ndarray
    chain: np.ndarray
    first: np.ndarray
    into: np.ndarray
    loose: np.ndarray
    a: np.ndarray
    b: np.ndarray

    def total(self, values: np.ndarray) -> np.ndarray:
        """[..., R] sums along the chains of values [..., P]."""
        if len(self.first) == 0:
            return values[..., :0]
        return np.add.reduceat(values, self.first, axis=-1)

    def along(self, start: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """[..., N - F] values at the inner nodes, from those at the starts of chains [..., R] and the
        differences over edges [..., P]."""
        walked = np.cumsum(steps, axis=-1)
        before = walked[..., self.first] - steps[..., self.first]
        chain = self.chain[self.into]
        return (start - before)[..., chain] + walked[..., self.into]


def chains(count: int, i: np.ndarray, j: np.ndarray, solid: np.ndarray) -> Chains:
    """The chains among nodes 0..count - 1 tied by edges from i [E] to j [E].

    Args:
        solid: [E] bool. Nodes at other edges are forks, and so is node 0.
    """
    inner, head, last = _walk(count, i, j, solid)
    pair = _pairs(count, i, j, inner)
    into, out = pair[:, 0].copy(), pair[:, 1].copy()
    here = np.flatnonzero(~last)  # the edge that two neighbours have in common leads from one to the other
    common = (pair[here, :1] == pair[here + 1]).any(axis=1)
    out[here] = into[here + 1] = np.where(common, pair[here, 0], pair[here, 1])
    lone = head & ~last
    into[lone] = pair[lone].sum(axis=1) - out[lone]
    lone = last & ~head
    out[lone] = pair[lone].sum(axis=1) - into[lone]

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
    stop = np.where(sign[final] > 0, j[edge[final]], i[edge[final]])

    fork, loose = np.ones(count, bool), np.ones(len(i), bool)
    fork[inner], loose[edge] = False, False
    number, between = np.cumsum(fork) - 1, np.flatnonzero(loose)
    return Chains(
        forks=np.flatnonzero(fork),
        inner=inner,
        edge=edge,
        sign=sign,
        chain=np.repeat(np.arange(len(first)), final - first + 1),
        first=first,
        into=place,
        loose=between,
        a=number[np.concatenate([start, i[between]])],
        b=number[np.concatenate([stop, j[between]])],
    )


def _walk(count: int, i: np.ndarray, j: np.ndarray, solid: np.ndarray) -> tuple[np.ndarray, ...]:
    """The inner nodes along their chains, and which of them begin and which end one."""
    passed = np.bincount(i, minlength=count) + np.bincount(j, minlength=count) == 2
    passed[0] = False
    kept = ~solid | (i == j)
    passed[i[kept]] = passed[j[kept]] = False
    both, one = passed[i] & passed[j], passed[i] ^ passed[j]
    doors = np.unique(np.where(passed[i], i, j)[one])
    # One more node is tied to both ends of every chain: depth first from there each chain is walked from end
    # to end. Rings that hang on nothing are never come to, and stay as they are.
    row = np.concatenate([np.full(len(doors), count), i[both], j[both]])
    column = np.concatenate([doors, j[both], i[both]])
    ties = csr_matrix((np.ones(len(row), np.int8), (row, column)), (count + 1, count + 1))
    order, before = depth_first_order(ties, count)
    inner = order[1:].astype(np.int64)
    head = before[inner] == count
    return inner, head, np.append(head[1:], True)[: len(inner)]


def _pairs(count: int, i: np.ndarray, j: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """[N - F, 2] the two edges of each inner node."""
    place = np.full(count, -1)
    place[inner] = np.arange(len(inner))
    owner = place[np.concatenate([i, j])]
    order = np.argsort(owner, kind="stable")[np.count_nonzero(owner < 0) :]
    return order.reshape(-1, 2) % len(i) if len(i) else order.reshape(-1, 2)
