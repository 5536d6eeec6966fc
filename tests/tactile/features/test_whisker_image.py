"""Whisker images: pixel values are obstacle heights, 0 without contact; dead whiskers have no effect."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tactile.base.errors import InputError
from tactile.base.types import Cycle, Odometry, Whisk
from tactile.calibration import Calibration
from tactile.frontend import Frontend, TouchConfig
from tactile.whisker_geometry import HeadConfig, shaft_points, tip_height, ur10_head
from tactile.whisker_image import MIN_BRIGHTNESS, ImageConfig, view_shape, whisk_observation, whisker_image

HEAD = ur10_head(HeadConfig())
ODOMETRY = Odometry(0.03, 0.001, 0.02, 1.0)
SWEEP = np.radians(65.0)
CONFIGS = st.builds(
    ImageConfig, transform=st.sampled_from(["max_angle", "contact_angle"]), radial=st.booleans()
)


def _whisks() -> st.SearchStrategy[Whisk]:
    truths, angles = arrays(bool, 18), arrays(float, 18, elements=st.floats(0, float(SWEEP)))
    reach = arrays(float, 18, elements=st.floats(0, 1))
    drawn = st.builds(Whisk, st.just(ODOMETRY), truths, truths, angles, truths, angles, reach)
    return drawn.map(lambda whisk: whisk._replace(held=whisk.held & whisk.contact))


@given(CONFIGS, _whisks())
def test_exactly_the_whiskers_without_contact_are_0(config: ImageConfig, whisk: Whisk) -> None:
    view = whisker_image(config, HEAD, whisk)
    assert view.shape == view_shape(config, HEAD) == (3, 6, 2 if config.radial else 1)
    assert ((view >= 0) & (view <= 1)).all()
    touching = whisk.contact if config.transform == "contact_angle" else whisk.held
    dark = (view == 0).all(axis=2).reshape(18)
    assert (dark == ~(touching & whisk.alive)).all()
    assert ((view == 0).any(axis=2).reshape(18) == dark).all()
    assert (view[view > 0] >= MIN_BRIGHTNESS).all()


@given(_whisks())
def test_pixels_grow_with_the_height(whisk: Whisk) -> None:
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


@given(CONFIGS, _whisks(), st.integers(0, 17))
def test_a_dead_whisker_has_no_effect(config: ImageConfig, whisk: Whisk, number: int) -> None:
    alive = whisk.alive.copy()
    alive[number] = False
    one = whisk_observation(config, HEAD, whisk._replace(alive=alive))
    wild = {name: getattr(whisk, name).copy() for name in ("contact", "touched", "held", "highest", "reach")}
    for name, value in {"contact": True, "touched": 0.7, "held": True, "highest": 0.9, "reach": 0.5}.items():
        wild[name][number] = value
    other = whisk_observation(config, HEAD, whisk._replace(alive=alive, **wild))
    assert (one.view == other.view).all()
    assert (one.point == other.point).all()
    assert not one.contact[number]
    assert not one.alive[number]


@given(_whisks())
def test_the_observation_has_view_contacts_and_points(whisk: Whisk) -> None:
    seen = whisk_observation(ImageConfig(), HEAD, whisk)
    assert seen.odometry == ODOMETRY
    assert (seen.contact == whisk.contact & whisk.alive).all()
    along = np.where(whisk.reach > 0, whisk.reach, 1.0) * HEAD.length
    there = shaft_points(HEAD, whisk.touched, along)[:, :2]
    assert np.allclose(seen.point[seen.contact], there[seen.contact])
    assert (seen.point[~seen.contact] == 0).all()


@given(CONFIGS, _whisks())
def test_the_front_end_observes_the_image_of_a_whisk(config: ImageConfig, whisk: Whisk) -> None:
    frontend = Frontend(TouchConfig(image=config))
    assert (frontend.view_shape, frontend.whiskers) == (view_shape(config, HEAD), 18)
    one, other = frontend.observe(whisk), whisk_observation(config, HEAD, whisk)
    assert all(np.array_equal(field, same) for field, same in zip(one[1:], other[1:], strict=True))
    assert frontend.observe(other) is other
    dead = Frontend(TouchConfig(image=config, head=HeadConfig(dead=(3, 11)))).observe(whisk)
    lost = np.isin(np.arange(18), [3, 11])
    assert not (dead.alive | dead.contact)[lost].any()
    shape = (18, -1)
    assert np.array_equal(dead.view.reshape(shape), one.view.reshape(shape) * ~lost[:, None])
    assert bool(one.view_seen) == whisk.alive.any()


STILL = np.full((18, 2), 2e-3)
CALIBRATION = Calibration(0 * STILL, STILL, 20 * STILL, np.full(18, SWEEP), np.ones(18, bool), 2000.0)


@pytest.mark.parametrize("given", [{}, {"image": {"radial": True, "transform": "max_angle"}}])
def test_a_dropped_whisk_has_motion_but_no_view(given: dict[str, object]) -> None:
    frontend = Frontend(TouchConfig.model_validate(given), CALIBRATION)
    seen = frontend.observe(Cycle(np.zeros(0), np.zeros((0, 18)), np.zeros((0, 18, 2)), ODOMETRY))
    assert tuple(seen.odometry) == tuple(ODOMETRY)
    for part in (seen.view_seen, seen.view, seen.contact, seen.point, seen.wall):
        assert not np.any(part)
    assert not seen.alive.any()  # unread whiskers must not count as free
    touched = np.linspace(0.1, 0.9, 18)
    full = frontend.observe(
        Whisk(ODOMETRY, touched > 0, touched > 0.5, touched, touched > 0.7, touched, touched)
    )
    # One chunk can hold both.
    for one, other in zip([*seen.odometry, *seen[1:]], [*full.odometry, *full[1:]], strict=True):
        assert (np.shape(one), np.asarray(one).dtype) == (np.shape(other), np.asarray(other).dtype)


def test_raw_samples_need_a_calibration() -> None:
    count = 2000
    cycle = Cycle(np.arange(count) / 2000, np.zeros((count, 18)), np.zeros((count, 18, 2)), ODOMETRY)
    with pytest.raises(InputError, match="calibration: raw whisker samples without a calibration"):
        Frontend(TouchConfig()).observe(cycle)
    seen = Frontend(TouchConfig(), CALIBRATION).observe(cycle)
    assert seen.view_seen
    assert (seen.view == 0).all()
