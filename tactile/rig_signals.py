"""A whisker head measured from its record: geometry, and noise, drift, baseline and faults of each channel.

The geometry (rest angle, base radii) comes from whisks at known poses among known walls. Each contact says
that the whisker met a wall at a protraction; a head of another rest angle or radius would have met it at
another one. The geometry is that whose predicted protractions are the measured ones, by robust least squares.
A tip on top of a wall tells the rest angle, a shaft against a wall's edge the radius too. Lengths and heights
of the bases are taken as they are, because they trade against the rest angle; and so does the delay of the
detection, which is part of the rest angle found.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tactile.base.errors import InputError
from tactile.base.samples import robust_sd
from tactile.calibration import DirtyRecordConfig, calibrate_free, estimate_drift, estimate_noise
from tactile.whisker_geometry import HeadConfig

LEAST_CONTACTS = 50
"""Least number of contacts for a geometry."""
MOST_CONTACTS = 3000
"""Contacts used at most, evenly spread over the record."""
STARTS_DEG = (50.0, 60.0, 70.0, 80.0, 90.0)
"""Rest angles to start from, besides the assumed one, degrees."""
MISSED = 0.5
"""Error of a contact that a geometry does not foresee, rad."""
LEAST_SCALE = 2e-3
"""Least scale of the errors, rad, for contacts without noise."""
BLOCKS = 20
"""Blocks of consecutive contacts; errors of neighbouring contacts are alike, those of blocks independent."""
STEEPEST_DEG = 95.0
"""Largest rest angle tried: more than 90 degrees, because the delay of the detection adds to it."""
STEP = 1e-3
"""Relative step of the numerical derivatives."""
RADII = (0.3, 3.0)
"""Limits of a radius, as multiples of the assumed one."""

Predict = Callable[[HeadConfig], np.ndarray]
"""Protractions [T, W] (rad) at which a head meets the walls around it at the T poses of the record; infinite
without contact."""
Measured = tuple[float, float]
"""A quantity and its standard deviation."""


def fit_head(
    assumed: HeadConfig, contact: np.ndarray, angle: np.ndarray, predict: Predict
) -> tuple[Measured, tuple[Measured | None, ...], int, tuple[float, float]]:
    """The geometry of a head.

    Args:
        assumed: geometry to start from; its lengths, heights and directions are kept.
        contact: [T, W] bool. angle: [T, W] protraction at first contact, rad. predict: see `Predict`.

    Returns:
        rest angle, degrees. radius of each ring, m; None for a ring without enough contacts against edges or
        none at all. number of contacts. robust standard deviation of a protraction with this geometry, and
        with the assumed one, rad.

    Raises:
        InputError: fewer than `LEAST_CONTACTS` contacts.
    """
    from scipy.optimize import least_squares  # slow to import

    row, whisker = np.nonzero(contact)
    if len(row) < LEAST_CONTACTS:
        raise InputError("head", f"{len(row)} contacts", f"at least {LEAST_CONTACTS}")
    some = np.unique(np.linspace(0, len(row) - 1, min(len(row), MOST_CONTACTS)).astype(int))
    row, whisker = row[some], whisker[some]
    measured = angle[row, whisker]

    def errors(values: np.ndarray) -> np.ndarray:
        found = predict(head_with(assumed, values))[row, whisker]
        return np.where(np.isfinite(found), np.clip(measured - found, -MISSED, MISSED), MISSED)

    before = np.array([assumed.rest_deg, *(ring.radius for ring in assumed.rings)])
    starts = [np.array([rest, *before[1:]]) for rest in (assumed.rest_deg, *STARTS_DEG)]
    values = min(starts, key=lambda start: float(np.median(np.abs(errors(start)))))
    bounds = np.array([[1.0, STEEPEST_DEG], *np.outer(before[1:], RADII)]).T
    for _ in range(3):
        scale = max(float(robust_sd(errors(values))), LEAST_SCALE)
        found = least_squares(
            errors, np.clip(values, *bounds), bounds=bounds, loss="cauchy", f_scale=scale,
            x_scale=np.array([10.0, *0.1 * before[1:]]), diff_step=STEP,
        )  # fmt: skip
        values = found.x
    plain = least_squares(errors, values, diff_step=STEP, max_nfev=1)  # the derivatives without the loss
    after, assumed_error = (float(robust_sd(errors(at))) for at in (values, before))
    sd = _uncertainties(plain.jac, errors(values), scale)
    rest, *fitted = zip(values.tolist(), sd.tolist(), strict=True)
    # A radius that is not known to its own size is unknown.
    radii = tuple((radius, one) if one < radius else None for radius, one in fitted)
    return rest, radii, len(row), (after, assumed_error)


def head_with(assumed: HeadConfig, values: np.ndarray) -> HeadConfig:
    """The head with another rest angle (degrees) and other radii (m): `values` [1 + rings]."""
    rest, *radii = values.tolist()
    pairs = zip(assumed.rings, radii, strict=True)
    rings = tuple(ring.model_copy(update={"radius": radius}) for ring, radius in pairs)
    return assumed.model_copy(update={"rest_deg": rest, "rings": rings})


def _uncertainties(slope: np.ndarray, error: np.ndarray, scale: float) -> np.ndarray:
    """Standard deviations of the values, by the sandwich formula over blocks of contacts (Huber 1967).

    Args:
        slope: [N, P] derivatives of the errors. error: [N] rad. scale: of the Cauchy loss.
    """
    tells = (np.abs(slope) > 0).sum(axis=0) >= LEAST_CONTACTS
    slope, off = slope[:, tells], (error / scale) ** 2
    inverse = np.linalg.pinv(slope.T @ (slope * ((1 - off) / (1 + off) ** 2)[:, None]))
    pull = slope * (error / (1 + off))[:, None]
    sums = np.array([block.sum(axis=0) for block in np.array_split(pull, BLOCKS)])
    sd = np.full(len(tells), np.inf)
    sd[tells] = np.sqrt(np.diag(inverse @ (sums.T @ sums) @ inverse))
    return sd


REPAIR = DirtyRecordConfig(on_dirty="repair")
MOST_CONTACT = 0.1
"""Share of a record in contact from which the drift of a whisker is unknown: its contacts change it more."""


class SignalRecord(NamedTuple):
    """Signals of W whiskers with K channels.

    Attributes:
        free: [F, W, K] samples in which the whiskers should touch nothing. drifting: [T, W, K] samples from
            which drift is estimated. block, block_time: samples of it in a block, and time between the
            beginnings of two blocks, s. contact: [W] share of `drifting` in contact. names: of the whiskers.
            unit: of the signals.
    """

    free: np.ndarray
    drifting: np.ndarray
    block: int
    block_time: float
    contact: np.ndarray
    names: tuple[str, ...]
    unit: str


class SignalFit(NamedTuple):
    """Properties of W whiskers with K channels; 0 for dead whiskers.

    Attributes:
        baseline, noise, white: [W, K] mean, standard deviation, and that of white noise with the same
            differences of neighbouring samples. correlation: [W, K] of neighbouring samples. drift: [W, K]
            random walk after one second, NaN where unknown. dead: [W] bool, without a signal. dirty:
            whiskers that touched something in the free record, and why; the rest is of their clean part.
    """

    baseline: np.ndarray
    noise: np.ndarray
    white: np.ndarray
    correlation: np.ndarray
    drift: np.ndarray
    dead: np.ndarray
    dirty: dict[int, str]


def fit_signals(record: SignalRecord) -> SignalFit:
    """The properties of all whiskers.

    Raises:
        InputError: no whisker has a signal, a record is too short, or a whisker is never free.
    """
    dead = (np.ptp(record.free, axis=0) == 0).all(axis=-1)
    live = ~dead
    shape = record.free.shape[1:]
    baseline, noise, white, drift = (np.zeros(shape) for _ in range(4))
    dirty: dict[int, str] = {}
    if live.any():
        free = calibrate_free(REPAIR, record.free[:, live])
        baseline[live], noise[live] = free.mean, free.noise
        white[live] = np.minimum(estimate_noise(record.free[:, live], lag=1), free.noise)
        # Per root of a sample of `drifting`; a block of these stands for `block_time`.
        each_second = np.sqrt(record.block / record.block_time)
        walk = estimate_drift(record.drifting[:, live], record.block) * each_second
        drift[live] = np.where(record.contact[live, None] > MOST_CONTACT, np.nan, walk)
        numbers = np.flatnonzero(live)
        dirty = {int(numbers[whisker]): reason for whisker, reason in free.dirty.items()}
    correlation = 1 - np.divide(white, noise, out=np.ones(shape), where=noise > 0) ** 2
    return SignalFit(baseline, noise, white, correlation, drift, dead, dirty)
