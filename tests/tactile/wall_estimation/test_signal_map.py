"""Signals of a whisker by the place of contact: a synthetic whisker whose signals are known everywhere."""

from __future__ import annotations

import numpy as np
import pytest

from tactile.base.errors import InputError
from tactile.wall_estimation.signal_map import fit_signal_map

BASE = np.array([0.01, -0.02, 0.005])
REST = np.radians(60.0)
GRID = np.meshgrid(np.linspace(0.012, 0.042, 8), np.radians(np.arange(0, 61, 10)), [-0.2, -0.1, 0, 0.1, 0.2])


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


POSITION = at(*(axis.ravel() for axis in GRID))


def test_the_map_meets_held_out_places() -> None:
    random = np.random.default_rng(1)
    inside = at(random.uniform(0.02, 0.04, 50), random.uniform(0.1, 0.9, 50), random.uniform(-0.15, 0.15, 50))
    error = np.abs(fit_signal_map(POSITION, signals(POSITION), BASE)(inside) - signals(inside))
    assert np.median(error) < 0.01 * np.median(np.abs(signals(inside)))


def test_a_calibration_row_that_contradicts_its_neighbours_is_left_out() -> None:
    signal = signals(POSITION)
    signal[120] = 0.0  # the whisker slipped off
    found = fit_signal_map(POSITION, signal, BASE)(POSITION[120:121])
    np.testing.assert_allclose(found, signals(POSITION[120:121]), atol=0.02 * np.abs(signal).max())


def test_too_few_calibration_rows_are_an_error() -> None:
    with pytest.raises(InputError, match="5 rows"):
        fit_signal_map(np.ones((5, 3)), np.ones((5, 3)), BASE)
