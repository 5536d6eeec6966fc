"""Geometry of whisker arrays, whisking control, and whisker images: pixel values are obstacle heights, 0
without contact; dead whiskers have no effect."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from tactile import whisking
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Odometry, Whisk
from tactile.calibration import Calibration
from tactile.frontend import Frontend, TouchConfig
from tactile.whisker_geometry import HeadConfig, RingConfig, shaft_points, tip_height, ur10_head
from tactile.whisker_image import MIN_BRIGHTNESS, ImageConfig, view_shape, whisk_observation, whisker_image
from tactile.whisking import WhiskingConfig, initial_drive, whisk_command, whisk_phase

RING = {"length": st.floats(0.02, 0.3), "radius": st.floats(0.01, 0.2), "height": st.floats(0.05, 0.5)}
RINGS = st.lists(st.builds(RingConfig, **RING), min_size=1, max_size=4).map(tuple)
ANGLES_DEG = {"rest_deg": st.floats(5, 90), "first_deg": st.floats(-360, 360)}
CONFIGS = st.builds(HeadConfig, whiskers=st.integers(1, 9), rings=RINGS, **ANGLES_DEG)


@given(CONFIGS.map(ur10_head), st.integers(0, 2**32 - 1))
def test_whiskers_keep_their_length_and_swing_at_right_angles(head, seed):
    for vectors in (head.rest, head.swing):
        assert np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-12)
    assert np.allclose((head.rest * head.swing).sum(axis=1), 0, atol=1e-12)
    angle = np.random.default_rng(seed).uniform(-4, 4, (5, len(head.length)))
    tips, half = (shaft_points(head, angle, head.length / part) for part in (1, 2))
    assert np.allclose(np.linalg.norm(tips - head.base, axis=-1), head.length, atol=1e-12)
    assert np.allclose(2 * (half - head.base), tips - head.base, atol=1e-12)


@given(CONFIGS, arrays(float, 6, elements=st.floats(0, 1), unique=True).map(np.sort))
def test_protraction_lowers_the_tip_until_it_hangs_down(config, share):
    head = ur10_head(config)
    count, rest = len(head.length), np.radians(config.rest_deg)
    heights = tip_height(head, np.repeat((share * rest)[:, None], count, axis=1))
    assert (np.diff(heights, axis=0) <= 0).all()
    assert (np.diff(heights, axis=0)[np.diff(share) > 1e-3] < 0).all()
    assert np.allclose(tip_height(head, np.full(count, rest)), head.base[:, 2] - head.length, atol=1e-12)


@given(CONFIGS)
def test_rings_are_rows_and_directions_columns(config):
    head = ur10_head(config)
    tips = shaft_points(head, np.zeros(len(head.length)), head.length)
    azimuth = np.arctan2(tips[:, 1], tips[:, 0]).reshape(head.shape)
    first = np.radians(config.first_deg) + 2 * np.pi * np.arange(config.whiskers) / config.whiskers
    assert np.allclose(np.exp(1j * azimuth), np.exp(1j * first), atol=1e-9)
    radius = np.hypot(*head.base[:, :2].T).reshape(head.shape)
    assert np.allclose(radius.T, [ring.radius for ring in config.rings])
    out = np.hypot(*tips[:, :2].T).reshape(head.shape) - radius
    lengths = np.array([ring.length for ring in config.rings])
    assert np.allclose(out.T, lengths * np.sin(np.radians(config.rest_deg)))


def test_the_papers_head_and_its_dead_whiskers():
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


def run_cycle(config, y, rate=2000.0):
    """Commanded protractions [T, ..., W] over one cycle of deflections [T, ..., W]."""
    drive, angles = initial_drive(*y.shape[1:]), []
    for k in range(len(y)):
        angle, drive = whisk_command(config, drive, k / rate, y[k], THRESHOLD, SHAPE)
        angles.append(angle)
    return np.array(angles)


def touch(whisker, size, count=1000, since=200):
    y = np.zeros((count, 18))
    y[since:, whisker] = size
    return y


@given(st.sampled_from(["open", "rcp", "spread"]), st.floats(0, 1), st.integers(0, 17))
def test_contact_changes_only_the_amplitude(mode, size, whisker):
    config = WhiskingConfig(mode=mode)
    angles = run_cycle(config, touch(whisker, size, count=100, since=10), rate=200.0)
    free = TOP * whisk_phase(config, np.arange(100) / 200.0)[:, None]
    assert (angles[0] == 0).all()
    assert (angles >= 0).all()
    assert (angles <= free + 1e-12).all()
    if size <= 0.04 or mode == "open":  # below the threshold nothing changes
        np.testing.assert_allclose(angles, free + np.zeros(18), atol=1e-12)


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_reduction_is_gain_times_deflection_above_threshold(sign):
    config = WhiskingConfig(gain=2.0)
    top = run_cycle(config, touch(4, sign * 0.1))[-1] / whisk_phase(config, 999 / 2000)
    np.testing.assert_allclose(TOP - top[4], 2.0 * 0.06, rtol=1e-6)
    np.testing.assert_allclose(np.delete(top, 4), TOP)


def test_the_amplitude_stays_reduced_until_the_cycle_ends():
    config, y = WhiskingConfig(), touch(0, 0.1)
    y[400:] = 0
    assert run_cycle(config, y)[-1, 0] < TOP - 0.2
    drive = initial_drive(18)
    for time in (*np.arange(0, 1, 0.005), 0.0, 0.5):
        touched = y[300] if 0 < time < 0.4 else y[0]
        angle, drive = whisk_command(config, drive, time, touched, THRESHOLD, SHAPE)
    np.testing.assert_allclose(angle, TOP)


def test_the_perturbation_is_the_same_at_any_sample_rate():
    coarse = run_cycle(WhiskingConfig(), touch(0, 0.2, 500, 100), 1000.0)[::5]
    fine = run_cycle(WhiskingConfig(), touch(0, 0.2, 2000, 400), 4000.0)[::20]
    np.testing.assert_allclose(coarse, fine, atol=0.02)


@given(st.integers(0, 17), st.floats(0, 1))
def test_free_neighbours_follow_by_the_configured_share(whisker, follow):
    config = WhiskingConfig(mode="spread", follow=follow)
    loss = TOP * whisk_phase(config, 59 / 120) - run_cycle(config, touch(whisker, 0.1, 60, 10), 120.0)[-1]
    row, column = divmod(whisker, 6)
    near = {row * 6 + (column + 1) % 6, row * 6 + (column - 1) % 6, *(r * 6 + column for r in range(3))}
    for other in set(range(18)) - {whisker}:
        np.testing.assert_allclose(loss[other], follow * loss[whisker] if other in near else 0, atol=1e-12)
    # The ends of a single row are not neighbours.
    assert whisking.neighbour_max(np.array([1.0, 0, 0, 0]), (1, 4)).tolist() == [1, 1, 0, 0]


def test_an_amplitude_above_the_limit_is_refused():
    head = ur10_head(HeadConfig(limit_deg=70))
    whisking.check_amplitude(WhiskingConfig(amplitude_deg=70), head)
    with pytest.raises(InputError, match=r"simulation\.whisking\.amplitude_deg: 80 degrees.*70"):
        whisking.check_amplitude(WhiskingConfig(amplitude_deg=80), head)


HEAD, ODOMETRY = ur10_head(HeadConfig()), Odometry(0.03, 0.001, 0.02, 1.0)
IMAGES = st.builds(
    ImageConfig, transform=st.sampled_from(["max_angle", "contact_angle"]), radial=st.booleans()
)
TRUTHS, ANGLES = arrays(bool, 18), arrays(float, 18, elements=st.floats(0, float(TOP)))
REACHES = arrays(float, 18, elements=st.floats(0, 1))
WHISKS = st.builds(Whisk, st.just(ODOMETRY), TRUTHS, TRUTHS, ANGLES, TRUTHS, ANGLES, REACHES).map(
    lambda whisk: whisk._replace(held=whisk.held & whisk.contact)
)


@given(IMAGES, WHISKS)
def test_exactly_the_whiskers_without_contact_are_0(config, whisk):
    view = whisker_image(config, HEAD, whisk)
    assert view.shape == view_shape(config, HEAD) == (3, 6, 2 if config.radial else 1)
    touching = whisk.contact if config.transform == "contact_angle" else whisk.held
    bright = np.repeat((touching & whisk.alive)[:, None], view.shape[2], axis=1)
    assert ((view.reshape(bright.shape) > 0) == bright).all()
    assert ((view[view > 0] >= MIN_BRIGHTNESS) & (view[view > 0] <= 1)).all()


@given(WHISKS)
def test_pixels_grow_with_the_height(whisk):
    for transform, touching, angle in (
        ("contact_angle", whisk.contact, whisk.touched),
        ("max_angle", whisk.held, whisk.highest),
    ):
        config = ImageConfig(transform=transform, tallest=0.06)
        view = whisker_image(config, HEAD, whisk).reshape(18)
        high = tip_height(HEAD, angle)
        graded = touching & whisk.alive & (high > MIN_BRIGHTNESS * 0.06) & (high < 0.06)
        assert np.allclose(view[graded] * 0.06, high[graded])
        assert (view[touching & whisk.alive & (high >= 0.06)] == 1).all()


@given(IMAGES, WHISKS, st.integers(0, 17))
def test_a_dead_whisker_has_no_effect(config, whisk, number):
    alive = whisk.alive.copy()
    alive[number] = False
    one = whisk_observation(config, HEAD, whisk._replace(alive=alive))
    wild = {"contact": True, "touched": 0.7, "held": True, "highest": 0.9, "reach": 0.5}
    for name, value in wild.items():
        wild[name] = np.where(np.arange(18) == number, value, getattr(whisk, name))
    other = whisk_observation(config, HEAD, whisk._replace(alive=alive, **wild))
    assert (one.view == other.view).all()
    assert (one.point == other.point).all()
    assert not one.contact[number]
    assert not one.alive[number]


@given(WHISKS)
def test_the_observation_has_view_contacts_and_points(whisk):
    seen = whisk_observation(ImageConfig(), HEAD, whisk)
    assert seen.odometry == ODOMETRY
    assert (seen.contact == whisk.contact & whisk.alive).all()
    along = np.where(whisk.reach > 0, whisk.reach, 1.0) * HEAD.length
    there = shaft_points(HEAD, whisk.touched, along)[:, :2]
    assert np.allclose(seen.point, np.where(seen.contact[:, None], there, 0))


@given(IMAGES, WHISKS)
def test_the_front_end_observes_the_image_of_a_whisk(config, whisk):
    frontend = Frontend(TouchConfig(image=config))
    assert (frontend.view_shape, frontend.whiskers) == (view_shape(config, HEAD), 18)
    one, other = frontend.observe(whisk), whisk_observation(config, HEAD, whisk)
    np.testing.assert_equal(one[1:], other[1:])
    assert frontend.observe(other) is other
    dead = Frontend(TouchConfig(image=config, head=HeadConfig(dead=(3, 11)))).observe(whisk)
    lost = np.isin(np.arange(18), [3, 11])
    assert not (dead.alive | dead.contact)[lost].any()
    shape = (18, -1)
    assert np.array_equal(dead.view.reshape(shape), one.view.reshape(shape) * ~lost[:, None])
    assert bool(one.view_seen) == whisk.alive.any()


STILL = np.full((18, 2), 2e-3)
CALIBRATION = Calibration(0 * STILL, STILL, 20 * STILL, np.full(18, TOP), np.ones(18, bool), 2000.0)


def still(count):
    return Cycle(np.arange(count) / 2000, np.zeros((count, 18)), np.zeros((count, 18, 2)), ODOMETRY)


@pytest.mark.parametrize("given", [{}, {"image": {"radial": True, "transform": "max_angle"}}])
def test_a_dropped_whisk_has_motion_but_no_view(given):
    frontend = Frontend(TouchConfig.model_validate(given), CALIBRATION)
    seen, touched = frontend.observe(still(0)), np.linspace(0.1, 0.9, 18)
    assert tuple(seen.odometry) == tuple(ODOMETRY)
    # Unread whiskers must not count as free.
    for part in (seen.view_seen, seen.view, seen.contact, seen.point, seen.wall, seen.alive):
        assert not np.any(part)
    flags = touched > 0, touched > 0.5, touched, touched > 0.7
    full = frontend.observe(Whisk(ODOMETRY, *flags, touched, touched))
    # One chunk can hold both.
    for one, other in zip([*seen.odometry, *seen[1:]], [*full.odometry, *full[1:]], strict=True):
        assert (np.shape(one), np.asarray(one).dtype) == (np.shape(other), np.asarray(other).dtype)


def test_raw_samples_need_a_calibration():
    with pytest.raises(InputError, match="calibration: raw whisker samples without a calibration"):
        Frontend(TouchConfig()).observe(still(2000))
    seen = Frontend(TouchConfig(), CALIBRATION).observe(still(2000))
    assert seen.view_seen
    assert (seen.view == 0).all()
