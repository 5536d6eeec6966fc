"""The table of batches, µs: steps of single networks, and of many networks and sessions in one call.

They are timed on the processor and, if JAX has one, on the GPU beside it. On a GPU all parameter sets and
sessions are computed at once; on the processor sets in blocks that fit into its cache, and sessions one after
another, because that is faster there. The maps of the sessions stay on the host and are not computed again:
what they said was recorded in single runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from evaluation.papers.tables.cycles import SESSIONS
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.papers.tables.speed import MOTION, interleaved_medians, replay_network
from evaluation.papers.trial_sessions import collect_session
from evaluation.studies.network_batch import BLOCK, tuned_levels
from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig, rings, units
from ratslam.classic.levels import window_levels
from ratslam.core.arrays import PackedRecords, allocate, layout_of
from ratslam.core.compilation import prepare_precision
from ratslam.core.session import CHUNK, Session, run_chunk
from ratslam.methods.recall import RecallBackend, RecallState
from ratslam.recall.memory import MapFeedback, MergedRows
from ratslam.runs.build_session import build_session
from ratslam.runs.settings.run_config import load_config
from robot.touch_source import observation_of
from tactile.base.types import Array, Observation, Odometry

BATCH_SIZES = 21, 61, 201
"""Cells along one side of the single networks."""
FEW = 200
"""Steps of a call with many sets."""
EVERY = 5
"""Steps from one view to the next."""
RECORDED = 4
"""Different sessions that a batch repeats."""
SINGLE = 400
"""Steps of a single network."""


def batch_table(sets: int, sessions: int, steps: int, rounds: int) -> Iterator[str]:
    """The lines of the table, each as soon as it is timed.

    Args:
        sets, sessions: number in one call on a GPU; on the processor a fifth of the sets and `RECORDED`
            sessions, as its time for each does not depend on their number. steps: of a session. rounds:
            repeats, of which the median is taken.
    """
    prepare_precision("float64")
    yield markdown_header(["what is computed", "device", "us a step of each"])
    core = jax.devices("cpu")[0]
    with jax.default_device(core):
        backend, recordings = _record_circuits(steps)
    for device in dict.fromkeys([jax.devices()[0], core]):
        gpu = device.platform != "cpu"
        name = device.device_kind if gpu else "one core"
        with jax.default_device(device):
            for n in BATCH_SIZES:
                for engine in ("window", "dense"):
                    replay, start = replay_network(n, engine, SINGLE, np.float32)
                    us = _median(partial(replay, start), SINGLE, rounds)
                    yield markdown_row([f"one network of {n} cells a side, {engine}", name, f"{us:.0f}"])
            many = sets if gpu else max(sets // 5, 1)
            for every in (0, EVERY, 1):
                call = _set_call(many, every, many if gpu else BLOCK)
                us = _median(call, many * FEW, rounds)
                views = f"a view every {every} steps" if every else "path integration"
                yield markdown_row([f"{many} sets of 21 cells, {views}", name, f"{us:.2f}"])
            several = sessions if gpu else len(recordings)
            used = [recordings[k % len(recordings)] for k in range(several)]
            run = SessionBatch(backend, at_once=gpu)
            us = _median(partial(run.replay, used), several * steps, rounds)
            states = run.replay(used)
            gap = max(  # largest difference of a belief from that of the single run
                float(np.abs(np.asarray(found[k], float) - own).max(initial=0.0))
                for k, recording in enumerate(used)
                for found, own in zip(states.belief, recording.state.belief, strict=True)
            )
            what = f"{several} sessions of {steps} steps, largest difference of a belief {gap:.0e}"
            yield markdown_row([what, name, f"{us:.1f}"])
    with jax.default_device(core):
        run = SessionBatch(backend, at_once=False)
        us = _median(lambda: [run.replay([each]) for each in recordings], len(recordings) * steps, rounds)
    what = f"{len(recordings)} sessions of {steps} steps, each in a call"
    yield markdown_row([what, "one core", f"{us:.1f}"])


def _record_circuits(steps: int) -> tuple[RecallBackend, list[Recording]]:
    """The backend and recordings of the first steps of `RECORDED` whisker sessions of ten circuits whose maps
    need as many pose cells."""
    recordings: list[Recording] = []
    for seed in count():
        config = load_config(SESSIONS["circuits"], [f"simulation.seed={seed}"])
        config, log = collect_session(config)
        observations = [observation_of(sample) for sample in log][:steps]
        made = build_session(config, log)
        if not seed:
            assert isinstance(made.backend, RecallBackend)
            backend, session = made.backend, RecordingSession(made.backend, reserve=made.reserve)
        found = session.record(observations)
        sides = [sides for _, _, sides, _, _ in found.chunks]  # numbers of cells along x and y
        if not recordings or sides == [sides for _, _, sides, _, _ in recordings[0].chunks]:
            recordings.append(found)
        if len(recordings) == RECORDED:
            break
    return backend, recordings


def _set_call(sets: int, every: int, block: int) -> Callable[[], Any]:
    """A call of `FEW` steps of many parameter sets, with a view half a torus away every so many steps, 0:
    none."""
    config, single = NetworkConfig(cells_xy=21), np.dtype(np.float32)
    unit, ring = units(config, single), rings(config, single)
    motion = np.tile(np.array([MOTION[0] * unit[0], 0.0, MOTION[1] * unit[2]], single), (FEW, 1))
    seen = np.arange(FEW) % every == every - 1 if every else np.zeros(FEW, bool)
    far = np.tile(np.asarray(ring, single) / 2, (FEW, 1))
    course = motion, far, np.where(seen, 0.02, 0.0).astype(single)
    spread = np.linspace(0.9, 1.1, sets, dtype=single)
    given = spread, 2 * spread, np.full(sets, 2e-5, single), spread
    return lambda: networks(config, given, course, block)


def _median(call: Callable[[], Any], steps: int, rounds: int) -> float:
    """Median us of a step of a call that makes so many, which is compiled first."""
    jax.block_until_ready(call())
    return interleaved_medians({"": (call, steps)}, rounds)[""]


Sets = tuple[Array, Array, Array, Array]
"""B parameter sets of the pose cells: deviations [B] of excitation and of inhibition, cells, global
inhibition [B], and factor [B] on the injected energy."""
Course = tuple[Array, Array, Array]
"""Input of the pose cells over T steps: body-frame odometry [T, 3], m, m, rad, recalled poses [T, 3], cells,
and the energy [T] injected there."""
Track = tuple[Array, Array, Array]
"""Decoded packets [B, T, 3] in cells, outcome [B, T] and window level [B, T]."""


def networks(config: NetworkConfig, sets: Sets, course: Course, block: int = BLOCK) -> Track:
    """The pose cells with every parameter set over one course, in the precision of the course.

    All sets are computed at the smallest window level first; those that needed a larger one are computed
    again with all levels, which in a batch cost time even where they are not used.
    """
    track = jax.tree.map(np.array, _networks(config, 1, sets, course, block))
    again = np.flatnonzero(np.any(track[2] > 0, axis=1))
    if len(again):
        room = np.resize(again, 1 << (len(again) - 1).bit_length())  # few shapes to compile
        chosen = jax.tree.map(lambda column: jnp.asarray(column)[room], sets)
        # All levels: one by one a set takes the time of its own level; at once, as on a GPU, that of all.
        whole = _networks(config, None, chosen, course, 1 if block <= BLOCK else block)
        for rows, exact in zip(track, whole, strict=True):
            rows[again] = np.asarray(exact)[: len(again)]
    return track


@partial(jax.jit, static_argnames=("config", "levels", "block"))
def _networks(config: NetworkConfig, levels: int | None, sets: Sets, course: Course, block: int) -> Track:
    dtype = np.dtype(course[0].dtype)
    used = window_levels(config, dtype)[:levels]

    def simulate(network: Sets) -> Track:
        *kernels, factor = network
        tuned = tuned_levels(used, *kernels)

        def step(cells: Any, row: Course) -> Any:
            motion, recall, energy = row
            odometry = Odometry(motion[0], motion[1], motion[2], jnp.ones((), dtype))
            cells, (_, outcome, level) = pose_cells.step(
                config, tuned, cells, odometry, recall, energy * factor
            )
            return cells, (cells.pose, outcome, level)

        return lax.scan(step, pose_cells.start(config, dtype, used), course)[1]

    return lax.map(simulate, sets, batch_size=block)


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
