"""Noise, drift and faults of whiskers are found again where they are known."""

from __future__ import annotations

import numpy as np
import pytest

from tactile.base.errors import InputError
from tactile.rig_signals import SignalFit, SignalRecord, fit_signals

ROWS, WHISKERS, RATE, BLOCK = 20000, 5, 200.0, 100
NOISE, COLOUR, DRIFT = 3.0, 0.5, 0.8  # unit, correlation, unit per root second
BASE = np.array([40.0, -7.0, 300.0])


def coloured(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Autoregressive noise of standard deviation 1."""
    noise = random.standard_normal(shape)
    for row in range(1, len(noise)):
        noise[row] = COLOUR * noise[row - 1] + np.sqrt(1 - COLOUR**2) * noise[row]
    return noise


def record(seed: int = 0, scale: float = 1.0) -> np.ndarray:
    random = np.random.default_rng(seed)
    shape = (ROWS, WHISKERS, 3)
    walk = np.cumsum(random.standard_normal(shape), axis=0) * DRIFT / np.sqrt(RATE)
    return scale * (BASE + NOISE * coloured(random, shape) + walk)


def fitted(signal: np.ndarray, free: int = 4000, contact: np.ndarray | None = None) -> SignalFit:
    contact = np.zeros(signal.shape[1]) if contact is None else contact
    names = tuple(f"w{k}" for k in range(signal.shape[1]))
    return fit_signals(SignalRecord(signal[:free], signal, BLOCK, BLOCK / RATE, contact, names, "counts"))


def test_noise_colour_and_drift_are_found_in_any_unit() -> None:
    found, other = fitted(record()), fitted(record(scale=1e-3))
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.1)
    np.testing.assert_allclose(found.white, NOISE * np.sqrt(1 - COLOUR), rtol=0.1)
    np.testing.assert_allclose(found.correlation, COLOUR, atol=0.1)
    assert abs(np.median(found.drift) - DRIFT) < 0.2 * DRIFT
    np.testing.assert_allclose(found.baseline, np.broadcast_to(BASE, (WHISKERS, 3)), atol=6)
    assert not found.dead.any()
    assert found.dirty == {}
    for a, b in zip(found[:3], other[:3], strict=True):
        np.testing.assert_allclose(1e-3 * a, b, rtol=1e-9)
    np.testing.assert_allclose(found.correlation, other.correlation, rtol=1e-9)


def test_dead_and_dirty_whiskers_are_named_and_the_drift_of_one_in_contact_is_unknown() -> None:
    signal = record(2)
    signal[:, 1] = 12.5  # a broken wire
    signal[1000:1800, 3, 0] += 400  # a contact in the free record
    found = fitted(signal, contact=np.array([0, 0.05, 0.3, 0, 0]))
    assert np.isnan(found.drift).any(axis=1).tolist() == [False, False, True, False, False]
    assert np.flatnonzero(found.dead).tolist() == [1]
    assert [*found.dirty] == [3]
    assert "standard deviation" in found.dirty[3]
    np.testing.assert_allclose(found.noise[3], NOISE, rtol=0.3)
    assert (found.noise[1] == 0).all()
    with pytest.raises(InputError, match="samples"):
        fitted(record()[:30])
