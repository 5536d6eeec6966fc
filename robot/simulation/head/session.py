"""A simulated session of a whiskered head as a source: the same bits every time, from one seed.

Every part draws from a stream of its own name (maze.loop, maze.walls, maze.heights, path, motion, sensor,
odometry), so that changing one leaves the others as they were.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path as File
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeInt

from robot.simulation.head.beam import StreamConfig
from robot.simulation.head.dynamic import simulate_dynamic
from robot.simulation.head.kinematic import MechanicsConfig, WhiskColumns, simulate_kinematic, whisk_of_row
from robot.simulation.head.quasistatic import simulate_quasistatic
from robot.simulation.head.whisk_stream import simulate_cycles, simulate_free_cycles
from robot.sources.odometry import OdometryConfig, simulate_odometry
from robot.sources.simulated import NO_ODOMETRY, SimulatedSource, digest_of_document, wrap_headings
from robot.sources.source_info import SimulationInfo, SourceInfo
from robot.world.head_trajectory import MotionConfig, poses_at
from robot.world.maze import POSE_CELL_SIZE, maze_text
from robot.world.scene import KidnapConfig, MazeConfig, PathConfig, make_scene, maze_info, other_surroundings
from robot.world.walls import Surroundings
from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Cycle, Whisk
from tactile.features.calibration import Calibration, CalibrationConfig, calibrate
from tactile.whiskers.head_geometry import HeadConfig, ur10_head
from tactile.whiskers.whisking import MID_PROTRACTION, WhiskingConfig, check_amplitude

RAW_TIERS = {"quasistatic": simulate_quasistatic, "dynamic": simulate_dynamic}
"""The tiers that make raw samples."""


class SimulationConfig(Settings):
    """A session to simulate. What the paper leaves open are these defaults."""

    maze: MazeConfig = MazeConfig()
    """The world."""
    path: PathConfig = PathConfig()
    """Where the head goes."""
    motion: MotionConfig = MotionConfig()
    """How it moves."""
    kidnaps: KidnapConfig = KidnapConfig()
    """When it is carried."""
    odometry: OdometryConfig = OdometryConfig()
    """What it believes of its motion."""
    whisking: WhiskingConfig = WhiskingConfig()
    """How whiskers are driven."""
    mechanics: MechanicsConfig = MechanicsConfig()
    """Drives, whiskers and sensors."""
    stream: StreamConfig = StreamConfig()
    """What the raw tiers know of them besides."""
    calibration: CalibrationConfig = CalibrationConfig()
    """The free whisking before the session, for the raw tiers."""
    later_maze: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Share of the session after which whiskers feel another maze, as a control: nothing there can be known
    again."""
    seed: NonNegativeInt = 0
    """Of everything random."""
    fidelity: Literal["auto", "kinematic", "quasistatic", "dynamic"] = "auto"
    """How much is modelled; `auto`: as little as the wanted outputs need."""
    raw: bool = False
    """Whether raw whisker samples are wanted, 2000 a second."""

    def resolved(self, folder: File) -> SimulationConfig:
        """The same with every relative path taken from the folder (of the configuration file, say)."""
        if self.maze.file is None:
            return self
        maze = self.maze.model_copy(update={"file": folder / self.maze.file})
        return self.model_copy(update={"maze": maze})


class ChosenTier(NamedTuple):
    """How much is modelled, and why."""

    name: Literal["kinematic", "quasistatic", "dynamic"]
    why: str


def choose_tier(config: SimulationConfig) -> ChosenTier:
    """The cheapest tier that gives what is wanted, or the one that was named.

    Raises:
        InputError: the one that was named cannot give it.
    """
    if config.fidelity == "kinematic" and config.raw:
        raise InputError(
            "simulation.fidelity", "kinematic, which makes no raw samples", "auto, quasistatic or dynamic"
        )
    if config.fidelity != "auto":
        return ChosenTier(config.fidelity, "it was named")
    if config.raw:
        return ChosenTier("quasistatic", "raw samples are wanted, bending modes and overshoot are not")
    return ChosenTier("kinematic", "angles of contact are all that is wanted")


class HeadSimulation(SimulatedSource):
    """A simulated session as a `Source`.

    Attributes:
        config, head_config: what it was made from. tier: how much was modelled, and why.
        scene: maze, path and walls. calibration: of the head, None in the kinematic tier.
        time: [N] s. start: [N] s, when the whisk cycles began.
        truth: [N, 3]. odometry: [N, 4]. carried: [N] bool, the head was carried since the row before.

    Raises:
        InputError: the configuration cannot be simulated; says what and where.
    """

    name = "simulation"

    def __init__(self, config: SimulationConfig, head_config: HeadConfig | None = None) -> None:
        head_config = head_config or HeadConfig()
        self.config, self.head_config, self.tier = config, head_config, choose_tier(config)
        self.head = head = ur10_head(head_config)
        whisking, seed = config.whisking, config.seed
        check_amplitude(whisking, head)
        self.scene = make_scene(config.maze, config.path, config.motion, config.kidnaps, head, seed)
        count = int(min(self.scene.duration, self.scene.path.duration) * whisking.rate)
        if count < 1:
            raise InputError("simulation.path", f"{self.scene.duration:.3g} s", "time for one whisk at least")
        self.start = np.arange(count) / whisking.rate
        self.time = self.start + MID_PROTRACTION / whisking.rate
        pose = poses_at(self.scene.path, self.time)
        self.truth = wrap_headings(pose)
        self.carried = np.zeros(count, bool)
        rows = np.searchsorted(self.time, self.scene.jumps)
        self.carried[rows[rows < count]] = True
        self.odometry = simulate_odometry(
            config.odometry, self.time, pose, stream(seed, "odometry"), self.carried
        )
        self._parts = self._surroundings()
        self.calibration = None if self.tier.name == "kinematic" else self._calibrated()
        self.features = self._kinematic() if self.calibration is None else None

        plain = config.model_dump(mode="json", exclude={"maze": {"file"}})
        self.digest = digest_of_document(
            {
                "head": head_config.model_dump(mode="json"),
                "simulation": plain,
                "maze": maze_text(self.scene.maze) if config.maze.file else "",
            }
        )
        self.info = SourceInfo(
            raw_whiskers=True,
            cell_size=POSE_CELL_SIZE,
            head=head_config,
            calibration=self.calibration,
            maze=maze_info(self.scene.maze, config.maze, config.seed),
            simulation=SimulationInfo(
                sha256=self.digest, seed=config.seed, tier=self.tier.name, why=self.tier.why
            ),
            provenance={"simulation": plain},
        )

    @property
    def rate_hz(self) -> float:
        return self.config.whisking.rate

    @property
    def view_shape(self) -> tuple[int, int, int]:
        return (*self.head.shape, 1)

    @property
    def whiskers(self) -> int:
        return len(self.head.length)

    def _surroundings(self) -> list[tuple[Surroundings, slice]]:
        """What is around in which cycles."""
        later = self.config.later_maze
        if later is None:
            return [(self.scene.surroundings, slice(None))]
        change = int(later * self.length)
        other = other_surroundings(self.scene, self.config.maze, self.head, self.config.seed)
        return [(self.scene.surroundings, slice(change)), (other, slice(change, None))]

    def _kinematic(self) -> WhiskColumns:
        config = self.config
        parts = []
        for surroundings, rows in self._parts:
            random = stream(config.seed, "sensor")  # the whole session's noise, whatever is around
            all_of_it = simulate_kinematic(
                config.mechanics, config.whisking, surroundings, self.scene.path, self.start, random
            )
            parts.append([column[rows] for column in all_of_it])
        return WhiskColumns(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def _calibrated(self) -> Calibration:
        """What the head's sensors report in free air, before the session."""
        config = self.config
        count = int(np.ceil(config.calibration.min_duration * config.whisking.rate))
        random = stream(config.seed, "calibration")
        record = simulate_free_cycles(
            RAW_TIERS[self.tier.name],
            config.stream,
            config.mechanics,
            config.whisking,
            self.head,
            count,
            random,
        )
        return calibrate(config.calibration, record, where="simulation")

    def _readings(self) -> Iterator[Whisk | Cycle]:
        if self.features is None:
            return self._cycles()
        return (whisk_of_row(self.head, self.features, row, NO_ODOMETRY) for row in range(self.length))

    def _cycles(self) -> Iterator[Cycle]:
        """Raw samples of each cycle, without its odometry."""
        assert self.calibration is not None
        config, random = self.config, stream(self.config.seed, "sensor")
        model, threshold = RAW_TIERS[self.tier.name], self.calibration.threshold[:, 1]
        for surroundings, rows in self._parts:
            yield from simulate_cycles(
                model,
                config.stream,
                config.mechanics,
                config.whisking,
                surroundings,
                self.scene.path,
                self.start[rows],
                random,
                threshold,
            )
