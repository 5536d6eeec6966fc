"""Geometry of whisker arrays, and whisking control: the effect of contact on the commanded sinusoid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.whisker_geometry import Head, HeadConfig, RingConfig, shaft_points, tip_height, ur10_head
from tactile.whisking import (
    WhiskingConfig,
    check_amplitude,
    initial_drive,
    neighbour_max,
    whisk_command,
    whisk_phase,
)

RING = {"length": st.floats(0.02, 0.3), "radius": st.floats(0.01, 0.2), "height": st.floats(0.05, 0.5)}
CONFIGS = st.builds(
    HeadConfig,
    rest_deg=st.floats(5, 90),
    first_deg=st.floats(-360, 360),
    whiskers=st.integers(1, 9),
    rings=st.lists(st.builds(RingConfig, **RING), min_size=1, max_size=4).map(tuple),
)
HEADS = CONFIGS.map(ur10_head)


@given(HEADS, st.integers(0, 2**32 - 1))
def test_whiskers_keep_their_length_and_swing_at_right_angles(head: Head, seed: int) -> None:
    for vectors in (head.rest, head.swing):
        assert np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-12)
    assert np.allclose((head.rest * head.swing).sum(axis=1), 0, atol=1e-12)
    angle = np.random.default_rng(seed).uniform(-4, 4, (5, len(head.length)))
    tips, half = (shaft_points(head, angle, head.length / part) for part in (1, 2))
    assert np.allclose(np.linalg.norm(tips - head.base, axis=-1), head.length, atol=1e-12)
    assert np.allclose(2 * (half - head.base), tips - head.base, atol=1e-12)


@given(CONFIGS, st.data())
def test_protraction_lowers_the_tip_until_it_hangs_down(config: HeadConfig, data: st.DataObject) -> None:
    head = ur10_head(config)
    share = data.draw(arrays(float, 6, elements=st.floats(0, 1), unique=True).map(np.sort))
    angle = np.repeat((share * np.radians(config.rest_deg))[:, None], len(head.length), axis=1)
    heights = tip_height(head, angle)
    apart = np.diff(share) > 1e-3
    assert (np.diff(heights, axis=0) <= 0).all()
    assert (np.diff(heights, axis=0)[apart] < 0).all()
    hanging = tip_height(head, np.full(len(head.length), np.radians(config.rest_deg)))
    assert np.allclose(hanging, head.base[:, 2] - head.length, atol=1e-12)


@given(CONFIGS)
def test_rings_are_rows_and_directions_columns(config: HeadConfig) -> None:
    head = ur10_head(config)
    tips = shaft_points(head, np.zeros(len(head.length)), head.length)
    azimuth = np.arctan2(tips[:, 1], tips[:, 0]).reshape(head.shape)
    assert np.allclose(np.exp(1j * azimuth), np.exp(1j * azimuth[:1]), atol=1e-9)
    steps = np.exp(1j * (azimuth - np.radians(config.first_deg)))
    assert np.allclose(steps, np.exp(2j * np.pi * np.arange(config.whiskers) / config.whiskers), atol=1e-9)
    radius = np.hypot(*head.base[:, :2].T).reshape(head.shape)
    assert np.allclose(radius.T, [ring.radius for ring in config.rings])
    out = np.hypot(*tips[:, :2].T).reshape(head.shape) - radius
    lengths = np.array([ring.length for ring in config.rings])
    assert np.allclose(out.T, lengths * np.sin(np.radians(config.rest_deg)))


def test_the_papers_head_and_its_dead_whiskers() -> None:
    head = ur10_head(HeadConfig(dead=(0, 17, 5)))
    assert head.shape == (3, 6)
    assert np.allclose(head.length.reshape(3, 6), [[0.05], [0.11], [0.16]])
    assert (tip_height(head, np.full(18, np.radians(65.0))) > 0).all()  # above the floor
    assert (tip_height(head, np.zeros(18)) > 0.05).all()  # above the walls at rest
    assert np.flatnonzero(~head.alive).tolist() == [0, 5, 17]
    with pytest.raises(ValidationError, match="whiskers 0 to 17"):
        HeadConfig(dead=(18,))
    with pytest.raises(ValidationError):
        HeadConfig(rings=())


SHAPE, THRESHOLD, TOP = (3, 6), np.full(18, 0.04), np.radians(65)
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
    free = TOP * whisk_phase(config, np.arange(100) / 200.0)[:, None]
    assert (angles[0] == 0).all()
    assert (angles >= 0).all()
    assert (angles <= free + 1e-12).all()
    if size <= 0.04 or mode == "open":  # below the threshold nothing changes
        np.testing.assert_allclose(angles, free + np.zeros(18), atol=1e-12)


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_reduction_is_gain_times_deflection_above_threshold(sign: int) -> None:
    config = WhiskingConfig(gain=2.0)
    top = run_cycle(config, touch(4, sign * 0.1))[-1] / whisk_phase(config, 999 / 2000)
    np.testing.assert_allclose(TOP - top[4], 2.0 * 0.06, rtol=1e-6)
    np.testing.assert_allclose(np.delete(top, 4), TOP)


def test_the_amplitude_stays_reduced_until_the_cycle_ends() -> None:
    config, y = WhiskingConfig(), touch(0, 0.1)
    y[400:] = 0
    assert run_cycle(config, y)[-1, 0] < TOP - 0.2
    drive = initial_drive(18)
    for time in (*np.arange(0, 1, 0.005), 0.0, 0.5):
        touched = y[300] if 0 < time < 0.4 else y[0]
        angle, drive = whisk_command(config, drive, time, touched, THRESHOLD, SHAPE)
    np.testing.assert_allclose(angle, TOP)


def test_the_perturbation_is_the_same_at_any_sample_rate() -> None:
    coarse = run_cycle(WhiskingConfig(), touch(0, 0.2, 500, 100), 1000.0)[::5]
    fine = run_cycle(WhiskingConfig(), touch(0, 0.2, 2000, 400), 4000.0)[::20]
    np.testing.assert_allclose(coarse, fine, atol=0.02)


@pytest.mark.parametrize("mode", ["open", "rcp", "spread"])
def test_a_batch_of_heads_equals_single_calls(mode: str) -> None:
    y, config = np.abs(stream(0, "y").standard_normal((100, 3, 18))) * 0.1, WhiskingConfig(mode=mode)
    apart = np.stack([run_cycle(config, y[:, k], 200.0) for k in range(3)], axis=1)
    assert np.array_equal(run_cycle(config, y, 200.0), apart)


@given(st.integers(0, 17), st.floats(0, 1))
def test_free_neighbours_follow_by_the_configured_share(whisker: int, follow: float) -> None:
    config = WhiskingConfig(mode="spread", follow=follow)
    loss = TOP * whisk_phase(config, 59 / 120) - run_cycle(config, touch(whisker, 0.1, 60, 10), 120.0)[-1]
    row, column = divmod(whisker, 6)
    near = {row * 6 + (column + 1) % 6, row * 6 + (column - 1) % 6, *(r * 6 + column for r in range(3))}
    for other in set(range(18)) - {whisker}:
        np.testing.assert_allclose(loss[other], follow * loss[whisker] if other in near else 0, atol=1e-12)
    # The ends of a single row are not neighbours.
    assert neighbour_max(np.array([1.0, 0, 0, 0]), (1, 4)).tolist() == [1, 1, 0, 0]


def test_an_amplitude_above_the_limit_is_refused() -> None:
    head = ur10_head(HeadConfig(limit_deg=70))
    check_amplitude(WhiskingConfig(amplitude_deg=70), head)
    with pytest.raises(InputError, match=r"simulation\.whisking\.amplitude_deg: 80 degrees.*70"):
        check_amplitude(WhiskingConfig(amplitude_deg=80), head)
