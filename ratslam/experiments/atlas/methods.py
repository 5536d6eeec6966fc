"""What the rows measure: the operations on saved maps, as functions of a map on the disk and a session."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ratslam.experiments.atlas.sessions import Recorded
from ratslam.experiments.atlas.stored_maps import MapArrays, StoredMap


class Localised(NamedTuple):
    """A session of T steps in a map that does not change.

    Attributes:
        found: [T] bool, whether the robot says that it knows where it is. foreign: [T] bool, whether it says
            that it is not in this map. pose: [T, 3] in the map (m, m, rad).
    """

    found: np.ndarray
    foreign: np.ndarray
    pose: np.ndarray


class Methods(NamedTuple):
    """Operations on saved maps; functions of a module, so that other processes can import them.

    Attributes:
        localise: a session in a map. extend: the map of a session and then another one, whose robot may stand
            anywhere: its arrays are over the steps of both, in this order. merge: one map of several, written
            to a new path, and its arrays over the steps of all, in the order of the arguments. changes:
            places [n, 2] of a map (m) where a session says that it no longer agrees, the surest first.
    """

    localise: Callable[[StoredMap, Recorded], Localised]
    extend: Callable[[StoredMap, Recorded], MapArrays]
    merge: Callable[[Sequence[StoredMap], Path], StoredMap]
    changes: Callable[[StoredMap, Recorded], np.ndarray]
