"""The session: feeds observations to a backend's kernel and folds its results into the map.

Live and replay run the same compiled function over a chunk of fixed length with a traced count: live passes
one observation, replay up to `CHUNK`, and both give the same bits. At the start of a chunk the capacity grows
to a power of two that depends only on the rows in use, the kernel follows the map where rows of its memory
are merged or restored, and it takes over the map's feedback.
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

from ratslam.core.backend import Backend, Evidence, Map, State
from ratslam.core.checkpoint import with_prefix
from ratslam.core.packing import Layout, PackedRecords, allocate, layout_of
from ratslam.core.precision import Precision, check_precision
from ratslam.core.types import Estimate
from tactile.base.types import Observation

Probe = Callable[[State, Any], Any]
"""A pure function of the state after a step and of the number of the step (int32, from 0 in the map) to a
NamedTuple of arrays, which is compiled with the kernel."""
CHUNK = 16
"""Observations per compiled call. Capacity and map feedback change only at multiples of it."""


class Step(NamedTuple):
    """Result of one observation.

    Attributes:
        estimate, evidence: of the backend, host NumPy. pose: [3] in the map frame at that time, m, m, rad.
        doubt: `Map.doubt` at that time. probed: record of the session's probe, host NumPy; None without one.
    """

    estimate: Estimate
    evidence: Evidence
    pose: np.ndarray
    doubt: float
    probed: Any = None


class Session:
    """A backend with its state and its map.

    Args:
        seed: of the backend's random stream. reserve: rows of memory allocated at the start, so that a live
            session does not recompile while it runs. precision: dtype of the kernel's floating state.
        probe: looks at the state after every step, for `Step.probed`; the results are the same with and
            without it, and without it nothing else is computed.

    Raises:
        ValueError: `precision` is float64 and JAX's 64-bit types are disabled (`ratslam.core.precision`).
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
        check_precision(precision)
        self.backend, self._probe = backend, probe
        self.reserve = reserve
        self._layout: Layout | None = None
        # Compiled as one: each operation by itself would be compiled too.
        self._init = jax.jit(backend.init, static_argnums=1)
        kernel = backend.kernel if probe is None else with_probe(backend.kernel, probe)
        self._run_chunk = jax.jit(partial(run_chunk, kernel), donate_argnums=0)
        self.restart(seed)

    def restart(self, seed: int = 0) -> None:
        """Goes back to the start with an empty map; the compiled functions are kept."""
        self.map: Map = self.backend.new_map()
        self.steps = 0
        self._capacity = capacity_at(0, self.reserve)
        self.state = self._init(jax.random.key(seed), self._capacity)

    def step(self, observation: Observation) -> Step:
        """Folds one observation, live."""
        return self._advance([observation])[0]

    def replay(self, observations: Iterable[Observation]) -> Iterator[Step]:
        """Folds many observations, a chunk at a time; bit-identical to `step` for each."""
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

    def warm(self, observation: Observation) -> None:
        """Compiles for observations like this one; results of later steps do not change."""
        self._layout = self._layout or layout_of(observation)
        self.state = self.backend.apply_map_feedback(self.state, self.map.feedback())
        self._compute(allocate(self._layout, CHUNK), 0)

    def arrays(self) -> dict[str, np.ndarray]:
        """The whole session for a checkpoint; a restored session continues bit for bit."""
        leaves = jax.tree.leaves(self.state)
        return (
            {f"state/{k}": np.asarray(leaf) for k, leaf in enumerate(leaves)}
            | {f"map/{name}": value for name, value in self.map.arrays().items()}
            | {
                "steps": np.array(self.steps),
                "reserve": np.array(self.reserve),
                "capacity": np.array(self._capacity),
            }
        )

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Continues from a checkpoint made by `arrays`.

        Raises:
            ValueError: the checkpoint has another backend or other shapes.
        """
        steps, reserve = int(arrays["steps"]), int(arrays["reserve"])
        capacity = int(arrays["capacity"])
        like = jax.eval_shape(lambda: self.backend.init(jax.random.key(0), capacity))
        leaves = jax.tree.leaves(like)
        saved = [arrays.get(f"state/{k}") for k in range(len(leaves))]
        for leaf, value in zip(leaves, saved, strict=True):
            if value is None or value.shape != leaf.shape or value.dtype != leaf.dtype:
                raise ValueError("the checkpoint was made with another configuration or view shape")
        self.state = jax.tree.unflatten(jax.tree.structure(like), [jnp.asarray(value) for value in saved])
        self.map.restore(with_prefix(arrays, "map/"))
        self.steps, self.reserve, self._capacity = steps, reserve, capacity

    def change_rows(self, rows: int, steps: int, change: Callable[[State], State]) -> None:
        """Follows a map that was changed as a whole.

        Args:
            rows: of the memory thereafter. steps: in the map. change: makes the new state of one with
                capacity for these rows.
        """
        self._hold(rows)
        self.state, self.steps = change(self.state), steps

    def compilations(self) -> int:
        """Number of compilations of the chunk function: one per capacity."""
        return self._run_chunk._cache_size()  # type: ignore[attr-defined]

    def _hold(self, rows: int) -> None:
        """Grows the capacity to these rows and those of one more chunk; each step adds at most one."""
        capacity = capacity_at(rows + CHUNK - 1, self.reserve)
        if capacity > self._capacity:
            self.state, self._capacity = self.backend.grow(self.state, capacity), capacity

    def _advance(self, observations: list[Observation]) -> list[Step]:
        if self.steps % CHUNK == 0:
            merged = self.map.merge()
            self._hold(self.backend.rows(self.state) if merged is None else merged.rows)
            if merged is not None:
                self.state = self.backend.merge_rows(self.state, merged)
            self.state = self.backend.apply_map_feedback(self.state, self.map.feedback())
        count = len(observations)
        self._layout = self._layout or layout_of(observations[0])
        chunk = allocate(self._layout, CHUNK)
        for k, observation in enumerate(observations):
            chunk.write(k, observation)
        results, steps = self._compute(chunk, count), []
        for observation, (estimate, evidence, *probed) in zip(
            observations, results.records(count), strict=True
        ):
            estimate = self.map.update(observation, estimate, evidence)
            steps.append(Step(estimate, evidence, self.map.pose(estimate), self.map.doubt(), *probed))
        self.steps += count
        return steps

    def _compute(self, chunk: PackedRecords, count: int) -> PackedRecords:
        """Replaces the state by that after the first `count` observations; returns the results of each."""
        if self._probe is None:
            self.state, results = self._run_chunk(self.state, chunk, np.int32(count))
        else:
            carry = self.state, np.int32(self.steps)
            (self.state, _), results = self._run_chunk(carry, chunk, np.int32(count))
        return results


def capacity_at(row: int, reserve: int = 0) -> int:
    """Capacity while row `row` is filled: a power of two, at least 256, that holds the row's whole chunk."""
    end = (row // CHUNK + 1) * CHUNK
    return 1 << (max(end, reserve, 256) - 1).bit_length()


def with_probe(kernel: Any, probe: Probe) -> Any:
    """The kernel with the number of the step beside its state and the probe's record after its results."""

    def step(carry: Any, observation: Observation) -> Any:
        state, number = carry
        state, *results = kernel(state, observation)
        # The barrier keeps the probe out of the kernel's loops, which would round otherwise with it.
        return (state, number + 1), *results, probe(lax.optimization_barrier(state), number)

    return step


def run_chunk(kernel: Any, state: Any, chunk: PackedRecords, count: Any) -> tuple[Any, PackedRecords]:
    """The kernel over the first `count` observations of a chunk.

    Returns:
        the state after them, and what the kernel returns beside it for each step; further rows are zero.
    """
    kernel = jax.jit(kernel, inline=True)  # traced once for both uses below

    def body(k: Any, carry: Any) -> Any:
        state, results = carry
        state, *output = kernel(state, chunk.at(k))
        return state, results.put(k, tuple(output))

    _, *output = jax.eval_shape(kernel, state, jax.eval_shape(chunk.at, jnp.int32(0)))
    return lax.fori_loop(0, count, body, (state, allocate(layout_of(tuple(output)), CHUNK, jnp.zeros)))
