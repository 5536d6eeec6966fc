"""Many sessions of the recall backend in one call: their beliefs and memories are computed together.

The maps stay on the host and are not computed again: what they said was recorded in single runs. On a GPU the
sessions of a block are computed at once; on a processor one after another, because that is faster there.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.core.arrays import PackedRecords, allocate, layout_of
from ratslam.core.session import CHUNK, Session, run_chunk
from ratslam.methods.recall import RecallBackend, RecallState
from ratslam.recall.memory import MapFeedback, MergedRows
from tactile.base.types import Observation

RecordedChunk = tuple[MergedRows | None, MapFeedback, tuple[int, ...], PackedRecords, int]
"""What the kernel of a session was given at one chunk: rows merged and feedback of the map before it, cells
of the network along x and y, the packed observations, and the number of steps."""


class Recording(NamedTuple):
    """A single run: its chunks, the rows that its memory has room for at the end, and its final state, host
    NumPy."""

    chunks: list[RecordedChunk]
    capacity: int
    state: RecallState


class RecordingSession(Session):
    """A session of the recall backend that records what its kernel is given."""

    def record(self, observations: Sequence[Observation]) -> Recording:
        """Runs the session from its start."""
        self.restart()
        parts = [observations[k : k + CHUNK] for k in range(0, len(observations), CHUNK)]
        records = [allocate(layout_of(observations[0]), CHUNK) for _ in parts]
        for rows, part in zip(records, parts, strict=True):
            for k, observation in enumerate(part):
                rows.write(k, observation)
            list(self.replay(part))
        chunks = [
            (*followed, rows, len(part))
            for followed, rows, part in zip(self._followed, records, parts, strict=True)
        ]
        return Recording(chunks, self._capacity, jax.tree.map(np.asarray, self.state))

    def restart(self, seed: int = 0) -> None:
        super().restart(seed)
        self._followed: list[tuple[MergedRows | None, MapFeedback, tuple[int, ...]]] = []

    def follow_map(self, merged: Any, feedback: Any) -> None:
        super().follow_map(merged, feedback)
        kept = feedback._replace(poses=feedback.poses.copy(), likeness=np.array(feedback.likeness))
        self._followed.append((merged, kept, self._sides))


class SessionBatch:
    """The compiled functions of a batch.

    Args:
        at_once: whether the sessions are computed at once, or one after another.
    """

    def __init__(self, backend: RecallBackend, at_once: bool) -> None:
        self._backend = backend
        every: Any = jax.vmap if at_once else _one_by_one
        run = partial(run_chunk, backend.kernel)
        self._follow = jax.jit(every(backend.follow_map))
        self._run = jax.jit(every(run, in_axes=(0, 0, None)), donate_argnums=0)

    def replay(self, recordings: Sequence[Recording]) -> RecallState:
        """The final states [B, ...] of B recorded sessions of as many steps, each as by itself.

        Raises:
            ValueError: they have other numbers of steps, or their networks other sides.
        """
        backend = self._backend
        empty = backend.init(None, max(each.capacity for each in recordings))
        states, sides = _stack([empty] * len(recordings)), ()
        for chunks in zip(*(each.chunks for each in recordings), strict=True):
            merged, feedback, network_sides, records, steps = zip(*chunks, strict=True)
            with_map = [len(each.poses) > 0 for each in feedback]
            if len(set(zip(steps, network_sides, with_map, strict=True))) > 1:
                raise ValueError("sessions of a batch need the same numbers of steps and of cells")
            if network_sides[0] != sides:
                sides = network_sides[0]
                states = jax.vmap(partial(backend.cover, sides=sides))(states)
            states = self._merge(states, merged)
            if with_map[0]:
                packed = _stack([empty.memory.pack_feedback(each) for each in feedback])
                memory, belief = self._follow(states.memory, states.belief, packed)
                states = states._replace(memory=memory, belief=belief)
            states, _ = self._run(states, _stack(records), np.int32(steps[0]))
        return cast(RecallState, jax.block_until_ready(states))

    def _merge(self, states: RecallState, merged: Sequence[MergedRows | None]) -> RecallState:
        """The states after rows of some memories were merged, on the host."""
        if all(each is None for each in merged):
            return states
        held = jax.tree.map(np.asarray, states)
        each_state = [jax.tree.map(lambda rows, k=k: rows[k], held) for k in range(len(merged))]
        with jax.default_device(jax.devices("cpu")[0]):
            after = [
                state if each is None else self._backend.merge_rows(state, each)
                for state, each in zip(each_state, merged, strict=True)
            ]
        return cast(RecallState, jax.tree.map(jnp.asarray, _stack(after)))


def _stack(trees: Sequence[Any]) -> Any:
    """One tree of arrays [B, ...] of B trees, host NumPy."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)


def _one_by_one(function: Any, in_axes: tuple[int | None, ...] | None = None) -> Any:
    """`jax.vmap` by a loop."""

    def each(*values: Any) -> Any:
        axes = in_axes or (0,) * len(values)
        mapped = [k for k, axis in enumerate(axes) if axis == 0]

        def call(rows: Any) -> Any:
            given = list(values)
            for k, row in zip(mapped, rows, strict=True):
                given[k] = row
            return function(*given)

        return lax.map(call, tuple(values[k] for k in mapped))

    return each
