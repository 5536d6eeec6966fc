"""A simulated session of a rat in a box with cues as a source, bit-identical for the same settings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import NonNegativeInt, PositiveFloat

from robot.simulation.rat.box import BoxConfig, ViewConfig, panoramic_views
from robot.simulation.rat.path_files import PathFileConfig, read_path
from robot.simulation.rat.phases import PhaseConfig, boxes_of, lay_out_phases
from robot.simulation.rat.random_walk import RandomWalkConfig, walk_randomly
from robot.simulation.rat.rat_odometry import RatOdometryConfig, measure_motion
from robot.simulation.rat.rat_path import RatPath, check_path, sample_path
from robot.sources.input_files import digest_of
from robot.sources.simulated import (
    NO_ODOMETRY,
    SimulatedSource,
    check_steps,
    digest_of_document,
    wrap_headings,
)
from robot.sources.source_info import SourceInfo
from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import between, wrap
from tactile.base.types import Observation, observation

CELLS, ROOM = 21, 1.05
"""The cell size that a session suggests is that of a torus of so many cells a side, larger than the longest
side of a box by this factor: each cell then has one place in the box."""
OUTSIDE = 0.1
"""Largest distance of a position from the box, m: a tracked head leans over a wall. It is put
at the wall."""
WALK_SECONDS = 600.0
"""Duration of a random walk of unspecified duration, s."""


class RatSimulationConfig(Settings):
    """A session of a rat in a box with cues."""

    path: PathFileConfig = PathFileConfig()
    """Recorded path."""
    walk: RandomWalkConfig | None = None
    """Random walk instead of a recorded path."""
    seconds: PositiveFloat | None = None
    """Duration, s; null: the whole path, 600 s of a walk."""
    rate_hz: PositiveFloat = 50.0
    """Steps per second."""
    odometry: RatOdometryConfig = RatOdometryConfig()
    """Errors of path integration."""
    box: BoxConfig = BoxConfig()
    """Box and cues."""
    views: ViewConfig = ViewConfig()
    """Views."""
    phases: tuple[PhaseConfig, ...] = ()
    """Changes during the session, such as darkness."""
    seed: NonNegativeInt = 0
    """Seed of all random streams."""

    def resolved(self, folder: Path) -> RatSimulationConfig:
        """A copy with relative paths taken from the folder, such as that of the configuration file."""
        return self.model_copy(update={"path": self.path.resolved(folder)})


class RatSimulation(SimulatedSource):
    """A session of a rat as a `Source` of `Observation`s.

    The odometry of a row is the motion along the path as the box is at that row; a jump, by a kidnap or
    another box, is in the truth alone.

    Args:
        path: positions in the box, its south-west corner at the origin, instead of those that the
            configuration names: for example of an agent of another simulator. They are not smoothed.

    Attributes:
        config: its settings. timeline: [N] phases. time: [N] s from 0. truth: [N, 3]. odometry: [N, 4].

    Raises:
        InputError: the path or a phase cannot be used; the error gives file and row, or the key.
    """

    name = "rat_simulation"
    whiskers = 0

    def __init__(self, config: RatSimulationConfig, path: RatPath | None = None) -> None:
        self.config = config
        self.view_shape = (1, config.views.columns, 1)
        pose = _poses_of(config, path)
        rows = _count_rows(config, len(pose))
        self.timeline = lay_out_phases(config.phases, config.box, pose[:, :2], rows, config.rate_hz)
        self.time = np.arange(rows) / config.rate_hz
        source, scale = self.timeline.source, self.timeline.scale
        here = scale_poses(pose[source], scale)
        before = scale_poses(pose[np.maximum(source - 1, 0)], scale)
        self.truth = wrap_headings(here)
        motion = np.column_stack(
            [between(before, here)[:, :2], here[:, 2] - before[:, 2], np.full(rows, 1.0)]
        )
        motion[:, 3] /= config.rate_hz
        motion[0] = 0.0
        self.odometry = measure_motion(config.odometry, motion, config.seed)
        self._boxes = boxes_of(config.box, config.phases)
        self.info = _describe(config, self._boxes)
        document = digest_of_document(self.info.provenance)
        self.digest = digest_of([document.encode(), np.ascontiguousarray(pose).tobytes()])

    @property
    def rate_hz(self) -> float:
        return self.config.rate_hz

    def views(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows [V] with a view, and these views [V, 1, C, 1]. Darkness has none."""
        views = self.config.views
        due = np.arange(0, self.length, views.every)
        noise = stream(self.config.seed, "rat views").standard_normal((len(due), views.columns))
        seen = np.zeros((len(due), *self.view_shape))
        times = self.timeline
        for number, box in enumerate(self._boxes):
            here = times.box[due] == number
            rows = due[here]
            turns = times.card_turn[rows], times.distal_turn[rows]
            seen[here] = panoramic_views(box, views, self.truth[rows], *turns, times.stretch[rows])
        seen = np.clip(seen + views.noise * noise[:, None, :, None], 0.0, 1.0)
        lit = ~times.dark[due]
        return due[lit], seen[lit]

    def _readings(self) -> Iterator[Observation]:
        rows, views = self.views()
        due, views_left = set(rows.tolist()), iter(views)
        for row in range(self.length):
            view = next(views_left) if row in due else None
            yield observation(NO_ODOMETRY, view, view_shape=self.view_shape)


def scale_poses(pose: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """[N, 3] poses [N, 3] in a box whose width and height have changed by factors [N, 2]; headings remain the
    direction of motion and are not wrapped."""
    heading = pose[:, 2]
    turned = np.arctan2(scale[:, 1] * np.sin(heading), scale[:, 0] * np.cos(heading))
    return np.column_stack([pose[:, :2] * scale, heading + wrap(turned - heading)])


def _poses_of(config: RatSimulationConfig, path: RatPath | None) -> np.ndarray:
    """[L, 3] poses of the path in the first box, headings not wrapped."""
    rate, size, smoothing = config.rate_hz, (config.box.width, config.box.height), 0.0
    if path is not None:
        where = "rat path"
        check_path(path, config.path, lambda row: f"{where}, row {row}")
    elif config.walk is not None:
        where, seconds = "rat_simulation.walk", config.seconds or WALK_SECONDS
        check_steps(where, seconds * rate)
        path = walk_randomly(config.walk, size, seconds, rate, config.seed)
    else:
        where, path, smoothing = str(config.path.file), read_path(config.path), config.path.smoothing
        check_steps(where, rate * (path.time[-1] - path.time[0]))
    return sample_path(_enter_box(path, size, where), config.path, rate, smoothing)


def _enter_box(path: RatPath, size: tuple[float, float], where: str) -> RatPath:
    """The path with positions a little outside the box moved to its walls."""
    inside = np.clip(path.position, 0.0, size)
    beyond = np.abs(path.position - inside).max(axis=1)
    box, cure = f"positions in the box of {size[0]:g} x {size[1]:g} m", "see unit and shift of the path"
    if (beyond > 0).all():
        raise InputError(where, "no position is inside the box", box, cure)
    far = np.flatnonzero(beyond > OUTSIDE)
    if len(far):
        x, y = path.position[far[0]].tolist()
        found = f"{len(far)} positions up to {beyond.max():.3g} m outside, the first ({x:.3g}, {y:.3g}) at "
        raise InputError(where, f"{found}{path.time[far[0]]:.6g} s", box, cure)
    return path._replace(position=inside)


def _count_rows(config: RatSimulationConfig, there: int) -> int:
    if config.seconds is None:
        return there
    rows = max(round(config.seconds * config.rate_hz), 1)
    if rows > there:
        found, expected = f"{config.seconds:g} s", f"at most the {there / config.rate_hz:g} s of the path"
        raise InputError("rat_simulation.seconds", found, expected)
    return rows


def _describe(config: RatSimulationConfig, boxes: list[BoxConfig]) -> SourceInfo:
    sizes = [(box.width, box.height) for box in boxes]
    sizes += [
        (config.box.width * phase.stretch[0], config.box.height * phase.stretch[1])
        for phase in config.phases
        if phase.stretch is not None
    ]
    width, height = np.max(sizes, axis=0).tolist()
    settings = config.model_dump(mode="json", exclude={"path": {"file"}})
    return SourceInfo(
        cell_size=round(ROOM * max(width, height) / CELLS, 6),
        box=(0.0, 0.0, width, height),
        provenance={"rat_simulation": settings},
    )
