"""Estimators of the direction of a wall from one contact (Fox et al. 2012, II-F and II-G).

Each is a pure function from a `WallContact` (HIT1 to HIT2 or ABORT) to a `Wall` in base_link at the end of
the contact. A direction is that *along* the wall, counter-clockwise from ahead, modulo half a turn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.base.se2 import inverse
from tactile.base.types import StepEnd
from tactile.wall_estimation.strain_templates import (
    WALL_DIRECTIONS,
    TemplateMatch,
    TipModel,
    direction_misfit,
)
from tactile.whisker_geometry import PlanarWhiskers

MIN_SEPARATION = 0.05
"""Least distance of two contacts for a line through them, m."""
LINE_SD = 0.05
"""Standard deviation of the direction of a line through two contacts, rad."""
TEMPLATE_SD = 0.10
"""Standard deviation of the direction of a matched template, rad."""
TIP_SD = 0.04
"""Least standard deviation of a direction from a sliding tip, rad."""
MAX_DIRECTION_SD = 0.15
"""A direction with a larger standard deviation is discarded, rad."""
MAX_WALL_MISFIT = 3.0
"""Largest misfit of a contact with a straight wall, in variances."""
MAX_INDEPENDENT_SAMPLES = 6
"""Upper limit of the effective sample count of a strain series, since model errors are correlated."""
OTHER_WALL_PROBABILITY = 0.1
"""Probability that the second contact is with another wall."""


class WallContact(NamedTuple):
    """The data of one contact with a wall, from HIT1 to HIT2 or ABORT.

    Attributes:
        first, now: [W] bool, contacts at HIT1 and at the end. travel: [3] motion between them, in the frame
            at HIT1. moment: kind of its end.
        strain: [N, W, 2] filtered strain since HIT1. alive: [W] bool, whiskers with usable strain.
    """

    first: np.ndarray
    now: np.ndarray
    travel: np.ndarray
    moment: StepEnd
    strain: np.ndarray
    alive: np.ndarray

    def first_whisker(self) -> int | None:
        """The whisker in contact at HIT1, of several the most strained one; None without usable strain."""
        may = self.first & self.alive
        if not may.any() or not len(self.strain):
            return None
        return int(np.argmax(np.where(may, np.abs(self.strain[0, :, 0]), -1.0)))

    def to_final_frame(self, points: np.ndarray) -> np.ndarray:
        """Points [..., 2] in the frame at HIT1, transformed to the frame at the end."""
        x, y, turn = inverse(self.travel)
        c, s = np.cos(turn), np.sin(turn)
        return points @ np.array([[c, s], [-s, c]]) + np.array([x, y])


class Wall(NamedTuple):
    """An estimated wall; all fields are 0 if there is no estimate.

    Attributes:
        known: whether there is an estimate. direction: along the wall, rad in [0, pi).
        point: [2] m, the point of the wall's line nearest to base_link's origin.
        sd: standard deviation of the direction, rad.
    """

    known: bool = False
    direction: float = 0.0
    point: np.ndarray = np.zeros(2)
    sd: float = 0.0

    @classmethod
    def through(cls, point: np.ndarray, direction: float, sd: float) -> Wall:
        """The wall with a direction (rad) through a point [2]."""
        normal = wall_normal(direction)
        return cls(True, float(direction % np.pi % np.pi), (normal @ point) * normal, float(sd))


def wall_normal(direction: float) -> np.ndarray:
    """The unit normal [2] of a wall, pointing ahead: 90 degrees (a wall straight across) gives 0 degrees."""
    return np.array([np.sin(direction), -np.cos(direction)])


def contact_points(feelers: PlanarWhiskers, radius: float) -> np.ndarray:
    """Assumed contact points [W, 2], m: at a fixed radius along the whiskers (II-D)."""
    return feelers.base + radius * feelers.direction


def geometric_wall(points: np.ndarray, contact: WallContact) -> Wall:
    """The line through the contacts of HIT1 and HIT2 (II-F), by total least squares for more than two.

    There is no estimate without HIT2 or with contacts closer than `MIN_SEPARATION`.

    Args:
        points: [W, 2] assumed contact points, m.
    """
    if contact.moment != StepEnd.HIT2:
        return Wall()
    before, new = contact.to_final_frame(points[contact.first]), points[contact.now & ~contact.first]
    there = np.concatenate([before, new])
    apart = np.linalg.norm(there[:, None] - there, axis=-1).max(initial=0.0)
    if apart < MIN_SEPARATION:
        return Wall()
    middle = there.mean(axis=0)
    along = np.linalg.svd(there - middle)[2][0]
    return Wall.through(middle, float(np.arctan2(along[1], along[0])), LINE_SD)


def template_wall(
    points: np.ndarray, match: TemplateMatch, contact: WallContact, max_error: float | None
) -> Wall:
    """The direction of the best template, through the contact of HIT1 (II-G); also after ABORT.

    Args:
        max_error: relative error of the match above which there is no estimate; None: no limit (the paper).
    """
    whisker = contact.first_whisker()
    if whisker is None or (max_error is not None and match.relative >= max_error):
        return Wall()
    return Wall.through(contact.to_final_frame(points[whisker]), match.angle, TEMPLATE_SD)


def fused_wall(tip: TipModel, points: np.ndarray, contact: WallContact) -> Wall:
    """The most likely direction by the sliding tip of the first whisker and, after HIT2, the second contact.

    There is no estimate if no straight wall fits the strain, or walls of too different directions do. The
    wall passes through the tip of the first whisker.
    """
    whisker = contact.first_whisker()
    if whisker is None:
        return Wall()
    misfit, away, samples = direction_misfit(tip, whisker, contact.strain)
    best = misfit.min()
    if not best < MAX_WALL_MISFIT:
        return Wall()
    log = -0.5 * min(samples, MAX_INDEPENDENT_SAMPLES) * (misfit - best)
    line = geometric_wall(points, contact)
    if line.known:
        off = np.sin(WALL_DIRECTIONS - line.direction) / line.sd
        log += np.log(OTHER_WALL_PROBABILITY + (1 - OTHER_WALL_PROBABILITY) * np.exp(-0.5 * off**2))
    weight = np.exp(log - log.max())
    likely = int(weight.argmax())
    if not misfit[likely] < MAX_WALL_MISFIT:
        return Wall()
    # Circular standard deviation at twice the angle, since directions repeat after half a turn.
    length = abs((weight @ np.exp(2j * WALL_DIRECTIONS)) / weight.sum())
    spread = np.sqrt(max(-2 * np.log(max(length, 1e-300)), 0.0)) / 2
    if spread > MAX_DIRECTION_SD:
        return Wall()
    direction = float(WALL_DIRECTIONS[likely])
    reached = tip.feelers.base[whisker] + away[likely] * wall_normal(direction)
    return Wall.through(reached, direction, float(np.hypot(TIP_SD, spread)))
