"""Localisation of a session in a finished map, which does not change."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ratslam.alignment.following import Motion
from ratslam.alignment.gain_odds import GainOdds
from ratslam.alignment.ground import Ground
from ratslam.alignment.hypotheses import Hypotheses, SessionViews
from ratslam.core.backend import Evidence, Map
from ratslam.core.checkpoint import Checkpointed
from ratslam.core.growable_array import GrowableArray
from ratslam.core.types import Action, Estimate
from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.map import KeyframeMap
from ratslam.keyframes.travel import HALT
from tactile.base.se2 import between, compose
from tactile.base.types import Observation

if TYPE_CHECKING:
    import networkx

CONFIRMING = 3
"""Keyframes after which a recalled pose has to agree with odometry before it is proposed."""
UNEXPLAINED = 4.0
"""The session is not in the map if its views, were it there, would have given this multiple of the log-odds
needed to be found, and the best supposed pose has less than half of these."""


class Localisation(IntEnum):
    """Whether the robot's pose in the map is known."""

    SEARCHING = 0
    """Not yet: what was seen so far fits several places, or none."""
    FOUND = 1
    """The pose is known."""
    LOST = 2
    """It was known, but what was seen since does not fit it."""
    NOT_THIS_MAP = 3
    """So much has been seen that fits nowhere that the session is most likely not in this map, or in a part
    that was never driven."""


class LocalisedPose(NamedTuple):
    """Attributes:
    state: see `Localisation`. pose: [3] the most likely pose in the map, m, m, rad; by odometry alone where
        none was ever supposed. covariance: [3, 3] of it. mass: its probability against all other poses and
        against not being in this map. log_odds: of the session being there.
    """

    state: Localisation
    pose: np.ndarray
    covariance: np.ndarray
    mass: float
    log_odds: float


class Place(NamedTuple):
    """A finished map to localise in: its keyframe map, the ground, and the log-odds of gains on it."""

    map: KeyframeMap
    ground: Ground
    odds: GainOdds

    @property
    def graph(self) -> KeyframeGraph:
        """The keyframes that are not merged."""
        return self.map.kept_keyframes()


class Localiser(Checkpointed, Map):
    """The map of the localise backend: the poses of a session in a finished map.

    Args:
        place: the finished map. log_odds: above which a pose is found, after the logarithm of the number of
            places is subtracted.
    """

    VALUES = ("_travel", "_state", "_recalled", "_anchor", "_last")
    PARTS = ("_views", "_hypotheses")

    def __init__(self, place: Place, log_odds: float) -> None:
        self.place = place
        self._places = float(np.log(max(place.ground.places(), 1.0)))
        self._needed = log_odds + self._places
        shifts, count = len(place.ground.turns), len(place.ground.poses)
        self._views, self._hypotheses = SessionViews(shifts, count), Hypotheses()
        self._travel = HALT
        self._state = int(Localisation.SEARCHING)
        self._recalled = np.full(
            5, np.nan
        )  # keyframe and pose of the newest recalled pose, keyframes agreeing
        self._anchor = np.zeros(3)  # pose of the newest keyframe
        self._last = np.zeros(11)  # its covariance, mass and log-odds
        self._pose = GrowableArray((3,), np.float64)
        self._known = GrowableArray((), np.int64)  # state of each step
        self._frame = GrowableArray((), np.int64)  # step of each keyframe
        self._record = GrowableArray((3,), np.float64)  # mass, log-odds, greatest standard deviation

    # Queries

    def localisation(self) -> LocalisedPose:
        """Where the robot is now."""
        pose = compose(self._anchor, self._corrected()[0])
        covariance = self._last[:9].reshape(3, 3)
        return LocalisedPose(
            Localisation(self._state), pose, covariance, float(self._last[9]), float(self._last[10])
        )

    def pose(self, estimate: Estimate) -> np.ndarray:
        del estimate
        return self.localisation().pose

    def trajectory(self) -> np.ndarray:
        """[T, 3] poses of all steps: in the map where they were found, by odometry from there elsewhere."""
        return self._pose.rows.copy()

    def states(self) -> np.ndarray:
        """[T] the `Localisation` at each step."""
        return self._known.rows.copy()

    def pieces(self) -> np.ndarray:
        """[T] 0 where the pose was found; each stretch between is a piece of its own."""
        found = self._known.rows == Localisation.FOUND
        begins = np.diff(found.astype(int), prepend=1) < 0
        return np.where(found, 0, np.cumsum(begins))

    def graph(self) -> networkx.DiGraph:
        """The graph of the finished map."""
        return self.place.map.graph()

    def files(self) -> dict[str, Callable[[Path], None]]:
        """State, mass and log-odds of every step as CSV, and the graph of the finished map."""
        return {"localisation.csv": self._write} | {
            name: write for name, write in self.place.map.files().items() if name == "map.json"
        }

    # Changes

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Moves all supposed poses by one step, and compares them with the view of a keyframe."""
        self._travel = self._travel.onwards(observation.odometry)
        if int(evidence.keyframe) >= 0:
            self._add_keyframe(evidence)
        now = self.localisation()
        self._pose.append(now.pose)
        self._known.append(int(now.state))
        deviation = float(np.sqrt(max(now.covariance[0, 0], now.covariance[1, 1])))
        self._record.append((now.mass, now.log_odds, deviation))
        spread = np.sqrt(np.maximum(np.diag(now.covariance), 0.0))
        lost = np.bool_(now.state != Localisation.FOUND)
        return estimate._replace(
            pose=now.pose, spread=spread, lost=lost, action=np.int32(Action.NONE), place=np.int32(-1)
        )

    def _add_keyframe(self, evidence: Evidence) -> None:
        ground, odds = self.place.ground, self.place.odds
        moved = Motion(*self._corrected())
        gain = np.asarray(evidence.gain)[:, : len(ground.poses)] if bool(evidence.shows) else None
        self._views.append(moved, gain)
        self._frame.append(len(self._pose.rows))
        self._hypotheses.advance(ground, odds, moved, gain)
        self._propose(evidence, moved)
        self._travel = HALT
        self._judge(moved)

    def _corrected(self) -> tuple[np.ndarray, np.ndarray]:
        """The motion since the newest keyframe without systematic errors, and its variance [3]."""
        graph, (motion, length, turn) = self.place.graph, self._travel
        variance = graph.odometry_variance(np.array([length]), np.array([turn]))[0]
        return graph.correct(motion, length), variance

    def _propose(self, evidence: Evidence, moved: Motion) -> None:
        """Proposes the recalled pose once it agrees with odometry for some keyframes.

        `_recalled` holds the keyframe of the newest one, its pose, and how many in a row agree.
        """
        if int(evidence.match) < 0 or float(evidence.posterior) <= 0.5:
            self._recalled[1:4] = compose(self._recalled[1:4], moved.motion)
            return
        ground = self.place.ground
        shift = int(evidence.shift_row)
        pose = ground.claims(np.array([shift]), np.array([int(evidence.match)]))[0]
        expected = compose(self._recalled[1:4], moved.motion)
        error = between(expected, pose)
        agrees = np.hypot(*error[:2]) < 2 * ground.reach and abs(error[2]) < ground.reach_heading
        count = self._recalled[4] + 1 if agrees else 1.0
        self._recalled = np.array([float(len(self._frame.rows)), *pose, count])
        if count >= CONFIRMING:
            self._hypotheses.propose(ground, self.place.odds, self._views, pose)

    def _judge(self, moved: Motion) -> None:
        """Finds, keeps or loses the pose."""
        known = self._hypotheses
        if not known.count:
            self._anchor = compose(self._anchor, moved.motion)
            self._last = np.array([*np.zeros(9), 0.0, -self._places])
            self._judge_without(0.0)
            return
        order = known.ranked()
        best, odds = int(order[0]), known.log_odds.rows
        others = np.logaddexp.reduce([*(odds[order[1:]]), self._needed])
        mass = float(1 / (1 + np.exp(np.minimum(others - odds[best], 700))))
        rival = odds[order[1]] if known.count > 1 else -np.inf
        self._anchor = known.pose.rows[best].copy()
        self._last = np.array(
            [*known.covariance.rows[best].reshape(-1), mass, float(odds[best] - self._places)]
        )
        fell = known.best.rows[best] - odds[best] > self._needed
        if odds[best] >= self._needed and odds[best] - rival >= self._needed / 2 and not fell:
            self._state = int(Localisation.FOUND)
        elif self._state == Localisation.FOUND:
            if fell or odds[best] < self._needed / 2:
                self._lose()
        else:
            self._judge_without(float(odds[best]))

    def _judge_without(self, best: float) -> None:
        """The state while no pose is found."""
        if self._state == Localisation.FOUND:
            self._lose()
        seen = int(self._views.shows.rows.sum())
        possible = seen * self.place.odds.expected
        if possible >= UNEXPLAINED * self._needed and best < self._needed / 2:
            self._state = int(Localisation.NOT_THIS_MAP)
        elif self._state == Localisation.NOT_THIS_MAP:
            self._state = int(Localisation.SEARCHING)

    def _lose(self) -> None:
        """The pose is lost: the search begins anew, with what was seen from now on."""
        self._state = int(Localisation.LOST)
        self._hypotheses.clear()
        self._views.forget(0)

    def _write(self, path: Path) -> None:
        lines = ["step,state,mass,log_odds,sd"]
        for step, (state, record) in enumerate(
            zip(self._known.rows, self._record.rows.tolist(), strict=True)
        ):
            mass, log_odds, deviation = record
            lines.append(
                f"{step},{Localisation(int(state)).name.lower()},{mass!r},{log_odds!r},{deviation!r}"
            )
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")
