"""A quasistatic cycle may be simulated in any parts, with bit-identical results."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robot.simulation.head.beam import StreamConfig
from robot.simulation.head.kinematic import HeadSetup, MechanicsConfig
from robot.simulation.head.whisk_stream import (
    WallSweep,
    advance_balance,
    simulate_quasistatic,
    whiskers_at_rest,
)
from robot.world.walls import NO_CONTACT
from tactile.base.random_streams import stream
from tactile.whisker_geometry import HeadConfig, ur10_head
from tactile.whisking import WhiskDrive, WhiskingConfig, whisk_command

HEAD = ur10_head(HeadConfig())
SAMPLES, CYCLES = 80, 3


def sweep() -> WallSweep:
    """Walls that enter, leave and slide."""
    random = stream(0, "walls")
    size = (SAMPLES, CYCLES, 18)
    wall = np.repeat(random.uniform(0.2, 1.4, (8, CYCLES, 18)), SAMPLES // 8, axis=0)
    wall = np.where(random.random((1, CYCLES, 18)) < 0.3, NO_CONTACT, wall)
    noise = 2e-3 * random.standard_normal((CYCLES, SAMPLES, 18, 3))
    reach, drift = random.uniform(0.3, 1.0, size), random.normal(0, 0.2, size)
    return WallSweep(np.arange(SAMPLES) / SAMPLES, wall, reach, drift, noise)


def part(whole: WallSweep, some: slice) -> WallSweep:
    return WallSweep(*(column[some] for column in whole[:-1]), whole.noise[:, some])


@given(
    st.lists(st.integers(1, SAMPLES - 1), max_size=6, unique=True), st.sampled_from(["open", "rcp", "spread"])
)
def test_a_cycle_simulated_in_parts_equals_the_whole(cuts: list[int], mode: str) -> None:
    config, mechanics, whole = StreamConfig(rate=SAMPLES), MechanicsConfig(slip=0.1), sweep()
    whisking, threshold = WhiskingConfig(mode=mode), np.full(18, 0.04)

    def law(drive: WhiskDrive, time: float, reading: np.ndarray) -> tuple[np.ndarray, WhiskDrive]:
        return whisk_command(whisking, drive, time, reading, threshold, HEAD.shape)

    ends = [0, *sorted(cuts), SAMPLES]
    balance, parts = whiskers_at_rest(CYCLES, 18), []
    for first, last in itertools.pairwise(ends):
        found, balance = advance_balance(config, mechanics, law, part(whole, slice(first, last)), balance)
        parts.append(found)
    once = simulate_quasistatic(HeadSetup(HEAD, config, mechanics, whisking), whole, threshold)
    assert (once[2] > 0).any()
    assert balance.slipped.any()
    for k, column in enumerate(once):
        assert np.array_equal(np.concatenate([found[k] for found in parts]), column)


def test_a_state_can_be_continued_twice() -> None:
    config, mechanics, whole = StreamConfig(rate=SAMPLES), MechanicsConfig(slip=0.1), sweep()
    whisking = WhiskingConfig(mode="open")

    def law(drive: WhiskDrive, time: float, reading: np.ndarray) -> tuple[np.ndarray, WhiskDrive]:
        return whisk_command(whisking, drive, time, reading, np.full(18, 0.04), HEAD.shape)

    before = whiskers_at_rest(CYCLES, 18)
    first = advance_balance(config, mechanics, law, whole, before)
    second = advance_balance(config, mechanics, law, whole, before)
    assert all(np.array_equal(a, b) for a, b in zip(first[0], second[0], strict=True))
    assert not before.touching.any()
    assert not before.slipped.any()
