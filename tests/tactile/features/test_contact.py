"""Contact detection in constructed streams with known contacts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Cycle, Odometry
from tactile.calibration import Calibration
from tactile.contact_threshold import (
    ContactConfig,
    ShaftConfig,
    detect_contacts,
    radial_distance,
    stiffness,
)

AMPLITUDE = 1.134
W = 18
CONFIG = ContactConfig()
ONES = np.ones((W, 2))
CALIBRATION = Calibration(
    0 * ONES, 2e-3 * ONES, 0.04 * ONES, AMPLITUDE * np.ones(W), np.ones(W, bool), 2000.0
)


def whisk(
    wall: np.ndarray, *, rate: float = 2000.0, sd: float = 2e-3, share: float = 0.5, reach: float = 0.75,
    slips: float = np.inf, seed: int = 0,
) -> Cycle:  # fmt: skip
    """A cycle against walls at angles [W]; whiskers bend by `share` of the commanded angle beyond them."""
    time = np.arange(int(rate)) / rate
    command = AMPLITUDE * (1 - np.cos(2 * np.pi * time))[:, None] / 2
    bend = np.where(command > wall, share * np.maximum(command - np.where(wall < np.inf, wall, 0), 0), 0.0)
    bend[np.maximum.accumulate(bend, axis=0) > slips] = 0.0
    angle = np.where(bend > 0, wall + bend, command)
    deflection = np.stack([0 * bend, stiffness(CONFIG.shaft, reach) * bend], axis=-1)
    noise = sd * stream(seed, "sensor").standard_normal((len(time), W, 3))
    return Cycle(time, angle + noise[..., 0], deflection + noise[..., 1:], Odometry(0.03, 0, 0, 1))


WALLS = np.linspace(0.1, 1.0, W)
FREE = np.full(W, np.inf)


def test_free_whisking_has_no_contacts() -> None:
    for seed in range(20):
        features = detect_contacts(CONFIG, CALIBRATION, whisk(FREE, seed=seed))
        assert not features.contact.any()
        assert not features.held.any()
        assert not features.touched.any()
        assert not features.reach.any()
        np.testing.assert_allclose(features.highest, AMPLITUDE, atol=3e-3)


@given(st.integers(0, 100), st.floats(0.25, 0.6))
def test_angles_at_first_contact_are_those_of_the_walls(seed: int, share: float) -> None:
    features = detect_contacts(CONFIG, CALIBRATION, whisk(WALLS, seed=seed, share=share))
    assert features.contact.all()
    assert features.held.all()
    # Not before the wall, except for noise; late by the smallest detectable bend.
    assert (features.touched > WALLS - 0.01).all()
    assert (features.touched < WALLS + 0.04).all()
    np.testing.assert_allclose(features.highest, WALLS + share * (AMPLITUDE - WALLS), atol=3e-3)


def test_false_and_missed_contacts_are_below_one_in_a_thousand() -> None:
    at = stream(1, "walls").uniform(0.05, AMPLITUDE - 0.04, (60, W))
    assert (
        sum((~detect_contacts(CONFIG, CALIBRATION, whisk(at[k], seed=k)).contact).sum() for k in range(60))
        <= 0.003 * at.size
    )
    assert (
        sum(detect_contacts(CONFIG, CALIBRATION, whisk(FREE, seed=k)).contact.sum() for k in range(60))
        <= 0.0013 * at.size
    )


def test_a_whisker_that_slips_off_has_a_contact_but_is_not_held() -> None:
    features = detect_contacts(CONFIG, CALIBRATION, whisk(np.full(W, 0.3), slips=0.2))
    assert features.contact.all()
    assert not features.held.any()
    np.testing.assert_allclose(features.touched, 0.31, atol=0.02)


def test_contacts_do_not_depend_on_the_sample_rate() -> None:
    usual = [detect_contacts(CONFIG, CALIBRATION, whisk(WALLS, seed=k)) for k in range(8)]
    for rate in (1000.0, 4000.0):
        other = [detect_contacts(CONFIG, CALIBRATION, whisk(WALLS, rate=rate, seed=99 + k)) for k in range(8)]
        assert all(np.array_equal(a.contact, b.contact) for a, b in zip(usual, other, strict=True))
        off = np.array([a.touched - b.touched for a, b in zip(usual, other, strict=True)])
        # Tolerance: 2 ms of the fastest sweep.
        assert np.sqrt((off**2).mean()) < 2e-3 * np.pi * AMPLITUDE


@given(st.floats(0.3, 1.0), st.floats(0.05, 1.0))
def test_the_radial_distance_inverts_the_stiffness(reach: float, taper: float) -> None:
    shaft = ShaftConfig(taper=taper)
    assert radial_distance(shaft, stiffness(shaft, reach)) == pytest.approx(reach)
    assert stiffness(shaft, shaft.reference) == pytest.approx(1)


@pytest.mark.parametrize("reach", [0.5, 0.65, 0.8, 1.0])
def test_the_radial_distance_is_estimated(reach: float) -> None:
    features = detect_contacts(CONFIG, CALIBRATION, whisk(np.linspace(0.1, 0.8, W), reach=reach))
    np.testing.assert_allclose(features.reach, reach, atol=0.05)


def test_sensor_offsets_are_subtracted() -> None:
    cycle = whisk(WALLS)
    shifted = cycle._replace(deflection=cycle.deflection + [0.3, -0.2])
    there = CALIBRATION._replace(mean=np.tile([0.3, -0.2], (W, 1)))
    for a, b in zip(
        detect_contacts(CONFIG, CALIBRATION, cycle)[1:],
        detect_contacts(CONFIG, there, shifted)[1:],
        strict=True,
    ):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_dead_whiskers_have_no_contacts_and_do_not_affect_others() -> None:
    plain = detect_contacts(CONFIG, CALIBRATION, whisk(WALLS))
    cycle = whisk(WALLS)
    cycle.angle[3, 2], cycle.deflection[700, 5, 0] = np.nan, np.inf
    features = detect_contacts(CONFIG, CALIBRATION._replace(alive=np.arange(W) != 9), cycle)
    silent = np.isin(np.arange(W), [2, 5, 9])
    assert np.array_equal(features.alive, ~silent)
    for name in ("contact", "touched", "held", "highest", "reach"):
        assert not getattr(features, name)[silent].any()
        # Approximate: the end of the protraction follows from all whiskers together.
        np.testing.assert_allclose(getattr(features, name)[~silent], getattr(plain, name)[~silent], atol=1e-3)


def test_too_low_sample_rates_are_refused() -> None:
    with pytest.raises(InputError, match=r"500 samples per second.*slope_window"):
        detect_contacts(CONFIG, CALIBRATION, whisk(FREE, rate=500.0))


def test_streams_with_gaps_are_refused() -> None:
    cycle = whisk(FREE)
    with pytest.raises(InputError, match="not increasing"):
        detect_contacts(CONFIG, CALIBRATION, cycle._replace(time=cycle.time * 0))
    with pytest.raises(InputError, match="cut off"):
        detect_contacts(CONFIG, CALIBRATION, Cycle(*(part[:10] for part in cycle[:3]), cycle.odometry))


def test_a_whisk_without_samples_has_no_contacts() -> None:
    """A dropped stream leaves the motion unchanged."""
    whole = whisk(WALLS)
    features = detect_contacts(CONFIG, CALIBRATION, Cycle(*(part[:0] for part in whole[:3]), whole.odometry))
    usual = detect_contacts(CONFIG, CALIBRATION, whole)
    assert features.odometry == whole.odometry
    for part, other in zip(features[1:], usual[1:], strict=True):
        assert (part.shape, part.dtype) == (other.shape, other.dtype)
        assert not part.any()
