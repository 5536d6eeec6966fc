"""Closures are selected afresh where a map needs much noise in its odometry."""

from __future__ import annotations

from pathlib import Path

import pytest

from ratslam.experiments.atlas.scenarios import ten_circuits
from ratslam.experiments.atlas.stored_maps import store_map
from ratslam.keyframes.fresh_selection import NOISY, seems_noisy
from ratslam.keyframes.odometry_noise import HeadingNoise


@pytest.mark.parametrize("start", [-0.5, 0.0, 1.0])
def test_noise_is_doubted_where_it_is_surely_above_that_of_the_start(start: float) -> None:
    first, sd = HeadingNoise(start), 0.2
    for above, expected in ((-1.0, False), (0.0, False), (0.9 * NOISY * sd, False), (1.1 * NOISY * sd, True)):
        assert seems_noisy(HeadingNoise(start + above, sd), first) is expected


@pytest.mark.soak
def test_two_halves_of_a_maze_that_look_alike_stay_two(tmp_path: Path) -> None:
    """This maze is the same after half a turn: the first half of a circuit fits the second one."""
    assert store_map(ten_circuits(31009), tmp_path).arrays.em < 0.05
