"""Places where a session that is localised in a map no longer agrees with it.

Signs, each a point with evidence for a change, are summed over all passes within a radius (a scan
statistic, Kulldorff 1997). The map's own revisits tell which sums come by chance: the largest are taken as
exponentially distributed, as those of scan statistics are (Karlin & Altschul 1990). No constant is in units
of the sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

RADIUS = 1.5
"""Radius within which signs are summed, as a multiple of the ground's reach."""
ALARMS = 0.05
"""Expected number of places named by chance in a session, below which a place is named."""
PRIOR_PEAKS, PRIOR_HEIGHT, PRIOR_KEYFRAMES = 4.0, 8.0, 400.0
"""Number and mean evidence (nat) of the chance sums assumed before any is counted, and the keyframes in which
they occur."""
PASS = 24
"""Keyframes without a sign after which the next sign is of another pass."""


class Signs(NamedTuple):
    """Signs for or against a change.

    Attributes:
        points: [n, 2] m, in the map. evidence: [n] log-odds of a change there, nat; negative against it.
        appears: [n] 1 where something is that was not, -1 where something is gone, else 0.
        keyframe: [n] of the session, ascending. keyframes: number of keyframes that were looked at.
    """

    points: np.ndarray
    evidence: np.ndarray
    appears: np.ndarray
    keyframe: np.ndarray
    keyframes: int


class Chance(NamedTuple):
    """Sums of signs where nothing has changed.

    Attributes:
        rate: number of positive ones for each keyframe. height: their mean, nat.
    """

    rate: float
    height: float

    def expected(self, evidence: float, keyframes: int) -> float:
        """Expected number of sums of at least this evidence in a session of `keyframes`."""
        return float(self.rate * keyframes * np.exp(-evidence / self.height))


class Change(NamedTuple):
    """A place that has changed.

    Attributes:
        position: [2] m, in the map, of what has changed. extent: m, along its longer axis. evidence: nat.
        alarms: expected number of such places by chance. appears: share of the evidence for something that
            was not there, -1 for something gone, .. 1. keyframes: [k] of the session that contradict,
            ascending.
        passes: number of times the robot came by.
    """

    position: np.ndarray
    extent: float
    evidence: float
    alarms: float
    appears: float
    keyframes: np.ndarray
    passes: int

    @property
    def kind(self) -> str:
        """What has changed: `new`, `gone` or `different`."""
        return "new" if self.appears > 0.5 else "gone" if self.appears < -0.5 else "different"


def learn_chance(revisits: Signs, radius: float) -> Chance:
    """The sums that come by chance, from signs at revisits in the map itself."""
    heights = [height for _, height, _ in _peaks(revisits, radius)]
    count = len(heights) + PRIOR_PEAKS
    total = sum(heights) + PRIOR_PEAKS * PRIOR_HEIGHT
    return Chance(count / (revisits.keyframes + PRIOR_KEYFRAMES), total / count)


def find_changes(signs: Signs, chance: Chance, radius: float) -> list[Change]:
    """The places that have changed, the surest first.

    Args:
        radius: m, see `RADIUS`.
    """
    found = []
    for _, height, near in _peaks(signs, radius):
        alarms = chance.expected(height, signs.keyframes)
        if alarms >= ALARMS:
            break
        found.append(_change(signs, near, height, alarms))
    return found


def _peaks(signs: Signs, radius: float) -> list[tuple[int, float, np.ndarray]]:
    """Signs around which the sum within the radius is positive and largest, at least two radii apart: the
    sign, the sum, and the signs within the radius; by descending sum."""
    if not len(signs.evidence):
        return []
    from scipy.spatial import cKDTree  # slow to import

    tree = cKDTree(signs.points)
    around = tree.query_ball_point(signs.points, radius, return_sorted=True)
    sums = np.array([signs.evidence[near].sum() for near in around])
    peaks, open_ = [], np.ones(len(sums), bool)
    for k in np.argsort(-sums, kind="stable").tolist():
        if sums[k] <= 0:
            break
        if open_[k]:
            peaks.append((k, float(sums[k]), np.array(around[k])))
            open_[tree.query_ball_point(signs.points[k], 2 * radius)] = False
    return peaks


def _change(signs: Signs, near: np.ndarray, height: float, alarms: float) -> Change:
    for_it = near[signs.evidence[near] > 0]
    weight = signs.evidence[for_it] / signs.evidence[for_it].sum()
    position = weight @ signs.points[for_it]
    apart = signs.points[for_it] - position
    spread = np.linalg.eigvalsh((weight[:, None] * apart).T @ apart)[-1]
    keyframes = np.unique(signs.keyframe[for_it])
    return Change(
        position=position,
        extent=float(np.sqrt(12 * max(spread, 0.0))),  # length of an evenly covered line with this variance
        evidence=height,
        alarms=alarms,
        appears=float(weight @ signs.appears[for_it]),
        keyframes=keyframes,
        passes=1 + int((np.diff(keyframes) > PASS).sum()),
    )
