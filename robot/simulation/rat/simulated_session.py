"""A simulated session of a rat in a box with cues as a source, bit-identical for the same settings.

Its random walk has Ornstein-Uhlenbeck speed and turning and is drawn to the walls, after Raudies & Hasselmo
2012 and RatInABox (George et al. 2024), whose means and times the defaults are.
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from functools import partial
from math import atan2, cos, exp, pi, sin
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat

from robot.recordings.csv_file import read_csv
from robot.recordings.input_judge import heading_errors
from robot.recordings.nwb_file import ANIMAL, NwbConfig, read_nwb
from robot.recordings.sanity_checks import RowName
from robot.simulation.rat.box import BoxConfig, ViewConfig, panoramic_views
from robot.simulation.rat.phases import PhaseConfig, lay_out_phases
from robot.simulation.rat.rat_path import (
    MotionConfig,
    RatOdometryConfig,
    RatPath,
    check_path,
    measure_motion,
    sample_path,
)
from robot.sources.in_memory import (
    NO_ODOMETRY,
    SimulatedSource,
    check_steps,
    digest_of_document,
    wrap_headings,
)
from robot.sources.input_files import digest_of, raise_errors, require_file
from robot.sources.source import SourceInfo, Warn
from tactile.base.bounded import read_npz
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import between, wrap
from tactile.base.settings import KeyPath, Settings
from tactile.base.types import Observation, observation

CELLS, ROOM = 21, 1.05
"""The cell size that a session suggests is that of a torus of so many cells a side, larger than the longest
side of a box by this factor: each cell then has one place in the box."""
OUTSIDE = 0.1
"""Largest distance of a position from the box, m: a tracked head leans over a wall. It is put
at the wall."""
WALK_SECONDS = 600.0
"""Duration of a random walk of unspecified duration, s."""

STEER = 8.0
"""Rate at which the rat turns from a wall that it touches, 1/s, as a share of the angle left."""

PACKAGED = {path.stem: path for path in sorted((Path(__file__).resolve().parent / "data").glob("*.npz"))}
"""Files of the packaged paths by name: `sargolini` (600 s, 1 x 1 m), `tanni` (1200 s, 3.5 x 2.5 m)."""


class PathFileConfig(MotionConfig):
    """A recorded path."""

    file: Path = Path("sargolini")
    """`sargolini` (600 s in 1 x 1 m), `tanni` (1200 s in 3.5 x 2.5 m), or a file: `.csv` with columns t, x, y
    and, if it was measured, heading; `.npz` with t [N] and pos [N, 2]; s, m and rad, with integers in ms and
    mm; or `.nwb`. The origin is a corner of the box."""
    nwb: NwbConfig = NwbConfig()
    """Series of an `.nwb` file; a measured head direction is the heading."""
    unit: PositiveFloat = 1.0
    """Length of the unit of positions, m: 0.01 for cm."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Added to the positions, m."""
    skip: NonNegativeFloat = 0.0
    """Time to leave out at the beginning, s."""

    def resolved(self, folder: Path, here: Container[KeyPath] = (), at: KeyPath = ()) -> Self:
        """See `Settings.resolved`; the name of a packaged path stays."""
        return self if str(self.file) in PACKAGED else super().resolved(folder, here, at)


def read_path(config: PathFileConfig, warn: Warn = None) -> RatPath:
    """The path of a file, checked, with the settings for unit, shift and skipped time applied.

    Args:
        warn: called with one sentence for each fault of the tracker in an NWB file.

    Raises:
        InputError: the file cannot be read, or holds no path of a rat (`check_path`), with its row.
    """
    file = PACKAGED.get(str(config.file), config.file)
    require_file(file)
    place: RowName
    if file.suffix == ".csv":
        table = read_csv(file)
        measured = ["heading"] if "heading" in table.names else []
        raise_errors(table.absences([(name, "") for name in ("t", "x", "y")]))
        raise_errors(table.judge(["t", "x", "y", *measured])[1])
        position = np.column_stack([table.column(name, "length") for name in ("x", "y")])
        time, heading = table.column("t", "time"), table.column("heading", "angle") if measured else None
        if heading is not None:
            raise_errors(heading_errors(heading, time, "the heading", str(file), ANIMAL))
        path, place = RatPath(time, position, heading), table.place
    elif file.suffix == ".nwb":
        session, place = read_nwb(file, config.nwb, warn), partial("{}, known sample {}".format, file)
        known = np.isfinite(session.position).all(axis=1)
        known &= True if session.heading is None else np.isfinite(session.heading)
        heading = None if session.heading is None else session.heading[known]
        path = RatPath(session.time[known], session.position[known], heading)
    else:
        path = read_npz(file, ("t", "pos"), _parse_arrays, "a path: arrays t [N] and pos [N, 2]")
        place = partial("{}:{}".format, file)
    path = path._replace(position=path.position * config.unit + np.asarray(config.shift))
    check_path(path, config, place)
    kept = path.time >= path.time[0] + config.skip
    if kept.sum() < 2:
        found = f"{config.skip:g} s to skip"
        expected = f"less than the duration of {file.name}, {path.time[-1] - path.time[0]:.4g} s"
        raise InputError("rat_simulation.path.skip", found, expected)
    heading = None if path.heading is None else path.heading[kept]
    return RatPath(path.time[kept], path.position[kept], heading)


def _parse_arrays(time: np.ndarray, position: np.ndarray) -> RatPath:
    """The path of arrays t [N] and pos [N, 2] in s and m; integers are thousandths."""
    if time.ndim != 1 or position.shape != (len(time), 2):
        raise ValueError(f"t {list(time.shape)} and pos {list(position.shape)}")
    time, position = (
        values / 1000.0 if np.issubdtype(values.dtype, np.integer) else values.astype(np.float64)
        for values in (time, position)
    )
    return RatPath(time, position)


class RandomWalkConfig(Settings):
    """A random walk."""

    speed: PositiveFloat = 0.16
    """Mean speed, m/s."""
    speed_sd: PositiveFloat = 0.084
    """Standard deviation of the speed, m/s; 0.52 of the mean resembles a Rayleigh distribution."""
    speed_time: PositiveFloat = 0.7
    """Correlation time of the speed, s."""
    turn_sd: NonNegativeFloat = 2.1
    """Standard deviation of the turn rate, rad/s."""
    turn_time: PositiveFloat = 0.08
    """Correlation time of the turn rate, s."""
    wall_distance: NonNegativeFloat = 0.1
    """Distance from which a wall acts on the direction, m."""
    thigmotaxis: Annotated[float, Field(ge=0, le=1)] = 0.5
    """How far the rat follows walls: 1: it turns along a wall, 0: straight away from it."""


def walk_randomly(
    config: RandomWalkConfig, size: tuple[float, float], seconds: float, rate_hz: float, seed: int
) -> RatPath:
    """A walk in a box of a size (m, m) with a corner at the origin, from its middle.

    Speeds have a gamma distribution of the given mean and standard deviation: the quantiles of a normal
    Ornstein-Uhlenbeck process. A longer walk of the same seed begins with the shorter one.
    """
    from scipy.stats import gamma, norm  # slow to import

    count = int(np.ceil(seconds * rate_hz)) + 1
    draws = stream(seed, "rat walk").standard_normal((count, 2))
    z = _ornstein_uhlenbeck(draws, np.array([config.speed_time, config.turn_time]), 1 / rate_hz)
    spread = config.speed_sd**2 / config.speed
    speed = gamma.ppf(norm.cdf(z[:, 0]), config.speed / spread, scale=spread)
    turn = config.turn_sd * z[:, 1]
    position = _walk(config, size, speed / rate_hz, turn / rate_hz, 1 / rate_hz)
    return RatPath(np.arange(count) / rate_hz, position)


def _ornstein_uhlenbeck(draws: np.ndarray, time: np.ndarray, step: float) -> np.ndarray:
    """[N, D] stationary processes of variance 1 from normal draws [N, D], for correlation times [D], s."""
    keep = np.exp(-step / time)
    fresh = np.sqrt(1 - keep**2)
    values = np.empty_like(draws)
    values[0] = draws[0]
    for row in range(1, len(draws)):
        values[row] = keep * values[row - 1] + fresh * draws[row]
    return values


def _walk(
    config: RandomWalkConfig, size: tuple[float, float], steps: np.ndarray, turns: np.ndarray, dt: float
) -> np.ndarray:
    """[N, 2] positions after steps [N], m, and turns [N], rad; walls reflect."""
    (width, height), steer = size, 1 - exp(-STEER * dt)
    x, y, heading = width / 2, height / 2, 0.0
    position = np.empty((len(steps), 2))
    for row, (step, turn) in enumerate(zip(steps.tolist(), turns.tolist(), strict=True)):
        position[row] = x, y
        heading += turn
        for distance, outward in ((x, pi), (width - x, 0.0), (y, -pi / 2), (height - y, pi / 2)):
            heading += steer * _turn_at_wall(config, distance, heading - outward)
        x, mirrored = _reflect(x + step * cos(heading), width)
        if mirrored:
            heading = pi - heading
        y, mirrored = _reflect(y + step * sin(heading), height)
        if mirrored:
            heading = -heading
    return position


def _turn_at_wall(config: RandomWalkConfig, distance: float, heading: float) -> float:
    """Turn that a wall asks for, rad: from a heading relative to its outward normal to one along it, or away
    from it; 0 for a rat that is farther than `wall_distance` or already leaves."""
    if distance >= config.wall_distance:
        return 0.0
    heading = atan2(sin(heading), cos(heading))
    wanted = pi / 2 + (1 - config.thigmotaxis) * pi / 2
    if abs(heading) >= wanted:
        return 0.0
    turn = wanted - abs(heading)
    return (1 - distance / config.wall_distance) * (turn if heading >= 0 else -turn)


def _reflect(value: float, size: float) -> tuple[float, bool]:
    """A coordinate mirrored at the walls at 0 and `size`, and whether it was."""
    if 0 <= value <= size:
        return value, False
    folded = value % (2 * size)
    return min(folded, 2 * size - folded), True


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


class RatSimulation(SimulatedSource):
    """A session of a rat as a `Source` of `Observation`s.

    The odometry of a row is the motion along the path as the box is at that row; a jump, by a kidnap or
    another box, is in the truth alone.

    Args:
        path: positions in the box, its south-west corner at the origin, instead of those that the
            configuration names: for example of an agent of another simulator. They are not smoothed.
        warn: see `read_path`.

    Attributes:
        config: its settings. timeline: [N] phases. time: [N] s from 0. truth: [N, 3]. odometry: [N, 4].

    Raises:
        InputError: the path or a phase cannot be used; the error gives file and row, or the key.
    """

    name = "rat_simulation"
    whiskers = 0

    def __init__(self, config: RatSimulationConfig, path: RatPath | None = None, warn: Warn = None) -> None:
        self.config, self.rate_hz = config, config.rate_hz
        self.view_shape = (1, config.views.columns, 1)
        pose = _poses_of(config, path, warn)
        rows = len(pose)
        if config.seconds is not None:
            rows = max(round(config.seconds * config.rate_hz), 1)
            if rows > len(pose):
                there = f"at most the {len(pose) / config.rate_hz:g} s of the path"
                raise InputError("rat_simulation.seconds", f"{config.seconds:g} s", there)
        self.timeline = lay_out_phases(config.phases, config.box, pose[:, :2], rows, config.rate_hz)
        self.time = np.arange(rows) / config.rate_hz
        source, scale = self.timeline.source, self.timeline.scale
        here = _scale_poses(pose[source], scale)
        before = _scale_poses(pose[np.maximum(source - 1, 0)], scale)
        self.truth = wrap_headings(here)
        step = np.full(rows, 1 / config.rate_hz)
        motion = np.column_stack([between(before, here)[:, :2], here[:, 2] - before[:, 2], step])
        motion[0] = 0.0
        self.odometry = measure_motion(config.odometry, motion, config.seed)
        # The timeline has the numbers of these boxes.
        self._boxes = [config.box, *(phase.box for phase in config.phases if phase.box is not None)]
        sizes = [np.array([box.width, box.height]) for box in self._boxes]
        sizes += [np.multiply(sizes[0], phase.stretch) for phase in config.phases if phase.stretch]
        width, height = np.max(sizes, axis=0).tolist()
        settings = config.model_dump(mode="json", exclude={"path": {"file"}})
        self.info = SourceInfo(
            cell_size=round(ROOM * max(width, height) / CELLS, 6),
            box=(0.0, 0.0, width, height),
            provenance={"rat_simulation": settings},
        )
        document = digest_of_document(self.info.provenance)
        self.digest = digest_of([document.encode(), np.ascontiguousarray(pose).tobytes()])

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


def _scale_poses(pose: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """[N, 3] poses [N, 3] in a box whose width and height have changed by factors [N, 2]; headings remain the
    direction of motion and are not wrapped."""
    heading = pose[:, 2]
    turned = np.arctan2(scale[:, 1] * np.sin(heading), scale[:, 0] * np.cos(heading))
    return np.column_stack([pose[:, :2] * scale, heading + wrap(turned - heading)])


def _poses_of(config: RatSimulationConfig, path: RatPath | None, warn: Warn) -> np.ndarray:
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
        where, path, smoothing = str(config.path.file), read_path(config.path, warn), config.path.smoothing
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
