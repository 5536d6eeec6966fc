"""Log-odds of two signed touch images showing one place against two places, learned from the session itself.

A signed image holds departures from rest in any unit, such as displacements of whisker roots in pixels or
pressures in counts; its pixels are correlated. Pixels are compared by their signed square roots, in which the
noise of a count is even (Bartlett 1936). Two images of one place share a Gaussian part, two images of
different places share none: the two-covariance model, whose log-odds are exact and quadratic (Ioffe 2006,
"Probabilistic linear discriminant analysis"; Brummer and de Villiers 2010). It is learned from the covariance
of all images and from that of the differences between confirmed images of one place. Real images have more
outliers than a Gaussian, and places may look alike, so that the log-odds are calibrated afterwards.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.linalg import eigh
from scipy.special import expit, logit

from tactile.base.types import Array

DIRECTIONS = 16
"""Number of directions in which images are compared: those with the largest correlation."""
PRIOR_CORRELATION = 0.5
"""Correlation between two visits of a pixel, before any pair is confirmed."""
LARGEST_CORRELATION = 0.98
"""Largest correlation between two visits, because covariances are never known exactly."""
DEAD = np.inf
"""Value of a dead pixel in a stored image."""


class Calibration(NamedTuple):
    """Log-odds L from those of the two-covariance model, S: with x = temper S + offset,

    L = log(((1 - outliers) e^x + outliers) / (1 - common + common e^x)).

    Attributes:
        temper: factor. offset: nat. outliers: share of images of one place that are as independent as those
            of two. common: share of pairs of different places that look like one place.
    """

    temper: float
    offset: float
    outliers: float
    common: float


PRIOR = Calibration(0.25, 0.0, 0.1, 0.1)
"""The calibration before any pair is confirmed."""
PRIOR_SD = Calibration(1.0, 3.0, 1.0, 1.0)
"""Standard deviations of the logarithm of the temper, of the offset and of the log-odds of the shares."""

LIMIT = 5.0
"""Largest departure from the prior calibration, standard deviations."""


class TwoCovariances(NamedTuple):
    """The learned model of images of D pixels.

    Attributes:
        mean: [D] of the stored images. projection: [D, DIRECTIONS] in units of noise; 0 for pixels that are
            not compared. correlation: [DIRECTIONS] between two visits, 0 for directions that are not used.
            calibration: [4] see `Calibration`.
    """

    mean: Array
    projection: Array
    correlation: Array
    calibration: Array


def stored_image(view: Array, alive: Array) -> Array:
    """The stored form [D] of a view [D]: signed square roots, `DEAD` where `alive` [D] is False. For NumPy
    and JAX."""
    library: Any = np if isinstance(view, np.ndarray) else jnp
    return library.where(alive, library.sign(view) * library.sqrt(abs(view)), DEAD)


def packed_shape(size: int) -> tuple[int, int, int]:
    """The shape of a packed model of images of this many pixels."""
    return (1, size + 2, DIRECTIONS + 1)


def pack(model: TwoCovariances) -> np.ndarray:
    """The model as one array."""
    packed = np.zeros(packed_shape(len(model.mean)))
    packed[0, :-2, :-1], packed[0, :-2, -1] = model.projection, model.mean
    packed[0, -2, :-1], packed[0, -1, : len(model.calibration)] = model.correlation, model.calibration
    return packed


def unpack(packed: Array) -> TwoCovariances:
    """The model in an array [1, D + 2, DIRECTIONS + 1], NumPy or JAX."""
    calibration = packed[0, -1, : len(Calibration._fields)]
    return TwoCovariances(packed[0, :-2, -1], packed[0, :-2, :-1], packed[0, -2, :-1], calibration)


def project(model: TwoCovariances, images: Array) -> Array:
    """[DIRECTIONS, n] the part of stored images [D, n] that is compared; dead pixels are at their mean."""
    library: Any = np if isinstance(images, np.ndarray) else jnp
    apart = library.where(images < DEAD, images - model.mean[:, None], 0.0)
    return model.projection.T @ apart


def log_odds(model: TwoCovariances, a: Array, b: Array) -> Array:
    """[n] calibrated log-odds of one place against two, of pairs of projected images [DIRECTIONS, n]; either
    may have n = 1. For NumPy and JAX."""
    return calibrated(model.calibration, _raw_log_odds(model.correlation[:, None], a, b))


def calibrated(calibration: Array | Calibration, raw: Array) -> Array:
    """Log-odds [n] after a calibration."""
    library: Any = np if isinstance(raw, np.ndarray) else jnp
    temper, offset, outliers, common = calibration
    x = temper * raw + offset
    same = library.logaddexp(library.log1p(-outliers) + x, library.log(outliers))
    return same - library.logaddexp(library.log1p(-common), library.log(common) + x)


def _raw_log_odds(correlation: Array, a: Array, b: Array) -> Array:
    """[n] log-odds of pairs of projected images, but for a constant."""
    return (a * b - correlation / 2 * (a * a + b * b)).sum(axis=0)


def learn(images: np.ndarray, pairs: np.ndarray, apart: np.ndarray) -> TwoCovariances:
    """The model learned from a session.

    The calibration is fitted to the log-odds of each half of the pairs by the covariances of the other half.

    Args:
        images: [N, D] stored, in order of time. pairs: [2, P, D] confirmed pairs of one place. apart: [Q, 2]
            numbers of images of pairs of different places, Q > 0.
    """
    steps = np.stack([images[1:], images[:-1]])
    covariances = _covariances(images, steps, pairs)
    kinds, scores = (steps, pairs), [np.zeros(kind.shape[1]) for kind in (steps, pairs)]
    for odd in (0, 1):
        rest = [kind[:, 1 - odd :: 2] for kind in kinds]
        trial = _covariances(images, *rest)
        for score, kind in zip(scores, kinds, strict=True):
            score[odd::2] = _raw_scores(trial, *kind[:, odd::2])
    same = np.concatenate(scores)
    weights = np.ones(len(same))
    compared = int(covariances.projection.any(axis=1).sum())
    weights[: steps.shape[1]] = min(compared / max(steps.shape[1], 1), 1.0)
    different = _raw_scores(covariances, images[apart[:, 0]], images[apart[:, 1]])
    calibration = calibrate(same, weights, different)
    return covariances._replace(calibration=np.array(calibration))


def _raw_scores(model: TwoCovariances, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[n] log-odds before calibration of pairs of stored images [n, D]."""
    return _raw_log_odds(model.correlation[:, None], project(model, one.T), project(model, other.T))


def _covariances(images: np.ndarray, steps: np.ndarray, pairs: np.ndarray) -> TwoCovariances:
    """The model with the prior calibration.

    A pixel that is dead in an image or never changes is left out. The covariance within a place is that of
    confirmed pairs, and before there are many, that of successive images, which mostly show one place: they
    count as much as D pairs. Priors of independent pixels keep every covariance regular.
    """
    size = images.shape[1]
    alive = (images < DEAD).all(axis=0)
    mean, sd = np.zeros(size), np.zeros(size)
    mean[alive], sd[alive] = images[:, alive].mean(axis=0), images[:, alive].std(axis=0)
    used = sd > 0
    count = int(used.sum())
    projection, correlation = np.zeros((size, DIRECTIONS)), np.zeros(DIRECTIONS)
    if count:
        prior = np.eye(count)
        total = _shrunk((images[:, used] - mean[used]) / sd[used], prior, len(images))
        within = (1 - PRIOR_CORRELATION) * prior
        for one, other in (steps, pairs):
            within = _shrunk((one[:, used] - other[:, used]) / (np.sqrt(2) * sd[used]), within, len(images))
        share, directions = eigh(within, total, subset_by_index=[0, min(DIRECTIONS, count) - 1])
        rho = np.clip(1 - share, 0.0, LARGEST_CORRELATION)
        correlation[: len(rho)] = rho
        projection[used, : len(rho)] = directions * np.sqrt(rho / (1 - rho**2)) / sd[used, None]
    return TwoCovariances(mean, projection, correlation, np.array(PRIOR))


def _shrunk(values: np.ndarray, prior: np.ndarray, most: int) -> np.ndarray:
    """[D, D] second moments of values [n, D] and of a prior that counts as D of them. They count as at most
    `most` values, because the pairs of N images are not more than N independent values."""
    count = min(len(values), most)
    share = count / (count + len(prior))
    return share * (values.T @ values) / max(len(values), 1) + (1 - share) * prior


def calibrate(same: np.ndarray, weights: np.ndarray, different: np.ndarray) -> Calibration:
    """The most probable calibration for log-odds of pairs of one place [P], which count by `weights` [P], and
    of different places [Q], which count as much in all."""
    if not len(same):
        return PRIOR
    from scipy.optimize import minimize  # slow to import, and only signed images need it

    # Numbers without bounds: the logarithm of the temper, the offset, the log-odds of the shares.
    prior = np.array([np.log(PRIOR.temper), PRIOR.offset, logit(PRIOR.outliers), logit(PRIOR.common)])
    sd, weight = np.array(PRIOR_SD), weights.sum() / len(different)

    def cost(free: np.ndarray) -> float:
        found = _bound(free)
        lost = weights @ np.logaddexp(0, -calibrated(found, same))
        lost += weight * np.logaddexp(0, calibrated(found, different)).sum()
        return float(lost + (((free - prior) / sd) ** 2).sum() / 2)

    limits = np.column_stack([prior - LIMIT * sd, prior + LIMIT * sd])
    return _bound(minimize(cost, prior, method="L-BFGS-B", bounds=limits).x)


def _bound(free: np.ndarray) -> Calibration:
    """The calibration of numbers without bounds [4]."""
    temper, offset, outliers, common = free
    return Calibration(float(np.exp(temper)), float(offset), float(expit(outliers)), float(expit(common)))
