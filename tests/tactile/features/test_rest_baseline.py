"""The baseline of whisking whiskers: it follows drift, stands still in contact, and tells a bent whisker."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile.base.random_streams import stream
from tactile.base.types import Cycle, Odometry, Whisk
from tactile.calibration import (
    Calibration,
    RestBaseline,
    RestBaselineConfig,
    follow_baseline,
)
from tactile.frontend import Frontend, TouchConfig

SD, COUNT = 2e-3, 18
TIME = np.arange(200) / 1000
FREE = Calibration(
    mean=np.zeros((COUNT, 2)),
    sd=np.full((COUNT, 2), SD),
    threshold=np.full((COUNT, 2), 20 * SD),
    free=np.full(COUNT, 1.0),
    alive=np.ones(COUNT, bool),
    rate=1000.0,
)


def cycle(seed: int, offset: np.ndarray | float, push: float = 0.0) -> Cycle:
    """A whisk with all baselines at an offset, rad; whisker 2 is pushed in the end of the protraction."""
    angle = np.repeat(0.5 - 0.5 * np.cos(2 * np.pi * TIME / 0.2)[:, None], COUNT, axis=1)
    deflection = offset + SD * stream(seed, "whisk").standard_normal((200, COUNT, 2))
    deflection[:, 2, 1] += push * np.maximum(angle[:, 2] - 0.3, 0)
    return Cycle(TIME, angle, deflection, Odometry(0.0, 0.0, 0.0, 0.2))


def drive(baseline: RestBaselineConfig | None, drift: float, cycles: int = 120) -> list[Whisk]:
    """Features of cycles whose baselines drift by `drift` sds a cycle; whisker 2 touches every third."""
    frontend = Frontend(TouchConfig(baseline=baseline), FREE)
    return [
        frontend.features(cycle(k, drift * SD * k, push=0.5 if k % 3 == 0 else 0.0)) for k in range(cycles)
    ]


@settings(max_examples=3, deadline=None)
@given(st.sampled_from([-0.4, 0.0, 0.4]))
def test_contacts_are_found_and_only_they_while_the_baseline_drifts(drift: float) -> None:
    contact = np.array([whisk.contact for whisk in drive(RestBaselineConfig(), drift)])
    assert contact[::3, 2].all()
    assert contact.sum() == len(contact[::3])


def test_the_calibrations_baseline_gives_false_contacts_then() -> None:
    contact = np.array([whisk.contact for whisk in drive(None, 0.4)])
    assert contact[60:].all()


def test_a_bent_whisker_has_no_signal_until_it_returns() -> None:
    config = RestBaselineConfig(bent_cycles=10)
    bent = np.zeros((COUNT, 2))
    bent[5, 0] = 30 * SD
    frontend = Frontend(TouchConfig(baseline=config), FREE)
    alive = np.array([frontend.features(cycle(k, bent * (k < 30))).alive for k in range(60)])
    assert alive[:9, 5].all()
    assert not alive[9:30, 5].any()
    assert alive[30:, 5].all()
    assert np.delete(alive, 5, axis=1).all()


def test_a_whisker_that_drifted_unseen_is_free_again() -> None:
    """A whisker in contact at rest for 20 cycles, whose baseline drifts meanwhile by more than the allowance
    of one cycle, is not lost: a random walk explains where it is found."""
    frontend = Frontend(TouchConfig(), FREE)
    pressed, drifted = np.zeros((COUNT, 2)), np.zeros((COUNT, 2))
    pressed[5, 0], drifted[5, 0] = 200 * SD, 9 * SD
    offsets = [*[pressed] * 20, *[drifted] * 10]
    whisks = [frontend.features(cycle(k, offset)) for k, offset in enumerate(offsets)]
    assert all(whisk.contact[5] for whisk in whisks[:20])
    assert not any(whisk.contact[5] for whisk in whisks[20:])
    np.testing.assert_allclose(frontend.baseline.offset[5, 0], 9 * SD, atol=SD)


def test_it_continues_from_its_arrays_bit_for_bit() -> None:
    cycles = [cycle(k, 0.3 * SD * k) for k in range(20)]
    one, other = (Frontend(TouchConfig(), FREE) for _ in range(2))
    for reading in cycles[:12]:
        one.observe(reading)
    other.restore({name: array.copy() for name, array in one.arrays().items()})
    for reading in cycles[12:]:
        for left, right in zip(one.observe(reading)[1:], other.observe(reading)[1:], strict=True):
            np.testing.assert_array_equal(left, right)
    for name, array in one.arrays().items():
        np.testing.assert_array_equal(array, other.arrays()[name])


def test_cycles_without_samples_and_with_nan_change_nothing() -> None:
    config, start = RestBaselineConfig(), RestBaseline(np.zeros((COUNT, 2)), np.zeros(COUNT, int))
    empty = Cycle(np.zeros(0), np.zeros((0, COUNT)), np.zeros((0, COUNT, 2)), Odometry(0.0, 0.0, 0.0, 0.2))
    assert follow_baseline(config, FREE, start, empty) is start
    broken = cycle(0, 0.0)
    broken.deflection[3, 7] = np.nan
    after = follow_baseline(config, FREE, start, broken)
    assert (after.offset[7] == 0).all()
    assert (after.offset[6] != 0).all()
    assert (after.away < config.bent_cycles).all()
