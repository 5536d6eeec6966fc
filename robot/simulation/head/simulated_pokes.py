"""A simulated session of an arm without a whisker head, which feels the walls of its maze by pokes.

The arm stops at even distances along its path and pokes once in each direction (`tactile.pokes`). Each poke
is simulated state by state: walls as springs and the errors of the measured force
(`robot.world.contact_force`); the threshold is learned from simulated pokes in free air. Streams of its own:
poke, poke.free, odometry.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot.drivers.ur10.driver_config import ArmConfig
from robot.simulation.head.odometry_errors import simulate_odometry
from robot.simulation.head.simulated_session import SimulationConfig
from robot.sources.in_memory import (
    NO_ODOMETRY,
    SimulatedSource,
    check_steps,
    digest_of_document,
    wrap_headings,
)
from robot.sources.source import SimulationInfo, SourceInfo, rate_of
from robot.world.contact_force import ContactForceConfig, force_error, free_way
from robot.world.maze import POSE_CELL_SIZE, maze_text
from robot.world.scene import HeadPath, make_scene, maze_info, moved_length, other_surroundings, poses_at
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Observation
from tactile.pokes import (
    PokeConfig,
    force_rise,
    is_loaded,
    learn_threshold,
    poke_angles,
    poke_observation,
)
from tactile.whisker_geometry import HeadConfig, ur10_head

HZ = 125
"""States per second, those of a CB3."""
REST = 0.1
"""Time at rest before a poke, s."""
CHUNK = 64
"""Rings simulated at a time."""


def ring_times(path: HeadPath, every: float, duration: float) -> np.ndarray:
    """Times [N] on a path at which the arm has moved on by `every` m, s."""
    length = moved_length(path)
    time = np.unique(np.interp(np.arange(0.0, length[-1], every), length, path.time))
    return time[time <= duration]


def simulate_pokes(
    config: PokeConfig,
    force: ContactForceConfig,
    place: np.ndarray,
    angle: np.ndarray,
    way: np.ndarray,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the tool [N, D, T] in pokes from places [N, 2] in directions [N, D] (rad), m, and the force
    against it [N, D, T], N.

    Args:
        way: [N, D] way to the wall, m; infinite without one.
    """
    count = int(np.ceil(config.reach / config.speed * HZ)) + 1
    went = np.maximum(np.arange(-round(REST * HZ), count), 0) * config.speed / HZ
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    where = place[:, None, None] + went[:, None] * along[:, :, None]
    error = np.einsum("ndtk,ndk->ndt", force_error(force, where)[..., :2], along)
    noise = force.noise * random.standard_normal(error.shape)
    return went, force.stiffness * np.maximum(went - way[..., None], 0.0) - error - noise


def feel(
    config: PokeConfig, went: np.ndarray, push: np.ndarray, threshold: float, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Depth [N, D] at which pokes stop, m, and whether they touched.

    Args:
        went: [T] depth of the tool in each state, m. push: [N, D, T] force against it, N. threshold: of the
            rise, N. limit: the arm's force limit, N.
    """
    found = (force_rise(config, push, HZ) > threshold) | is_loaded(push, limit)
    contact = found.any(axis=-1)
    return np.where(contact, went[found.argmax(axis=-1)], config.reach), contact


class PokeSimulation(SimulatedSource):
    """A simulated session as a `Source`.

    Attributes:
        time: [N] s, of the rings. truth: [N, 3]. odometry: [N, 4]. depth: [N, D] of the pokes, m. contact:
            [N, D] bool. kidnapped: [N] bool, whether a kidnap precedes the ring. way: [N, D] to the wall, m;
            infinite without one. threshold: of the force's rise, N.

    Raises:
        InputError: the configuration cannot be simulated; the error gives key and reason.
    """

    name = "simulation"

    def __init__(self, config: SimulationConfig, pokes: PokeConfig) -> None:
        self.config, self.pokes = config, pokes
        self.whiskers, self.view_shape = pokes.directions, (1, pokes.directions, 1)
        seed, head = config.seed, ur10_head(HeadConfig())
        if config.raw or config.fidelity != "auto" or config.mechanics.baseline.is_on:
            found = "force, with settings of whiskers (raw, fidelity or mechanics.baseline)"
            raise InputError("simulation.touch", found, "none of them: pokes have no whiskers")
        scene = make_scene(config.maze, config.path, config.motion, config.kidnaps, head, seed)
        moved = ring_times(scene.path, pokes.every, min(scene.duration, scene.path.duration))
        check_steps("simulation", len(moved))
        if not len(moved):
            raise InputError("simulation.path", f"{scene.duration:.3g} s", "at least one ring of pokes")
        pose = poses_at(scene.path, moved)
        self.kidnapped = np.zeros(len(moved), bool)
        rows = np.searchsorted(moved, scene.jumps)
        self.kidnapped[rows[rows < len(moved)]] = True
        angle = pose[:, 2:] + poke_angles(pokes)
        change = len(moved) if config.later_maze is None else int(config.later_maze * len(moved))
        walls = [scene.surroundings.walls.box]
        if config.later_maze is not None:
            walls.append(other_surroundings(scene, config.maze, head, seed).walls.box)
        self.way = np.concatenate(
            [
                free_way(box, pokes.radius, pose[part, :2], angle[part], pokes.reach)
                for box, part in zip(walls, (slice(change), slice(change, None)), strict=False)
            ]
        )
        limit, free = ArmConfig().force_limit, np.full((1, pokes.directions), np.inf)
        start = pose[:1, :2], angle[:1]
        _, push = simulate_pokes(pokes, config.force, *start, free, stream(seed, "poke.free"))
        self.threshold = learn_threshold(pokes, list(push[0]), HZ, limit)
        random, felt = stream(seed, "poke"), []
        for first in range(0, len(moved), CHUNK):
            part = slice(first, first + CHUNK)
            went, push = simulate_pokes(
                pokes, config.force, pose[part, :2], angle[part], self.way[part], random
            )
            felt.append(feel(pokes, went, push, self.threshold, limit))
        self.depth, self.contact = (np.concatenate(column) for column in zip(*felt, strict=True))
        took = (self.depth / pokes.speed + self.depth / pokes.retract).sum(axis=1)
        self.time, self.truth = moved + np.cumsum(took), wrap_headings(pose)
        random = stream(seed, "odometry")
        self.odometry = simulate_odometry(config.odometry, moved, pose, random, self.kidnapped)
        self.odometry[1:, 3] = np.diff(self.time)
        self.rate_hz = rate_of(self.time)
        plain = config.model_dump(mode="json", exclude={"maze": {"file"}})
        drawing = maze_text(scene.maze) if config.maze.file else ""
        settings = {"pokes": pokes.model_dump(mode="json"), "simulation": plain, "maze": drawing}
        self.digest = digest_of_document(settings)
        why = "`simulation.touch` is force"
        self.info = SourceInfo(
            pokes=pokes,
            cell_size=POSE_CELL_SIZE,
            maze=maze_info(scene.maze, config.maze, seed),
            simulation=SimulationInfo(sha256=self.digest, seed=seed, tier="pokes", why=why),
            provenance={"simulation": plain},
        )

    def _readings(self) -> Iterator[Observation]:
        for depth, contact in zip(self.depth, self.contact, strict=True):
            yield poke_observation(self.pokes, depth, contact, NO_ODOMETRY)
