"""A simulated walk through a maze on which every whisker image is a real one.

Poses and odometry are those of a session of the touch table; what the whiskers feel is recorded
(`robot.recordings.real_whiskers`). Each place, a cell and one of four facings, holds one of the recorded
objects, so that several places feel alike. The first visit to a place gives rows of the first half of its
object's recording, later visits give rows of the second half, and no row is given twice in a session.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import NonNegativeInt

from evaluation.papers.tables.touch_table import TouchTask, task_config
from robot.recordings.real_whiskers import OBJECTS_WHISKERS, read_object
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of
from robot.sources.source import SourceEntry, SourceInfo
from robot.world.maze import CELL_SIDE
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.settings import Settings

CIRCUITS = "CCCA"
FACINGS = 4
AWAY = 20
"""Number of whisks elsewhere after which a place is visited anew."""


class WalkConfig(Settings):
    """A walk over real images."""

    folder: Path
    """Folder of the recorded objects, one CSV file each."""
    simulation: SimulationConfig
    """The session whose poses and odometry are used."""
    seed: NonNegativeInt = 0
    """Seed of the objects of the places and of the rows."""
    shuffled: bool = False
    """Control: every whisk gives a row of any object."""


Visits = tuple[np.ndarray, np.ndarray]
"""What each of N whisks feels: [N] number of the object; [N] bool, the place had been visited before."""


def open_walk(config: WalkConfig) -> InMemorySource:
    """The walk as a source.

    Raises:
        InputError: a recording cannot be read, there are none, or an object is needed more often than half of
            its rows; the session cannot be simulated.
    """
    paths = sorted(config.folder.glob("*.csv"))
    if not paths:
        raise InputError(str(config.folder), "no CSV files", "the recorded objects")
    objects, digests = zip(*(read_object(path) for path in paths), strict=True)
    session = HeadSimulation(config.simulation)
    visits = plan_visits(session.truth, len(objects), config.seed)
    count = session.length
    if config.shuffled:
        rows = np.concatenate(objects)
        images = rows[stream(config.seed, "rows of objects").permutation(len(rows))[:count]]
    else:
        images = draw_by_place(objects, visits, config.seed)
    settings = config.model_dump_json(exclude={"folder"})
    return InMemorySource(
        name="walk",
        digest=digest_of([*(digest.encode() for digest in digests), settings.encode()]),
        time=session.time,
        motion=session.odometry,
        moved=np.ones(count, bool),
        views=images[:, None],
        seen=np.ones(count, bool),
        label=np.full(count, -1, np.int32),
        truth=session.truth,
        info=SourceInfo(signed_views=True, cell_size=session.info.cell_size),
        alive=np.ones(OBJECTS_WHISKERS, bool),
    )


def plan_visits(truth: np.ndarray, things: int, seed: int) -> Visits:
    """The objects that a robot at poses [N, 3] feels, and which visits are the first ones. Each place has an
    object by chance; a visit ends after `AWAY` whisks elsewhere."""
    cell = np.floor(truth[:, :2] / CELL_SIDE).astype(int)
    facing = np.round(truth[:, 2] / (2 * np.pi / FACINGS)).astype(int) % FACINGS
    _, place = np.unique(np.column_stack([cell, facing]), axis=0, return_inverse=True)
    place = place.reshape(-1)
    thing = stream(seed, "objects of places").integers(things, size=place.max() + 1)[place]
    later = np.zeros(len(place), bool)
    for number in range(place.max() + 1):
        whisks = np.flatnonzero(place == number)
        away = np.diff(whisks) > AWAY
        later[whisks[1:]] = np.cumsum(away) > 0
    return thing, later


def most_needed(visits: Visits) -> int:
    """The largest number of rows that an object needs, of first visits or of later ones."""
    thing, again = visits
    return int(max(np.bincount(thing[again == later]).max(initial=0) for later in (False, True)))


def draw_by_place(objects: Sequence[np.ndarray], visits: Visits, seed: int) -> np.ndarray:
    """[N, 8, 16] a row of the object of each whisk: of the first half of its recording in first visits, else
    of the second.

    Raises:
        InputError: there are too few rows.
    """
    thing, again = visits
    random = stream(seed, "rows of objects")
    images = np.zeros((len(thing), *objects[0].shape[1:]))
    for number, touches in enumerate(objects):
        half = len(touches) // 2
        for later, rows in ((False, np.arange(half)), (True, np.arange(half, 2 * half))):
            whisks = np.flatnonzero((thing == number) & (again == later))
            if len(whisks) > half:
                which = "later" if later else "first"
                found = f"object {number} is felt {len(whisks)} times in {which} visits"
                raise InputError("seed", found, f"at most {half} times", "choose another seed")
            images[whisks] = touches[random.permutation(rows)[: len(whisks)]]
    return images


def walk_simulation(maze: int) -> SimulationConfig:
    """The session of a maze of the touch table, its first four circuits."""
    config = task_config(TouchTask("main", maze))
    assert config.simulation is not None  # every row of the table is simulated
    return SimulationConfig.model_validate(
        config.simulation.model_dump(exclude_unset=True) | {"path": {"circuits": CIRCUITS}}
    )


ENTRY = SourceEntry(WalkConfig, lambda config, warn: open_walk(config))
