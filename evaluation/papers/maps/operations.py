"""What is measured of saved maps: the operations of this program on them, in tasks, session by session."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from evaluation.papers.figure import MAPS, Figure, find_figure, write_page
from evaluation.papers.maps.scenarios import Recipe, Recorded
from evaluation.papers.maps.stored_maps import STEPS, MapArrays, StoredMap, store_map
from evaluation.papers.tables.comparison import Measured, SessionLog, compare_figures, measured_rows, some_of
from evaluation.papers.trial_sessions import capacity_for
from ratslam.core.session import Session
from ratslam.grid.localiser import GridLocaliser
from ratslam.places.localiser import Localisation, Localiser
from ratslam.runs.build_session import build_session
from ratslam.runs.localise import localising
from ratslam.runs.merge import merge_maps
from ratslam.runs.run_directory import changes_of
from ratslam.runs.saved_map import read_map
from robot.touch_source import observation_of
from tactile.base.types import Observation


class Localised(NamedTuple):
    """A session of T steps in a map that does not change.

    Attributes:
        found: [T] bool, whether the robot says that it knows where it is. foreign: [T] bool, whether it says
            that it is not in this map. pose: [T, 3] in the map (m, m, rad).
    """

    found: np.ndarray
    foreign: np.ndarray
    pose: np.ndarray

    @classmethod
    def by(cls, session: Session, observations: Iterable[Observation]) -> Self:
        """What a session in a map says at each of its steps."""
        steps = list(session.replay(observations))
        localiser = session.map
        assert isinstance(localiser, Localiser | GridLocaliser)
        states = localiser.states()
        pose = np.array([step.pose for step in steps])
        return cls(states == Localisation.FOUND, states == Localisation.NOT_THIS_MAP, pose)


class MapTask(NamedTuple):
    """One session of a row.

    Attributes:
        seed: of its maze; in rows of recordings, the number of the recording. folder: for maps. methods: what
            is measured.
    """

    seed: int
    folder: Path
    methods: Methods

    def map_of(self, recipe: Recipe) -> StoredMap:
        """The map of a session, made once for all rows."""
        return store_map(recipe, self.folder)


@lru_cache(maxsize=1)
def _session_in(path: Path, reserve: int) -> Session:
    """A session of any state in a map; the last one that was compiled is used again."""
    saved = read_map(path)
    config = localising(saved.config, saved)
    rows = config.session.model_copy(update={"reserve": reserve})
    return build_session(config.model_copy(update={"session": rows}), saved.source)


class Methods:
    """The operations of this program on saved maps; tests measure others."""

    def localise(self, made: StoredMap, recorded: Recorded) -> Localised:
        """A session in a map, with `backend: localise`; poses are those given at each step.

        Raises:
            InputError: the session is not one of the map's sensor.
        """
        session = _session_in(made.path, capacity_for(recorded.log.length))
        session.restart(recorded.config.session.seed)
        return Localised.by(session, (observation_of(sample) for sample in recorded.log))

    def extend(self, made: StoredMap, recorded: Recorded) -> MapArrays:
        """The map of a session and then another one, which begins a new piece of it.

        Raises:
            InputError: the session is not one of the map's sensor.
        """
        session = read_map(made.path).open_session()
        session.begin_piece()
        for _ in session.replay(observation_of(sample) for sample in recorded.log):
            pass
        return MapArrays.of_session(session, np.concatenate([made.arrays.truth, recorded.truth]))

    def merge(self, maps: Sequence[StoredMap], path: Path) -> StoredMap:
        """One map of several, in a new folder; steps in the order of the arguments.

        Raises:
            InputError: the maps cannot be merged.
        """
        merged = merge_maps([made.path for made in maps], path)
        begins = np.cumsum([0, *merged["steps"][:-1]]).tolist()
        begin = {Path(at).parent: first for at, first in zip(merged["maps"], begins, strict=True)}
        order = np.concatenate([begin[made.path] + made.order for made in maps])
        session = read_map(path).open_session()
        truth = np.concatenate([made.arrays.truth for made in maps])
        whole = MapArrays.of_session(session, truth)
        arrays = whole._replace(trajectory=whole.trajectory[order], piece=whole.piece[order])
        np.savez(path / STEPS, **arrays._asdict())
        return StoredMap(path, arrays, order)

    def changes(self, made: StoredMap, recorded: Recorded) -> np.ndarray:
        """Places [n, 2] of a map (m) where a session says that it no longer agrees, the surest first."""
        self.localise(made, recorded)
        localiser = _session_in(made.path, capacity_for(recorded.log.length)).map
        assert isinstance(localiser, Localiser)
        found = changes_of(localiser, recorded.config.touch)
        return np.array([change.position for change in found]).reshape(-1, 2)


def reproduce_maps(
    names: Sequence[str],
    methods: Methods,
    output: Path,
    first: int,
    sessions: int | None = None,
    workers: int = 1,
    against: Path | None = None,
) -> Iterator[str]:
    """The lines of the page, each table as soon as it is measured; writes `maps.md`, a PNG per figure, and
    `maps.csv`, a session as soon as it is measured.

    Args:
        names: of the figures. output: folder for the page, and for the maps in `maps`, which later calls use
            again. first: seed of the first maze; each session has the next one. sessions: of each figure;
            None: the figure's own number. workers: processes. against: folder of an earlier run; the same
            sessions are compared below the last table.

    Raises:
        InputError: a session cannot be recorded, or a file of the sessions cannot be used.
    """
    tasks: dict[str, dict[str, MapTask]] = {}
    for name in names:
        usual = find_figure(MAPS[name]).sessions
        seeds: Iterable[tuple[str, int]]  # or the numbers of the recordings
        if isinstance(usual, int):
            seeds = ((str(seed), seed) for seed in range(first, first + (sessions or usual)))
        else:
            seeds = ((label, number) for number, label in enumerate(usual[:sessions]))
        tasks[name] = {label: MapTask(seed, output / "maps", methods) for label, seed in seeds}
    log = SessionLog("maps", output, against, tasks)

    def measure(name: str, figure: Figure) -> tuple[list[str], list[Measured]]:
        ((_, found),) = measured_rows(figure.measure, {name: tasks[name]}, workers, log)
        return [f"{len(found)} sessions: {some_of(tasks[name])}.", ""], found

    yield from write_page(output / "maps.md", MAPS, names, measure)
    yield from compare_figures(log, names)
