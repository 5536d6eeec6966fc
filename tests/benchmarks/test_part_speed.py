"""Timings on one core after compilation: maps, recall, grid filter, touch; a step of the pose cells."""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numba import njit

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.exm import experience_metric
from evaluation.papers.tables import speed
from ratslam.core.session import Session
from ratslam.grid.config import GridConfig
from ratslam.mapping import optimizer
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
from tactile.base.se2 import integrate
from tactile.base.types import stack
from tactile.frontend import TouchConfig

pytestmark = pytest.mark.soak


def timed(benchmark, call, count=1, rounds=5):
    """What a call returns; its median time is noted, and that of each of its `count` parts."""
    found = benchmark.pedantic(call, rounds=rounds if benchmark.enabled else 1)
    if benchmark.stats is not None:
        benchmark.extra_info["us_each"] = benchmark.stats.stats.median / count * 1e6
        benchmark.extra_info["each_per_second"] = count / benchmark.stats.stats.median
    return found


@pytest.fixture(scope="module")
def frame_map():
    """A square driven again and again with a biased gyro, closed wherever it was before."""
    frames, closures, random = 1000, 400, np.random.default_rng(0)
    turn = np.where(np.arange(1, frames) % 12 == 0, np.pi / 2, 0.0)
    true = np.column_stack([np.full(frames - 1, 0.5), np.zeros(frames - 1), turn])
    motion = true - [0, 0, 0.001] + random.normal(0, [0.01, 0.01, 0.005], true.shape)
    later = random.integers(60, frames, closures)
    noise = np.tile([0.01, 0.01, 0.001], (frames - 1, 1))
    chain = optimizer.OdometryChain(motion, np.full(frames - 1, 0.5), noise)
    path = np.concatenate([np.zeros((1, 3)), integrate(true)])
    links = optimizer.LoopClosures(
        i=later % 48, j=later, turn=(path[later] - path[later % 48])[:, 2], sequence=np.arange(closures) // 5,
        variance=np.array([0.1, 0.1, 0.02]), scale=np.full(closures // 5, 6.0),
    )  # fmt: skip
    begin = optimizer.MapFit(np.concatenate([np.zeros((1, 3)), integrate(motion)]), 0.0, np.zeros(0))
    return begin, optimizer.MapProblem(chain, links, optimizer.CalibrationPrior(0.0, 0.01, 0.0, 0.05))


def test_a_map_of_1000_frames_is_solved(benchmark, frame_map):
    fit = timed(benchmark, partial(optimizer.solve, *frame_map, iterations=4))
    assert abs(fit.bias - 0.002) < 0.001


def test_a_closure_is_checked_against_the_covariance(benchmark, frame_map):
    fit = optimizer.solve(*frame_map, iterations=4)
    timed(benchmark, lambda: optimizer.MapCovariance(fit, frame_map[1]).relative(5, 999, 0.0))


@pytest.mark.parametrize("shifts", [0, 3])
@pytest.mark.parametrize("frames", [1500, 100_000])
def test_one_recall(benchmark, frames, shifts):
    dtype = "float64"
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


@pytest.fixture(scope="module")
def arena():
    source, touch = CreateSimulation(CreateSimulationConfig(reports=512, seed=5)), TouchConfig()
    return [sample.reading for sample in open_touch_source(source, touch)], planar_whiskers_of(source, touch)


@pytest.mark.parametrize("particles", [100, 1000])
def test_grid_replay(benchmark, arena, particles):
    reports, feelers = arena
    rows = reports if benchmark.enabled else reports[:8]
    particles, dtype = particles if benchmark.enabled else 100, np.float32
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


def kernel(width: int, sigma: float) -> np.ndarray:
    at = np.arange(width) - width // 2
    squares = at[:, None, None] ** 2 + at[None, :, None] ** 2 + at[None, None, :] ** 2
    weight = np.exp(-squares / (2 * sigma**2))
    return weight / weight.sum()


@njit(cache=False)
def scatter(p, weight, out):
    k, n, m = p.shape
    half = weight.shape[0] // 2
    out[:] = 0.0
    for h, y, x in np.ndindex(k, n, m):
        if p[h, y, x] != 0.0:
            for a, b, c in np.ndindex(weight.shape):
                i, j = (h + a - half) % k, (y + b - half) % n
                out[i, j, (x + c - half) % m] += p[h, y, x] * weight[a, b, c]


@njit(cache=False)
def threshold(p, q, g):
    total = 0.0
    for cell in np.ndindex(p.shape):
        left = p[cell] - q[cell]
        p[cell] = left - g if left >= g else 0.0
        total += p[cell]
    for cell in np.ndindex(p.shape):
        p[cell] /= total


@njit(cache=False)
def shift(p, out, d, turn):
    k, n, m = p.shape
    out[:] = 0.0
    st, at = (1 if turn >= 0 else -1), abs(turn)
    for h in range(k):
        angle = h * 2 * np.pi / k
        dx, dy = d * np.cos(angle), d * np.sin(angle)
        sx, sy, ax, ay = (1 if dx >= 0 else -1), (1 if dy >= 0 else -1), abs(dx), abs(dy)
        for y, x in np.ndindex(n, m):
            for i, wt in ((h, 1 - at), ((h + st) % k, at)):
                for j, wy in ((y, 1 - ay), ((y + sy) % n, ay)):
                    out[i, j, x] += p[h, y, x] * wt * wy * (1 - ax)
                    out[i, j, (x + sx) % m] += p[h, y, x] * wt * wy * ax


@njit(cache=False)
def peak(p):
    best, where = -1.0, (0, 0, 0)
    for cell in np.ndindex(p.shape):
        if p[cell] > best:
            best, where = p[cell], cell
    return where


def loops(n, k=36):
    """A step of the compiled loops, which has been compiled."""
    excite, inhibit = kernel(7, 1.0), kernel(5, 2.0)
    activity, first, second = np.zeros((3, k, n, n))
    activity[k // 2, n // 2, n // 2] = 1

    def step():
        scatter(activity, excite, first)
        scatter(first, inhibit, second)
        threshold(first, second, 2e-5)
        shift(first, activity, *speed.MOTION)
        return peak(activity)

    step()
    return step


@pytest.mark.parametrize("n", [11, 21, 41, 61, 101, 201])
def test_replay(benchmark, n):
    if benchmark.enabled:
        calls, few, loop = speed.network_calls(n), max(5, 400 // n), loops(n)
        calls["loop"] = (lambda: [loop() for _ in range(few)], few)
    elif n in (11, 41):
        window, start = speed.replay_network(n, "window", 10)
        calls = {"window": (partial(window, start), 10)}
    else:
        pytest.skip("timed by make bench only")
    us = speed.interleaved_medians(calls)
    after, above = benchmark.pedantic(calls["window"][0], rounds=1)
    assert int(above) == 0
    assert np.isfinite(after.pose).all()
    ratio = {name: us.get("numpy", np.nan) / value for name, value in us.items()}
    benchmark.extra_info.update(us=us, ratio=ratio)
    print(f"\n{n} x {n} x 36: us {us}, times as fast as NumPy {ratio}")


@pytest.mark.parametrize("n", [41, 101])
def test_two_packets(benchmark, n):
    if not benchmark.enabled:
        pytest.skip("timed by make bench only")
    steps = 2000
    alone, start = speed.replay_network(n, "window", steps)
    pairs, _ = speed.replay_network(n, "window", steps, every=4)
    calls = {"one": (partial(alone, start), steps), "two": (partial(pairs, start), steps)}
    us = speed.interleaved_medians(calls)
    _, above = benchmark.pedantic(pairs, args=(start,), rounds=1)
    share = int(above) / steps
    assert share > 0.5
    pair = us["one"] + (us["two"] - us["one"]) / share
    benchmark.extra_info.update(us=us, share=share, us_of_a_step_with_two=pair)
    print(f"\n{n}: one packet {us['one']:.0f} us, two {pair:.0f} us ({share:.0%} of the steps)")


@pytest.mark.parametrize("n", [21, 101])
def test_live(benchmark, n):
    if not benchmark.enabled and n != 21:
        pytest.skip("timed by make bench only")
    step, cells = speed.network_step(n, "window")
    live = jax.jit(step, donate_argnums=0)
    nowhere, nothing = np.zeros(3), np.zeros(())
    took = []
    for _ in range(3000 if benchmark.enabled else 20):
        start = time.perf_counter()
        cells, _told = live(cells, nowhere, nothing)
        np.asarray(cells.pose)
        took.append((time.perf_counter() - start) * 1e6)
    half, most = np.quantile(took[10:], [0.5, 0.99])
    benchmark.extra_info.update(p50=half, p99=most)
    print(f"\n{n} live: p50 {half:.0f} us, p99 {most:.0f} us")
    benchmark.pedantic(np.asarray, args=(cells.pose,), rounds=1)
