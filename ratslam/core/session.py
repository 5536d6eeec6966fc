"""The session: the one loop, and the one object that changes.

Live and replay run the same compiled function over a chunk of fixed length with a traced count: live passes
one observation, replay many, and both give the same bits. Memory grows to powers of two that depend on the
rows in use alone, before a chunk that could need more; at the start of a chunk the kernel hears of the map.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from itertools import islice
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.core.backend import Backend, Evidence, Map
from ratslam.core.packing import Layout, Rows, empty, layout_of, room
from ratslam.core.types import Estimate
from tactile.base.types import Observation

CHUNK = 16
"""Observations per compiled call; capacities change and the map guides only at multiples of it."""


class Step(NamedTuple):
    """What one observation led to.

    Attributes:
        estimate, evidence: of the backend, host NumPy. pose: [3] in the map frame as it was known then.
    """

    estimate: Estimate
    evidence: Evidence
    pose: np.ndarray


class Session:
    """Feeds observations to a backend and folds what it says into its map.

    Args:
        seed: of the backend's random stream. reserve: rows of memory made room for at the start, so that a
            live session does not compile in mid-run. precision: of the kernel; float64 needs JAX's x64.

    Raises:
        ValueError: JAX is not set up for the precision asked for.
    """

    def __init__(
        self,
        backend: Backend,
        *,
        seed: int = 0,
        reserve: int = 0,
        precision: Literal["float64", "float32"] = "float64",
    ) -> None:
        if precision == "float64":
            jax.config.update("jax_enable_x64", True)
        self.backend = backend
        self.map: Map = backend.new_map()
        self.steps = 0
        self.reserve = reserve
        self._capacity = capacity_at(0, reserve)
        self.state = backend.init(jax.random.key(seed), self._capacity)
        self._layout: Layout | None = None
        self._run = jax.jit(partial(run_chunk, backend.kernel), donate_argnums=0)

    def step(self, observation: Observation) -> Step:
        """One observation, live."""
        return self._advance([observation])[0]

    def replay(self, observations: Iterable[Observation]) -> Iterator[Step]:
        """Many observations, a chunk at a time; the same bits as `step` by `step`."""
        remaining = iter(observations)
        # Chunks end where capacities may change, wherever the session stands when the replay begins.
        while chunk := list(islice(remaining, CHUNK - self.steps % CHUNK)):
            yield from self._advance(chunk)

    def warm(self, observation: Observation) -> None:
        """Compiles for observations like this one; the first step stays what it would have been."""
        self._layout = self._layout or layout_of(observation)
        self.state = self.backend.apply_map_feedback(self.state, self.map.feedback())
        self.state, _ = self._run(self.state, room(self._layout, CHUNK), np.int32(0))

    def arrays(self) -> dict[str, np.ndarray]:
        """The whole session for a checkpoint: a restored one continues bit for bit."""
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
        """Takes up where `arrays` was taken.

        Raises:
            ValueError: the arrays are of a session with another backend or other shapes.
        """
        steps, reserve = int(arrays["steps"]), int(arrays["reserve"])
        capacity = int(arrays["capacity"])
        like = jax.eval_shape(lambda: self.backend.init(jax.random.key(0), capacity))
        leaves = jax.tree.leaves(like)
        saved = [arrays.get(f"state/{k}") for k in range(len(leaves))]
        for leaf, value in zip(leaves, saved, strict=True):
            if value is None or value.shape != leaf.shape or value.dtype != leaf.dtype:
                raise ValueError("the checkpoint is of another configuration or view shape")
        self.state = jax.tree.unflatten(jax.tree.structure(like), [jnp.asarray(value) for value in saved])
        prefix = "map/"
        self.map.restore({k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)})
        self.steps, self.reserve, self._capacity = steps, reserve, capacity

    def compilations(self) -> int:
        """How often the chunk function was compiled: once per capacity."""
        return self._run._cache_size()  # type: ignore[attr-defined]

    def _advance(self, observations: list[Observation]) -> list[Step]:
        if self.steps % CHUNK == 0:
            # A step fills one row at most.
            capacity = capacity_at(self.backend.rows(self.state) + CHUNK - 1, self.reserve)
            if capacity > self._capacity:
                self.state, self._capacity = self.backend.grow(self.state, capacity), capacity
            self.state = self.backend.apply_map_feedback(self.state, self.map.feedback())
        count = len(observations)
        self._layout = self._layout or layout_of(observations[0])
        chunk = room(self._layout, CHUNK)
        for k, observation in enumerate(observations):
            chunk.write(k, observation)
        self.state, told = self._run(self.state, chunk, np.int32(count))
        steps = []
        for observation, (estimate, proof) in zip(observations, told.records(count), strict=True):
            estimate = self.map.update(observation, estimate, proof)
            steps.append(Step(estimate, proof, self.map.pose(estimate)))
        self.steps += count
        return steps


def capacity_at(row: int, reserve: int = 0) -> int:
    """Rows of memory where `row` may be filled: a power of two that holds its whole chunk."""
    end = (row // CHUNK + 1) * CHUNK
    return 1 << (max(end, reserve, 256) - 1).bit_length()


def run_chunk(kernel: Any, state: Any, chunk: Rows, count: Any) -> tuple[Any, Rows]:
    """The kernel over the first `count` observations of a chunk: the state after them, and what each step
    told, (estimate, evidence); rows beyond are zero."""

    def body(k: Any, carry: Any) -> Any:
        state, told = carry
        state, *output = kernel(state, chunk.at(k))
        return state, told.put(k, tuple(output))

    _, *output = jax.eval_shape(kernel, state, jax.eval_shape(chunk.at, jnp.int32(0)))
    return lax.fori_loop(0, count, body, (state, empty(layout_of(tuple(output)), CHUNK)))
