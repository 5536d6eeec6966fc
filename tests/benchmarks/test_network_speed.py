"""One dense network iteration inside replay, beside the NumPy yardstick, on one core."""

from __future__ import annotations

import importlib.util
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam import posecells
from ratslam.posecells import PoseCellConfig
from tactile.types import Odometry

_spec = importlib.util.spec_from_file_location("yardstick", Path(__file__).with_name("yardstick.py"))
yardstick = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(yardstick)

FACTOR = {11: 3.4, 21: 2.4, 41: 2.8, 61: 3.8, 101: 3.7}
"""How many times the C++ reference (-O3) is faster than the yardstick, measured once side by side."""


def replay(n: int, steps: int):
    config = PoseCellConfig(cells_xy=n)
    table = posecells.tables(config, np.dtype(float))
    unit = posecells.units(config, np.dtype(float))
    odometry = Odometry(0.2 * unit[0], 0.0, 0.1 * unit[2], 1.0)

    @jax.jit
    def run(cells):
        def step(_, cells):
            moved = Odometry(*(jnp.asarray(value, float) for value in odometry))
            return posecells.step(config, table, cells, moved, jnp.zeros(3), jnp.zeros(()))[0]

        return jax.lax.fori_loop(0, steps, step, cells)

    return run, posecells.start(config, np.dtype(float))


def timed(call) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


@pytest.mark.parametrize("n", [11, 21, 41, 61, 101])
def test_a_network_iteration(benchmark, n):
    """The same motion in both; timed in turns so that both see the same machine."""
    steps = max(8, 4000 // n)
    run, cells = replay(n, steps)
    run(cells)[0].block_until_ready()
    plain = yardstick.Yardstick(n)
    ours, theirs = [], []
    for _ in range(5):
        ours.append(timed(lambda: run(cells)[0].block_until_ready()) / steps)
        theirs.append(timed(lambda: [plain.step(0.2, 0.1) for _ in range(8)]) / 8)
    ratio = float(np.median(theirs) / np.median(ours))
    benchmark.extra_info.update(
        us_ours=np.median(ours) * 1e6,
        us_numpy=np.median(theirs) * 1e6,
        ratio=ratio,
        ratio_to_cpp=ratio / FACTOR[n],
    )
    print(
        f"\n{n} x {n} x 36: {np.median(ours) * 1e6:.0f} us, NumPy {np.median(theirs) * 1e6:.0f} us, "
        f"ratio {ratio:.1f}, to the C++ {ratio / FACTOR[n]:.1f}"
    )
    after = benchmark.pedantic(run, args=(cells,), rounds=1)
    assert float(after.activity.sum()) == pytest.approx(1)
    assert np.isfinite(plain.activity).all()
