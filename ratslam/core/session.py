"""The session: feeds observations to a backend's kernel and folds its results into the map.

Live and replay run the same compiled function over a chunk of fixed length with a traced count: live passes
one observation, replay up to `CHUNK`, and both give the same bits. At the start of a chunk the capacity grows
to a power of two that depends only on the rows in use, the kernel follows the map where rows of its memory
are merged or restored, and it takes over the map's feedback.

`finite_values` masks what is NaN or infinite, for every kernel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.core.arrays import Layout, PackedRecords, allocate, layout_of, with_prefix
from ratslam.core.backend import Backend, Evidence, Map, State
from ratslam.core.compilation import Precision
from ratslam.core.estimates import Estimate
from tactile.base.errors import InputError
from tactile.base.types import Array, Observation, Odometry

CHUNK = 16
"""Observations per compiled call. Capacity and map feedback change only at multiples of it."""
MOST_STATE = 1 << 30
"""Largest state of a new session, bytes."""
LAP, REHEARSED = 40, 140
"""Steps of a lap of a rehearsal, and steps in all."""
UNKNOWN = -1
"""`Session.earlier` after a checkpoint of an early version, which does not hold it."""


class Probe(NamedTuple):
    """Pure functions of the state to an array or a tuple of arrays, which are compiled with the kernel.

    Attributes:
        each: is called after every step, for `Step.probed`. seldom: after the last of each `interval` steps,
            counted from the first in the map, for `Step.seldom`; None: never.
    """

    each: Callable[[State], Any]
    seldom: Callable[[State], Any] | None = None
    interval: int = 1

    def rows(self) -> int:
        """The largest number of intervals that a chunk has part in."""
        return (CHUNK - 2) // self.interval + 2

    def spread(self, rows: PackedRecords | None, number: int, count: int) -> Iterator[Any]:
        """The records of `seldom` for `count` steps from step `number` on, None where it was not called."""
        records = [] if rows is None else list(rows.records(self.rows()))
        for k in range(number + 1, number + count + 1):
            due = rows is not None and k % self.interval == 0
            yield records[k // self.interval - 1 - number // self.interval] if due else None


class Step(NamedTuple):
    """Result of one observation.

    Attributes:
        estimate, evidence: of the backend, host NumPy. pose: [3] in the map frame at that time, m, m, rad.
        doubt: `Map.doubt` at that time. probed, seldom: records of the session's probe, host NumPy; None
            without one.
    """

    estimate: Estimate
    evidence: Evidence
    pose: np.ndarray
    doubt: float
    probed: Any = None
    seldom: Any = None


class Session:
    """A backend with its state and its map.

    Args:
        seed: of the backend's random stream. reserve: rows of memory allocated at the start, so that a live
            session does not recompile while it runs. precision: dtype of the kernel's floating state.
        probe: looks at the state after the steps, for `Step.probed` and `Step.seldom`; the results are the
            same with and without it, and without it nothing else is computed.

    Attributes:
        map: of the steps. state: of the kernel. steps: number of observations in the map. earlier: how many
            of these came before the present recording (`begin_recording`), or `UNKNOWN`.

    Raises:
        InputError: the state would take more than `MOST_STATE`.
        ValueError: `precision` is float64 and JAX's 64-bit types are disabled (`ratslam.core.compilation`).
    """

    def __init__(
        self,
        backend: Backend,
        *,
        seed: int = 0,
        reserve: int = 0,
        precision: Precision = "float64",
        probe: Probe | None = None,
    ) -> None:
        if precision == "float64" and not jax.config.read("jax_enable_x64"):
            raise ValueError(
                "precision float64, but JAX's 64-bit types are disabled; call"
                " ratslam.core.compilation.prepare_precision('float64') before JAX is used"
            )
        self.backend, self._probe = backend, probe
        self.reserve = reserve
        self._layout: Layout | None = None
        # Compiled as one: each operation by itself would be compiled too.
        self._init = jax.jit(backend.init, static_argnums=1)
        run = run_chunk if probe is None else partial(_run_probed_chunk, probe)
        self._run_chunk = jax.jit(partial(run, backend.kernel), donate_argnums=0)
        capacity = capacity_at(0, reserve)
        state = jax.eval_shape(lambda key: backend.init(key, capacity), jax.random.key(0))
        size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
        if size > MOST_STATE:
            found = f"a state of {size >> 20} MiB, with rows for {capacity} steps"
            cure = "fewer cells or particles, smaller views, or a smaller session.reserve"
            raise InputError("session", found, f"at most {MOST_STATE >> 20} MiB at the start", cure)
        self.restart(seed)

    def restart(self, seed: int = 0) -> None:
        """Goes back to the start with an empty map; the compiled functions are kept."""
        self.steps = self.earlier = 0
        self._capacity = capacity_at(0, self.reserve)
        self._sides: tuple[int, ...] = ()
        self.map: Map = self.backend.new_map()
        self.state = self._init(jax.random.key(seed), self._capacity)

    def step(self, observation: Observation) -> Step:
        """Folds one observation, live.

        Args:
            observation: body-frame odometry since the one before, m, m, rad, with a view [R, C, K], a place
                id or whiskers; of the same shapes in every step.

        Returns:
            the estimate and evidence of the kernel, and the pose [3] in the map frame, m, m, rad.
        """
        return self._advance([observation])[0]

    def replay(self, observations: Iterable[Observation]) -> Iterator[Step]:
        """Folds many observations, a chunk of up to `CHUNK` at a time; bit-identical to `step` for each."""
        remaining = iter(observations)
        # Chunks end at multiples of CHUNK, wherever the session stands when the replay begins.
        while chunk := list(islice(remaining, CHUNK - self.steps % CHUNK)):
            yield from self._advance(chunk)

    def begin_piece(self) -> None:
        """Lets the next step begin a new piece of the map (`Map.begin_piece`), because the robot may stand
        anywhere: it was carried, or begins another session in the map. Live and replay give the same bits
        where both call it before the same step.

        Raises:
            InputError: the map cannot hold pieces.
        """
        self.map.begin_piece()
        state = self.backend.begin_piece(self.state)
        self.state = self.backend.apply_map_feedback(state, self.map.feedback())

    def begin_recording(self) -> None:
        """Counts the next step as the first of a recording: all steps so far are of earlier ones."""
        self.earlier = self.steps

    def warm(self, observation: Observation) -> None:
        """Compiles for observations like this one; results of later steps do not change."""
        self._layout = self._layout or layout_of(observation)
        self.state = self.backend.apply_map_feedback(self.state, self.map.feedback())
        self._compute(allocate(self._layout, CHUNK), 0)

    def rehearse(self, like: Observation, pace: float, seed: int = 0) -> None:
        """Drives laps of a circle with views that come again, `pace` m a step, and goes back to the start
        (`restart`): the kernel is compiled for observations like this one, and so is what the map computes at
        its first closures. Else a live session waits for that, and drops views, while the robot moves."""
        views = np.random.default_rng(0).random((LAP, *like.view.shape))
        ahead = Odometry(*map(np.float64, (pace, 0.0, 2 * np.pi / LAP, 1.0)))
        for k in range(REHEARSED):
            self.step(like._replace(odometry=ahead, view=views[k % LAP], view_seen=np.True_))
        self.restart(seed)

    def arrays(self) -> dict[str, np.ndarray]:
        """The whole session for a checkpoint; a restored session continues bit for bit."""
        leaves = jax.tree.leaves(self.state)
        arrays = {f"state/{k}": np.asarray(leaf) for k, leaf in enumerate(leaves)}
        arrays |= {f"map/{name}": value for name, value in self.map.arrays().items()}
        counts = {"steps": self.steps, "earlier": self.earlier, "reserve": self.reserve}
        arrays |= {name: np.array(count) for name, count in counts.items()}
        return arrays | {"capacity": np.array(self._capacity), "sides": np.array(self._sides, np.int64)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Continues from a checkpoint made by `arrays`; of one without a state, which an earlier version
        wrote, with what the backend makes of the map (`Backend.state_of`).

        Raises:
            ValueError: the checkpoint has another backend or other shapes.
        """
        steps, reserve = int(arrays["steps"]), int(arrays["reserve"])
        capacity, sides = int(arrays["capacity"]), tuple(arrays["sides"].tolist())

        def start() -> State:
            state = self.backend.init(jax.random.key(0), capacity)
            return self.backend.cover(state, sides) if sides else state

        like = jax.eval_shape(start)
        self.map.restore(with_prefix(arrays, "map/"))
        leaves = jax.tree.leaves(like)
        saved = [arrays.get(f"state/{k}") for k in range(len(leaves))]
        if not any(name.startswith("state/") for name in arrays):
            saved = jax.tree.leaves(self.backend.state_of(self.map, capacity))
        for leaf, value in zip(leaves, saved, strict=True):
            if value is None or value.shape != leaf.shape or value.dtype != leaf.dtype:
                raise ValueError("the checkpoint was made with another configuration or view shape")
        self.state = jax.tree.unflatten(jax.tree.structure(like), [jnp.asarray(value) for value in saved])
        self.steps, self.reserve, self._capacity, self._sides = steps, reserve, capacity, sides
        self.earlier = int(arrays["earlier"])

    def change_rows(self, rows: int, steps: int, change: Callable[[State], State]) -> None:
        """Follows a map that was changed as a whole; its steps count as those of earlier recordings.

        Args:
            rows: of the memory thereafter. steps: in the map. change: makes the new state of one with
                capacity for these rows.
        """
        self._hold(rows)
        self.state, self.steps = change(self.state), steps
        self.begin_recording()

    def compilations(self) -> int:
        """Number of compilations of the chunk function: one per capacity."""
        return self._run_chunk._cache_size()  # type: ignore[attr-defined]

    def _hold(self, rows: int) -> None:
        """Grows the capacity to these rows and those of one more chunk; each step adds at most one."""
        capacity = capacity_at(rows + CHUNK - 1, self.reserve)
        if capacity > self._capacity:
            self.state, self._capacity = self.backend.grow(self.state, capacity), capacity

    def follow_map(self, merged: Any, feedback: Any) -> None:
        """Lets the state follow the map, at the start of each chunk: `Map.merge` and `Map.feedback`."""
        self._hold(self.backend.rows(self.state) if merged is None else merged.rows)
        sides = self.backend.sides(feedback)  # of what covers the ground: it grows with the map
        sides = tuple(map(max, sides, self._sides)) if self._sides else sides
        if sides != self._sides:
            self.state, self._sides = self.backend.cover(self.state, sides), sides
        if merged is not None:
            self.state = self.backend.merge_rows(self.state, merged)
        self.state = self.backend.apply_map_feedback(self.state, feedback)

    def _advance(self, observations: list[Observation]) -> list[Step]:
        if self.steps % CHUNK == 0:
            self.follow_map(self.map.merge(), self.map.feedback())
        count = len(observations)
        self._layout = self._layout or layout_of(observations[0])
        chunk = allocate(self._layout, CHUNK)
        for k, observation in enumerate(observations):
            chunk.write(k, observation)
        steps = []
        results = self._compute(chunk, count)
        for observation, (estimate, evidence, *probed) in zip(observations, results, strict=True):
            estimate = self.map.update(observation, estimate, evidence)
            steps.append(Step(estimate, evidence, self.map.pose(estimate), self.map.doubt(), *probed))
        self.steps += count
        return steps

    def _compute(self, chunk: PackedRecords, count: int) -> Iterator[tuple[Any, ...]]:
        """Replaces the state by that after the first `count` observations; returns the results of each and
        the records of the probe."""
        if self._probe is None:
            self.state, results = self._run_chunk(self.state, chunk, np.int32(count))
            return results.records(count)
        self.state, results, rows = self._run_chunk(
            self.state, chunk, np.int32(count), np.int32(self.steps % self._probe.interval)
        )
        seldom = self._probe.spread(rows, self.steps, count)
        return ((*each, other) for each, other in zip(results.records(count), seldom, strict=True))


def capacity_at(row: int, reserve: int = 0) -> int:
    """Capacity while row `row` is filled: a power of two, at least 256, that holds the row's whole chunk."""
    end = (row // CHUNK + 1) * CHUNK
    return 1 << (max(end, reserve, 256) - 1).bit_length()


def run_chunk(kernel: Any, state: Any, chunk: PackedRecords, count: Any) -> tuple[Any, PackedRecords]:
    """The kernel over the first `count` observations of a chunk.

    Returns:
        the state after them, and what the kernel returns beside it for each step; further rows are zero.
    """
    body, results = _loop(kernel, state, chunk)
    return lax.fori_loop(0, count, body, (state, results))


def _run_probed_chunk(
    probe: Probe, kernel: Any, state: Any, chunk: PackedRecords, count: Any, begun: Any
) -> tuple[Any, PackedRecords, PackedRecords | None]:
    """`run_chunk` with the record of `probe.each` after the kernel's results, and the records of
    `probe.seldom`, one for each interval that the chunk has part in: at its end, or at that of the chunk.

    Args:
        begun: steps of the first interval before this chunk.
    """

    def step(state: Any, observation: Observation) -> Any:
        state, *results = kernel(state, observation)
        # The barrier keeps the probe out of the kernel's loops, which would round otherwise with it.
        return state, *results, probe.each(lax.optimization_barrier(state))

    body, results = _loop(step, state, chunk)
    seldom, interval = probe.seldom, probe.interval
    if seldom is None:
        return *lax.fori_loop(0, count, body, (state, results)), None

    def advance(k: Any, carry: Any) -> Any:
        steps, rows = carry
        first = jnp.maximum(k * interval - begun, 0)
        last = jnp.minimum((k + 1) * interval - begun, count)
        steps = lax.fori_loop(first, last, body, steps)
        return steps, rows.put(k, seldom(steps[0]))

    rows = allocate(layout_of(jax.eval_shape(seldom, state)), probe.rows(), jnp.zeros)
    intervals = (begun + count + interval - 1) // interval
    (state, results), rows = lax.fori_loop(0, intervals, advance, ((state, results), rows))
    return state, results, rows


def _loop(kernel: Any, state: Any, chunk: PackedRecords) -> tuple[Any, PackedRecords]:
    """The body of a loop over the observations of a chunk, and its empty results."""
    kernel = jax.jit(kernel, inline=True)  # traced once for both uses below

    def body(k: Any, carry: Any) -> Any:
        state, results = carry
        state, *output = kernel(state, chunk.at(k))
        return state, results.put(k, tuple(output))

    _, *output = jax.eval_shape(kernel, state, jax.eval_shape(chunk.at, jnp.int32(0)))
    return body, allocate(layout_of(tuple(output)), CHUNK, jnp.zeros)


def finite_values(dtype: np.dtype, observation: Observation) -> tuple[Odometry, Array, Array, Array]:
    """The odometry and view of an observation in this precision; a value that is not finite zeroes the whole
    motion or the whole view.

    Returns:
        odometry; view [R, C, K]; bool: the view was finite; bool: nothing was masked.
    """
    odometry = Odometry(*(jnp.asarray(value, dtype) for value in observation.odometry))
    moves = jnp.stack(odometry[:3])
    fine = jnp.all(jnp.isfinite(moves))
    dx, dy, dtheta = jnp.where(fine, moves, 0.0)
    view = jnp.asarray(observation.view, dtype)
    visible = jnp.all(jnp.isfinite(view))
    clean = fine & (visible | ~observation.view_seen)
    return Odometry(dx, dy, dtheta, odometry.dt), jnp.where(visible, view, 0.0), visible, clean
