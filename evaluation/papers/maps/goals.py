"""Figure: an emulated arm drives to goals on a map made in replay, in closed loop and in virtual time.

Each goal is an experience drawn at random at most 1 m away along driven cells; a drive starts where the one
before ended. In further drives a wall is put across the way.

The arm is the emulator's, each move is checked and planned as for a real one, and the head gives contact
features (`robot.simulation.head.kinematic`): no sockets, processes or clocks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import networkx
import numpy as np

from evaluation.papers.figure import Figure
from evaluation.papers.maps.localisation_metrics import RIGHT
from evaluation.papers.maps.operations import MapTask
from evaluation.papers.maps.pictures import PathPanel, draw_panels, median, spread, table
from evaluation.papers.maps.scenarios import Recipe, ten_circuits
from evaluation.papers.maps.stored_maps import StoredMap
from evaluation.papers.tables.comparison import Measured
from evaluation.papers.tables.markdown import count
from ratslam.live.goal_drive import DriveState, GoalDrive, GoalRoute
from ratslam.live.goal_planner import GoalPlanner, contact_map, felt_points
from ratslam.places.localiser import Localiser
from ratslam.runs.localise import localising
from ratslam.runs.saved_map import read_map
from ratslam.runs.slam import Slam
from robot.drivers.outcome import Fault
from robot.drivers.ur10.safety import plan_move
from robot.emulators.ur10.emulated_arm import EmulatedArm, MoveL
from robot.emulators.ur10.emulator_config import UrEmulatorConfig
from robot.live.live_config import GoalConfig, LiveConfig
from robot.live.live_rig import ArmOdometry
from robot.simulation.head.kinematic import HeadSetup, simulate_kinematic
from robot.sources.source import Sample
from robot.world.maze import Cell, Maze, cell_centre, wall_boxes
from robot.world.scene import HeadPath, make_scene, maze_seed
from robot.world.walls import Surroundings, Walls
from tactile.base.random_streams import stream
from tactile.base.se2 import between, compose, segment_distances
from tactile.base.types import Whisk
from tactile.frontend import Frontend
from tactile.whisker_geometry import ur10_head
from tactile.whisking import MID_PROTRACTION


class VirtualArm:
    """Arm and head; it has the methods of `robot.drivers.ur10.arm.Arm` that routes call.

    Args:
        start: [3] pose of the head in the arm's map (m, m, rad). surroundings: walls; they may be replaced.

    Attributes:
        surroundings: walls. time: s. poses: [3] of the head after each control step so far.
    """

    fault: Fault | None = None

    def __init__(self, config: LiveConfig, surroundings: Surroundings, start: np.ndarray) -> None:
        self.surroundings, self.time = surroundings, 0.0
        self._config, self._dt = config, 1.0 / config.arm.hz
        tcp = tuple(map(float, config.arm.placing.tcp_from_pose(start)))
        self._arm = EmulatedArm(UrEmulatorConfig(hz=config.arm.hz, start=tcp))  # type: ignore[arg-type]
        plan = config.plan
        self._setup = HeadSetup(surroundings.head, plan.stream, plan.mechanics, plan.whisking)
        self._random = stream(plan.seed, "live.sensor")
        self._odometer = ArmOdometry(config)
        self.poses: list[np.ndarray] = []
        self._remember()

    def move(self, tcp: np.ndarray, speed: float | None = None) -> None:
        """Starts a straight move; it replaces the present one.

        Raises:
            robot.drivers.ur10.safety.TargetRefused: the target is rejected.
        """
        move = plan_move(self._config.arm, tcp, np.array(self._arm.state.tcp), speed)
        goal = tuple(map(float, move.target))
        self._arm.order([MoveL(goal, move.speed, self._config.arm.acceleration)])  # type: ignore[arg-type]

    def arrived(self) -> bool:
        """Whether the arm has no unfinished move."""
        return not self._arm.busy

    def halt(self) -> None:
        """Stops the arm."""
        self._arm.halt(self._config.arm.deceleration)

    def whisk(self) -> Sample:
        """The next whisk, with the motion of the arm meanwhile; the odometry has the configured errors."""
        period = 1 / self._config.plan.whisking.rate
        begin, first = self.time, len(self.poses) - 1
        for _ in range(round(period / self._dt)):
            self._arm.step(self._dt)
            self.time += self._dt
            self._remember()
        steps = np.array(self.poses[first:])
        steps[:, 2] = np.unwrap(steps[:, 2])
        path = HeadPath(np.linspace(begin, self.time, len(steps)), steps)
        features = simulate_kinematic(self._setup, self.surroundings, path, np.array([begin]), self._random)
        stamp = begin + MID_PROTRACTION * period
        odometry, truth = self._odometer.step(stamp, stamp)
        columns = (column[0] for column in features[2:])
        return Sample(stamp, Whisk(odometry, features.alive, *columns), truth)

    def whisks(self) -> Iterator[Sample]:
        """Whisk after whisk, without end."""
        while True:
            yield self.whisk()

    def _remember(self) -> None:
        state = self._arm.state
        self._odometer.add(np.array([self.time]), np.array([state.tcp]), np.array([state.speed]))
        self.poses.append(self._config.arm.placing.pose_from_tcp(np.array(state.tcp))[0])


PAIRS, WALLS = 20, 5
"""Number of drives without and with a wall put in the way."""
RATIO, MINUTES = 1.15, 60
"""Goals: length of the paths over that of the shortest ways; duration of all drives."""

NEAREST, FARTHEST = 0.18, 1.0
"""Range of a goal's distance along driven cells, m: from one cell side."""
LONGEST = 400
"""Whisks after which a drive is given up."""


class Drive(NamedTuple):
    """A drive to one goal.

    Attributes:
        state: its end. goal: [2] its true place, m. replans: number of new ways. error: true distance from
            the goal at the end, m, by the nearest step of the map (`MapSteps`). reckoned: true distance, m,
            from where the noisy odometry puts the robot, summed from the start of the first drive on. by_arm:
            distance from the goal, m, at which exact motion from the end of the map to the goal's pose in the
            map would have ended. length: of the true path, m. shortest: way over driven cells, m. clearance:
            least distance of the head's axis from a wall on the way, m. clear: whether no whisker at rest was
            inside a wall. path: [n, 2] true, m.
    """

    state: DriveState
    goal: np.ndarray
    replans: int
    error: float
    reckoned: float
    by_arm: float
    length: float
    shortest: float
    clearance: float
    clear: bool
    path: np.ndarray

    @property
    def reached(self) -> bool:
        """Whether it ended at its goal, by the truth too."""
        return self.said_reached and self.error <= RIGHT.distance

    @property
    def said_reached(self) -> bool:
        """Whether it said that it ended there."""
        return self.state is DriveState.REACHED

    @property
    def solved(self) -> bool:
        """Of a drive with a wall in its way: whether it ended at its goal by a new way, or as blocked."""
        return self.state is DriveState.BLOCKED or (self.replans > 0 and self.reached)


class ClosedLoop:
    """The arm in the maze of a simulated session and its map, its mapper and its drives, one after the other.

    Attributes:
        scene: of the session. experiences: of the map.
    """

    def __init__(self, recipe: Recipe, stored: StoredMap) -> None:
        config, plan, self._stored = recipe.config, recipe.config.simulation, stored
        assert plan is not None
        self._head = ur10_head(config.touch.head)
        self.scene = make_scene(plan.maze, plan.path, plan.motion, plan.kidnaps, self._head, plan.seed)
        self._plan = plan
        # The arm's session in the world of the simulated one, with its odometry errors.
        self._live = LiveConfig.model_validate(
            {"plan": plan.model_dump(), "noise": plan.odometry.model_dump(), "seed": plan.seed}
        )
        # Localises a robot that stands where a map ended, in that map.
        saved = read_map(stored.path)
        self._slam = Slam(localising(saved.config, saved, "here"), saved.source)
        self._frontend = Frontend(config.touch)
        self._reckoned = self._end = stored.arrays.truth[-1]
        self._arm = VirtualArm(self._live, self.walls(), self._end)
        self._cell = config.pose_cells.cell_size
        localiser = self._slam.map
        assert isinstance(localiser, Localiser)
        finished = localiser.place.map
        self._route: GoalRoute | None = None
        self._contacts = contact_map(finished, config.touch)
        self.experiences: networkx.DiGraph = finished.graph()

    @property
    def time(self) -> float:
        """Duration of all drives so far, s."""
        return self._arm.time

    @property
    def pose(self) -> np.ndarray:
        """[3] true pose."""
        return self._arm.poses[-1]

    def place_of(self, experience: int) -> np.ndarray:
        """[2] where an experience is in the world, m, by the step of the map that is nearest to it."""
        return self._stored.arrays.steps.true_places(self._pose_of(experience)[None, :2])[0]

    def _pose_of(self, experience: int) -> np.ndarray:
        node = self.experiences.nodes[experience]
        return np.array([node["x"], node["y"], node["heading"]])

    def walls(self, across: Sequence[Cell] = ()) -> Surroundings:
        """The walls of the maze, with one more between two neighbouring cells."""
        maze = Maze(self.scene.maze.across.copy(), self.scene.maze.along.copy())
        if across:
            wall, place = maze.between_cells(*across)
            wall[place] = True
        heights = stream(maze_seed(self._plan.maze, self._plan.seed), "maze.heights")
        return Surroundings(wall_boxes(maze, heights, self._plan.maze.heights), self._head)

    def way_to(self, experience: int) -> tuple[float, list[Cell]]:
        """The shortest driven way to an experience from the present true pose; see `shortest_driven`."""
        return shortest_driven(self.scene.loop, self.pose[:2], self.place_of(experience))

    def draw_goal(self, random: np.random.Generator) -> int:
        """An experience in the range of goals from the present true pose."""
        far = {place: self.way_to(place)[0] for place in self.experiences}
        return int(random.choice([place for place, length in far.items() if NEAREST <= length <= FARTHEST]))

    def drive_blocked(self, random: np.random.Generator) -> Drive:
        """A drive with a wall across the shortest way, half-way; it is taken away afterwards."""
        cells: list[Cell] = []
        while len(cells) < 2:  # the wall is between centres that the way passes
            goal = self.draw_goal(random)
            _, cells = self.way_to(goal)
        middle = len(cells) // 2
        self._arm.surroundings = self.walls(cells[middle - 1 : middle + 1])
        drive = self.drive(goal)
        self._arm.surroundings = self.walls()
        return drive

    def drive(self, experience: int) -> Drive:
        """Drives to an experience."""
        goal = GoalConfig(map=self._stored.path, to=(experience,))
        planner = GoalPlanner(self.experiences, goal, self._live.plan.motion)
        drive, first, whisks = GoalDrive(goal, planner, self._cell), len(self._arm.poses) - 1, 0
        if self._route is None:
            self._route = GoalRoute(drive, self._live, self._contacts)
        self._route.drive = drive
        while whisks < LONGEST and not self._route.advance(self._arm):
            self._route.see(*self._sight())
            whisks += 1
        poses, place = np.array(self._arm.poses[first:]), self.place_of(experience)
        path, walls = poses[:, :2], self._arm.surroundings
        error, reckoned, by_arm = self._errors(experience)
        return Drive(
            drive.state, place, drive.replans, error, reckoned, by_arm,
            float(np.hypot(*np.diff(path, axis=0).T).sum()),
            shortest_driven(self.scene.loop, path[0], place)[0],
            _clearance(walls.walls, path),
            not (walls.contact(poses).angle <= 0).any(),
            path,
        )  # fmt: skip

    def _errors(self, experience: int) -> tuple[float, float, float]:
        """True distance from an experience now; that of where odometry, and of where the exact motion of the
        arm would have led on the way to it, m."""
        arrays, pose = self._stored.arrays, self._pose_of(experience)
        error = arrays.steps.errors(pose[None], self.pose[None], RIGHT.distance)[0, 0]
        # Odometry would end where it takes its pose for that of the robot.
        reckoned = np.hypot(*(self._reckoned - self.pose)[:2])
        by_arm = compose(self._end, between(arrays.trajectory[-1], pose))
        return float(error), float(reckoned), float(np.hypot(*(by_arm[:2] - self.place_of(experience))))

    def _sight(self) -> tuple[np.ndarray | None, np.ndarray, np.ndarray, np.ndarray]:
        """Estimate and contacts of the next whisk, and the arm's poses in it and after it."""
        sample = self._arm.whisk()
        seen = self._frontend.observe(sample.reading)
        estimate = self._slam.step(seen)
        assert sample.truth is not None
        motion = sample.reading.odometry
        self._reckoned = compose(self._reckoned, np.array([motion.dx, motion.dy, motion.dtheta]))
        pose = None if estimate.lost else estimate.pose
        points = felt_points(seen, self._frontend.config)
        return pose, points, sample.truth, self.pose


def shortest_driven(loop: Sequence[Cell], a: np.ndarray, b: np.ndarray) -> tuple[float, list[Cell]]:
    """The shortest way between two points [2] over the cells of the loop, along the lines between their
    centres, which were driven: its length, m, and the cells whose centres it passes, in order."""
    links = list(zip(loop, [*loop[1:], loop[0]], strict=True))
    ends = np.array([[cell_centre(cell), cell_centre(other)] for cell, other in links])
    graph: networkx.Graph = networkx.Graph()
    for (cell, other), (p, q) in zip(links, ends, strict=True):
        graph.add_edge(cell, other, length=float(np.hypot(*(p - q))))
    nearest = [int(np.argmin(segment_distances(point, ends[:, 0], ends[:, 1]))) for point in (a, b)]
    for name, point, link in zip(("from", "to"), (a, b), nearest, strict=True):
        for cell in links[link]:
            graph.add_edge(name, cell, length=float(np.hypot(*(cell_centre(cell) - point))))
    if nearest[0] == nearest[1]:
        graph.add_edge("from", "to", length=float(np.hypot(*(a - b))))
    found: Any = networkx.single_source_dijkstra(graph, "from", "to", weight="length")
    length, way = found
    return float(length), way[1:-1]


def _clearance(walls: Walls, path: np.ndarray) -> float:
    """Least distance of points of a path [N, 2 or 3] from the walls, in plan, m."""
    low, high = walls.box[:, :2], walls.box[:, 2:]
    place = path[:, None, :2]
    out = np.maximum(np.maximum(low - place, place - high), 0.0)
    return float(np.linalg.norm(out, axis=-1).min())


def _measure_goals(task: MapTask) -> Measured:
    """Drives on one map, each from where the last one ended."""
    recipe = ten_circuits(task.seed)
    stored = task.map_of(recipe)
    loop, random = ClosedLoop(recipe, stored), stream(task.seed, "atlas.goals")
    free = [loop.drive(loop.draw_goal(random)) for _ in range(PAIRS)]
    walled = [loop.drive_blocked(random) for _ in range(WALLS)]
    mapped = stored.arrays.steps.truth[:, :2]
    least = _clearance(loop.scene.surroundings.walls, mapped)
    return goal_figures(free, walled, loop.time, mapped, least, loop.scene.maze)


def goal_figures(
    free: list[Drive], walled: list[Drive], seconds: float, mapped: np.ndarray, least: float, maze: Maze
) -> Measured:
    """The figures of the drives on one map: numbers of drives, and lengths in m.

    Args:
        free, walled: drives without and with a wall put in the way. seconds: duration of all, by the arm.
            mapped: [n, 2] true path of the session that made the map, m. least: its least distance from a
            wall, m.
    """
    drives, done = free + walled, [drive for drive in free if drive.said_reached]
    lengths = sum(drive.length for drive in done), sum(drive.shortest for drive in done)
    figures = {
        "not_reached": sum(not drive.reached for drive in free),
        "wrongly_reached": sum(drive.said_reached and not drive.reached for drive in drives),
        "error": median(np.array([drive.error for drive in done])),
        "path_ratio": lengths[0] / lengths[1] if done else np.nan,
        "clearance": min(drive.clearance for drive in drives),
        "in_wall": sum(not drive.clear for drive in drives),
        "seconds": seconds,
        "wall_not_solved": sum(not drive.solved for drive in walled),
    }
    gap = np.full((1, 2), np.nan)  # between the paths of two drives
    driven = np.concatenate([gap, *(np.concatenate([drive.path, gap]) for drive in free)])
    goals, ways = np.array([drive.goal for drive in free]).reshape(-1, 2), {"map": mapped, "drives": driven}
    paths = PathPanel("drives to goals, without a wall in the way", maze, ways, [("goals", goals)])
    return Measured(figures, {"free": free, "walled": walled, "mapping": least, "paths": paths})


def _goal_lines(found: Sequence[Measured]) -> list[str]:
    free, walled = ([drive for one in found for drive in one.shown[name]] for name in ("free", "walled"))
    n, drives, done = len(free), free + walled, [one for one in free if one.said_reached]
    driven, shortest = np.array([(one.length, one.shortest) for one in done]).reshape(-1, 2).T
    ratio = driven.sum() / max(shortest.sum(), 1e-9)
    return table(
        f"reached (truly within {RIGHT.distance:g} m) | {n} of {n} | {count([one.reached for one in free])}"
        f" | {count([one.reckoned <= RIGHT.distance for one in free])} by odometry alone,"
        f" {count([one.by_arm <= RIGHT.distance for one in free])} by the arm's exact motion alone",
        f"said to be reached at a wrong place | 0 of {len(drives)} |"
        f" {count([one.said_reached and (not one.reached) for one in drives])} | -",
        f"error where reached, m, median (worst) | - | {spread([one.error for one in done], 3)} |"
        f" {spread([one.reckoned for one in free], 3)} odometry, {spread([one.by_arm for one in free], 3)}"
        " the arm's exact motion",
        f"path over the shortest driven way, all reached | {RATIO:g} | {ratio:.2f} | -",
        "least distance of the head's axis from a wall, m | - |"
        f" {min(one.clearance for one in drives):.3f} | {min(one.shown['mapping'] for one in found):.3f}"
        " while mapping",
        f"no whisker at rest inside a wall on the way | {len(drives)} of {len(drives)} |"
        f" {count([one.clear for one in drives])} | -",
        f"duration of all drives, min | {MINUTES} | {max(one.record['seconds'] for one in found) / 60:.0f}"
        " | -",
        f"wall in the way: reached by a new way, or blocked | {len(walled)} of {len(walled)} |"
        f" {count([one.solved for one in walled])} |"
        f" {sum(one.state is DriveState.BLOCKED for one in free)} of {n} blocked without a wall",
    )


def _draw_goals(found: Sequence[Measured], png: Path) -> None:
    """Draws the drives of one maze, and how far from the goals all of them ended."""
    free = [drive for one in found for drive in one.shown["free"]]
    title = "Driving to goals on a map of touch"
    line = f"One map, then goal after goal: reached {count([drive.reached for drive in free])}."
    names, limits = ("distance from the goal at the end, m", ""), {"right": RIGHT.distance}
    dots = {
        "whiskers": [drive.error for drive in free if drive.said_reached],
        "odometry": [drive.reckoned for drive in free],
        "exact arm": [drive.by_arm for drive in free],
    }
    draw_panels(png, title, line, names, dots=dots, limits=limits, paths=found[0].shown["paths"])


GOALS = Figure("Drive to goals on a map", _measure_goals, _goal_lines, _draw_goals, 1)
