"""A whisker that slides along an object: a synthetic whisker with a known map, and slices of real sweeps."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.whiskers.sliding_contact import (
    ContactTrack,
    SlidingContact,
    find_contact,
    track_contact,
)
from evaluation.papers.whiskers.tangent import Circle, fit_circle, local_tangents, plane_covariance
from robot.recordings.real_whiskers import cut_sweep, read_stage, read_stage_calibration
from tactile.base.errors import InputError
from tactile.wall_estimation.signal_map import (
    SignalMap,
    fit_signal_map,
)

SLICES = Path(__file__).parents[2] / "data" / "real_touch" / "stanford"
BASE = np.array([0.01, -0.02, 0.005])
RADIUS, CENTRE = 15e-3, np.array([5e-3, -3e-3])
REST, REACH = np.radians(60.0), 0.042


def at(reach: np.ndarray, turn: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Positions [N, 3] at distances from the base (m), bent by `turn` and raised by `rise` (rad)."""
    angle = REST - turn
    flat = reach * np.cos(rise)
    return BASE + np.stack([-flat * np.cos(angle), -flat * np.sin(angle), reach * np.sin(rise)], axis=-1)


def signals(position: np.ndarray) -> np.ndarray:
    """A whisker whose signals fall with the distance of the contact, each at its own rate."""
    away = position - BASE
    reach = np.linalg.norm(away, axis=1)
    turn = REST - np.arctan2(-away[:, 1], -away[:, 0])
    rise = np.arcsin(away[:, 2] / reach)
    size = 1.0 - reach / 0.07
    across, along = 3000.0 * turn * size, 2000.0 * turn * (1.0 - reach / 0.05)
    return np.stack([3000.0 * rise * size, across, along], axis=-1)


@cache
def synthetic_map() -> SignalMap:
    grid = np.meshgrid(
        np.linspace(0.012, REACH, 8), np.radians(np.arange(0, 61, 10)), [-0.2, -0.1, 0, 0.1, 0.2]
    )
    position = at(*(axis.ravel() for axis in grid))
    return fit_signal_map(position, signals(position), BASE)


@cache
def synthetic_sweep(noise: float) -> tuple[ContactTrack, np.ndarray]:
    """A track along a circle, and the true angles of its contacts on it."""
    progress = np.linspace(0.0, 1.0, 60)
    angle = np.radians(150.0 - 95.0 * progress)
    turn = np.radians(6.0 + 38.0 * np.sin(0.8 * np.pi * progress))
    contact = at(0.027 + 0.014 * progress, turn, np.full(60, 0.02))
    outline = np.append(
        CENTRE + RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1), np.zeros((60, 1)), 1
    )
    random = np.random.default_rng(5)
    signal = signals(contact) + random.normal(0.0, noise, (60, 3))
    touch = SlidingContact(0, signal, np.full(3, noise), False)
    return track_contact(synthetic_map(), contact - outline, touch), angle


def circle_of(track: ContactTrack) -> Circle:
    return fit_circle(track.outline[:, :2], plane_covariance(track.covariance))


def angle_between(one: np.ndarray, other: np.ndarray | float) -> np.ndarray:
    return np.degrees(np.abs((one - other + np.pi / 2) % np.pi - np.pi / 2))


def test_the_map_meets_held_out_places_and_knows_where_it_guesses() -> None:
    random = np.random.default_rng(1)
    inside = at(random.uniform(0.02, 0.04, 50), random.uniform(0.1, 0.9, 50), random.uniform(-0.15, 0.15, 50))
    error = np.abs(synthetic_map().predict(inside) - signals(inside))
    assert np.median(error) < 0.01 * np.median(np.abs(signals(inside)))
    outside = at(np.full(1, 0.04), np.full(1, 2.0), np.full(1, 0.8))
    variances = [synthetic_map().variance(place) for place in (inside, outside)]
    assert variances[1].min() > 10 * variances[0].max()


def test_slopes_are_those_of_the_map() -> None:
    place = at(np.array([0.02, 0.035]), np.array([0.2, 0.7]), np.array([0.0, 0.1]))
    step = 1e-6
    numeric = [
        (synthetic_map().predict(place + move) - synthetic_map().predict(place - move)) / 2 / step
        for move in step * np.eye(3)
    ]
    found = synthetic_map().slope(place)
    np.testing.assert_allclose(found, np.stack(numeric, axis=2), atol=1e-4 * np.abs(found).max())


def test_a_calibration_row_that_contradicts_its_neighbours_is_left_out() -> None:
    position, signal = synthetic_map().position, signals(synthetic_map().position)
    signal[120] = 0.0  # the whisker slipped off
    assert 120 in fit_signal_map(position, signal, BASE).left_out


def test_too_few_calibration_rows_are_an_error() -> None:
    with pytest.raises(InputError, match="5 rows"):
        fit_signal_map(np.ones((5, 3)), np.ones((5, 3)), BASE)


def test_tangent_and_radius_of_a_known_circle() -> None:
    track, angle = synthetic_sweep(1.0)
    found = local_tangents(track.outline[:, :2], plane_covariance(track.covariance))
    error = angle_between(found.direction, angle + np.pi / 2)
    assert np.median(error) < 1.5
    motion = angle_between(angle + np.pi / 2, 0.0)
    assert np.median(motion) > 15.0
    circle = circle_of(track)
    assert abs(circle.radius / RADIUS - 1) < 0.06
    assert np.linalg.norm(circle.centre - CENTRE) < 1e-3
    curvature = np.abs(found.curvature[10:-10])
    assert abs(np.median(curvature) * RADIUS - 1) < 0.3


def test_stated_uncertainty_grows_with_noise_and_covers_the_error() -> None:
    quiet, angle = synthetic_sweep(1.0)
    loud, _ = synthetic_sweep(30.0)
    sd = []
    for track in (quiet, loud):
        found = local_tangents(track.outline[:, :2], plane_covariance(track.covariance))
        error = np.radians(angle_between(found.direction, angle + np.pi / 2))
        assert np.median(error / found.sd) < 1.5
        sd.append(np.median(found.sd))
    assert sd[1] > 3 * sd[0]
    assert circle_of(loud).sd > 3 * circle_of(quiet).sd


def test_no_motion_and_other_channels_are_errors() -> None:
    touch = SlidingContact(0, np.ones((10, 3)), np.ones(3), False)
    with pytest.raises(InputError, match="no motion"):
        track_contact(synthetic_map(), np.zeros((10, 3)), touch)
    with pytest.raises(InputError, match="2 channels"):
        track_contact(synthetic_map(), np.zeros((10, 3)), touch._replace(signal=np.ones((10, 2))))


def sweep_of(shape: np.ndarray, drift: float) -> np.ndarray:
    random = np.random.default_rng(2)
    quiet = random.normal(0.0, 1.0, (100, 3)) + np.linspace(0.0, drift, 100)[:, None]
    quiet[20 : 20 + len(shape), 1] += shape
    return quiet


def test_a_contact_is_found_above_a_drifting_baseline() -> None:
    touch = find_contact(sweep_of(500.0 * np.sin(np.linspace(0.0, np.pi, 50)), 30.0))
    assert 20 <= touch.first <= 22
    assert 46 <= len(touch.signal) <= 50
    assert not touch.slips_off
    assert abs(touch.signal[25, 1] - 500.0) < 10.0


def test_a_sudden_end_is_a_slip() -> None:
    touch = find_contact(sweep_of(500.0 * np.sin(np.linspace(0.0, 0.8 * np.pi, 50)), 0.0))
    assert touch.slips_off
    assert touch.first + len(touch.signal) == 70


def test_a_sweep_without_contact_is_an_error() -> None:
    with pytest.raises(InputError, match="contact of"):
        find_contact(sweep_of(np.zeros(50), 0.0))


def test_real_sweeps_along_a_cylinder() -> None:
    """The centre comes from one sweep, the tangents from another at another depth of the same day."""
    known = fit_signal_map(*read_stage_calibration(SLICES / "stage_calibration.csv"))
    tracks = []
    for number in (2, 5):
        sweep = cut_sweep(read_stage(SLICES / f"stage_cylinder_{number}.csv"))
        touch = find_contact(sweep.signal)
        assert touch.slips_off
        tracks.append(track_contact(known, sweep.position[touch.first :][: len(touch.signal)], touch))
    points = tracks[1].outline[:, :2]
    ray = points - circle_of(tracks[0]).centre
    true = np.arctan2(-ray[:, 0], ray[:, 1])
    found = local_tangents(points, plane_covariance(tracks[1].covariance))
    assert np.median(angle_between(found.direction, true)) < 12.0
    assert np.median(angle_between(true, 0.0)) > 15.0
    for track in tracks:
        assert abs(circle_of(track).radius / RADIUS - 1) < 0.25
