"""SE(2) pose graphs of the classic map: edges, robust nonlinear least squares, g2o and node-link JSON files.

The error of an edge is that of g2o (Kuemmerle et al. 2011). The cost, with the robust kernel of Huber or of
Geman & McClure, is minimised from an initial guess by a damped Newton's method (Levenberg-Marquardt), with
the curvature of the kernels (Triggs et al. 2000) and the block factorisation of `normal_equations`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order

from ratslam.mapping.normal_equations import BlockPattern, elimination_order
from tactile.base.bounded import SPOILT, malformed, read_text
from tactile.base.compiled import compiled
from tactile.base.se2 import wrap

if TYPE_CHECKING:
    import networkx


PI = float(np.pi)
Triple = tuple[np.ndarray, np.ndarray, np.ndarray]


class Edges(NamedTuple):
    """E relative poses measured between nodes.

    Attributes:
        i, j: [E] int, nodes. motion: [E, 3] measured pose of j in the frame of i (m, m, rad).
        information: [E, 3] inverse variances, or [E, 3, 3] inverse covariances.
    """

    i: np.ndarray
    j: np.ndarray
    motion: np.ndarray
    information: np.ndarray


@compiled
def difference_error(poses: np.ndarray, i: np.ndarray, j: np.ndarray, motion: np.ndarray) -> Triple:
    """The error of g2o: the pose of j in the frame of i, minus the measured one, in the measured frame.

    Args:
        i, j, motion: see `Edges`.

    Returns:
        errors [E, 3] and their Jacobians [E, 3, 3] by the poses of i and of j.
    """
    error, by_a, by_b = np.empty((len(i), 3)), np.zeros((len(i), 3, 3)), np.zeros((len(i), 3, 3))
    for e in range(len(i)):
        a, b, (x, y, turn) = poses[i[e]], poses[j[e]], motion[e]
        c, s = np.cos(a[2] + turn), np.sin(a[2] + turn)
        cm, sm = np.cos(turn), np.sin(turn)
        dx, dy = b[0] - a[0], b[1] - a[1]
        ahead, aside = c * dx + s * dy, c * dy - s * dx
        error[e, 0], error[e, 1] = ahead - (cm * x + sm * y), aside - (cm * y - sm * x)
        error[e, 2] = PI - (PI - (b[2] - a[2] - turn)) % (2 * PI)
        by_b[e, 0, 0], by_b[e, 0, 1], by_b[e, 1, 0], by_b[e, 1, 1], by_b[e, 2, 2] = c, s, -s, c, 1.0
        by_a[e] = -by_b[e]
        by_a[e, 0, 2], by_a[e, 1, 2] = aside, -ahead
    return error, by_a, by_b


def _information_matrices(information: np.ndarray) -> np.ndarray:
    """[E, 3, 3] information in either form as matrices."""
    return information if information.ndim == 3 else information[:, :, None] * np.eye(3)


GROWN = 1.05
"""Growth of the number of edges by which the order of elimination is computed anew."""
INITIAL_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e-12, 1e12
FIRST_DAMPING, DAMPING_FACTOR = 1e-6, 10.0
"""Damping is multiplied by the factor, to the first times the factor at least, when a step fails; divided
when it succeeds."""


class GraphEquations:
    """The normal equations of all nodes, by blocks. Damping acts on the change of every node.

    Args:
        ordered: number of edges, the first ones, by which the nodes are ordered for elimination; nodes that
            they do not join come last. before: equations of the same graph with fewer edges.
    """

    def __init__(self, count: int, edges: Edges, ordered: int, before: GraphEquations | None = None) -> None:
        i, j = edges.i - 1, edges.j - 1  # node 0 is fixed
        tied = (i >= 0) & (j >= 0) & (i != j)
        self.ordered = ordered
        if before is not None and before.ordered == ordered:
            self.order: np.ndarray = before.order
        else:
            first = tied[:ordered]
            a, b = i[:ordered][first], j[:ordered][first]
            self.order = elimination_order(int(max(a.max(initial=-1), b.max(initial=-1))) + 1, a, b)
        place = np.concatenate([self.order, np.arange(len(self.order), count - 1)])
        self.pattern = BlockPattern(count - 1, i[tied], j[tied], place)
        self.size = count, len(i)
        position, slot = np.append(place, -1), np.full(len(i), -1)
        slot[tied] = self.pattern.slot
        self._ends = position[i], position[j], slot
        ties = csr_matrix((np.ones(len(i), np.int8), (edges.i, edges.j)), (count, count))
        nodes, parent = breadth_first_order(ties, 0, directed=False)
        self._tree = nodes[1:].astype(np.int64), parent[nodes[1:]].astype(np.int64)

    def step(
        self, errors: Triple, information: np.ndarray, weights: np.ndarray, curvature: np.ndarray, damp: float
    ) -> np.ndarray | None:
        """The damped step of Newton's method [N, 3], or None if the equations are singular.

        Args:
            errors: see `difference_error`. information: [E, 3, 3]. weights, curvature: [E], see `Kernel`.
        """
        n = self.pattern.count
        diagonal, right = np.zeros((n, 3, 3)), np.zeros((n, 3, 1))
        above = np.zeros((len(self.pattern.row), 3, 3))
        _add_edges(self._ends, errors, information, weights, curvature, (diagonal, above, right))
        scale = np.diagonal(diagonal, axis1=1, axis2=2)
        diagonal[:, range(3), range(3)] += damp * np.where(scale > 0, scale, 1.0) + (scale == 0)
        factor = self.pattern.factorise(diagonal, above)
        if factor is None:
            return None
        change = factor.solve(right)[self.pattern.place, :, 0]
        return np.concatenate([np.zeros((1, 3)), change]) if np.isfinite(change).all() else None

    def move(self, poses: np.ndarray, change: np.ndarray) -> np.ndarray:
        """The poses after a step [N, 3], taken in the poses of the nodes relative to each other along a
        tree: where a node turns, the nodes behind it go round it, not along the tangent."""
        moved = poses + change
        _move_along_tree(*self._tree, poses, change, moved)
        moved[:, 2] = wrap(moved[:, 2])
        return moved


@compiled
def _move_along_tree(
    nodes: np.ndarray, parents: np.ndarray, poses: np.ndarray, change: np.ndarray, moved: np.ndarray
) -> None:
    """Replaces the moved poses of nodes [T], which come after their parents [T]."""
    for k in range(len(nodes)):
        n, p = nodes[k], parents[k]
        x, y, turn = poses[n, 0] - poses[p, 0], poses[n, 1] - poses[p, 1], change[p, 2]
        x += change[n, 0] - change[p, 0] + turn * y
        y += change[n, 1] - change[p, 1] - turn * (poses[n, 0] - poses[p, 0])
        rotated = moved[p, 2] - poses[p, 2]
        c, s = np.cos(rotated), np.sin(rotated)
        moved[n, 0], moved[n, 1] = moved[p, 0] + c * x - s * y, moved[p, 1] + s * x + c * y


@compiled
def _add_edges(
    ends: Triple, errors: Triple, information: np.ndarray, trust: np.ndarray, bend: np.ndarray, blocks: Triple
) -> None:
    """Adds edges to the equations: of each the weight `trust` [E] times J' W J, less the curvature `bend` [E]
    times (J' W e) (J' W e)', and the weight times -J' W e; see `Kernel`.

    Args:
        ends: [E] position of either node in the order of elimination, -1 for node 0, and the block above
            the diagonal. blocks: diagonal [n, 3, 3], above [B, 3, 3], right [n, 3, 1].
    """
    (at_i, at_j, slot), (error, by_i, by_j), (diagonal, above, right) = ends, errors, blocks
    pull, tight = np.empty(3), np.empty((3, 3))
    for e in range(len(slot)):
        if at_i[e] == at_j[e]:
            continue
        for r in range(3):
            pull[r] = 0.0
            for c in range(3):
                pull[r] += information[e, r, c] * error[e, c]
        for r in range(3):
            for c in range(3):
                tight[r, c] = trust[e] * information[e, r, c] - bend[e] * pull[r] * pull[c]
        for at, by in ((at_i[e], by_i[e]), (at_j[e], by_j[e])):
            if at >= 0:
                _add_product(by, tight, by, diagonal[at])
                for p in range(3):
                    for r in range(3):
                        right[at, p, 0] -= trust[e] * by[r, p] * pull[r]
        if slot[e] >= 0 and at_i[e] < at_j[e]:
            _add_product(by_i[e], tight, by_j[e], above[slot[e]])
        elif slot[e] >= 0:
            _add_product(by_j[e], tight, by_i[e], above[slot[e]])


@compiled
def _add_product(a: np.ndarray, middle: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """out [3, 3] += a' middle b."""
    for p in range(3):
        for c in range(3):
            pulled = a[0, p] * middle[0, c] + a[1, p] * middle[1, c] + a[2, p] * middle[2, c]
            for q in range(3):
                out[p, q] += pulled * b[c, q]


@compiled
def _chi_squares(error: np.ndarray, information: np.ndarray) -> np.ndarray:
    """[E] squared Mahalanobis errors."""
    chi2 = np.zeros(len(error))
    for e in range(len(error)):
        for r in range(3):
            for c in range(3):
                chi2[e] += error[e, r] * information[e, r, c] * error[e, c]
    return chi2


Function = Callable[[np.ndarray], np.ndarray]
Kernel = tuple[Function, Function, Function]
"""A robust kernel: weight (the slope of the cost), cost, and curvature (twice the fall of the slope, at most
the weight over the squared error) of an edge as functions of its squared Mahalanobis error."""

no_kernel: Kernel = (np.ones_like, lambda chi2: chi2, np.zeros_like)
"""Plain least squares."""


def huber(scale: float) -> Kernel:
    """Cost linear beyond `scale` standard deviations, so the influence of an edge is bounded (Huber 1964)."""
    return (
        lambda chi2: np.minimum(1.0, scale / np.sqrt(np.maximum(chi2, 1e-300))),
        lambda chi2: np.where(chi2 <= scale**2, chi2, 2 * scale * np.sqrt(chi2) - scale**2),
        lambda chi2: np.where(chi2 <= scale**2, 0.0, scale / np.maximum(chi2, 1e-300) ** 1.5),
    )


def geman_mcclure(mu: float) -> Kernel:
    """Cost bounded by mu: an error far beyond sqrt(mu) standard deviations has no influence (Geman 1985)."""

    def curvature(chi2: np.ndarray) -> np.ndarray:
        weight = (mu / (mu + chi2)) ** 2
        return weight * np.minimum(4 / (mu + chi2), 1 / np.maximum(chi2, 1e-300))

    return (lambda chi2: (mu / (mu + chi2)) ** 2, lambda chi2: mu * chi2 / (mu + chi2), curvature)


class Termination(Enum):
    """Reason for the end of the search."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "the iteration limit was reached; raise it or start nearer"
    NO_DECREASE = "no step lowers the cost; another start may be better"
    SINGULAR = "the equations are singular; check that every node is connected to node 0"
    NOT_FINITE = "a pose, a measurement or its information is not finite"


class Solution(NamedTuple):
    """Poses [N, 3], reason for the end, number of steps, final cost, and robust weights [E] of the edges."""

    poses: np.ndarray
    termination: Termination
    iterations: int
    cost: float
    weights: np.ndarray


def least_squares(
    poses: np.ndarray,
    edges: Edges,
    *,
    kernel: Kernel = no_kernel,
    robust: np.ndarray | None = None,
    iterations: int = 50,
    tolerance: float = 1e-9,
    equations: GraphEquations | None = None,
) -> Solution:
    """Levenberg-Marquardt from the given poses [N, 3]; node 0 is fixed.

    Args:
        kernel: applied to the edges of `robust` [E] bool (None: to all); other edges have weight 1.
        tolerance: the largest change of a step at convergence, m and rad. equations: of this graph, where
            they are known.

    Returns:
        a solution whose poses are finite if the given poses are; without any improvement, the given poses.
    """
    poses, unit = np.array(poses, float), np.ones(len(edges.i))
    if not all(np.isfinite(values).all() for values in (poses, edges.motion, edges.information)):
        return Solution(poses, Termination.NOT_FINITE, 0, np.inf, unit)
    if len(edges.i) == 0 or len(poses) < 2:
        return Solution(poses, Termination.CONVERGED, 0, 0.0, unit)
    robust = np.ones(len(edges.i), bool) if robust is None else np.asarray(robust, bool)
    information = _information_matrices(edges.information)
    problem = edges, information, kernel, robust
    errors, weights, curvature, cost = _evaluate(poses, *problem)
    if not np.isfinite(cost):
        return Solution(poses, Termination.NOT_FINITE, 0, np.inf, unit)
    equations = equations or GraphEquations(len(poses), edges, len(edges.i))
    # Damped steps until one ends the search; damping rises after a step that raises the cost.
    damping, taken = INITIAL_DAMPING, 0
    termination = Termination.ITERATION_LIMIT
    while taken < iterations:
        step = equations.step(errors, information, weights, curvature, damping)
        if step is None:
            termination = Termination.SINGULAR
            break
        moved = poses + step
        moved[:, 2] = wrap(moved[:, 2])
        small, trial = np.abs(step).max() < tolerance, _evaluate(moved, *problem)
        if not small and not trial[-1] <= cost:
            moved = equations.move(poses, step)
            trial = _evaluate(moved, *problem)
        if trial[-1] <= cost * (1 + 1e-12) + 1e-300:
            taken += 1
            small = small or cost - trial[-1] <= 1e-12 * cost
            poses, damping = moved, max(damping / DAMPING_FACTOR, LEAST_DAMPING)
            errors, weights, curvature, cost = trial
        elif not small:
            damping = max(damping, FIRST_DAMPING) * DAMPING_FACTOR
        if small:
            termination = Termination.CONVERGED
            break
        if damping > MOST_DAMPING:
            termination = Termination.NO_DECREASE
            break
    return Solution(poses, termination, taken, cost, weights)


def _evaluate(
    poses: np.ndarray, edges: Edges, information: np.ndarray, kernel: Kernel, robust: np.ndarray
) -> tuple[Triple, np.ndarray, np.ndarray, float]:
    """Errors with Jacobians, robust weights [E] and curvature [E], and cost at some poses."""
    errors = difference_error(poses, edges.i, edges.j, edges.motion)
    with np.errstate(over="ignore", invalid="ignore"):
        chi2 = _chi_squares(errors[0], information)
        among, weights, curvature = chi2[robust], np.ones(len(chi2)), np.zeros(len(chi2))
        weight, loss, bend = kernel
        weights[robust], curvature[robust] = weight(among), bend(among)
        chi2[robust] = loss(among)
    return errors, weights, curvature, float(chi2.sum())


def growing_equations(count: int, edges: Edges, before: GraphEquations | None) -> GraphEquations | None:
    """The equations of a graph to which nodes and edges are added, None without edges.

    The order of elimination is computed whenever the number of edges has grown by `GROWN`, from the edges up
    to a number that follows from their number now: so a graph that was loaded is solved to the same bits.

    Args:
        count: number of nodes. edges: those of the last call come first. before: what the last call gave.
    """
    if before is not None and before.size == (count, len(edges.i)):
        return before
    if not len(edges.i):
        return None
    ordered = int(GROWN ** np.floor(np.log(len(edges.i)) / np.log(GROWN) + 1e-9))
    return GraphEquations(count, edges, ordered, before)


EXPECTED = "a map.json written by ratslam"
UPPER = tuple(zip(*np.triu_indices(3), strict=True))


def write_g2o(path: Path, poses: np.ndarray, edges: Edges, fixed: Sequence[int] = ()) -> None:
    """Writes VERTEX_SE2 and EDGE_SE2 lines, and FIX lines for the vertices `fixed`; floats are exact
    (repr), so equal graphs give equal bytes."""
    lines = [f"VERTEX_SE2 {k} {_floats(pose)}" for k, pose in enumerate(poses)]
    lines += [f"FIX {k}" for k in fixed]
    information = _information_matrices(edges.information)
    for i, j, motion, weight in zip(edges.i, edges.j, edges.motion, information, strict=True):
        lines.append(f"EDGE_SE2 {int(i)} {int(j)} {_floats(motion)} {_floats(weight[k] for k in UPPER)}")
    Path(path).write_text("".join(line + "\n" for line in lines), encoding="utf-8")


def write_json(path: Path, graph: networkx.DiGraph) -> None:
    """Writes node-link JSON, which `networkx.node_link_graph` reads."""
    import networkx  # slow to import

    content = networkx.node_link_data(graph, edges="edges")
    Path(path).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> networkx.DiGraph:
    """Reads a node-link JSON file.

    Raises:
        InputError: the file is not node-link JSON.
    """
    import networkx  # slow to import

    with malformed(path, EXPECTED, spoilt=(*SPOILT, networkx.NetworkXException)):
        content = json.loads(read_text(path, EXPECTED))
        return networkx.DiGraph(networkx.node_link_graph(content, edges="edges"))


def _floats(values) -> str:
    return " ".join(repr(float(value)) for value in values)
