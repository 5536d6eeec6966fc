"""A wide circle that a robot drives again and again, with recall written by hand."""

from collections import namedtuple

import numpy as np

from ratslam.mapping.acceptance import AcceptByOdds
from ratslam.mapping.appearance import LabelAppearance
from ratslam.mapping.config import FULL, KeyframeMapConfig
from ratslam.mapping.map import KeyframeMap
from ratslam.mapping.map_state import MapState
from tactile.base.se2 import compose
from tactile.base.types import Odometry, observation

CELL, STEP, LAP, BIAS = 0.5, 0.2, 200, 0.01
"""The last two: keyframes of a lap, and the heading bias of the odometry, rad/m."""


Seen = namedtuple("Seen", "keyframe match shift posterior log_ratio")
"""Evidence of one step, as recall gives it."""
Pose = namedtuple("Pose", "place previous action")
"""The part of an estimate that the map changes."""


def new_graph(cell, guard, appearance=None, ablation=FULL, **settings):
    """A graph without keyframes; of ids by default."""
    config = KeyframeMapConfig.model_validate(settings)
    return MapState(config, cell, appearance or LabelAppearance(), guard, ablation)


def add(graph, motion, pose=None, length=None, turn=None):
    """One more keyframe, by odometry [3] from the newest; at this pose [3], if there is one."""
    length = float(np.hypot(*motion[:2])) if length is None else length
    pose = compose(graph.pose.rows[-1], motion) if pose is None else pose
    graph.append(pose, motion, length, abs(float(motion[2])) if turn is None else turn)


def same(one, other):
    """Whether two maps have the same state, bit for bit."""
    first, second = one.arrays(), other.arrays()
    assert first.keys() == second.keys()
    return all(np.array_equal(first[name], second[name], equal_nan=True) for name in first)


def new_map(acceptance=AcceptByOdds, find_tie=None, **settings):
    config = KeyframeMapConfig.model_validate(settings)
    return KeyframeMap(config, CELL, LabelAppearance(), acceptance, find_tie=find_tie)


def step(map, motion, seen, label):
    """One update by odometry [3], after which the view of this id is seen."""
    view = observation(Odometry(*np.asarray(motion).tolist(), 0.1), None, view_shape=(1, 1, 1), label=label)
    return map.update(view, Pose(-1, -1, 0), seen)


def drive(map, recalled, first=0, last=LAP + 60, bias=BIAS):
    """Drives keyframes first to last - 1. recalled: match and log ratio by keyframe."""
    turn = 2 * np.pi / LAP - bias * STEP
    for k in range(first, last):
        match, ratio = recalled.get(k, (-1, 0.0))
        step(map, (STEP, 0.0, turn) if k else (0.0, 0.0, 0.0), Seen(k, match, 0, float(match >= 0), ratio), k)
    return map


def sequence(start, match, length, ratio):
    """Candidates of a sequence that goes on as odometry does."""
    return {start + n: (match + n, ratio) for n in range(length)}


TRUE = sequence(LAP + 2, 2, 12, 4.0)
"""The beginning of the lap, seen where it is."""


def with_log(state, log, cut=None):
    """The same map with these closures and, if given, cuts."""
    state.log, state.cut = log, state.cut if cut is None else cut
    return state


def at_fit(state, fit, log, cut):
    """The map at a fit, with these closures and cuts."""
    found = with_log(state, log).trial()
    found.take_fit(fit)
    found.cut, found.log = cut, log
    return found
