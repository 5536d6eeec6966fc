"""Geometry of whisker arrays: constant lengths, orthogonal axes, rows and columns as configured."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from tactile.whisker_geometry import (
    Head,
    HeadConfig,
    RingConfig,
    shaft_points,
    tip_height,
    ur10_head,
)

CONFIGS = st.builds(
    HeadConfig,
    rest_deg=st.floats(5, 90),
    first_deg=st.floats(-360, 360),
    whiskers=st.integers(1, 9),
    rings=st.lists(
        st.builds(
            RingConfig, length=st.floats(0.02, 0.3), radius=st.floats(0.01, 0.2), height=st.floats(0.05, 0.5)
        ),
        min_size=1,
        max_size=4,
    ).map(tuple),
)
HEADS = CONFIGS.map(ur10_head)


@given(HEADS)
def test_rest_and_swing_are_unit_vectors_at_right_angles(head: Head) -> None:
    for vectors in (head.rest, head.swing):
        assert np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-12)
    assert np.allclose((head.rest * head.swing).sum(axis=1), 0, atol=1e-12)
    assert head.shape[0] * head.shape[1] == len(head.length) == len(head.base) == len(head.alive)


@given(HEADS, st.integers(0, 2**32 - 1))
def test_whisker_lengths_do_not_depend_on_the_angle(head: Head, seed: int) -> None:
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
    assert (np.diff(heights, axis=0) <= 0).all()
    apart = np.diff(share) > 1e-3
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


def test_the_papers_head() -> None:
    head = ur10_head(HeadConfig())
    assert head.shape == (3, 6)
    assert np.allclose(head.length.reshape(3, 6), [[0.05], [0.11], [0.16]])
    lowest = tip_height(head, np.full(18, np.radians(65.0)))
    assert (lowest > 0).all()  # above the floor
    assert (tip_height(head, np.zeros(18)) > 0.05).all()  # above the walls at rest


def test_dead_whiskers_are_named_by_number() -> None:
    assert np.flatnonzero(~ur10_head(HeadConfig(dead=(0, 17, 5))).alive).tolist() == [0, 5, 17]
    with pytest.raises(ValidationError, match="whiskers 0 to 17"):
        HeadConfig(dead=(18,))
    with pytest.raises(ValidationError):
        HeadConfig(rings=())
