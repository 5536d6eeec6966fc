"""Localisation of a session in a finished map, which does not change, and the odds of views that it needs.

The log-odds that a view's gain is one of a true pose are learned from the map compared with itself: later
keyframes are localised against earlier ones, each stretch from its own pose (true) and from the places
elsewhere whose first views fit best (false).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ratslam.core.arrays import GrowableArray
from ratslam.core.backend import Evidence, LocalisedMap
from ratslam.core.estimates import Estimate, Localisation, LocalisedPose
from ratslam.mapping.ground import (
    NO_MOTION,
    SESSION_WEIGHTING,
    GainOdds,
    GainWeighting,
    Ground,
    Motion,
    PoseHypothesis,
    advance_all,
    learn_gain_odds,
)
from ratslam.mapping.map import KeyframeMap
from ratslam.mapping.step_record import NO_TRAVEL
from ratslam.places.hypotheses import LONGEST, Hypotheses, SessionViews
from ratslam.places.placement import NOTHING_RECALLED
from tactile.base.se2 import between, wrap
from tactile.base.types import Observation

if TYPE_CHECKING:
    import networkx


UNEXPLAINED = 4.0
"""The session is not in the map if its views, were it there, would have given this multiple of the log-odds
needed to be found, and the best hypothesis has less than half of these."""
LARGEST_EXPONENT = 700.0
"""Of a double, rounded down."""
HEADING_NOISE = 2.0
"""Variance of the heading by odometry as a multiple of what the settings say. Maps start from less noise than
odometry has, so that a wrong map has to bend what is believed; in a turn the pose would be lost by that."""
UNCERTAIN = 2 * LONGEST
"""Keyframes before a pose is lost at which it may have been wrong already."""


class Place(NamedTuple):
    """A finished map to localise in.

    Attributes:
        map: its keyframe map. frames: [N] the keyframes of the ground, numbered as they were taken. ground:
            them as ground. odds: log-odds of gains on it.
    """

    map: KeyframeMap
    frames: np.ndarray
    ground: Ground
    odds: GainOdds


class Visits(NamedTuple):
    """The keyframes of a session whose pose in the map was found and that show something.

    Attributes:
        step: [K] of the session. pose: [K, 3] in the map, m, m, rad. view: [K, D] as the map stores views.
    """

    step: np.ndarray
    pose: np.ndarray
    view: np.ndarray


class Localiser(LocalisedMap):
    """The map of the localise backend: the poses of a session in a finished map.

    Args:
        place: the finished map. log_odds: above which a pose is found, after the logarithm of the number of
            places is subtracted. start: [3] pose in the map at which the session begins; it is believed,
            until views contradict it. None: unknown.
    """

    VALUES = ("_travel", "_state", "_recalled", "_newest", "_covariance", "_mass", "_log_odds")
    PARTS = ("_views", "_hypotheses")

    def __init__(self, place: Place, log_odds: float, start: np.ndarray | None = None) -> None:
        super().__init__("ground", place.ground.poses)
        self.place = place
        self._places = float(np.log(max(place.ground.places(), 1.0)))
        self._needed = log_odds + self._places
        shifts, count = len(place.ground.turns), len(place.ground.poses)
        self._views, self._hypotheses = SessionViews(shifts, count), Hypotheses()
        self._travel = NO_TRAVEL
        self._state = int(Localisation.SEARCHING)
        self._recalled = NOTHING_RECALLED
        self._newest, self._covariance = np.zeros(3), np.zeros((3, 3))  # pose of the newest keyframe
        self._mass, self._log_odds = 0.0, -self._places
        course = self._course  # of which a checkpoint has these arrays
        self._pose, self._states, self._record = course.pose, course.states, course.record
        self._frame = GrowableArray((), np.int64)  # step of each keyframe
        self._found = GrowableArray((3,), np.float64)  # its pose, NaN where that is not known
        size = place.map.appearance.stored(place.frames[:0])[0].shape[1]
        self._view = GrowableArray((size,), np.float64)  # its view
        if start is not None:
            at = PoseHypothesis(start.copy(), np.diag(place.ground.variance))
            self._hypotheses.add(at, self._needed)  # just likely enough to be found
            self._state = int(Localisation.FOUND)
            self._newest, self._covariance = at
            self._mass, self._log_odds = 0.5, self._needed - self._places

    # Queries

    def localisation(self) -> LocalisedPose:
        now = PoseHypothesis(self._newest, self._covariance).moved(self._moved())
        state = Localisation(self._state)
        if state == Localisation.FOUND and not now.is_comparable(self.place.ground):
            state = Localisation.LOST  # nothing was seen for long
        return LocalisedPose(state, *now, self._mass, self._log_odds)

    def visits(self) -> Visits:
        """Where the session was in the map, and what it saw there."""
        pose = self._found.rows
        found = np.isfinite(pose[:, 0])
        return Visits(self._frame.rows[found], pose[found], self._view.rows[found])

    def graph(self) -> networkx.DiGraph:
        """The graph of the finished map."""
        return self.place.map.graph()

    def files(self) -> dict[str, Callable[[Path], None]]:
        """State, mass and log-odds of every step as CSV, and the graph of the finished map."""
        return super().files() | {"map.json": self.place.map.files()["map.json"]}

    # Changes

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Moves all hypotheses by one step, and compares them with the view of a keyframe."""
        self._travel = self._travel.onwards(observation.odometry)
        if int(evidence.keyframe) >= 0:
            self._view.append(self.place.map.appearance.view_of(observation))
            self._add_keyframe(evidence)
        now = self.localisation()
        self._course.append(now, PoseHypothesis(now.pose, now.covariance).deviations()[0])
        return now.complete(estimate)

    @property
    def compared(self) -> int:
        """Number of views compared with the map."""
        return len(self._frame.rows)

    def _add_keyframe(self, evidence: Evidence) -> None:
        ground, odds = self.place.ground, self.place.odds
        moved = self._moved()
        gain = None
        if bool(evidence.shows):
            gain = SESSION_WEIGHTING.weigh(np.asarray(evidence.gain)[:, : len(ground.poses)])
        self._views.append(moved, gain)
        self._frame.append(len(self._pose.rows))
        shift, match = int(evidence.shift_row), int(evidence.match)
        self._recalled = self._recalled.onwards(ground, moved, shift, match, float(evidence.posterior))
        recalled = None
        if gain is not None and self._recalled.now:
            recalled = self._recalled.pose, float(gain[shift, match])
        confirmed = recalled if self._recalled.is_confirmed else None
        self._hypotheses.advance(ground, odds, moved, gain, confirmed)
        if recalled is not None:
            self._hypotheses.continue_uncertain(ground, odds, recalled)
        if confirmed is not None:
            self._hypotheses.propose(ground, odds, self._views, confirmed[0])
        self._travel = NO_TRAVEL
        self._update_state(moved)
        known = self._state == Localisation.FOUND and gain is not None
        self._found.append(self._newest if known else np.full(3, np.nan))

    def _moved(self) -> Motion:
        """The motion since the newest keyframe without the systematic errors that the map knows."""
        graph, (motion, length, turn) = self.place.map.state, self._travel
        variance = graph.odometry_variance(length, turn)
        variance[2] *= HEADING_NOISE * graph.heading_noise.further_factor
        return Motion(graph.correct(motion, length), variance)

    def _update_state(self, moved: Motion) -> None:
        """Finds, keeps or loses the pose."""
        known, needed = self._hypotheses, self._needed
        order, odds = known.ranked(), known.log_odds.rows
        now, best, ahead = PoseHypothesis(self._newest, self._covariance).moved(moved), 0.0, 0.0
        self._mass, self._log_odds = 0.0, -self._places
        fell, uncertain = True, False
        if known.count:
            now, best = PoseHypothesis(*map(np.copy, known.at(order[0]))), float(odds[order[0]])
            others = np.logaddexp.reduce([*odds[order[1:]], needed])
            self._mass = float(1 / (1 + np.exp(np.minimum(others - best, LARGEST_EXPONENT))))
            self._log_odds = best - self._places
            ahead = best - (odds[order[1]] if known.count > 1 else -np.inf)
            fell = known.fall(order[0]) > needed
            uncertain = not fell and not now.is_comparable(self.place.ground)
        self._newest, self._covariance = now
        possible = int(self._views.shows.rows.sum()) * self.place.odds.expected
        state = Localisation(self._state)
        after = state.after(
            found=best >= needed and ahead >= needed / 2 and not fell and not uncertain,
            lost=fell or uncertain,
            likely=best >= needed / 2 and not uncertain,
            unexplained=possible >= UNEXPLAINED * needed and not uncertain,
        )
        if fell and state == Localisation.FOUND:
            self._forget()
        self._state = int(after)

    def _forget(self) -> None:
        """The search begins anew, with the views from now on."""
        self._mass, self._log_odds = 0.0, -self._places
        self._found.rows[-UNCERTAIN:] = np.nan
        self._hypotheses.clear()
        self._views.forget(0)


STRETCHES = 24
"""Number of stretches."""
LENGTH, FIRST = 48, 8
"""Keyframes of a stretch, and of its beginning, by which alike places are chosen and known as such."""
ALIKE = 6
"""Number of other places from which each stretch is followed."""
ELSEWHERE = 2.0
"""Least distance of another place, as a multiple of the ground's reach."""

Gains = Callable[[int, int], np.ndarray]
"""Gains [n, S, M] of the n keyframes that follow a keyframe, against those of the ground before it.
Arguments: the keyframe, n."""


def _follow(ground: Ground, gains: np.ndarray, moves: list[Motion], poses: np.ndarray, k: int) -> np.ndarray:
    """[P, k] gains of the first keyframes of a stretch that begins at each of `poses` [P, 3].

    Args:
        gains: [n, S, M] of its views on the ground. moves: [n] into each keyframe.
    """
    at, found = PoseHypothesis(poses, np.zeros((len(poses), 3, 3))), np.zeros((len(poses), k))
    for row in range(k):
        at, found[:, row] = advance_all(ground, at, moves[row], gains[row])
    return found


def compare_with_itself(
    ground: Ground, guard: int, gains: Gains, weighing: GainWeighting, held: np.ndarray | None = None
) -> GainOdds:
    """The log-odds of gains on this ground.

    Args:
        guard: number of keyframes before a stretch that do not count as ground. weighing: of the gains.
            held: [N] bool, the keyframes that are ground for a session; None: all.
    """
    count = len(ground.poses)
    held = np.ones(count, bool) if held is None else held
    first = max(count // 3, 2 * guard)
    true, false = [np.zeros(0)], [np.zeros(0)]
    if count > first + LENGTH + guard:
        for begin in np.linspace(first, count - LENGTH - 1, STRETCHES).astype(int).tolist():
            poses = ground.poses[begin : begin + LENGTH]
            motions = [NO_MOTION, *(Motion(step, np.zeros(3)) for step in between(poses[:-1], poses[1:]))]
            known = begin - guard
            earlier = ground._replace(poses=ground.poses[:known][held[:known]])
            seen = weighing.weigh(gains(begin, LENGTH)[:, :, : len(earlier.poses)])
            # Poses elsewhere on the ground at which the beginning of the stretch fits best.
            shift, frame = np.indices((len(ground.turns), len(earlier.poses))).reshape(2, -1)
            claims = earlier.claims(shift, frame)
            apart = np.hypot(*(claims - poses[0])[:, :2].T)
            same = (apart < ELSEWHERE * ground.reach) & _facing(claims, poses[0], ground)
            # Without those near an earlier one that faces alike.
            claims = claims[~same]
            kept: list[int] = []
            for k, pose in enumerate(claims):
                near = np.hypot(*(claims[kept] - pose)[:, :2].T) < ground.reach
                if not (near & _facing(claims[kept], pose, ground)).any():
                    kept.append(k)
            claims = claims[kept]
            fits = _follow(earlier, seen, motions, claims, FIRST)
            fit = np.where(np.isfinite(fits), fits, -1.0).sum(axis=1)
            alike = claims[np.argsort(fit, kind="stable")[::-1][:ALIKE]]
            here, *elsewhere = _follow(earlier, seen, motions, np.stack([poses[0], *alike]), LENGTH)
            true.append(_continued(here, weighing.matching))
            false += [_continued(gain, weighing.matching) for gain in elsewhere]
    return learn_gain_odds(np.concatenate(true), np.concatenate(false), weighing.prior)


def _facing(poses: np.ndarray, pose: np.ndarray, ground: Ground) -> np.ndarray:
    return np.abs(wrap(poses[:, 2] - pose[2])) < 2 * ground.reach_heading


def _continued(gain: np.ndarray, matching: float) -> np.ndarray:
    """The gains of a stretch that follow `FIRST` matching ones."""
    rows = np.lib.stride_tricks.sliding_window_view(gain, FIRST)[:-1]
    before = np.isfinite(rows).all(axis=1) & (np.nan_to_num(rows).mean(axis=1) > matching)
    found = gain[FIRST:][before]
    return found[np.isfinite(found)]
