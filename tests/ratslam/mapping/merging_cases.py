"""Routes that a robot drives again and again, with recall written by hand that follows the map's merges."""

from collections import namedtuple

import numpy as np

from ratslam.mapping.acceptance import AcceptByEvidence
from ratslam.mapping.appearance import LabelAppearance
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.map import KeyframeMap
from tactile.base.se2 import compose, fit_rigid_motion, integrate
from tests.ratslam.mapping.map_cases import CELL, STEP, Seen, step

GUARD, CHUNK, NONE, RATIO = 20, 16, -1, 4.0
"""Steps between two merges, as in a session, are a chunk; the last is the evidence of what recall finds."""
RUN, PAUSE = 15, 5
"""Places in a row that recall finds, and that it does not find thereafter."""


Route = namedtuple("Route", "odometry truth place look recalled ratio")
"""A drive of N keyframes: [N, 3] motion into each, [N, 3] poses, [N] where each keyframe is along a lap, [N]
number of its view, [N] the place that recall finds, `NONE` for none, [N] its log-likelihood ratio."""


class LookAppearance(LabelAppearance):
    """The views of a route; the ids are the numbers of the keyframes."""

    def __init__(self, look):
        super().__init__()
        self._look = look

    def misfits(self, frame, others, reversed):
        return (self._look[others] != self._look[frame]).astype(float)


class Drive:
    """A map with the keyframe that each of its rows is, as a kernel keeps them, and the experience of each
    keyframe."""

    def __init__(self, route, acceptance=lambda *_: AcceptByEvidence(), **settings):
        self.acceptance = acceptance
        config, looks = KeyframeMapConfig.model_validate(settings), LookAppearance(route.look)
        self.map = KeyframeMap(config, CELL, looks, acceptance, guard=GUARD)
        self.route, self.settings, self.rows = route, settings, np.zeros(0, int)
        self.experiences: list[int] = []

    @property
    def steps(self):
        """Number of keyframes driven; each step is one."""
        return self.map.state.unmerged.count

    def go(self, last):
        """Drives up to keyframe `last` - 1; at every `CHUNK`th one the map may merge."""
        for k in range(self.steps, last):
            if k % CHUNK == 0 and (merged := self.map.merge()) is not None:
                assert len(merged.onto) == len(self.rows)
                self.rows = merged.label
            match = self._recall(int(self.route.recalled[k]))
            self.rows = np.append(self.rows, k)
            seen = Seen(len(self.rows) - 1, match, 0, float(match >= 0), self.route.ratio[k])
            self.experiences.append(int(step(self.map, self.route.odometry[k], seen, k).place))
        return self

    def restored(self):
        """The same continued from a checkpoint."""
        other = Drive(self.route, self.acceptance, **self.settings)
        other.map.restore(self.map.arrays())
        other.rows, other.experiences = self.rows.copy(), list(self.experiences)
        return other

    def error(self):
        """[T] distances of the final trajectory from the truth, m."""
        path = self.map.map_trajectory()
        return off(path, self.route.truth[: len(path)])

    def merged_apart(self):
        """[T] true distances of keyframes from those that they are or are merged with, m."""
        return self._apart(self.rows[self.map.state.archive.row.rows])

    def experience_apart(self):
        """[T] true distances of keyframes from the first one of their experience, m."""
        nodes = self.map.graph().nodes
        return self._apart([nodes[place]["keyframe"] for place in self.experiences])

    def _apart(self, others):
        truth = self.route.truth
        return np.hypot(*(truth[: len(others)] - truth[others])[:, :2].T)

    def _recall(self, place):
        """The row of the oldest keyframe at a place, or near it."""
        old = self.rows[: max(len(self.rows) - GUARD, 0)]
        if place < 0 or not len(old):
            return NONE
        apart = np.abs(self.route.place[old] - place)
        best = int(np.argmin(apart))
        return best if apart[best] <= 1 else NONE


def off(poses, truth):
    """[N] distances of poses from the true ones, moved as a whole to fit them best, m."""
    return np.hypot(*(compose(fit_rigid_motion(poses, truth), poses) - truth)[:, :2].T)


def arcs(*parts):
    """[n, 3] motions along arcs of (steps, turn)."""
    turn = np.concatenate([np.full(steps, whole / steps) for steps, whole in parts])
    return np.stack([STEP * np.cos(turn / 2), STEP * np.sin(turn / 2), turn], axis=1)


def laps(lap, count):
    """`count` laps of motions [n, 3], by odometry with noise of turns and a bias; most places of the first
    lap are recalled later, `RUN` in a row."""
    motion = np.tile(lap, (count, 1))
    truth = np.vstack([np.zeros(3), integrate(motion[:-1])])
    motion = np.vstack([np.zeros(3), motion[:-1]])
    k = np.arange(len(motion))
    place = k % len(lap)
    recalled = np.where((k >= len(lap)) & (place % (RUN + PAUSE) < RUN), place, NONE)
    error = np.random.default_rng(0).normal(0, 0.02, len(k)) - 0.01 * np.hypot(*motion[:, :2].T)
    measured = motion + np.outer(error * (k > 0), [0.0, 0.0, 1.0])
    return Route(measured, truth, place, place, recalled, np.full(len(k), RATIO))


def circles(count, size):
    """Laps of a circle of `size` keyframes."""
    return laps(arcs((size, 2 * np.pi)), count)


CORRIDOR, NORTH, SOUTH = 16, 0, 74
"""Keyframes of a corridor, and the places where the two begin."""


def corridors(count):
    """Laps through two parallel corridors that look the same, 1.3 m apart, heading east in both. In the first
    lap recall takes the second for the first one, when only odometry speaks against it; later it finds
    nothing there."""
    turns = [part for steps in (16, 26, 36, 26) for part in ((CORRIDOR, 0.0), (steps, np.pi))]
    route = laps(arcs(*turns), count)
    place = route.place
    inside = (place >= SOUTH) & (place < SOUTH + CORRIDOR)
    look = np.where(inside, place - SOUTH + NORTH, place)
    false = (np.arange(len(place)) < SOUTH + CORRIDOR - 1) & inside & (place > SOUTH)
    recalled = np.where(inside, NONE, route.recalled)
    recalled[false] = look[false]
    return route._replace(look=look, recalled=recalled, ratio=np.where(false, 1.5, RATIO))
