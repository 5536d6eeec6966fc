"""How the wall lies that whiskers have met, between HIT1 and HIT2 or ABORT (Fox et al. 2012, II-F and II-G).

Estimators are pure: from a `WallContact` to a `Wall`, in base_link as the robot stands at its end.
Directions are those *along* the wall, counter-clockwise from ahead, modulo half a turn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.base.se2 import inverse
from tactile.base.types import StepEnd
from tactile.wall_estimation.sliding_tip import WALL_DIRECTIONS, TipModel, direction_misfit
from tactile.wall_estimation.strain_templates import TemplateMatch
from tactile.whiskers.planar_whiskers import PlanarWhiskers

MIN_SEPARATION = 0.05
"""Two contacts closer than this have no line through them, m."""
LINE_SD = 0.05
"""Of the direction of the line through two contacts, rad."""
TEMPLATE_SD = 0.10
"""Of a template's, rad."""
TIP_SD = 0.04
"""Of what a whisker's tip tells at best, rad."""
MAX_DIRECTION_SD = 0.15
"""Standard deviation from which a direction is none, rad."""
MAX_WALL_MISFIT = 3.0
"""From which it was no wall, in variances."""
MAX_INDEPENDENT_SAMPLES = 6
"""Samples at most that a series of strain is worth: what the law leaves out lasts."""
OTHER_WALL_PROBABILITY = 0.1
"""Chance that the second contact is with another wall."""


class WallContact(NamedTuple):
    """What passed between HIT1 and HIT2 or ABORT.

    Attributes:
        first, now: [W] bool, the contacts at its beginning and end. travel: [3] the motion between, in the
            frame at its beginning. moment: how it ended.
        strain: [N, W, 2] filtered, since HIT1. alive: [W] bool, whiskers whose strain can be used.
    """

    first: np.ndarray
    now: np.ndarray
    travel: np.ndarray
    moment: StepEnd
    strain: np.ndarray
    alive: np.ndarray


class Wall(NamedTuple):
    """Attributes:
    known: whether anything is. direction: along the wall, rad in [0, pi). point: [2] m, the point of its line
    nearest to base_link's origin. sd: of the direction, rad. All 0 where nothing is known.
    """

    known: bool
    direction: float
    point: np.ndarray
    sd: float


def no_wall() -> Wall:
    """No wall is known."""
    return Wall(False, 0.0, np.zeros(2), 0.0)


def wall_normal(direction: float) -> np.ndarray:
    """[2] The unit normal of a wall of that direction, ahead of the robot: the one place where walls and
    normals are turned into each other. A wall straight across (90 degrees) has its normal ahead (0)."""
    return np.array([np.sin(direction), -np.cos(direction)])


def wall_through(point: np.ndarray, direction: float, sd: float) -> Wall:
    """The wall of a direction that passes through a point [2]."""
    normal = wall_normal(direction)
    return Wall(True, float(direction % np.pi % np.pi), (normal @ point) * normal, float(sd))


def contact_points(feelers: PlanarWhiskers, radius: float) -> np.ndarray:
    """[W, 2] m, where whiskers touch if they do: at a fixed radius along them (II-D)."""
    return feelers.base + radius * feelers.direction


def first_whisker(meeting: WallContact) -> int | None:
    """The whisker that met the wall at HIT1; the one more strained of several. None if none can be used."""
    may = meeting.first & meeting.alive
    if not may.any() or not len(meeting.strain):
        return None
    return int(np.argmax(np.where(may, np.abs(meeting.strain[0, :, 0]), -1.0)))


def to_final_frame(points: np.ndarray, meeting: WallContact) -> np.ndarray:
    """[..., 2] Points as they lay at HIT1, seen from where the robot stands at the end."""
    x, y, turn = inverse(meeting.travel)
    c, s = np.cos(turn), np.sin(turn)
    return points @ np.array([[c, s], [-s, c]]) + np.array([x, y])


def geometric_wall(points: np.ndarray, meeting: WallContact) -> Wall:
    """The line through the contacts of HIT1 and HIT2 (II-F), by total least squares if they are more than
    two; none if it came to no HIT2 or they are too close.

    Args:
        points: [W, 2] m, where whiskers touch if they do.
    """
    if meeting.moment != StepEnd.HIT2:
        return no_wall()
    there = np.concatenate(
        [to_final_frame(points[meeting.first], meeting), points[meeting.now & ~meeting.first]]
    )
    apart = np.linalg.norm(there[:, None] - there, axis=-1).max(initial=0.0)
    if apart < MIN_SEPARATION:
        return no_wall()
    middle = there.mean(axis=0)
    along = np.linalg.svd(there - middle)[2][0]
    return wall_through(middle, float(np.arctan2(along[1], along[0])), LINE_SD)


def template_wall(points: np.ndarray, match: TemplateMatch, meeting: WallContact, flat: float | None) -> Wall:
    """The winner's direction through the contact of HIT1 (II-G), after ABORT too.

    Args:
        flat: relative error from which it was no flat wall; None: every contact is one, as in the paper.
    """
    whisker = first_whisker(meeting)
    if whisker is None or (flat is not None and match.relative >= flat):
        return no_wall()
    return wall_through(to_final_frame(points[whisker], meeting), match.angle, TEMPLATE_SD)


def fused_wall(tip: TipModel, points: np.ndarray, meeting: WallContact) -> Wall:
    """The direction most likely by how the whisker that met the wall turned, and by the second contact if it
    came to HIT2; none where no straight wall turns it so, or several would.

    The wall passes through that whisker's tip.
    """
    whisker = first_whisker(meeting)
    if whisker is None:
        return no_wall()
    felt = direction_misfit(tip, whisker, meeting.strain)
    best = felt.misfit.min()
    if not best < MAX_WALL_MISFIT:
        return no_wall()
    log = -0.5 * min(felt.samples, MAX_INDEPENDENT_SAMPLES) * (felt.misfit - best)
    line = geometric_wall(points, meeting)
    if line.known:
        off = np.sin(WALL_DIRECTIONS - line.direction) / line.sd
        log += np.log(OTHER_WALL_PROBABILITY + (1 - OTHER_WALL_PROBABILITY) * np.exp(-0.5 * off**2))
    chance = np.exp(log - log.max())
    likely = int(chance.argmax())
    if not felt.misfit[likely] < MAX_WALL_MISFIT:
        return no_wall()
    # Directions repeat after half a turn, so they are spread on the circle at twice the angle.
    length = abs((chance @ np.exp(2j * WALL_DIRECTIONS)) / chance.sum())
    spread = np.sqrt(max(-2 * np.log(max(length, 1e-300)), 0.0)) / 2
    if spread > MAX_DIRECTION_SD:
        return no_wall()
    direction = float(WALL_DIRECTIONS[likely])
    reached = tip.feelers.base[whisker] + felt.away[likely] * wall_normal(direction)
    return wall_through(reached, direction, float(np.hypot(TIP_SD, spread)))
