"""The operations of this program on saved maps."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from evaluation.papers.maps.row import Localised, Methods
from evaluation.papers.maps.sessions import Recorded
from evaluation.papers.maps.stored_maps import STEPS, MapArrays, StoredMap
from evaluation.papers.trials.touch_trial import capacity_for
from ratslam.core.session import Session
from ratslam.places.localiser import Localisation, Localiser
from ratslam.runs.build_session import build_session
from ratslam.runs.localise import localising
from ratslam.runs.map_changes import changes_of
from ratslam.runs.merge import merge_maps
from ratslam.runs.saved_map import read_map
from robot.touch_source import observation_of


def localise(made: StoredMap, recorded: Recorded) -> Localised:
    """A session in a map, with `backend: localise`; poses are those given at each step.

    Raises:
        InputError: the session is not one of the map's sensor.
    """
    session = _session_in(made.path, capacity_for(recorded.log.length))
    session.restart(recorded.config.session.seed)
    steps = list(session.replay(observation_of(sample) for sample in recorded.log))
    localiser = session.map
    assert isinstance(localiser, Localiser)
    states = localiser.states()
    pose = np.array([step.pose for step in steps])
    return Localised(states == Localisation.FOUND, states == Localisation.NOT_THIS_MAP, pose)


def extend(made: StoredMap, recorded: Recorded) -> MapArrays:
    """The map of a session and then another one, which begins a new piece of it.

    Raises:
        InputError: the session is not one of the map's sensor.
    """
    session = read_map(made.path).open_session()
    session.begin_piece()
    for _ in session.replay(observation_of(sample) for sample in recorded.log):
        pass
    return MapArrays.of_session(session, np.concatenate([made.arrays.truth, recorded.truth]))


def merge(maps: Sequence[StoredMap], path: Path) -> StoredMap:
    """One map of several, in a new folder; steps in the order of the arguments.

    Raises:
        InputError: the maps cannot be merged.
    """
    merged = merge_maps([made.path for made in maps], path)
    begins = np.cumsum([0, *merged.steps[:-1]]).tolist()
    begin = {at.parent: first for at, first in zip(merged.maps, begins, strict=True)}
    order = np.concatenate([begin[made.path] + made.order for made in maps])
    session = read_map(path).open_session()
    truth = np.concatenate([made.arrays.truth for made in maps])
    whole = MapArrays.of_session(session, truth)
    arrays = whole._replace(trajectory=whole.trajectory[order], piece=whole.piece[order])
    np.savez(path / STEPS, **arrays._asdict())
    return StoredMap(path, arrays, order)


def changes(made: StoredMap, recorded: Recorded) -> np.ndarray:
    """Places [n, 2] of a map (m) where a session says that it no longer agrees, the surest first."""
    localise(made, recorded)
    localiser = _session_in(made.path, capacity_for(recorded.log.length)).map
    assert isinstance(localiser, Localiser)
    found = changes_of(localiser, recorded.config.touch)
    return np.array([change.position for change in found]).reshape(-1, 2)


@lru_cache(maxsize=1)
def _session_in(path: Path, reserve: int) -> Session:
    """A session of any state in a map; the last one that was compiled is used again."""
    saved = read_map(path)
    config = localising(saved.config, saved)
    rows = config.session.model_copy(update={"reserve": reserve})
    return build_session(config.model_copy(update={"session": rows}), saved.source)


PRODUCT = Methods(localise, extend, merge, changes)
