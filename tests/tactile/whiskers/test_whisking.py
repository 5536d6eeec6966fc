"""Whisking control: the effect of contact on the commanded sinusoid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.whisker_geometry import HeadConfig, ur10_head
from tactile.whisking import (
    WhiskingConfig,
    check_amplitude,
    initial_drive,
    neighbour_max,
    whisk_command,
    whisk_phase,
)

SHAPE = (3, 6)
THRESHOLD = np.full(18, 0.04)
MODES = st.sampled_from(["open", "rcp", "spread"])


def run_cycle(config: WhiskingConfig, y: np.ndarray, rate: float = 2000.0) -> np.ndarray:
    """Commanded protractions [T, ..., W] over one cycle of deflections [T, ..., W]."""
    drive, angles = initial_drive(*y.shape[1:]), []
    for k in range(len(y)):
        angle, drive = whisk_command(config, drive, k / rate, y[k], THRESHOLD, SHAPE)
        angles.append(angle)
    return np.array(angles)


def touch(whisker: int, size: float, count: int = 1000, since: int = 200) -> np.ndarray:
    y = np.zeros((count, 18))
    y[since:, whisker] = size
    return y


@given(MODES, st.floats(0, 1), st.integers(0, 17))
def test_contact_changes_only_the_amplitude(mode: str, size: float, whisker: int) -> None:
    config = WhiskingConfig(mode=mode)
    angles = run_cycle(config, touch(whisker, size, count=100, since=10), rate=200.0)
    free = np.radians(config.amplitude_deg) * whisk_phase(config, np.arange(100) / 200.0)[:, None]
    assert (angles[0] == 0).all()
    assert (angles >= 0).all()
    assert (angles <= free + 1e-12).all()


@given(MODES, st.floats(0, 0.04))
def test_below_the_threshold_nothing_changes(mode: str, size: float) -> None:
    config = WhiskingConfig(mode=mode)
    free = np.radians(config.amplitude_deg) * whisk_phase(config, np.arange(100) / 200.0)
    np.testing.assert_allclose(run_cycle(config, touch(3, -size, 100, 10), 200.0)[:, 3], free, atol=1e-12)


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_reduction_is_gain_times_deflection_above_threshold(sign: int) -> None:
    config = WhiskingConfig(gain=2.0)
    top = run_cycle(config, touch(4, sign * 0.1))[-1] / whisk_phase(config, 999 / 2000)
    np.testing.assert_allclose(np.radians(65) - top[4], 2.0 * 0.06, rtol=1e-6)
    np.testing.assert_allclose(np.delete(top, 4), np.radians(65))


def test_the_amplitude_stays_reduced_until_the_cycle_ends() -> None:
    config = WhiskingConfig()
    y = touch(0, 0.1)
    y[400:] = 0
    assert run_cycle(config, y)[-1, 0] < np.radians(65) - 0.2
    drive = initial_drive(18)
    for time in (*np.arange(0, 1, 0.005), 0.0, 0.5):
        angle, drive = whisk_command(
            config, drive, time, y[300] if 0 < time < 0.4 else y[0], THRESHOLD, SHAPE
        )
    np.testing.assert_allclose(angle, np.radians(65))


def test_the_perturbation_is_the_same_at_any_sample_rate() -> None:
    config = WhiskingConfig()
    coarse = run_cycle(config, touch(0, 0.2, 500, 100), 1000.0)[::5]
    fine = run_cycle(config, touch(0, 0.2, 2000, 400), 4000.0)[::20]
    np.testing.assert_allclose(coarse, fine, atol=0.02)


def test_a_batch_of_heads_equals_single_calls() -> None:
    y = np.abs(stream(0, "y").standard_normal((100, 3, 18))) * 0.1
    for mode in ("open", "rcp", "spread"):
        config = WhiskingConfig(mode=mode)
        together = run_cycle(config, y, 200.0)
        apart = np.stack([run_cycle(config, y[:, k], 200.0) for k in range(3)], axis=1)
        assert np.array_equal(together, apart)


@given(st.integers(0, 17), st.floats(0, 1))
def test_free_neighbours_follow_by_the_configured_share(whisker: int, follow: float) -> None:
    config = WhiskingConfig(mode="spread", follow=follow)
    top = run_cycle(config, touch(whisker, 0.1, 60, 10), 120.0)[-1]
    loss = np.radians(65) * whisk_phase(config, 59 / 120) - top
    row, column = divmod(whisker, 6)
    near = {row * 6 + (column + 1) % 6, row * 6 + (column - 1) % 6, *(r * 6 + column for r in range(3))}
    for other in set(range(18)) - {whisker}:
        np.testing.assert_allclose(loss[other], follow * loss[whisker] if other in near else 0, atol=1e-12)


def test_the_ends_of_a_single_row_are_not_neighbours() -> None:
    assert neighbour_max(np.array([1.0, 0, 0, 0]), (1, 4)).tolist() == [1, 1, 0, 0]


def test_an_amplitude_above_the_limit_is_refused() -> None:
    head = ur10_head(HeadConfig(limit_deg=70))
    check_amplitude(WhiskingConfig(amplitude_deg=70), head)
    with pytest.raises(InputError, match=r"simulation\.whisking\.amplitude_deg: 80 degrees.*70"):
        check_amplitude(WhiskingConfig(amplitude_deg=80), head)
