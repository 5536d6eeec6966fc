"""Where a whisker touches while it slides along an object, and the outline of that object.

The object stands still in its own frame and moves past the whisker by a known motion. The contact is the
point of the whisker's frame at which the calibrated signals (`SignalMap`) are those measured; seen from the
object it moves along the outline, at a speed that changes little from sample to sample. All contacts of a
sweep are estimated together (maximum a posteriori, Gauss-Newton with Levenberg's damping). Lin et al. 2024
(arXiv 2406.06038) filter the same two relations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.base.errors import InputError
from tactile.base.samples import longest_run
from tactile.wall_estimation.signal_map import SignalMap

FREE_ROWS = 8
"""Samples at the start of a sweep, and at its end if the whisker is free there, that give the baseline."""
MIN_SIGNAL_SDS = 8.0
"""Signal of a contact, in standard deviations of the noise."""
FREE_CHANGE = 3.0
"""A whisker is free at the end if it varies there at most this many times as much as at the start."""
SHARE_OF_PEAK = 0.1
"""A whisker whose last signals are smaller than this share of the largest is free; a fall by more than this
share from one sample to the next is a whisker that slips off."""
SLIP_ROWS = 4
"""Samples at the end of a contact in which a fall is a slip."""
MIN_ROWS = 8
"""Least number of samples in contact."""
SPEED_LENGTH = 3.0
"""Distance over which the contact's velocity along the object changes by the whisker's own velocity, as a
share of the longest calibrated reach: a random walk."""
TIP_SD = 0.05
"""Standard deviation of a slipping contact's reach about the longest calibrated one, as a share of it."""
OTHER_DAY = 4.0
"""Error of the map in a sweep, in repeatabilities within the calibration: the whisker is mounted again, and
rubs differently."""
START_SHARES = ((0.4, 0.7), (0.7, 0.85), (0.85, 1.0))
"""Signals are alike at two reaches: the search starts from the likeliest contact within each of these shares
of the longest calibrated reach."""
ROUNDS, STEPS = 3, 15
"""Times the variance of the map is computed anew; largest number of Gauss-Newton steps each time."""
DAMPING = (1e-6, 1e-3, 1e8)
"""Least, first and largest damping, as a share of the diagonal."""
CONVERGED = 1e-3
"""Relative change of the cost at which a round ends."""


class SlidingContact(NamedTuple):
    """The samples of a sweep in contact.

    Attributes:
        first: index of the first. signal: [N, C] above baseline. noise: [C] standard deviation of a free
            whisker's signals. slips_off: whether the contact ends because the object leaves the tip.
    """

    first: int
    signal: np.ndarray
    noise: np.ndarray
    slips_off: bool


class ContactTrack(NamedTuple):
    """The contacts of N samples of one sweep.

    Attributes:
        contact: [N, 3] in the whisker's frame, m. outline: [N, 3] the same points in the object's frame, m.
        covariance: [3N, 3N] of either, sample by sample, m². misfit: mean squared error of the signals in
            standard deviations; about 1 or less if the map holds. cost: twice the negative log posterior.
    """

    contact: np.ndarray
    outline: np.ndarray
    covariance: np.ndarray
    misfit: float
    cost: float


def find_contact(signal: np.ndarray) -> SlidingContact:
    """The longest contact of a sweep [N, C] that starts with a free whisker, above a linear baseline.

    Raises:
        InputError: the sweep holds no contact of `MIN_ROWS` samples.
    """
    before, after = signal[:FREE_ROWS], signal[-FREE_ROWS:]
    noise = np.maximum(before.std(axis=0, ddof=1), 1e-12)
    start = np.median(before, axis=0)
    peak = np.linalg.norm(signal - start, axis=1).max()
    end = np.median(after, axis=0)
    quiet = (after.std(axis=0, ddof=1) <= FREE_CHANGE * noise).all()
    if not quiet or np.linalg.norm(end - start) > SHARE_OF_PEAK * peak:
        end = start
    above = signal - np.linspace(start, end, len(signal))
    touching = (np.abs(above) > MIN_SIGNAL_SDS * noise).any(axis=1)
    run = longest_run(touching)
    first, last = run.start, run.stop
    size = np.append(np.linalg.norm(above[first:last], axis=1), 0.0 if last < len(signal) else np.inf)
    fall = -np.diff(size)[-SLIP_ROWS:]
    slips_off = bool(len(fall) and fall.max() > SHARE_OF_PEAK * peak)
    if slips_off:
        last -= len(fall) - 1 - int(np.argmax(fall))
    if last - first < MIN_ROWS:
        raise InputError("sweep", f"a contact of {last - first} samples", f"at least {MIN_ROWS}")
    return SlidingContact(first, above[first:last], noise, slips_off)


def track_contact(known: SignalMap, place: np.ndarray, touch: SlidingContact) -> ContactTrack:
    """Estimates all contacts of a sweep.

    Args:
        known: the whisker's map. place: [N, 3] position of the object's frame in the whisker's frame at the
            samples in contact, m.

    Raises:
        InputError: no motion, or another number of channels or samples than expected.
    """
    if touch.signal.shape != (len(place), known.weight.shape[1]):
        found = f"{touch.signal.shape[0]} samples of {touch.signal.shape[1]} channels"
        raise InputError("sweep", found, f"{len(place)} of {known.weight.shape[1]}, as stage and calibration")
    if not np.diff(place, axis=0).any():
        raise InputError("sweep", "no motion", "a whisker that slides along an object")
    search = _Search(known, place, touch)
    tracks = [search.descend(start) for start in search.starts()]
    return min(tracks, key=lambda track: track.cost)


class _Search:
    """Maximum a posteriori contacts of one sweep."""

    def __init__(self, known: SignalMap, place: np.ndarray, touch: SlidingContact) -> None:
        self.known, self.place, self.touch = known, place, touch
        self.reaches = np.linalg.norm(known.position - known.base, axis=1)
        self.reach = float(self.reaches.max())
        step = float(np.linalg.norm(np.diff(place, axis=0), axis=1).mean())
        change_sd = step * np.sqrt(step / (SPEED_LENGTH * self.reach))
        self.smooth = np.kron(np.diff(np.eye(len(place)), n=2, axis=0), np.eye(3)) / change_sd
        share = OTHER_DAY * known.noise * np.linalg.norm(touch.signal, axis=1)[:, None]
        self.sample_variance = touch.noise**2 + share**2

    def starts(self) -> list[np.ndarray]:
        """In each range of reaches, the calibrated position [3] with signals nearest to the strongest."""
        strongest = self.touch.signal[np.argmax(np.linalg.norm(self.touch.signal, axis=1))]
        expected = self.known.predict(self.known.position)
        error = np.linalg.norm(expected - strongest, axis=1)
        ranges = [
            (self.reaches >= low * self.reach) & (self.reaches <= high * self.reach)
            for low, high in START_SHARES
        ]
        return [self.known.position[use][np.argmin(error[use])] for use in ranges if use.any()]

    def errors(self, contact: np.ndarray, sd: np.ndarray) -> np.ndarray:
        """Errors of signals, of the outline's smoothness and of the tip, in standard deviations."""
        wrong = (self.touch.signal - self.known.predict(contact)) / sd
        rough = self.smooth @ (contact - self.place).ravel()
        return np.concatenate([wrong.ravel(), rough, self.tip(contact)[0]])

    def tip(self, contact: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Error [0 or 1] of the last contact's reach if it slips off, and its derivatives [same, 3N]."""
        slope = np.zeros((int(self.touch.slips_off), contact.size))
        away = contact[-1] - self.known.base
        reach = np.linalg.norm(away)
        slope[:, -3:] = away / reach / (TIP_SD * self.reach)
        return np.full(len(slope), (reach - self.reach) / (TIP_SD * self.reach)), slope

    def descend(self, start: np.ndarray) -> ContactTrack:
        """The local optimum from a contact [3] at the same place of the whisker in all samples."""
        contact = np.tile(start, (len(self.place), 1))
        for _ in range(ROUNDS):
            variance = self.sample_variance + self.known.variance(contact)
            contact, normal, error = self._round(contact, np.sqrt(variance))
        misfit = float((error[: variance.size] ** 2).mean())
        cost = float(error @ error + np.log(variance).sum())
        return ContactTrack(contact, contact - self.place, np.linalg.inv(normal), misfit, cost)

    def _round(self, contact: np.ndarray, sd: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Contacts, normal matrix [3N, 3N] and errors with fixed standard deviations [N, C]."""
        least, damping, most = DAMPING
        error = self.errors(contact, sd)
        for _ in range(STEPS):
            normal, down = self._normal(contact, error, sd)
            while damping < most:
                damped = normal + damping * np.diag(np.diag(normal))
                moved = contact + np.linalg.solve(damped, down).reshape(contact.shape)
                new = self.errors(moved, sd)
                if new @ new < error @ error:
                    break
                damping *= 4.0
            if damping >= most:
                break
            gain = 1.0 - (new @ new) / (error @ error)
            contact, error, damping = moved, new, max(damping / 8.0, least)
            if gain < CONVERGED:
                break
        return contact, self._normal(contact, error, sd)[0], error

    def _normal(
        self, contact: np.ndarray, error: np.ndarray, sd: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix and right side of a Gauss-Newton step."""
        count, channels = sd.shape
        slope = self.known.slope(contact) / sd[:, :, None]
        rest = np.concatenate([self.smooth, self.tip(contact)[1]])
        normal = rest.T @ rest
        blocks = np.einsum("nci,ncj->nij", slope, slope)
        for k in range(count):
            normal[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += blocks[k]
        wrong = error[: count * channels].reshape(count, channels)
        down = np.einsum("nci,nc->ni", slope, wrong).ravel() - rest.T @ error[count * channels :]
        return normal, down
