"""Places that have changed: where a session that is localised in a map no longer agrees with it.

Signs are contacts of whiskers that the map does not expect, and expected ones that fail; each pixel of an
image is compared with those of the keyframes near by through the log-odds that recall learned
(`ratslam.recall.whisker_likelihood`). A sign stands at the wall where the whisker touches, or touched in
the map, not at the robot. Signs are summed over all passes within a radius (a scan statistic, Kulldorff
1997). The map's own revisits show which sums come by chance: the largest are taken as exponentially
distributed (Karlin & Altschul 1990). No constant is in units of the sensor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.mapping.appearance import WhiskerAppearance
from ratslam.mapping.ground import Ground
from ratslam.places.localiser import Place, Visits
from ratslam.recall.whisker_likelihood import PixelLayout, level_heights
from tactile.base.se2 import compose
from tactile.frontend import TouchConfig, has_points, touched_points

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


def learn_chance(revisits: Signs, radius: float) -> tuple[float, float]:
    """The sums that come by chance where nothing has changed, from signs at revisits in the map itself:
    number of positive ones for each keyframe, and their mean, nat."""
    heights = [height for _, height, _ in _peaks(revisits, radius)]
    count = len(heights) + PRIOR_PEAKS
    total = sum(heights) + PRIOR_PEAKS * PRIOR_HEIGHT
    return count / (revisits.keyframes + PRIOR_KEYFRAMES), total / count


def find_changes(signs: Signs, chance: tuple[float, float], radius: float) -> list[Change]:
    """The places that have changed, the surest first.

    Args:
        chance: see `learn_chance`. radius: m, see `RADIUS`.
    """
    found, (rate, mean) = [], chance
    for _, height, near in _peaks(signs, radius):
        # Expected number of sums of at least this evidence by chance.
        alarms = float(rate * signs.keyframes * np.exp(-height / mean))
        if alarms >= ALARMS:
            break
        for_it = near[signs.evidence[near] > 0]
        weight = signs.evidence[for_it] / signs.evidence[for_it].sum()
        position = weight @ signs.points[for_it]
        apart = signs.points[for_it] - position
        spread = np.linalg.eigvalsh((weight[:, None] * apart).T @ apart)[-1]
        keyframes = np.unique(signs.keyframe[for_it])
        change = Change(
            position=position,
            extent=float(np.sqrt(12 * max(spread, 0.0))),  # of an evenly covered line with this variance
            evidence=height,
            alarms=alarms,
            appears=float(weight @ signs.appears[for_it]),
            keyframes=keyframes,
            passes=1 + int((np.diff(keyframes) > PASS).sum()),
        )
        found.append(change)
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


def session_changes(place: Place, visits: Visits, touch: TouchConfig) -> list[Change]:
    """The places at which a session does not agree with the map, the surest first; none for maps of other
    images than touch.

    Args:
        visits: of the session; `Change.keyframes` number them. touch: how touch images become points.
    """
    appearance, likeness = place.map.appearance, place.map.appearance.metric().likeness
    if not isinstance(appearance, WhiskerAppearance) or not likeness.size:
        return []
    if not has_points(touch, len(appearance.layout.group)) or not len(visits.step):
        return []

    def contacts_of(frames: np.ndarray) -> ContactMap:
        ground = place.ground._replace(poses=place.map.solution().pose.rows[frames])
        levels = appearance.stored(frames)[0].astype(int)
        return ContactMap(ground, levels, appearance.layout, likeness, touch)

    radius = RADIUS * place.ground.reach
    count = np.full(len(visits.step), len(place.frames))
    signs = contact_signs(contacts_of(place.frames), visits.pose, visits.view.astype(int), count)
    # Signs in the map itself: its later two thirds, each keyframe compared with those long before it.
    state = place.map.state
    late = np.arange(state.total // 3, state.total)
    own = contacts_of(np.arange(state.total))
    revisits = contact_signs(own, own.ground.poses[late], own.levels[late], late - state.guard)
    return find_changes(signs, learn_chance(revisits, radius), radius)


class ContactMap(NamedTuple):
    """The contacts of N keyframes with D whiskers each.

    Attributes:
        ground: the keyframes. levels: [N, D] of their images. layout: of the pixels. log_odds: [G, LEVELS,
            LEVELS], see `log_odds_table`. touch: see `touched_points`.
    """

    ground: Ground
    levels: np.ndarray
    layout: PixelLayout
    log_odds: np.ndarray
    touch: TouchConfig


def contact_points(
    poses: np.ndarray, levels: np.ndarray, touch: TouchConfig
) -> tuple[np.ndarray, np.ndarray]:
    """[n, D, 2] contact points (m) of images [n, D] of levels taken at poses [n, 3], and [n, D] bool,
    there is one."""
    points, touched = touched_points(touch, level_heights(levels))
    body = np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)
    return compose(poses[:, None], body)[..., :2], touched


def contact_signs(made: ContactMap, poses: np.ndarray, levels: np.ndarray, known: np.ndarray) -> Signs:
    """The signs in K images of a session.

    Args:
        poses: [K, 3] in the map. levels: [K, D] of the images. known: [K] number of the first keyframes of
            the map with which each is compared.
    """
    ground, found = made.ground, [(np.zeros(0, int), np.zeros((0, 2)), np.zeros(0), np.zeros(0))]
    remembered, _ = contact_points(ground.poses, made.levels, made.touch)
    points, touched = contact_points(poses, levels, made.touch)
    for k, pose in enumerate(poses):
        shift, frame = ground.near(pose, ground.reach, ground.reach_heading)
        near = shift[frame < known[k]], frame[frame < known[k]]
        if len(near[0]):
            signs = _compare(made, remembered, levels[k], points[k], touched[k], near)
            found.append((np.full(len(signs[0]), k), *signs))
    number, where, evidence, appears = (np.concatenate(column) for column in zip(*found, strict=True))
    return Signs(where, evidence, appears, number, len(poses))


def _compare(
    made: ContactMap,
    remembered: np.ndarray,
    level: np.ndarray,
    points: np.ndarray,
    touched: np.ndarray,
    near: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [n, 2], evidence [n] and appearance [n] of the signs in one image.

    Args:
        remembered: [N, D, 2] contact points of the keyframes of the map, m. level: [D] of the image. points
            [D, 2], touched [D]: see `contact_points`. near: sector shifts and keyframes compared with.
    """
    # Keyframes [n, 1], their pixels [n, D] with which each pixel of the image is compared, and the log-odds
    # [n, D] that they show the same.
    shift, frame = near[0], near[1][:, None]
    reversed = np.cos(made.ground.turns[shift]) < 0
    pixel = np.where(reversed[:, None], made.layout.opposite, np.arange(len(level)))
    log_odds = made.log_odds[made.layout.group, level, made.levels[frame, pixel]]
    total = log_odds.sum(axis=1)
    weight = np.exp(total - total.max())
    weight = weight / weight.sum()
    expected = weight[:, None] * (level_heights(made.levels[frame, pixel]) > 0)
    share = expected.sum(axis=0)
    middle = (expected[..., None] * remembered[frame, pixel]).sum(axis=0) / np.maximum(share, 1e-9)[:, None]
    was = share > 0.5
    here = touched | was
    where = np.where(touched[:, None], points, middle)
    return where[here], -(weight @ log_odds)[here], touched[here].astype(float) - was[here]
