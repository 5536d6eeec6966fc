"""The interface of a SLAM method: `Backend`, a pure kernel with its state, and `Map`, which folds its
results.

A step of RatSLAM (Milford & Wyeth 2004) has two halves: local view and odometry move the pose cells, and what
they say builds the experience map. Here the first half is the kernel, the second the map. The kernel has no
access to the map and the map none to the kernel's state, so the kernel can be scanned, batched and replayed
bit for bit. The only feedback of the map to the kernel is a plain record, applied to the state at fixed step
counts. `PathMap` is the smallest map: the path of a backend's own estimates.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import jax
import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.core.estimates import (
    Estimate,
    GridDrawing,
    LocalisedCourse,
    LocalisedPose,
    PoseCellActivity,
    pieces_of,
    write_course,
)
from tactile.base.errors import InputError
from tactile.base.types import Array, Observation

if TYPE_CHECKING:
    import networkx


State = Any
"""A pytree of arrays of fixed shapes and dtypes."""
Evidence = Any
"""The backend's own record of one step: a NamedTuple of arrays of fixed shapes with at least `outcome`.
Fields annotated `ratslam.core.estimates.Scalar` are columns of `steps.csv`."""
NO_CLOSURE = "no loop closure was accepted, the map is the odometry"
"""Why a map of a method that closes loops is not judged."""
Feedback = Any
"""A record of host arrays that the map gives to the kernel, or None."""


class PoseCellProbe(NamedTuple):
    """What can be recorded of the pose cells of a method.

    Attributes:
        shape: (K, N, N) cells over heading, y, x; of a network that grows, those that it begins with; of a
            twisted sheet fewer over y. cell_size: side of a cell, m.
        each: pure function of the state and of the indices [C] of cells in the flattened network to their
            activity [C], float32. hold: pure function of the state to what `active` needs.
        active: indices [n] of the active cells and their activity [n], float32, of what was held; on the
            host.
        packet: [3] decoded pose over x, y, heading, cells, and energy: activity that views have injected, or
            where activity is a posterior its total; both of a step's evidence.
    """

    shape: tuple[int, int, int]
    cell_size: float
    each: Callable[[State, np.ndarray], Array]
    hold: Callable[[State], Any]
    active: Callable[[Any], tuple[np.ndarray, np.ndarray]]
    packet: Callable[[Evidence], np.ndarray]
    energy: Callable[[Evidence], Array]


class Map(Protocol):
    """The map on the host: takes one step at a time; poses are in the map frame.

    Methods with a body are defaults for a map without graph, loop closures, feedback and optimisation.
    """

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Adds one step.

        Args:
            observation: the odometry (m, m, rad), view or whiskers that the kernel was given. estimate,
                evidence: what it returned for them, host NumPy.

        Returns:
            the estimate completed by the map (confirmed places).
        """

    def feedback(self) -> Feedback:
        """The record that the kernel takes over at the next multiple of `ratslam.core.session.CHUNK` steps,
        or None."""
        return None

    def merge(self) -> Any:
        """Merges rows of the memory, or restores merged ones, and returns the record of host arrays that the
        kernel needs to follow, whose `rows` is their number thereafter; None if nothing is to be done. Called
        before `feedback`."""
        return None

    def begin_piece(self) -> None:
        """The robot may stand anywhere: the next step begins a new piece, to which no odometry leads. The
        poses of a piece can be compared with others only once loop closures have joined them.

        Raises:
            InputError: the map cannot hold pieces.
        """
        expected = "`backend: recall`, whose map can begin a new piece"
        raise InputError("map", "a method whose map is one piece", expected)

    def pose(self, estimate: Estimate) -> np.ndarray:
        """[3] the robot's current pose in the map frame: x m, y m, heading rad."""
        return np.asarray(estimate.pose, float)

    def trajectory(self) -> np.ndarray:
        """[T, 3] poses of all steps, best estimate: the optimised map, or odometry if that is doubted."""

    def map_trajectory(self) -> np.ndarray:
        """[T, 3] poses of all steps in the optimised map, doubted or not."""
        return self.trajectory()

    def doubt(self) -> float:
        """Probability that the present map's error is worse than odometry's, as judged some steps ago; NaN
        for maps that do not judge themselves, and where no loop closure is accepted."""
        return np.nan

    def final_doubt(self) -> float:
        """The same probability of the final map."""
        return self.doubt()

    def unjudged(self) -> str:
        """`NO_CLOSURE`, with an addition perhaps, if that is why there is no such probability; else ''."""
        return ""

    def online_trajectory(self) -> np.ndarray:
        """[T, 3] poses of all steps in the online map, before the final optimisation."""
        return self.trajectory()

    def closures(self) -> np.ndarray:
        """[M, 2] pairs of steps joined by accepted loop closures: the later and the earlier."""
        return np.zeros((0, 2), int)

    def judged_closures(self) -> np.ndarray:
        """[n, 3] candidates for loop closures as judged so far: the earlier step, the later step, and 1 if
        accepted, 0 if open, -1 if removed. Called while the map grows, so it must not optimise."""
        return np.zeros((0, 3), int)

    def grid(self) -> GridDrawing | None:
        """The occupancy grid, of a map that is one."""
        return None

    def pieces(self) -> np.ndarray:
        """[T] the piece of each step: pieces are parts of the map that nothing connects, numbered from 0."""
        return np.zeros(len(self.trajectory()), int)

    def graph(self) -> networkx.DiGraph:
        """The map as a graph."""
        import networkx  # slow to import

        return networkx.DiGraph()

    def files(self) -> dict[str, Callable[[Path], None]]:
        """Files of the map in a run directory: a function that writes each, by name."""

    def arrays(self) -> dict[str, np.ndarray]:
        """The whole state, for a checkpoint."""

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Replaces the whole state by that of `arrays`."""


class Backend(Protocol):
    """A SLAM method.

    Methods with a body are defaults for a method whose state does not grow and that uses no map feedback.

    Attributes:
        SINGLE: fields of the state in single precision, whatever that of the session is.
    """

    SINGLE: ClassVar[tuple[str, ...]] = ()

    def init(self, key: Array, capacity: int) -> State:
        """The state before the first step.

        Args:
            key: of the random stream (`jax.random`), for methods that draw. capacity: rows of the arrays that
                grow; all sessions of one capacity share a compiled kernel.

        Returns:
            a pytree of arrays whose shapes and dtypes depend on `capacity` alone.
        """

    def rows(self, state: State) -> int:
        """Largest number of rows in use; a step adds at most one."""
        return 0

    def grow(self, state: State, capacity: int) -> State:
        """The same state with a larger capacity."""
        return state

    def sides(self, feedback: Feedback) -> tuple[int, ...]:
        """Sizes of the arrays that cover the ground of the map, of a method that has some; (): none."""
        return ()

    def cover(self, state: State, sides: tuple[int, ...]) -> State:
        """The state with arrays of these sizes, never smaller than before, that cover the ground. The map's
        feedback is applied to it at once."""
        return state

    def apply_map_feedback(self, state: State, feedback: Feedback) -> State:
        """The state after the map's feedback; same shapes and dtypes."""
        return state

    def merge_rows(self, state: State, merged: Any) -> State:
        """The state, which holds `merged.rows` rows at least, after rows of the memory were merged or
        restored; same shapes and dtypes."""
        return state

    def begin_piece(self, state: State) -> State:
        """The state of a robot that may stand anywhere, with the same memory; see `Map.begin_piece`. The
        map's feedback is applied to it at once."""
        return state

    def state_of(self, map: Map, capacity: int) -> State:
        """The state of a session whose map was saved by an earlier version, as far as it follows from the
        map; of a method whose state has changed since.

        Raises:
            ValueError: the method's has not.
        """
        raise ValueError("the checkpoint has no state")

    def kernel(self, state: State, observation: Observation) -> tuple[State, Estimate, Evidence]:
        """One step; pure, so that it can be jitted, scanned and vmapped.

        Args:
            state: after the step before. observation: body-frame odometry, m, m, rad; the view [R, C, K]; a
                place id; contacts of whiskers. Values may be NaN (`ratslam.core.session.finite_values`).

        Returns:
            the state after the step, of the same shapes and dtypes; the estimate of the pose [3] in the
            method's own frame, m, m, rad; and the evidence, from which the map is made.
        """

    def activity(self, state: State) -> PoseCellActivity | None:
        """The activity of the pose cells, of a method that has them; must compile nothing."""
        return None

    def probe(self) -> PoseCellProbe | None:
        """What can be recorded of the pose cells, of a method that has them."""
        return None

    def sheet_probe(self, sheet: Any) -> PoseCellProbe | None:
        """What can be recorded of grid cells that read the belief, of a method that has one.

        Args:
            sheet: a `ratslam.network.config.SheetConfig`.
        """
        return None

    def new_map(self) -> Map:
        """An empty map."""


def enlarge(rows: Any, empty: Any) -> Any:
    """The arrays of `empty` (a NamedTuple) with those of `rows` at their beginning, for `Backend.grow`."""

    def fill(old: Array, new: Array) -> Array:
        return old if old.shape == new.shape else new.at[tuple(slice(0, n) for n in old.shape)].set(old)

    return jax.tree.map(fill, rows, empty)


class PathMap(Checkpointed, Map):
    """A map for backends that estimate the pose in the map frame and have no graph."""

    def __init__(self) -> None:
        self._pose = GrowableArray((3,), np.float64)

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Adds the pose of a step."""
        self._pose.append(estimate.pose)
        return estimate

    def trajectory(self) -> np.ndarray:
        """[T, 3] the estimates of all steps."""
        return self._pose.rows.copy()

    def files(self) -> dict[str, Callable[[Path], None]]:
        """None."""
        return {}


class LocalisedMap(Checkpointed, Map):
    """The poses and states of a session that is localised in a finished map, which does not change.

    Args:
        name, digest: an array that tells the finished map from others, and its name in a checkpoint.
    """

    def __init__(self, name: str, digest: np.ndarray) -> None:
        self._name, self._digest, self._course = name, digest, LocalisedCourse()

    @abstractmethod
    def localisation(self) -> LocalisedPose:
        """The robot's pose now, and whether it is known."""

    def pose(self, estimate: Estimate) -> np.ndarray:
        del estimate
        return self.localisation().pose.copy()

    def trajectory(self) -> np.ndarray:
        """[T, 3] poses of all steps, as they were given at the time."""
        return self._course.pose.rows.copy()

    def states(self) -> np.ndarray:
        """[T] the `Localisation` at each step."""
        return self._course.states.rows.copy()

    def pieces(self) -> np.ndarray:
        return pieces_of(self._course.states.rows)

    def files(self) -> dict[str, Callable[[Path], None]]:
        """State, mass and log-odds of every step as CSV."""
        course = self._course
        return {"localisation.csv": lambda path: write_course(path, course.states.rows, course.record.rows)}

    def arrays(self) -> dict[str, np.ndarray]:
        """The whole state, with what tells the finished map from others."""
        return super().arrays() | {self._name: self._digest.copy()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Replaces the whole state by that of `arrays`.

        Raises:
            ValueError: the finished map has changed since.
        """
        if not np.array_equal(arrays[self._name], self._digest):
            raise ValueError("a session in another map, or in this one before it was changed")
        super().restore(arrays)
