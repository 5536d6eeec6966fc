"""Timings of parts, each on one core after compilation: maps, recall, grid filter, touch, scores of cells."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evaluation.cells.analysis import analyse_cells
from evaluation.cells.head_direction import mean_vector_length, preferred_direction
from evaluation.cells.information import information
from evaluation.cells.rate_map import rate_maps, tuning_curves
from evaluation.cells.recording import BinnedSums, CellRecording
from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.exm import experience_metric
from ratslam.core.session import Session
from ratslam.grid.config import GridConfig
from ratslam.mapping.optimizer import (
    CalibrationPrior,
    LoopClosures,
    MapCovariance,
    MapFit,
    MapProblem,
    OdometryChain,
    solve,
)
from ratslam.methods.grid import GridBackend
from ratslam.network import pose_cells
from ratslam.network.config import Network, PoseCellConfig
from ratslam.recall import observation_model
from ratslam.recall.config import RecallConfig
from ratslam.recall.filter import recognise
from ratslam.recall.memory import MapFeedback, init_memory
from ratslam.runs.build_session import build_session, open_source, read_observations
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig
from robot.simulation.create.simulated_session import CreateSimulation, CreateSimulationConfig
from robot.touch_source import open_touch_source, planar_whiskers_of
from tactile.base.random_streams import stream
from tactile.base.se2 import integrate
from tactile.base.types import stack
from tactile.frontend import TouchConfig


def timed(benchmark, call, count=1, rounds=5):
    """What a call returns; its median time is noted, and that of each of its `count` parts."""
    found = benchmark.pedantic(call, rounds=rounds if benchmark.enabled else 1)
    if benchmark.stats is not None:
        benchmark.extra_info["us_each"] = benchmark.stats.stats.median / count * 1e6
        benchmark.extra_info["each_per_second"] = count / benchmark.stats.stats.median
    return found


# A closure in a map of 1000 frames


@pytest.fixture(scope="module")
def frame_map():
    """A square driven again and again with a biased gyro, closed wherever it was before."""
    frames, closures, random = 1000, 400, np.random.default_rng(0)
    turn = np.where(np.arange(1, frames) % 12 == 0, np.pi / 2, 0.0)
    true = np.column_stack([np.full(frames - 1, 0.5), np.zeros(frames - 1), turn])
    motion = true - [0, 0, 0.001] + random.normal(0, [0.01, 0.01, 0.005], true.shape)
    later = random.integers(60, frames, closures)
    chain = OdometryChain(motion, np.full(frames - 1, 0.5), np.tile([0.01, 0.01, 0.001], (frames - 1, 1)))
    path = np.concatenate([np.zeros((1, 3)), integrate(true)])
    links = LoopClosures(
        i=later % 48, j=later, turn=(path[later] - path[later % 48])[:, 2], sequence=np.arange(closures) // 5,
        variance=np.array([0.1, 0.1, 0.02]), scale=np.full(closures // 5, 6.0),
    )  # fmt: skip
    begin = MapFit(np.concatenate([np.zeros((1, 3)), integrate(motion)]), 0.0, np.zeros(0))
    return begin, MapProblem(chain, links, CalibrationPrior(0.0, 0.01, 0.0, 0.05))


def test_a_map_of_1000_frames_is_solved(benchmark, frame_map):
    fit = timed(benchmark, partial(solve, *frame_map, iterations=4))
    assert abs(fit.bias - 0.002) < 0.001


def test_a_closure_is_checked_against_the_covariance(benchmark, frame_map):
    fit = solve(*frame_map, iterations=4)
    timed(benchmark, lambda: MapCovariance(fit, frame_map[1]).relative(5, 999, 0.0))


# Recall


@pytest.mark.parametrize("shifts", [0, 3])
@pytest.mark.parametrize("frames", [1500, 100_000])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_one_recall(benchmark, frames, shifts, dtype):
    """One frame compared with many remembered ones, and the pose cells driven by them."""
    cell, config, random = 0.6, RecallConfig(shifts=shifts), np.random.default_rng(0)
    capacity = 1 << (frames - 1).bit_length()
    turns = np.cumsum(random.normal(0, 0.3, frames))
    steps = 0.5 * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    poses = np.column_stack([np.cumsum(steps, axis=0), turns])
    memory = init_memory(config, 18, capacity, np.dtype(dtype))._replace(
        view=jnp.asarray(random.random((18, capacity)), dtype), count=jnp.int32(frames - 1)
    )
    memory = memory.apply_map_feedback(MapFeedback(poses, 0.01, 0.0, 5.0, np.pi / 18, 0.06))
    cells = PoseCellConfig(cell_size=cell)
    network = Network(cells, config.excite, config.excite_heading, config.miss, config.leak)
    silent = pose_cells.start(network, (2 * shifts + 1, len(memory.label)))
    belief = pose_cells.cover(network, silent, pose_cells.sides_for(network, poses))
    views = jnp.asarray(np.random.default_rng(1).random((64, 18)), dtype)
    looks, moved = max(4, 300_000 // frames), jnp.asarray([0.5, 0.0, 0.1], dtype)

    @jax.jit
    def replay(memory, belief):
        def recall(k, carry):
            memory, belief = carry
            memory = memory.accumulate_motion(moved)
            motion = memory.corrected_motion()
            weighed = observation_model.view_likelihood(config, cell, memory, views[k % 64])
            belief, _ = recognise(config, network, memory, belief, motion, weighed, config.local)
            zero = jnp.zeros_like(memory.length)
            return memory._replace(motion=jnp.zeros_like(moved), length=zero), belief

        return jax.lax.fori_loop(0, looks, recall, (memory, belief))[1]

    replay(memory, belief)
    after = timed(benchmark, lambda: jax.block_until_ready(replay(memory, belief)), looks)
    assert np.isfinite(np.asarray(after.activity)).all()
    assert 0 < float(after.activity.sum()) <= 1 + 1e-3


# The grid filter


@pytest.fixture(scope="module")
def arena():
    """512 reports of a simulated Create, and its whiskers."""
    source, touch = CreateSimulation(CreateSimulationConfig(reports=512, seed=5)), TouchConfig()
    return [sample.reading for sample in open_touch_source(source, touch)], planar_whiskers_of(source, touch)


@pytest.mark.parametrize(("particles", "dtype"), [
    (100, np.float32), (100, np.float64), (1000, np.float32), (10_000, np.float32),
])  # fmt: skip
def test_grid_replay(benchmark, arena, particles, dtype):
    reports, feelers = arena
    rows = reports[: 512 if particles < 5000 else 64] if benchmark.enabled else reports[:8]
    particles = particles if benchmark.enabled else 100
    method = GridBackend(GridConfig(particles=particles), feelers, 2.5, dtype)

    def step(state, observation):
        state, estimate, _ = method.kernel(state, observation)
        return state, estimate.pose

    fast, chunk = jax.jit(partial(jax.lax.scan, step)), jax.tree.map(jnp.asarray, stack(rows))
    state = method.init(jax.random.key(0), 256)
    jax.block_until_ready(fast(state, chunk))
    timed(benchmark, lambda: jax.block_until_ready(fast(state, chunk)), len(rows))


def test_grid_live(benchmark, arena):
    reports, feelers = arena
    rows = iter(reports * 20)
    live = Session(GridBackend(GridConfig(particles=100), feelers, 2.5, np.float32), precision="float32")
    live.step(next(rows))
    timed(benchmark, lambda: live.step(next(rows)), rounds=500)


# Touch: simulated seconds per second of computation


def simulated(**simulation):
    """A session with jitter of the motion: its settings, source, observations and truths."""
    jitter = {"position": 0.005, "yaw_deg": 1.5, "speed": 0.05}
    settings = RunConfig.model_validate(
        {"simulation": {"motion": {"jitter": jitter}} | simulation, "session": {"reserve": 2048}}
    )
    source = open_source(settings)
    settings = complete(settings, source)
    seen = open_touch_source(source, settings.touch)
    rows = list(read_observations(seen))
    return settings, seen, [reading for _, reading in rows], np.array([sample.truth for sample, _ in rows])


def test_ten_circuits_are_mapped_and_scored(benchmark):
    given = {} if benchmark.enabled else {"path": {"circuits": "CC"}}
    settings, source, observations, truth = simulated(**given)
    session = build_session(settings, source)
    list(session.replay(observations[:32]))

    def map_and_score():
        settings, _, observations, truth = simulated(**given)
        session.restart(settings.session.seed)
        place = np.array([int(step.estimate.place) for step in session.replay(observations)])
        experience_metric(place, truth)
        return energy_all_pairs(session.map.trajectory(), truth)

    timed(benchmark, map_and_score, len(truth), rounds=3)


@pytest.mark.parametrize("tier", ["kinematic", "quasistatic", "dynamic"])
def test_one_circuit_is_simulated(benchmark, tier):
    one = partial(simulated, fidelity=tier, path={"circuits": "C"})
    timed(benchmark, one, len(one()[3]), rounds=3)


# Scores of all cells of the default network: 20 x 20 bins of place, 36 of heading

CELLS = 36 * 21 * 21


@pytest.fixture(scope="module")
def recording():
    """Sums of 600 s in random amounts."""
    draw = stream(0, "sums")
    seconds, held = draw.exponential(1.5, (20, 20)), draw.exponential(600 / 36, 36)
    place = draw.exponential(1 / CELLS, (CELLS, 20, 20)) * seconds
    heading = draw.exponential(1 / CELLS, (CELLS, 36)) * held
    edges, none = np.linspace(0, 1, 21), np.zeros(0)
    sums = BinnedSums(edges, edges, seconds, place.astype(np.float32), held, heading.astype(np.float32))
    return CellRecording((36, 21, 21), 0.05, none, none, none, none, none, none, none, sums)


def test_maps_information_and_tuning_of_all_cells(benchmark, recording):
    sums = recording.sums

    def score():
        maps, curves = rate_maps(sums), tuning_curves(sums)
        turn = curves, sums.heading_seconds
        return information(maps, sums.seconds), mean_vector_length(*turn), preferred_direction(*turn)

    assert all(len(column) == CELLS for column in timed(benchmark, score))


def test_all_scores_of_all_cells(benchmark, recording):
    assert len(timed(benchmark, partial(analyse_cells, recording)).cell) == CELLS
