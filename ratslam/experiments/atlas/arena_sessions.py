"""Sessions of a whiskered Create in random arenas, and the grid maps of them on the disk.

The map is that of 900 reports. Later sessions have random streams of their own: another start, another drive,
another error of the wheels."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.localisation import MapSteps, known_steps
from ratslam.config.completion import complete
from ratslam.config.run_config import RunConfig
from ratslam.experiments.atlas.sessions import draw_seed
from ratslam.experiments.trials.arena_trial import simulate_session
from ratslam.pipeline.build_session import build_session
from ratslam.pipeline.saved_map import describe_readings, write_map
from ratslam.pipeline.source import open_observations
from robot.touch_source import observation_of, open_touch_source
from tactile.base.random_streams import stream
from tactile.base.types import Observation

REPORTS = 900
"""Reports of a session; a little more than six minutes."""
MAP_SIDE = 2.0
"""Side of the map over that of the arena: it is centred on the start."""


class ArenaDrive(NamedTuple):
    """A session of T reports: the observations, the true poses [T, 3], and the motions by odometry [T, 3]."""

    observations: list[Observation]
    truth: np.ndarray
    motion: np.ndarray


class ArenaMap(NamedTuple):
    """A grid map on the disk, and its steps."""

    path: Path
    steps: MapSteps


def arena_config(arena: int, side: float, seed: int) -> RunConfig:
    """The configuration of a session in an arena.

    Args:
        arena: its seed. side: of the arena, m. seed: of everything else.
    """
    wheels = {"noise": "bias", "level": 0.05}
    simulation = {"arena": {"side": side, "seed": arena}, "wheels": wheels, "reports": REPORTS, "seed": seed}
    return RunConfig.model_validate(
        {
            "create_simulation": simulation,
            "backend": "grid",
            "session": {"precision": "float32"},
            "grid": {"side": MAP_SIDE * side},
        }
    )


def drive_elsewhere(arena: int, side: float) -> ArenaDrive:
    """A further session in an arena, from another start."""
    config = arena_config(arena, side, draw_seed(arena, "arena start"))
    assert config.create_simulation is not None
    session = simulate_session(config.create_simulation)
    touch = complete(config, session.source).touch
    seen = [observation_of(sample) for sample in open_touch_source(session.source, touch)]
    motion = np.array([[float(value) for value in one.odometry[:3]] for one in seen])
    return ArenaDrive(seen, session.truth, motion)


def shuffled_contacts(drive: ArenaDrive, seed: int) -> ArenaDrive:
    """The same drive with what the whiskers met at another of its reports."""
    order = stream(seed, "control.shuffled").permutation(len(drive.observations))
    names = ("contact", "alive", "point", "wall", "wall_point", "wall_sd")
    mixed = [
        one._replace(**{name: getattr(drive.observations[k], name) for name in names})
        for one, k in zip(drive.observations, order.tolist(), strict=True)
    ]
    return drive._replace(observations=mixed)


def store_arena_map(arena: int, side: float, folder: Path) -> ArenaMap:
    """The map of an arena; made and written to `folder` unless it is there."""
    path = folder / f"arena_{arena}_{side:g}.npz"
    beside = path.with_suffix(".steps.npz")
    if not (path.exists() and beside.exists()):
        folder.mkdir(parents=True, exist_ok=True)
        with open_observations(arena_config(arena, side, arena)) as (config, source):
            samples = list(source)
            session = build_session(config, source)
            for _ in session.replay(observation_of(sample) for sample in samples):
                pass
            write_map(path, session, config, describe_readings(source), recording=source.digest)
        truth = np.array([sample.truth for sample in samples])
        unfinished = beside.with_name(f".{os.getpid()}.npz")
        np.savez(unfinished, trajectory=session.map.trajectory(), truth=truth)
        unfinished.replace(beside)
    with np.load(beside) as saved:
        return ArenaMap(path, known_steps(saved["trajectory"], saved["truth"]))
