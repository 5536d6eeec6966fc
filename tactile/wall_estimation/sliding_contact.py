"""Where a whisker touches while it slides along an object, and the outline of that object.

The object stands still in its own frame and moves past the whisker by a known motion. The contact is the
point of the whisker's frame at which the calibrated signals (`SignalMap`) are those measured; seen from the
object it moves along the outline about as far per step as the whisker does. All contacts of a sweep are
estimated together (maximum a posteriori, Gauss-Newton with Levenberg's damping), the errors of the map being
alike at neighbouring positions. (Lin et al. 2024, arXiv 2406.06038, filter the same two relations.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular

from tactile.base.errors import InputError
from tactile.wall_estimation.signal_map import SignalMap, predict_mean, predict_signal, signal_slope

ROUNDS = 4
"""Times the covariance of the map's errors is computed anew."""
STEPS = 12
"""Largest number of Gauss-Newton steps per round."""
DAMPING = (1e-6, 1e-3, 1e8)
"""Least, first and largest damping, as a share of the diagonal."""
CONVERGED = 1e-3
"""Relative change of the cost at which a round ends."""


class ContactTrack(NamedTuple):
    """The contacts of N samples of one sweep.

    Attributes:
        contact: [N, 3] in the whisker's frame, m. outline: [N, 3] the same points in the object's frame, m.
        covariance: [3N, 3N] of either, sample by sample, m². misfit: mean squared error of the signals in
            standard deviations; about 1 or less if the map holds.
    """

    contact: np.ndarray
    outline: np.ndarray
    covariance: np.ndarray
    misfit: float


def track_contact(known: SignalMap, place: np.ndarray, signal: np.ndarray, noise: np.ndarray) -> ContactTrack:
    """Estimates all contacts of a sweep.

    Args:
        known: the whisker's map. place: [N, 3] position of the object's frame in the whisker's frame, m.
        signal: [N, C] signals above baseline while in contact. noise: [C] standard deviation of a free
            whisker's signals, same unit.

    Raises:
        InputError: fewer than two samples, no motion, or another number of channels than the map's.
    """
    if signal.shape[1] != known.weight.shape[1] or len(signal) < 2:
        found = f"{signal.shape[0]} samples of {signal.shape[1]} channels"
        raise InputError("sweep", found, f"at least 2 of {known.weight.shape[1]}, as in the calibration")
    step = float(np.linalg.norm(np.diff(place, axis=0), axis=1).mean())
    if not step > 0:
        raise InputError("sweep", "no motion", "a whisker that slides along an object")
    share = known.noise * np.linalg.norm(signal, axis=1)[:, None]
    sample_variance = noise**2 + share**2
    contact = np.tile(_first_guess(known, signal), (len(signal), 1))
    for _ in range(ROUNDS):
        errors = predict_signal(known, contact).covariance
        roots = [
            cholesky(error + np.diag(variance), lower=True)
            for error, variance in zip(errors, sample_variance.T, strict=True)
        ]
        contact, normal, cost = _descend(known, contact, signal, place, roots, step)
    covariance = np.linalg.inv(normal)
    return ContactTrack(contact, contact - place, covariance, cost / signal.size)


def _first_guess(known: SignalMap, signal: np.ndarray) -> np.ndarray:
    """The calibrated position [3] with signals nearest to the strongest sample."""
    strongest = signal[np.argmax(np.linalg.norm(signal, axis=1))]
    calibrated = predict_mean(known, known.position)
    nearest: np.ndarray = known.position[np.argmin(np.linalg.norm(calibrated - strongest, axis=1))]
    return nearest


def _descend(
    known: SignalMap,
    contact: np.ndarray,
    signal: np.ndarray,
    place: np.ndarray,
    roots: list[np.ndarray],
    step: float,
) -> tuple[np.ndarray, np.ndarray, float]:
    """One round: contacts [N, 3], normal matrix [3N, 3N], squared error of the signals."""
    least, damping, most = DAMPING
    best = _errors(known, contact, signal, place, roots, step)
    normal = np.eye(contact.size)
    for _ in range(STEPS):
        slope = _slopes(known, contact, roots, step)
        normal, down = slope.T @ slope, slope.T @ best
        while damping < most:
            damped = normal + damping * np.diag(np.diag(normal))
            moved = contact + np.linalg.solve(damped, down).reshape(contact.shape)
            error = _errors(known, moved, signal, place, roots, step)
            if error @ error < best @ best:
                break
            damping *= 4.0
        if damping >= most:
            break
        gain = 1.0 - (error @ error) / (best @ best)
        contact, best, damping = moved, error, max(damping / 8.0, least)
        if gain < CONVERGED:
            break
    return contact, normal, float((best[: signal.size] ** 2).sum())


def _errors(
    known: SignalMap,
    contact: np.ndarray,
    signal: np.ndarray,
    place: np.ndarray,
    roots: list[np.ndarray],
    step: float,
) -> np.ndarray:
    """Errors of signals and of the contact's motion along the object, in standard deviations."""
    wrong = signal - predict_mean(known, contact)
    white = [solve_triangular(root, one, lower=True) for root, one in zip(roots, wrong.T, strict=True)]
    return np.concatenate([*white, -np.diff(contact - place, axis=0).ravel() / step])


def _slopes(known: SignalMap, contact: np.ndarray, roots: list[np.ndarray], step: float) -> np.ndarray:
    """Derivatives of minus `_errors` by all coordinates."""
    count = len(contact)
    slope = signal_slope(known, contact)
    white = [
        solve_triangular(root, block_diag(*slope[:, c, None, :]), lower=True) for c, root in enumerate(roots)
    ]
    change = np.kron(np.diff(np.eye(count), axis=0), np.eye(3)) / step
    return np.concatenate([*white, change])
