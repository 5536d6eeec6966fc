"""One map of two: their keyframes, closures and steps one after the other, in pieces apart.

Nothing joins the second map to the first one here (`ratslam.places.joining`). The odometry of the second is
bent so that the calibration of the first one corrects it as its own did: each session keeps its own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.core.arrays import with_prefix
from ratslam.mapping.experiences import Experiences
from ratslam.mapping.map import KeyframeMap
from ratslam.mapping.map_state import INTERRUPTED
from ratslam.mapping.optimizer import CalibrationPrior
from ratslam.mapping.step_record import leading_to, settled
from tactile.base.se2 import bend_motion, between

Arrays = dict[str, np.ndarray]
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
    a, b = _finished(first), _finished(second)
    # Of the first map: keyframes that are not merged, keyframes ever taken, closure sequences.
    size, taken, sequences = len(a["graph/taken"]), int(a["graph/taken"][-1]) + 1, len(a["log/verdict"])
    bend = Bend(_calibration(b), _calibration(a))
    united = a | _graph("graph/", a, b, (size, taken, sequences), bend)
    united |= _log("log/", a, b, size, sequences)
    if first.state.merged or second.state.merged:
        one, other = _archived(first, a), _archived(second, b)
        pairs = other["pairs"].copy()
        pairs[:, :2] += taken
        archive = one | _graph("graph/", one, other, (taken, taken, sequences), bend)
        archive |= _log("log/", one, other, taken, sequences)
        archive["row"] = np.concatenate([one["row"], other["row"] + size])
        archive["offset"] = np.concatenate([one["offset"], other["offset"]])
        archive["pairs"] = np.concatenate([one["pairs"], pairs])
        united |= {f"archive/{name}": value for name, value in archive.items()}
    united |= _steps(a, b, taken, bend)
    # What concerns the newest keyframe, and the odometry since.
    motion, length = b["travel/0"], b["travel/1"]
    bent = bend.motions(motion[None], np.asarray(length)[None])[0]
    united |= {name: value for name, value in b.items() if name.startswith(OF_NEWEST)}
    united |= {"travel/0": bent, "travel/1": length, "travel/2": b["travel/2"]}
    kept = {name: value for name, value in united.items() if not name.startswith(AFRESH)}
    blank.restore(blank.arrays() | kept)
    blank.appearance.extend(second.appearance)
    state = blank.state
    blank.appearance.relearn(state.confirmed_pairs())
    state.place_pieces()
    state.reckoned = state.pose.rows[-1].copy()
    blank.selection.hypotheses.begin(state.fit(), state.log.sequences)
    return blank


def _finished(map: KeyframeMap) -> Arrays:
    """The arrays of a map with the poses and verdicts of its final solution."""
    map.solution()  # which the archive takes over
    return map.arrays() | map.kept_solution().arrays()


def _calibration(arrays: Arrays) -> CalibrationPrior:
    bias, turn_error = (float(arrays[f"graph/{name}/0"]) for name in ("bias", "turn_error"))
    return CalibrationPrior(bias, 0.0, turn_error, 0.0)


def _archived(map: KeyframeMap, own: Arrays) -> Arrays:
    """The archive of a map, made of the map itself where no keyframe was merged."""
    if map.state.merged:
        return with_prefix(own, "archive/")
    count = map.state.count
    rows = {"row": np.arange(count), "offset": np.zeros((count, 3)), "pairs": own["archive/pairs"]}
    return rows | {name: value for name, value in own.items() if name.startswith(("graph/", "log/"))}


def _graph(prefix: str, a: Arrays, b: Arrays, counts: tuple[int, int, int], bend: Bend) -> Arrays:
    """Keyframes of both; counts: of the first map the keyframes in these arrays, those ever taken, and the
    closure sequences."""
    (size, taken, sequences), cut = counts, b[prefix + "cut"]
    moved = b | {
        prefix + "motion": bend.motions(b[prefix + "motion"], b[prefix + "length"]),
        prefix + "cut": np.where((cut >= 0) & (cut < INTERRUPTED), cut + sequences, cut),
        prefix + "taken": b[prefix + "taken"] + taken,
        prefix + "begins": b[prefix + "begins"].copy(),
    }
    moved[prefix + "begins"][0] = True
    moved[prefix + "motion"][0] = 0.0
    names = ("pose", "motion", "length", "turn", "cut", "begins", "seam", "taken")
    graph = {prefix + name: np.concatenate([a[prefix + name], moved[prefix + name]]) for name in names}
    i, j, motion, length, turn, variance = (b[f"{prefix}links/{k}"] for k in range(6))
    links = (i + size, j + size, bend.links(motion, length, turn), length, bend.turns(length, turn), variance)
    for k, value in enumerate(links):
        graph[f"{prefix}links/{k}"] = np.concatenate([a[f"{prefix}links/{k}"], value])
    return graph


def _log(prefix: str, a: Arrays, b: Arrays, size: int, sequences: int) -> Arrays:
    """Candidates and sequences; the first map has `size` keyframes and so many sequences."""
    candidate = b[prefix + "candidate"].copy()
    candidate[:, :2] += size
    candidate[candidate[:, 3] >= 0, 3] += sequences
    moved = b | {prefix + "candidate": candidate}
    names = [name for name in a if name.startswith(prefix)]
    return {name: np.concatenate([a[name], moved[name]]) for name in names}


def _steps(a: Arrays, b: Arrays, taken: int, bend: Bend) -> Arrays:
    """Steps, the first map having so many keyframes; those of the second map before its first keyframe lead
    to that."""
    frame, motion = b["steps/frame"], b["steps/motion"].copy()
    early, led = frame == -1, frame < -1
    motion[early, :3] = between(b["graph/pose"][0], motion[early, :3])
    motion[:, :3] = np.where(early[:, None], motion[:, :3], bend.motions(motion[:, :3], motion[:, 3]))
    motion[early, 3] = 0.0
    number = np.where(early, leading_to(taken), np.where(led, frame - taken, frame + taken))
    return {
        "steps/frame": np.concatenate([settled(a["steps/frame"], taken), number]),
        "steps/motion": np.concatenate([a["steps/motion"], motion]),
        "steps/odometry": np.concatenate([a["steps/odometry"], b["steps/odometry"]]),
    }


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
