"""A simulated session of the whisker head as a source, bit-identical for the same settings.

Every part draws from its own random stream (maze.loop, maze.walls, maze.heights, path, motion, sensor,
colour, drift, odometry), so that changing one part leaves the others unchanged.

The dynamic fidelity, `simulate_dynamic`, has drives with inertia, whiskers with two bending modes and elastic
walls. Each whisker is a linear system of six states, its angle and the two loads of `Beam` with their rates,
driven by the command (linear between samples) and the force of the wall (constant between samples), and is
integrated exactly by a matrix exponential. The wall is a stiff spring whose force is taken at the end of the
sample (implicit, stable at any stiffness):
    force = spring x (depth without force) / (1 + spring x give).
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeInt
from scipy.linalg import expm

from robot.simulation.head.baseline import make_baseline
from robot.simulation.head.beam import Beam, StreamConfig, make_beam
from robot.simulation.head.kinematic import HeadSetup, MechanicsConfig, simulate_kinematic
from robot.simulation.head.odometry_errors import OdometryConfig, simulate_odometry
from robot.simulation.head.whisk_stream import (
    TrueSamples,
    WallSweep,
    simulate_cycles,
    simulate_free_cycles,
    simulate_quasistatic,
)
from robot.sources.in_memory import (
    NO_ODOMETRY,
    SimulatedSource,
    check_steps,
    digest_of_document,
    wrap_headings,
)
from robot.sources.source import SimulationInfo, SourceInfo
from robot.world.contact_force import ContactForceConfig
from robot.world.maze import POSE_CELL_SIZE, maze_text
from robot.world.scene import (
    KidnapConfig,
    MazeConfig,
    MotionConfig,
    PathConfig,
    make_scene,
    maze_info,
    other_surroundings,
    poses_at,
)
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.settings import Settings
from tactile.base.types import Cycle, Whisk
from tactile.calibration import CalibrationConfig, calibrate
from tactile.contact_threshold import stiffness
from tactile.whisker_geometry import HeadConfig, ur10_head
from tactile.whisking import MID_PROTRACTION, WhiskingConfig, check_amplitude, initial_drive, whisk_command

WALL_STIFFNESS = 300.0
"""Ratio of wall stiffness to whisker stiffness."""


def simulate_dynamic(setup: HeadSetup, sweep: WallSweep, threshold: np.ndarray) -> TrueSamples:
    """Angle, x and y, [T, N, W] rad: a `robot.simulation.head.whisk_stream.MechanicsModel`."""
    head, config, mechanics, whisking = setup
    model = make_beam(config.beam.shaft)
    step, push = _systems(setup, model)  # [W, 6, 8], [W, 6, 3]
    # Displacement of the contact point per unit of each of the first three states.
    arm = np.concatenate([sweep.reach[None], model.at(sweep.reach)])  # [3, T, N, W]
    give = np.einsum("itnw,wij,jtnw->tnw", arm, push[:, :3], arm, optimize=True)
    spring = WALL_STIFFNESS * model.unit
    force_per = 1 / (1 / spring + give)
    reading_noise = sweep.noise[..., 2].swapaxes(0, 1)
    slide, hard = sweep.drift / config.rate, stiffness(config.beam.shaft, sweep.reach)
    angle, side, moment = (np.zeros(sweep.wall.shape) for _ in range(3))

    size = sweep.wall.shape[1:]
    state = np.zeros((size[1], 8, size[0]))  # for each whisker: six states, command, rate of the command
    drive, reading, aim = initial_drive(*size), np.zeros(size), np.zeros(size)
    touching, slipped = np.zeros(size, bool), np.zeros(size, bool)
    late, x, before = np.zeros(size), np.zeros(size), np.zeros(size)
    for k, time in enumerate(sweep.time):
        last, (aim, drive) = aim, whisk_command(whisking, drive, time, reading, threshold, head.shape)
        state[:, 6], state[:, 7] = last.T, (aim - last).T
        state[:, :6] = step @ state
        # A wall that reaches a whisker from the side makes contact at the whisker's present angle.
        late = np.where(touching, late, np.maximum(before - sweep.wall[k], 0.0))
        wall = sweep.wall[k] + late
        place = arm[:, k]
        along = state[:, :3].T  # [N, 3, W], axes from the end
        depth = place[0] * (along[:, 0] - wall) + place[1] * along[:, 1] + place[2] * along[:, 2]
        touching = (depth > 0) & ~slipped
        force = np.where(touching, depth * force_per[k], 0.0)
        state[:, :6] -= push @ (place * force).transpose(2, 0, 1)
        slipped |= touching & (along[:, 0] - wall > mechanics.slip)
        before = along[:, 0] + (place[1] * along[:, 1] + place[2] * along[:, 2]) / place[0]
        y = -(model.moment[0] * along[:, 1] + model.moment[1] * along[:, 2]) / model.unit
        limit = config.beam.friction * force * place[0] / (hard[k] * model.unit)
        x = np.minimum(np.maximum(x + slide[k], -limit), limit)
        angle[k], side[k], moment[k] = along[:, 0], hard[k] * x, y
        reading = y + reading_noise[k]
    return angle, side, moment


def _systems(setup: HeadSetup, model: Beam) -> tuple[np.ndarray, np.ndarray]:
    """State transition [W, 6, 8] of one sample, and effect [W, 6, 3] of forces along the first three states.

    Units are the length, rigidity and mass of each whisker; rates are per time unit of its beam, the rate of
    the command is per sample.
    """
    head, config, mechanics, _ = setup
    servo = mechanics.servo * model.unit
    lengths, which = np.unique(head.length, return_inverse=True)
    steps, pushes = [], []
    beam = config.beam
    for length in lengths.tolist():
        unit = float(length**2 * 2 / beam.radius * np.sqrt(beam.density / beam.modulus))  # of time, s
        sample = 1 / (config.rate * unit)
        rotor = servo / (2 * np.pi * config.servo.frequency * unit) ** 2
        mass = np.zeros((3, 3))
        mass[0, 0] = rotor + model.inertia
        mass[0, 1:] = mass[1:, 0] = model.coupled
        mass[1:, 1:] = model.mass
        drag = 2 * config.servo.damping * np.sqrt(servo * mass[0, 0])
        spring, damper = np.zeros((3, 3)), np.zeros((3, 3))
        spring[0, 0], damper[0, 0] = servo, drag
        spring[1:, 1:] = model.stiffness
        damper[1:, 1:] = 2 * beam.damping / model.modes[0] * model.stiffness
        inverse = np.linalg.inv(mass)
        flow = np.zeros((11, 11))  # six states, command, its rate, three forces
        flow[:3, 3:6] = sample * np.eye(3)
        flow[3:6, :3], flow[3:6, 3:6] = -sample * inverse @ spring, -sample * inverse @ damper
        flow[3:6, 6], flow[3:6, 7] = sample * inverse[:, 0] * servo, inverse[:, 0] * drag
        flow[6, 7] = 1.0
        flow[3:6, 8:] = sample * inverse
        carried = expm(flow)
        steps.append(carried[:6, :8])
        pushes.append(carried[:6, 8:])
    return np.array(steps)[which], np.array(pushes)[which]


RAW_TIERS = {"quasistatic": simulate_quasistatic, "dynamic": simulate_dynamic}
"""Mechanics models that give raw samples."""


class SimulationConfig(Settings):
    """A simulated session of the whisker head. The defaults fill in what Salman & Pearson 2016 leave open."""

    maze: MazeConfig = MazeConfig()
    """Maze."""
    path: PathConfig = PathConfig()
    """Route of the head."""
    motion: MotionConfig = MotionConfig()
    """Speed and variation of its motion."""
    kidnaps: KidnapConfig = KidnapConfig()
    """Kidnaps."""
    odometry: OdometryConfig = OdometryConfig()
    """Odometry errors."""
    whisking: WhiskingConfig = WhiskingConfig()
    """Drive of the whiskers."""
    mechanics: MechanicsConfig = MechanicsConfig()
    """Drives, whiskers and sensors."""
    stream: StreamConfig = StreamConfig()
    """Further mechanics of the raw fidelities."""
    calibration: CalibrationConfig = CalibrationConfig()
    """Free whisking before the session, for the raw fidelities."""
    later_maze: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Fraction of the session after which the maze is replaced by another one: a control in which no later
    place can be recognised."""
    seed: NonNegativeInt = 0
    """Seed of all random streams."""
    fidelity: Literal["auto", "kinematic", "quasistatic", "dynamic"] = "auto"
    """Model of the mechanics; `auto`: the cheapest one that gives the requested data."""
    raw: bool = False
    """Whether to give raw whisker samples, 2000 per second."""
    touch: Literal["head", "force"] = "head"
    """What feels: a whisker head, or, without one, the tool of the arm by pokes (`touch.pokes`)."""
    force: ContactForceConfig = ContactForceConfig()
    """Walls under pokes, and errors of the measured force."""


Tier = Literal["kinematic", "quasistatic", "dynamic"]


def choose_tier(config: SimulationConfig) -> tuple[Tier, str]:
    """The fidelity in the configuration, or for `auto` the cheapest one that gives the requested data; why.

    Raises:
        InputError: raw samples, or a baseline that acts on them, are requested, but the configured fidelity
            has none.
    """
    on = config.mechanics.baseline.is_on
    if config.fidelity == "kinematic" and (config.raw or on):
        found = "kinematic, which has no raw samples" + (" for mechanics.baseline to act on" if on else "")
        raise InputError("simulation.fidelity", found, "auto, quasistatic or dynamic")
    if config.fidelity != "auto":
        return config.fidelity, "set by simulation.fidelity"
    if on:
        return "quasistatic", "mechanics.baseline acts on raw samples"
    if config.raw:
        return "quasistatic", "raw samples are wanted, without bending modes and overshoot"
    return "kinematic", "only contact features are wanted"


class HeadSimulation(SimulatedSource):
    """A simulated session as a `Source`.

    Attributes:
        config, head_config: its settings. tier: the fidelity and its reason.
        scene: maze, path and walls. calibration: of the head, None in the kinematic fidelity.
        time: [N] s. start: [N] s, start of each whisk cycle.
        truth: [N, 3]. odometry: [N, 4]. kidnapped: [N] bool, whether a kidnap precedes the row.
        features: contact features [N, W], None in the raw fidelities.

    Raises:
        InputError: the configuration cannot be simulated; the error gives key and reason.
    """

    name = "simulation"

    def __init__(self, config: SimulationConfig, head_config: HeadConfig | None = None) -> None:
        head_config = head_config or HeadConfig()
        self.config, self.head_config = config, head_config
        self.tier, self.tier_reason = choose_tier(config)
        self.head = head = ur10_head(head_config)
        self.whiskers, self.view_shape = len(head.length), (*head.shape, 1)
        whisking, seed = config.whisking, config.seed
        self.rate_hz = whisking.rate
        self._setup = HeadSetup(head, config.stream, config.mechanics, whisking)
        check_amplitude(whisking, head)
        self.scene = make_scene(config.maze, config.path, config.motion, config.kidnaps, head, seed)
        check_steps("simulation", min(self.scene.duration, self.scene.path.duration) * whisking.rate)
        count = int(min(self.scene.duration, self.scene.path.duration) * whisking.rate)
        if count < 1:
            raise InputError("simulation.path", f"{self.scene.duration:.3g} s", "at least one whisk")
        self.start = np.arange(count) / whisking.rate
        self.time = self.start + MID_PROTRACTION / whisking.rate
        pose = poses_at(self.scene.path, self.time)
        self.truth = wrap_headings(pose)
        self.kidnapped = np.zeros(count, bool)
        rows = np.searchsorted(self.time, self.scene.jumps)
        self.kidnapped[rows[rows < count]] = True
        random = stream(seed, "odometry")
        self.odometry = simulate_odometry(config.odometry, self.time, pose, random, self.kidnapped)
        self._parts = [(self.scene.surroundings, slice(None))]  # walls, and the cycles to which they apply
        if config.later_maze is not None:
            change = int(config.later_maze * count)
            other = other_surroundings(self.scene, config.maze, head, seed)
            self._parts = [(self.scene.surroundings, slice(change)), (other, slice(change, None))]
        mechanics, rate = config.mechanics, config.stream.rate
        self._baseline = make_baseline(mechanics.baseline, mechanics.noise, rate, self.whiskers, seed)
        self.calibration, self.features = None, None
        if self.tier == "kinematic":
            parts = []
            for surroundings, cycles in self._parts:
                random = stream(seed, "sensor")  # noise of the whole session, independent of the maze
                columns = simulate_kinematic(self._setup, surroundings, self.scene.path, self.start, random)
                parts.append([column[cycles] for column in columns[2:]])
            features = (np.concatenate(columns) for columns in zip(*parts, strict=True))
            self.features = Whisk(NO_ODOMETRY, head.alive, *features)
        else:  # free whisking before the session
            whisks = int(np.ceil(config.calibration.min_duration * whisking.rate))
            random, model = stream(seed, "calibration"), RAW_TIERS[self.tier]
            record = simulate_free_cycles(model, self._setup, whisks, random, self._baseline)
            self.calibration = calibrate(config.calibration, record, where="simulation")

        plain = config.model_dump(mode="json", exclude={"maze": {"file"}})
        drawing = maze_text(self.scene.maze) if config.maze.file else ""
        settings = {"head": head_config.model_dump(mode="json"), "simulation": plain}
        self.digest = digest_of_document({**settings, "maze": drawing})
        self.info = SourceInfo(
            raw_whiskers=True,
            cell_size=POSE_CELL_SIZE,
            head=head_config,
            calibration=self.calibration,
            maze=maze_info(self.scene.maze, config.maze, seed),
            simulation=SimulationInfo(sha256=self.digest, seed=seed, tier=self.tier, why=self.tier_reason),
            provenance={"simulation": plain},
        )

    def _readings(self) -> Iterator[Whisk | Cycle]:
        if self.features is not None:
            features = zip(*self.features[2:], strict=True)
            yield from (Whisk(NO_ODOMETRY, self.head.alive, *row) for row in features)
            return
        assert self.calibration is not None
        random, baseline = stream(self.config.seed, "sensor"), deepcopy(self._baseline)
        model, threshold = RAW_TIERS[self.tier], self.calibration.threshold[:, 1]
        for walls, rows in self._parts:
            path, start = self.scene.path, self.start[rows]
            yield from simulate_cycles(model, self._setup, walls, path, start, random, threshold, baseline)
