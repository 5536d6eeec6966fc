"""A step of the pose cells, in replay and live, beside the NumPy yardstick and other ways to do it.

All are timed in turns in one run, so that all see the same machine; only the ratios mean anything.
"""

from __future__ import annotations

import importlib.util
import time
from functools import partial
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.attractor import adaptive_window, pose_cells
from ratslam.attractor.config import PoseCellConfig, rings, units
from tactile.base.types import Odometry


def beside(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


FACTOR = {11: 3.4, 21: 2.4, 41: 2.8, 61: 3.8, 101: 3.7}
"""How many times the C++ reference (-O3) is faster than the yardstick, measured once side by side."""
ROUNDS = 5
MOTION = 0.2, 0.1
"""Cells ahead and cells of heading at each step."""


def stepping(n: int, engine: str, dtype=float):
    """A step of that engine as (cells, recall, energy) -> (cells, told), and its start."""
    config, dtype = PoseCellConfig(cells_xy=n, engine=engine), np.dtype(dtype)
    rungs, unit = adaptive_window.rungs(config, dtype), units(config, dtype)
    moved = Odometry(*(jnp.asarray(v, dtype) for v in (MOTION[0] * unit[0], 0.0, MOTION[1] * unit[2], 1.0)))

    def step(cells, recall, energy):
        return pose_cells.step(config, rungs, cells, moved, recall, energy)

    return step, pose_cells.start(config, dtype)


def replaying(n: int, engine: str, steps: int, dtype=float, every: int = 0):
    """A run of so many steps, every so many of them with a little injected at another packet, which moves
    as the first does, half a torus away."""
    step, start = stepping(n, engine, dtype)
    ring = rings(PoseCellConfig(cells_xy=n), np.dtype(dtype))

    @jax.jit
    def run(cells):
        def body(k, carry):
            cells, above = carry
            far = (cells.pose + ring / 2 * np.array([1, 1, 0], dtype)) % ring
            inject = (k % every == every - 1) if every else jnp.bool_(False)
            cells, told = step(cells, far, jnp.where(inject, 0.02, 0.0).astype(dtype))
            return cells, above + (told.rung > 0).astype(jnp.int32)

        return jax.lax.fori_loop(0, steps, body, (cells, jnp.int32(0)))

    jax.block_until_ready(run(start))
    return run, start


def timed(call, count: int) -> float:
    """us for each of so many."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return (time.perf_counter() - start) / count * 1e6


def in_turns(calls: dict) -> dict:
    """Medians in us of {name: (call, how many it does)}."""
    rounds = [{name: timed(*call) for name, call in calls.items()} for _ in range(ROUNDS)]
    return {name: float(np.median([each[name] for each in rounds])) for name in calls}


def many(call, count: int):
    return lambda: [call(*MOTION) for _ in range(count)]


@pytest.mark.parametrize("n", [11, 21, 41, 61, 101, 201])
def test_replay(benchmark, n):
    """The moving window and the dense network, beside the yardstick, compiled loops and FFTs."""
    enabled = benchmark.enabled
    if not enabled and n not in (11, 41):
        pytest.skip("timed by make bench only")
    steps, few = (4000, max(5, 400 // n)) if enabled else (10, 1)
    window, start = replaying(n, "window", steps)
    calls = {"window": (partial(window, start), steps)}
    if enabled:
        single, start32 = replaying(n, "window", steps, np.float32)
        dense, whole = replaying(n, "dense", few)
        plain, loop, fourier = (
            getattr(beside(module), name)(n)
            for module, name in (
                ("yardstick", "Yardstick"),
                ("sparseloop", "SparseLoop"),
                ("fourier", "Fourier"),
            )
        )
        loop.step(*MOTION)
        calls |= {
            "window, float32": (partial(single, start32), steps),
            "dense": (partial(dense, whole), few),
            "numpy": (many(plain.step, few), few),
            "loop": (many(loop.step, few), few),
            "fft": (many(fourier.step, few), few),
        }
    us = in_turns(calls)
    after, above = benchmark.pedantic(window, args=(start,), rounds=1)
    assert int(above) == 0
    assert np.isfinite(after.pose).all()
    if not enabled:
        return
    ratio = {name: us["numpy"] / us[name] for name in us}
    to_cpp = {name: value / FACTOR[n] for name, value in ratio.items()} if n in FACTOR else {}
    benchmark.extra_info.update(us=us, ratio=ratio, to_cpp=to_cpp)
    told = ", ".join(
        f"{name} {us[name]:.0f} us ({ratio[name]:.1f}x" + (f", C++ {to_cpp[name]:.1f}x)" if to_cpp else ")")
        for name in us
    )
    print(f"\n{n} x {n} x 36: {told}")


@pytest.mark.parametrize("n", [41, 101])
def test_two_packets(benchmark, n):
    """Two packets that are kept alive: each step on two patches, beside a step on one."""
    if not benchmark.enabled:
        pytest.skip("timed by make bench only")
    steps = 2000
    alone, start = replaying(n, "window", steps)
    pairs, _ = replaying(n, "window", steps, every=4)
    us = in_turns({"one": (partial(alone, start), steps), "two": (partial(pairs, start), steps)})
    _, above = benchmark.pedantic(pairs, args=(start,), rounds=1)
    share = int(above) / steps
    assert share > 0.5
    pair = us["one"] + (us["two"] - us["one"]) / share
    benchmark.extra_info.update(us=us, share=share, us_of_a_step_with_two=pair)
    print(f"\n{n}: one packet {us['one']:.0f} us, two {pair:.0f} us ({share:.0%} of the steps)")


@pytest.mark.parametrize("n", [21, 101])
def test_live(benchmark, n):
    """One call for each step, its pose read back."""
    if not benchmark.enabled and n != 21:
        pytest.skip("timed by make bench only")
    step, cells = stepping(n, "window")
    live = jax.jit(step, donate_argnums=0)
    nowhere, nothing = np.zeros(3), np.zeros(())
    took = []
    for _ in range(3000 if benchmark.enabled else 20):
        start = time.perf_counter()
        cells, _told = live(cells, nowhere, nothing)
        np.asarray(cells.pose)
        took.append((time.perf_counter() - start) * 1e6)
    assert live._cache_size() == 1
    half, most = np.quantile(took[10:], [0.5, 0.99])
    benchmark.extra_info.update(p50=half, p99=most)
    print(f"\n{n} live: p50 {half:.0f} us, p99 {most:.0f} us")
    benchmark.pedantic(np.asarray, args=(cells.pose,), rounds=1)
