"""The experience map: a pose graph of places (experiences), connected by the odometry between them.

A place is a pair of a view template and a pose of the packet. It is created when a view is new at a pose,
linked when a known place is reached by a new link, and set when it is reached by a known one (Milford & Wyeth
2004; Ball et al. 2013, sections 5 and 6). Motion accumulates in the body frame of the current node and
restarts at every new node, so a link remains valid when the solver moves its nodes. The growable arrays are
the state; networkx graphs are made from them on request.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from ratslam.classic.relaxation import relax
from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.core.backend import NO_CLOSURE, Evidence, Map
from ratslam.core.estimates import Action, Estimate
from ratslam.mapping.pose_graph import (
    Edges,
    GraphEquations,
    geman_mcclure,
    growing_equations,
    huber,
    least_squares,
    no_kernel,
    write_g2o,
    write_json,
)
from tactile.base.se2 import between, compose, inverse
from tactile.base.settings import Settings
from tactile.base.types import Array, Observation

if TYPE_CHECKING:
    import networkx


class OdometryNoise(Settings):
    """Uncertainty of the odometry between two nodes; variances grow with distance and turn."""

    per_metre: PositiveFloat = 0.05
    """Standard deviation of position after one metre, m."""
    heading_per_metre: NonNegativeFloat = 0.05
    """Standard deviation of heading after one metre, rad."""
    heading_per_radian: NonNegativeFloat = 0.05
    """Standard deviation of heading after a turn of one radian, rad."""
    least: PositiveFloat = 0.005
    """Least standard deviation of a link, m and rad."""


class LeastSquares(Settings):
    """SE(2) least squares, solved at every loop closure."""

    name: Literal["least_squares"] = "least_squares"
    """Selects this solver."""
    kernel: Literal["none", "huber", "geman_mcclure"] = "huber"
    """Robust kernel on loop closures."""
    scale: PositiveFloat = 1.0
    """Scale of the kernel, in standard deviations."""


class Relaxation(Settings):
    """The relaxation of Ball et al. 2013 after every action: each link in turn moves both of its ends."""

    name: Literal["relaxation"] = "relaxation"
    """Selects this solver."""
    loops: PositiveInt = 20
    """Sweeps per action."""
    correction: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Share of a link's error by which each end moves."""


class ExperienceConfig(Settings):
    """The experience map."""

    solver: Annotated[LeastSquares | Relaxation, Field(discriminator="name")] = LeastSquares()
    """Solver that makes the map consistent."""
    closures: bool = True
    """Use loop closures; without them the map is raw odometry."""
    noise: OdometryNoise = OdometryNoise()
    """Uncertainty of the odometry."""
    match_sd: PositiveFloat = 0.1
    """Standard deviation of the position at a recognised place, m."""
    match_sd_heading: PositiveFloat = 0.1
    """Standard deviation of the heading at a recognised place, rad."""


class Travel(NamedTuple):
    """Motion since the current node: pose [3] in its frame, variance [3], length in m, duration in s. At the
    node it is the difference of the heading from the stored one."""

    motion: np.ndarray
    variance: np.ndarray = np.zeros(3)
    length: float = 0.0
    duration: float = 0.0


class ExperienceMap(Checkpointed, Map):
    """The map of the classic backend.

    The fields of `arrays()` are its whole state: node poses [M, 3] (x m, y m, heading rad), the place each
    node stands for, links with their measured motion, and for every step its node and the motion
    since, which give the final trajectory.
    """

    VALUES = ("_current", "_travel")

    def __init__(self, config: ExperienceConfig | None = None) -> None:
        self.config = config or ExperienceConfig()
        self._pose = GrowableArray((3,), np.float64)
        self._node_of = GrowableArray((), np.int64)  # place id -> node, -1 for ids that never became a node
        self._template = GrowableArray((), np.int64)
        self._made = GrowableArray((), np.int64)  # the step at which each node was made
        self._ends = GrowableArray((2,), np.int64)
        self._motion = GrowableArray((3,), np.float64)
        self._information = GrowableArray((3,), np.float64)
        self._record = GrowableArray((3,), np.float64)  # traversals, metres, seconds
        self._closure = GrowableArray((), np.bool_)
        self._step_node = GrowableArray((), np.int64)
        self._step_motion = GrowableArray((3,), np.float64)
        self._odometry = GrowableArray((3,), np.float64)  # of each step, NaN where it is not known
        self._reached = GrowableArray((2,), np.int64)  # step, and the first step at the node reached
        self._link_of: dict[tuple[int, int], int] = {}
        self._growing: GraphEquations | None = None
        self._current = -1
        self._travel = Travel(np.zeros(3))

    def pose(self, estimate: Estimate) -> np.ndarray:
        """[3] the current node's pose and the motion since; before the first node, dead reckoning."""
        del estimate
        if self._is_odometry() and len(self._odometry.rows):
            return self._odometry.rows[-1].copy()
        return compose(self._origin(), self._travel.motion)

    def nodes(self) -> np.ndarray:
        """[M, 3] poses of the nodes."""
        return self._pose.rows.copy()

    def edges(self) -> Edges:
        """All links: ends, motion and information."""
        i, j = self._ends.rows.T.copy()
        return Edges(i, j, self._motion.rows.copy(), self._information.rows.copy())

    def trajectory(self) -> np.ndarray:
        """[T, 3] poses of all steps: present pose of the step's node, and the motion since; the odometry to
        the bit before a known node is reached."""
        if self._is_odometry():
            return self._odometry.rows.copy()
        node, motion = self._step_node.rows, self._step_motion.rows
        if not len(self._pose.rows):
            return motion.copy()
        origin = np.where(node[:, None] >= 0, self._pose.rows[np.maximum(node, 0)], 0.0)
        return compose(origin, motion)

    def unjudged(self) -> str:
        return "" if len(self._reached.rows) else NO_CLOSURE

    def _is_odometry(self) -> bool:
        return not len(self._reached.rows) and bool(np.isfinite(self._odometry.rows[-1:]).all())

    def closures(self) -> np.ndarray:
        """[M, 2] steps at which a known node was reached, and the step at which it was created."""
        return self._reached.rows.copy()

    def graph(self) -> networkx.DiGraph:
        """Nodes with x, y (m), heading (rad), template; links with dx, dy, dtheta, and their traversals."""
        import networkx  # slow to import

        graph: networkx.DiGraph = networkx.DiGraph()
        for node, (pose, template) in enumerate(zip(self._pose.rows, self._template.rows, strict=True)):
            x, y, heading = map(float, pose)
            graph.add_node(node, x=x, y=y, heading=heading, template=int(template))
        links = zip(self._ends.rows, self._motion.rows, self._record.rows, self._closure.rows, strict=True)
        for (a, b), motion, (traversals, length, duration), closure in links:
            dx, dy, dtheta = map(float, motion)
            graph.add_edge(
                int(a), int(b), dx=dx, dy=dy, dtheta=dtheta, traversals=int(traversals),
                length=float(length), duration=float(duration), closure=bool(closure),
            )  # fmt: skip
        return graph

    def files(self) -> dict[str, Callable[[Path], None]]:
        """The map as node-link JSON and as a g2o graph."""
        return {
            "map.json": lambda path: write_json(path, self.graph()),
            "map.g2o": lambda path: write_g2o(path, self.nodes(), self.edges()),
        }

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Adds the odometry, then creates, links or reaches a node by the action of the estimate."""
        self._advance(observation.odometry)
        action, place = int(estimate.action), int(estimate.place)
        relative = float(evidence.relative)
        if action == Action.CREATE:
            self._create(place, int(evidence.template), relative)
        elif action in (Action.LINK, Action.SET) and self.config.closures and self._find_node(place) >= 0:
            node = self._find_node(place)
            self._reached.append((len(self._step_node.rows), self._made.rows[node]))
            measured = compose(self._travel.motion, np.array([0.0, 0.0, -relative]))
            self._arrive(node, measured, relative, closure=True)
        self._step_node.append(self._current)
        self._step_motion.append(self._travel.motion)
        return estimate

    def _advance(self, odometry) -> None:
        moved = np.array([float(odometry.dx), float(odometry.dy), float(odometry.dtheta)])
        before = self._odometry.rows[-1] if len(self._odometry.rows) else np.zeros(3)
        self._odometry.append(compose(before, moved) if np.isfinite(moved).all() else before.copy())
        if not np.isfinite(moved).all():
            return  # the kernel reports NOT_FINITE
        noise, length = self.config.noise, float(np.hypot(moved[0], moved[1]))
        heading = noise.heading_per_metre**2 * length + noise.heading_per_radian**2 * abs(moved[2])
        along = noise.per_metre**2 * length
        travel = self._travel
        variance = travel.variance + np.array([along, along, heading])
        duration = travel.duration + float(odometry.dt)
        self._travel = Travel(compose(travel.motion, moved), variance, travel.length + length, duration)

    def _create(self, place: int, template: int, relative: float) -> None:
        node = len(self._pose.rows)
        measured = compose(self._travel.motion, np.array([0.0, 0.0, -relative]))
        self._pose.append(compose(self._origin(), measured))
        self._template.append(template)
        self._made.append(len(self._step_node.rows))
        while len(self._node_of.rows) <= place:
            self._node_of.append(-1)
        self._node_of.rows[place] = node
        self._arrive(node, measured, relative, closure=False)

    def _arrive(self, node: int, measured: np.ndarray, relative: float, closure: bool) -> None:
        """Links a node with the one before, goes on from it, and solves the map."""
        if self._current >= 0 and node != self._current:
            self._link(node, measured, closure)
        self._current = node
        self._travel = Travel(np.array([0.0, 0.0, relative]))
        self._solve(closure)

    def _link(self, node: int, measured: np.ndarray, closure: bool) -> None:
        """Adds a link, or merges another traversal of a known one by the inverse-variance mean."""
        variance = self._travel.variance + self.config.noise.least**2
        if closure:
            xy, heading = self.config.match_sd**2, self.config.match_sd_heading**2
            variance = variance + np.array([xy, xy, heading])
        information = 1 / variance
        evidence = np.array([1.0, self._travel.length, self._travel.duration])
        known = self._link_of.get((self._current, node))
        backwards = known is None and (node, self._current) in self._link_of
        if backwards:
            known = self._link_of[node, self._current]
            measured = inverse(measured)
        if known is None:
            self._link_of[self._current, node] = len(self._ends.rows)
            self._ends.append((self._current, node))
            self._motion.append(measured)
            self._information.append(information)
            self._record.append(evidence)
            self._closure.append(closure)
            return
        before = self._information.rows[known]
        total = before + information
        motion = self._motion.rows[known]
        step = between(np.array([0.0, 0.0, motion[2]]), np.array([0.0, 0.0, measured[2]]))[2]
        share = information / total
        self._motion.rows[known] = motion + share * np.array([*(measured - motion)[:2], step])
        self._information.rows[known] = total
        self._record.rows[known] += evidence

    def _solve(self, closure: bool) -> None:
        """Moves the nodes: by least squares at a loop closure, or by the relaxation after every action."""
        solver = self.config.solver
        if isinstance(solver, LeastSquares) and closure:
            poses, edges, scale = self._pose.rows, self.edges(), solver.scale
            kernels = {"none": no_kernel, "huber": huber(scale), "geman_mcclure": geman_mcclure(scale**2)}
            self._growing = growing_equations(len(poses), edges, self._growing)
            kernel, robust = kernels[solver.kernel], self._closure.rows
            solution = least_squares(poses, edges, kernel=kernel, robust=robust, equations=self._growing)
            self._pose.rows[:] = solution.poses
        elif isinstance(solver, Relaxation) and len(self._ends.rows):
            x, y, turn = self._motion.rows.T
            links = (*self._ends.rows.T, np.hypot(x, y), np.arctan2(y, x), turn)
            self._pose.rows[:] = relax(self._pose.rows, links, solver.loops, solver.correction)

    def _origin(self) -> np.ndarray:
        return self._pose.rows[self._current] if self._current >= 0 else np.zeros(3)

    def _find_node(self, place: int) -> int:
        return int(self._node_of.rows[place]) if 0 <= place < len(self._node_of.rows) else -1

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        super().restore(arrays)
        self._link_of = {(int(a), int(b)): k for k, (a, b) in enumerate(self._ends.rows)}
        self._growing = None


TIE = 1e-9
"""Distances, in radii, that differ by less are equal, so rounding does not decide."""


class PlaceConfig(Settings):
    """Size of places."""

    radius: PositiveFloat = 2.0
    """Radius along x and y, cells."""
    radius_heading: PositiveFloat = 2.0
    """Radius along heading, cells."""


class Places(NamedTuple):
    """The stored places, rows in order of creation.

    Attributes:
        packet: [C, 3] pose of the packet at creation, cells, minus the relative heading of the view.
        template: [C] int32. count, current: int32; current is -1 before the first place.
        link: [C, 2] int32, linked pairs of places; links: their number, int32.
    """

    packet: Array
    template: Array
    count: Array
    current: Array
    link: Array
    links: Array


def start(capacity: int, dtype: np.dtype) -> Places:
    """An empty store."""
    return Places(
        packet=jnp.zeros((capacity, 3), dtype),
        template=jnp.full(capacity, -1, jnp.int32),
        count=jnp.int32(0),
        current=jnp.int32(-1),
        link=jnp.full((capacity, 2), -1, jnp.int32),
        links=jnp.int32(0),
    )


def distance(config: PlaceConfig, rings: np.ndarray, store: Places, packet: Array) -> Array:
    """[C] distances of a packet [3] from all places, in radii, wrapped along each ring."""
    apart = jnp.abs(store.packet - packet[None, :])
    apart = jnp.minimum(apart, rings[None, :] - apart)
    reach = np.array([[config.radius, config.radius, config.radius_heading]], apart.dtype)
    return jnp.sqrt(jnp.sum((apart / reach) ** 2, axis=1))


def decide(
    config: PlaceConfig, rings: np.ndarray, store: Places, packet: Array, template: Array, seen: Array
) -> tuple[Places, tuple[Array, Array, Array, Array]]:
    """Keeps, reaches or creates a place, given the template and the packet [3] of a view.

    Returns:
        the store; and the current place after the step, the one before, an `Action`, and bool: the store was
        not full.
    """
    capacity = store.template.shape[0]
    row = jnp.arange(capacity, dtype=jnp.int32)
    previous, origin = store.current, jnp.maximum(store.current, 0)
    far = distance(config, rings, store, packet)

    stay = (previous >= 0) & (store.template[origin] == template) & (far[origin] <= 1 + TIE)
    candidate = (row < store.count) & (store.template == template) & (row != previous) & (far < 1 - TIE)
    nearest = jnp.min(jnp.where(candidate, far, jnp.inf))
    reached = jnp.argmax(candidate & (far <= nearest + TIE)).astype(jnp.int32)

    act = seen & ~stay
    reach = act & jnp.any(candidate)
    room = store.count < capacity
    create = act & ~reach & room
    place = jnp.where(reach, reached, jnp.where(create, store.count, previous))

    travelled = (reach | create) & (previous >= 0)
    pair = jnp.stack([previous, place])
    forth, back = (jnp.all(store.link == ends[None, :], axis=1) for ends in (pair, pair[::-1]))
    joined = jnp.any(forth | back)
    new_link = travelled & ~joined & (store.links < capacity)
    at = jnp.minimum(store.links, capacity - 1)
    end = jnp.minimum(store.count, capacity - 1)
    reaching = jnp.where(joined | (previous < 0), Action.SET, Action.LINK)
    action = jnp.where(create, Action.CREATE, jnp.where(reach, reaching, Action.NONE))
    store = Places(
        packet=store.packet.at[end].set(jnp.where(create, packet, store.packet[end])),
        template=store.template.at[end].set(jnp.where(create, template, store.template[end])),
        count=store.count + create.astype(jnp.int32),
        current=place,
        link=store.link.at[at].set(jnp.where(new_link, pair, store.link[at])),
        links=store.links + new_link.astype(jnp.int32),
    )
    return store, (place, previous, action.astype(jnp.int32), room | ~(act & ~reach))
