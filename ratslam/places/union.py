"""One map of two: their keyframes, closures and steps one after the other, in pieces apart.

Nothing joins the second map to the first one here (`ratslam.places.joining`). The odometry of the second is
bent so that the calibration of the first one corrects it as its own did: each session keeps its own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.mapping.experiences import Experiences
from ratslam.mapping.map import KeyframeMap
from ratslam.mapping.map_state import MapState
from ratslam.mapping.optimizer import CalibrationPrior
from ratslam.mapping.step_record import Travel
from tactile.base.se2 import bend_motion

AFRESH = ("acceptance/log_ratio", "experiences/", "merger/", "selection/", "solved/", "tie_odds/")
"""Parts of a map that begin anew: what they hold is about one session."""
OF_NEWEST = ("live/", "since/", "turned/", "begins/", "doubt/")
"""Parts about the newest keyframe, which is that of the second map."""


class Bend(NamedTuple):
    """The change of odometry after which the calibration `new` corrects it as `old` did before."""

    old: CalibrationPrior
    new: CalibrationPrior

    def motions(self, motion: np.ndarray, length: np.ndarray) -> np.ndarray:
        """[n, 3] motions over distances [n]."""
        return self.links(motion, length, motion[:, 2])

    def links(self, motion: np.ndarray, length: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """[n, 3] motions over distances [n] with turns [n] by odometry within them."""
        return bend_motion(motion, self.turns(length, turn) - turn)

    def turns(self, length: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """[n] turns by odometry within distances [n]."""
        right = turn * (1 + self.old.turn_error) + (self.old.bias - self.new.bias) * length
        return right / (1 + self.new.turn_error)


def unite(first: KeyframeMap, second: KeyframeMap, blank: KeyframeMap) -> KeyframeMap:
    """The map with all keyframes of two, those of the second in pieces of their own.

    Args:
        blank: an empty map of the same settings, which becomes the result.
    """
    for map in (first, second):
        map.solution()  # which the archive takes over
    kept, other, newest = first.kept_solution(), second.kept_solution(), second.arrays()
    arrays = {n: v for n, v in (first.arrays() | kept.arrays()).items() if not n.startswith(AFRESH)}
    blank.restore(blank.arrays() | arrays | {n: v for n, v in newest.items() if n.startswith(OF_NEWEST)})
    state, archive, source = blank.state, blank.state.archive, second.state.merged
    bend = Bend(_calibration(other), _calibration(kept))
    size, taken = state.count, state.total  # keyframes of the first map: not merged, and ever taken
    if archive and (archive.begun or source):
        if not archive.begun:
            archive.begin(state)
        _append(archive.state, source.state if source else other, taken, bend)
        archive.row.extend(size + (source.row.rows if source else np.arange(other.count)))
        archive.offset.extend(source.offset.rows if source else np.zeros((other.count, 3)))
        if source:
            archive.pairs.extend(source.pairs.rows + [taken, taken, 0])
    _append(state, other, taken, bend)
    state.steps.extend(second.state.steps, taken, other.pose.rows[0], bend.motions)
    motion, length, turn = second.travel  # the odometry since the newest keyframe
    blank.travel = Travel(bend.motions(motion[None], np.array([length]))[0], length, turn)
    blank.appearance.extend(second.appearance)
    blank.appearance.relearn(state.confirmed_pairs())
    state.place_pieces()
    state.reckoned = state.pose.rows[-1].copy()
    blank.selection.hypotheses.begin(state.fit(), state.log.sequences)
    return blank


def _calibration(solution: MapState) -> CalibrationPrior:
    return CalibrationPrior(solution.bias, 0.0, solution.turn_error, 0.0)


def _append(state: MapState, other: MapState, taken: int, bend: Bend) -> None:
    """Adds the keyframes and closures of another map; taken: number of keyframes of the first map, ever
    taken."""
    motion, links = bend.motions(other.motion.rows, other.length.rows), other.links
    motion[0] = 0.0
    turn, bent = bend.turns(links.length, links.turn), bend.links(links.motion, links.length, links.turn)
    links = links._replace(i=links.i + state.count, j=links.j + state.count, motion=bent, turn=turn)
    state.extend(other, motion, links, taken)


def renew_experiences(map: KeyframeMap) -> None:
    """Forms the experiences of a finished map anew, so that pieces that were joined share those of their
    common ground."""
    poses, archive = map.solution().pose.rows, map.state.merged
    experiences = Experiences(map.config.place_radius * map.cell, map.config.place_heading)
    for frame, begins in enumerate(map.state.unmerged.begins.rows.tolist()):
        experiences.arrive(poses[: frame + 1], frame, -1, True, begins)
    if archive:
        experiences.merge(map.state.taken.rows, archive.row.rows, archive.offset.rows)
    own = {f"experiences/{name}": value for name, value in experiences.arrays().items()}
    map.restore(map.arrays() | own)
