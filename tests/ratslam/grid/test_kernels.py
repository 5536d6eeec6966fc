"""Laws of footprints: shape, translation and rotation."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.grid import likelihoods as kernels
from tactile.base.se2 import wrap

SIZE = 31
MIDDLE = (SIZE - 1) / 2
PLACE = st.tuples(*[st.floats(10, 20)] * 2)
ANGLE = st.floats(-10, 10)
FAN = np.pi / 12

blobs = jax.jit(kernels.gaussian_blobs, static_argnums=(2, 3))
disc = jax.jit(kernels.disc, static_argnums=(1, 2))
sector = jax.jit(
    lambda place, angle, size: kernels.wall_sector(place, angle, 5.0, FAN, size), static_argnums=2
)
SHAPES = {
    "edge": jax.jit(lambda place, angle: kernels.wall_edge(place, angle, 4.0, 1.2, SIZE)),
    "sector": lambda place, angle: sector(place, angle, SIZE),
}


@pytest.fixture(params=SHAPES, scope="module")
def shape(request):
    """The footprint [SIZE, SIZE] of a wall at a place [2], cells, of a direction, rad."""
    return lambda place, angle: np.asarray(SHAPES[request.param](np.array([place]), np.array([angle])))[0]


def offsets(place):
    at = np.arange(SIZE)
    return at[None] - place[0], at[:, None] - place[1]


# Contacts


@given(st.lists(PLACE, min_size=3, max_size=3), st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_blobs_are_sums_of_round_gaussians(places, amounts):
    expected = np.zeros((SIZE, SIZE))
    for place, amount in zip(places, amounts, strict=True):
        right, up = offsets(place)
        expected += amount * np.exp(-(right**2 + up**2) / (2 * 1.5**2))
    footprint = np.asarray(blobs(np.array([places, places[::-1]]), np.array(amounts), 1.5, SIZE))
    assert footprint[0] == pytest.approx(expected, abs=1e-12)
    doubled = np.asarray(blobs(np.array([places]), 2 * np.array(amounts), 1.5, SIZE))
    assert doubled[0] == pytest.approx(2 * expected, abs=1e-12)


def test_a_blob_has_its_amount_at_its_place_and_is_absent_without_whiskers():
    place = np.array([[[9.0, 20.0]]])  # x, y
    footprint = np.asarray(blobs(place, np.array([2.0]), 1.0, SIZE))[0]
    assert np.unravel_index(footprint.argmax(), footprint.shape) == (20, 9)
    assert footprint.max() == pytest.approx(2)
    assert footprint[20, 10] == footprint[21, 9] == pytest.approx(2 * np.exp(-0.5))
    assert not np.any(blobs(np.zeros((4, 0, 2)), np.zeros(0), 1.0, SIZE))


@given(PLACE, st.floats(1.0, 6.0))
def test_a_disc_is_full_inside_and_empty_outside(place, radius):
    footprint = np.asarray(jax.jit(kernels.disc, static_argnums=2)(np.array([place]), radius, SIZE))[0]
    away = np.hypot(*offsets(place))
    assert (footprint[away <= radius - 0.5] == 1).all()
    assert (footprint[away >= radius + 0.5] == 0).all()
    assert ((footprint >= 0) & (footprint <= 1)).all()
    assert footprint.sum() == pytest.approx(np.pi * (radius**2 + 1 / 12), abs=0.25 + 0.1 * radius)


# Walls


@given(PLACE, ANGLE)
def test_a_footprint_is_the_same_for_opposite_wall_directions(shape, place, angle):
    """It is invariant to half a turn, and to a mirror along the wall."""
    footprint = shape(place, angle)
    assert footprint == pytest.approx(shape(place, angle + np.pi), abs=1e-9)
    opposite = shape(np.array([SIZE - 1, SIZE - 1]) - place, angle)[::-1, ::-1]
    assert footprint == pytest.approx(opposite, abs=1e-9)


@given(PLACE, ANGLE)
def test_a_footprint_turns_with_its_wall(shape, place, angle):
    """By a right angle, which maps the window onto itself: x, y becomes -y, x."""
    turned = shape((SIZE - 1 - place[1], place[0]), angle + np.pi / 2)
    assert turned == pytest.approx(np.rot90(shape(place, angle), -1), abs=1e-6)
    mirrored = shape((place[0], SIZE - 1 - place[1]), -angle)
    assert mirrored == pytest.approx(shape(place, angle)[::-1], abs=1e-6)


@pytest.mark.parametrize("angle", np.radians([0, 30, 45, 90, 135, 200]))
def test_a_footprint_is_largest_at_the_contact_and_lies_along_the_wall(shape, angle):
    footprint = shape((MIDDLE, MIDDLE), angle)
    assert footprint[SIZE // 2, SIZE // 2] == 1
    assert footprint.max() == 1
    right, up = offsets((MIDDLE, MIDDLE))
    spread = [(footprint * part).sum() for part in (right**2 + 0 * up, right * up, 0 * right + up**2)]
    axis = 0.5 * np.arctan2(2 * spread[1], spread[0] - spread[2])
    assert np.sin(axis - angle) == pytest.approx(0, abs=0.01)


def test_an_edge_has_the_given_length_and_width():
    footprint = np.asarray(SHAPES["edge"](np.array([[MIDDLE, MIDDLE]]), np.zeros(1)))[0]
    right, up = offsets((MIDDLE, MIDDLE))
    assert footprint == pytest.approx(np.exp(-(right**2) / (2 * 4.0**2) - up**2 / (2 * 1.2**2)), abs=1e-12)


@pytest.mark.parametrize("angle", np.radians([0, 30, 90, 160, 250]))
def test_eq_4_draws_the_edge_both_ways(angle):
    """With a standard deviation of 5 cells and pi / 12, each way has a mass of 16.7; read as printed, without
    the modulus, the way back has none."""
    size = 51
    place = np.array([[25.0, 25.0]])
    footprint = np.asarray(sector(place, np.array([angle]), size))[0]
    right, up = np.arange(size)[None] - 25.0, np.arange(size)[:, None] - 25.0
    ahead = np.cos(angle) * right + np.sin(angle) * up
    forward, backward = footprint[ahead > 1e-9].sum(), footprint[ahead < -1e-9].sum()
    assert forward == pytest.approx(backward, rel=1e-6)
    assert forward == pytest.approx(16.7, rel=0.05)
    off, away = wrap(np.arctan2(up, right) - angle), np.hypot(right, up)
    printed = np.exp(-(away**2) / (2 * 25) - off**2 / (2 * FAN**2))
    assert footprint[ahead > 1e-9] == pytest.approx(printed[ahead > 1e-9], abs=1e-9)
    assert printed[ahead < -1e-9].sum() < 1e-3


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_kernels_keep_their_precision(dtype):
    place, angle, amount = np.full((2, 2), 3.0, dtype), np.ones(2, dtype), np.ones(1, dtype)
    for make, *parts in (
        (lambda place, amount: kernels.gaussian_blobs(place[:, None], amount, 1.0, 8), place, amount),
        (lambda place: kernels.disc(place, 2.0, 8), place),
        (lambda place, angle: kernels.wall_edge(place, angle, 3.0, 1.0, 8), place, angle),
        (lambda place, angle: kernels.wall_sector(place, angle, 3.0, FAN, 8), place, angle),
    ):
        footprint = jax.eval_shape(make, *parts)
        assert footprint.dtype == dtype
        assert footprint.shape == (2, 8, 8)
