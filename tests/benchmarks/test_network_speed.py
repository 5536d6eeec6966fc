"""A step of the pose cells, in replay and live, beside the NumPy network and compiled loops.

All are timed in turns in one process, because only ratios on the same machine are meaningful.
"""

from __future__ import annotations

import importlib.util
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

from evaluation.papers.tables.speed import (
    MOTION,
    interleaved_medians,
    network_calls,
    network_step,
    replay_network,
)

FACTOR = {11: 3.4, 21: 2.4, 41: 2.8, 61: 3.8, 101: 3.7}
"""Speed of the C++ reference (-O3) relative to the NumPy network, measured once side by side."""


def loops(n):
    """The compiled loops, which are imported, and compiled, only here."""
    spec = importlib.util.spec_from_file_location("sparseloop", Path(__file__).with_name("sparseloop.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    loop = module.SparseLoop(n)
    loop.step(*MOTION)
    return loop


@pytest.mark.parametrize("n", [11, 21, 41, 61, 101, 201])
def test_replay(benchmark, n):
    """The moving window and the dense network, beside the NumPy network and compiled loops."""
    if not benchmark.enabled and n not in (11, 41):
        pytest.skip("timed by make bench only")
    if benchmark.enabled:
        calls, few, loop = network_calls(n), max(5, 400 // n), loops(n)
        calls["loop"] = (lambda: [loop.step(*MOTION) for _ in range(few)], few)
    else:
        window, start = replay_network(n, "window", 10)
        calls = {"window": (partial(window, start), 10)}
    us = interleaved_medians(calls)
    after, above = benchmark.pedantic(calls["window"][0], rounds=1)
    assert int(above) == 0
    assert np.isfinite(after.pose).all()
    if benchmark.enabled:
        ratio = {name: us["numpy"] / value for name, value in us.items()}
        to_cpp = {name: value / FACTOR[n] for name, value in ratio.items()} if n in FACTOR else {}
        benchmark.extra_info.update(us=us, ratio=ratio, to_cpp=to_cpp)
        print(f"\n{n} x {n} x 36: us {us}, times as fast as NumPy {ratio}, as C++ {to_cpp}")


@pytest.mark.parametrize("n", [41, 101])
def test_two_packets(benchmark, n):
    """Two persistent packets: a step on two windows, beside a step on one."""
    if not benchmark.enabled:
        pytest.skip("timed by make bench only")
    steps = 2000
    alone, start = replay_network(n, "window", steps)
    pairs, _ = replay_network(n, "window", steps, every=4)
    us = interleaved_medians({"one": (partial(alone, start), steps), "two": (partial(pairs, start), steps)})
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
    step, cells = network_step(n, "window")
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
