"""Figure: an emulated arm drives to goals on a map made in replay, in closed loop and in virtual time.

Each goal is an experience drawn at random at most 1 m away along driven cells; a drive starts where the one
before ended. In further drives a wall is put across the way.

The arm is the emulator's, each move is checked and planned as for a real one, and the head gives contact
features (`robot.simulation.head.kinematic`): no sockets, processes or clocks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import networkx
import numpy as np

from evaluation.papers.figure import Figure
from evaluation.papers.maps.localisation_metrics import RIGHT, localisation_errors, true_places
from evaluation.papers.maps.operations import MapTask
from evaluation.papers.maps.pictures import (
    HEADER,
    Panel,
    PathPanel,
    count,
    draw_panels,
    median,
    spread,
    table_line,
)
from evaluation.papers.maps.scenarios import Recipe, open_world, ten_circuits
from evaluation.papers.maps.stored_maps import StoredMap
from evaluation.papers.tables.comparison import Record
from ratslam.live.goal_drive import DriveState, GoalDrive, GoalRoute
from ratslam.live.goal_planner import GoalPlanner, contact_map, felt_points
from ratslam.places.localiser import Localiser
from ratslam.runs.localise import localising
from ratslam.runs.saved_map import read_map
from ratslam.runs.settings.run_config import RunConfig
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
from robot.world.scene import HeadPath, Scene, make_scene, maze_seed
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
        self._remember()
        self.poses = [self._pose()]

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
            self.poses.append(self._pose())
        steps = np.array(self.poses[first:])
        steps[:, 2] = np.unwrap(steps[:, 2])
        path = HeadPath(np.linspace(begin, self.time, len(steps)), steps)
        features = simulate_kinematic(self._setup, self.surroundings, path, np.array([begin]), self._random)
        stamp = begin + MID_PROTRACTION * period
        odometry, truth = self._odometer.step(stamp, stamp)
        alive = self._setup.head.alive
        return Sample(stamp, Whisk(odometry, alive, *(column[0] for column in features)), truth)

    def whisks(self) -> Iterator[Sample]:
        """Whisk after whisk, without end."""
        while True:
            yield self.whisk()

    def _pose(self) -> np.ndarray:
        return self._config.arm.placing.pose_from_tcp(np.array(self._arm.state.tcp))[0]

    def _remember(self) -> None:
        state = self._arm.state
        self._odometer.add(np.array([self.time]), np.array([state.tcp]), np.array([state.speed]))


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
        state, reason: its end. whisks: their number. replans: new ways.
        error: true distance from the goal at the end, m, by the nearest step of the map
            (`evaluation.papers.maps.localisation_metrics`). reckoned: true distance, m, from where the noisy
            odometry puts the robot, summed from the start of the first drive on. by_arm: distance from the
            goal, m, at which exact motion from the end of the map to the goal's pose in the map would have
            ended. length: of the true path, m. shortest: way over driven cells, m. clearance: least distance
            of the head's axis from a wall on the way, m. clear: whether no whisker at rest was inside a wall.
        path: [n, 2] true, m. goal: [2] its true place, m.
    """

    state: DriveState
    reason: str
    goal: np.ndarray
    whisks: int
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


class _DrivenMap(NamedTuple):
    """A map with the world in which it was made.

    Attributes:
        config: of the session that made it. scene: of that session. stored: the map.
    """

    config: RunConfig
    scene: Scene
    stored: StoredMap

    @property
    def end(self) -> np.ndarray:
        """[3] true pose at its end."""
        return self.stored.arrays.truth[-1]


def driven_map(recipe: Recipe, stored: StoredMap) -> _DrivenMap:
    """The map of a session in a simulated maze."""
    plan = recipe.config.simulation
    assert plan is not None
    head = ur10_head(recipe.config.touch.head)
    scene = make_scene(plan.maze, plan.path, plan.motion, plan.kidnaps, head, plan.seed)
    return _DrivenMap(recipe.config, scene, stored)


class ClosedLoop:
    """The arm in its maze, its mapper and its drives, one after the other."""

    def __init__(self, made: _DrivenMap) -> None:
        self._made = made
        # The arm's session in the world of the simulated one, with its odometry errors.
        plan = made.config.simulation
        assert plan is not None
        self._live = LiveConfig.model_validate(
            {"plan": plan.model_dump(), "noise": plan.odometry.model_dump(), "seed": plan.seed}
        )
        # Localises a robot that stands where a map ended, in that map.
        saved = read_map(made.stored.path)
        self._slam = Slam(localising(saved.config, saved, "here"), saved.source)
        self._frontend = Frontend(made.config.touch)
        self._arm = VirtualArm(self._live, walls_of(made), made.end)
        self._cell = made.config.pose_cells.cell_size
        localiser = self._slam.map
        assert isinstance(localiser, Localiser)
        finished = localiser.place.map
        self._route: GoalRoute | None = None
        self._head = ur10_head(made.config.touch.head)
        self._contacts = contact_map(finished, made.config.touch.image, self._head)
        self.experiences: networkx.DiGraph = finished.graph()
        self._reckoned = made.end

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
        return true_places(self._made.stored.arrays.steps, self._pose_of(experience)[None, :2])[0]

    def _pose_of(self, experience: int) -> np.ndarray:
        node = self.experiences.nodes[experience]
        return np.array([node["x"], node["y"], node["heading"]])

    def put_walls(self, walls: Surroundings) -> None:
        """Replaces the walls."""
        self._arm.surroundings = walls

    def drive(self, experience: int) -> Drive:
        """Drives to an experience."""
        goal = GoalConfig(map=self._made.stored.path, to=(experience,))
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
            drive.state, drive.reason, place, whisks, drive.replans, error, reckoned, by_arm,
            float(np.hypot(*np.diff(path, axis=0).T).sum()),
            shortest_driven(self._made.scene.loop, path[0], place),
            clearance(walls.walls, path),
            not (walls.contact(poses).angle <= 0).any(),
            path,
        )  # fmt: skip

    def _errors(self, experience: int) -> tuple[float, float, float]:
        """True distance from an experience now; that of where odometry, and of where the exact motion of the
        arm would have led on the way to it, m."""
        steps, pose = self._made.stored.arrays.steps, self._pose_of(experience)
        error = localisation_errors(steps, pose[None], self.pose[None], RIGHT.distance)[0, 0]
        # Odometry would end where it takes its pose for that of the robot.
        reckoned = np.hypot(*(self._reckoned - self.pose)[:2])
        by_arm = compose(self._made.end, between(self._made.stored.arrays.trajectory[-1], pose))
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
        points = felt_points(seen, self._made.config.touch.image, self._head)
        return pose, points, sample.truth, self.pose


def _drive_blocked(loop: ClosedLoop, made: _DrivenMap, random: np.random.Generator) -> Drive:
    """A drive with a wall across the shortest way, half-way; it is taken away afterwards."""
    while True:
        goal = _draw_goal(loop, made, random)
        cells = cells_between(made.scene.loop, loop.pose[:2], loop.place_of(goal))
        if len(cells) >= 2:  # the wall is between centres that the way passes
            break
    middle = len(cells) // 2
    loop.put_walls(walls_of(made, (cells[middle - 1], cells[middle])))
    drive = loop.drive(goal)
    loop.put_walls(walls_of(made))
    return drive


def _draw_goal(loop: ClosedLoop, made: _DrivenMap, random: np.random.Generator) -> int:
    """An experience in the range of goals from the present true pose."""
    far = {
        place: shortest_driven(made.scene.loop, loop.pose[:2], loop.place_of(place))
        for place in loop.experiences
    }
    return int(random.choice([place for place, length in far.items() if NEAREST <= length <= FARTHEST]))


def walls_of(made: _DrivenMap, across: tuple[Cell, Cell] | None = None) -> Surroundings:
    """The walls of the maze, with one more between two neighbouring cells."""
    maze, plan = made.scene.maze, made.config.simulation
    assert plan is not None
    maze = Maze(maze.across.copy(), maze.along.copy())
    if across is not None:
        wall, place = maze.between_cells(*across)
        wall[place] = True
    heights = stream(maze_seed(plan.maze, plan.seed), "maze.heights")
    return Surroundings(wall_boxes(maze, heights, plan.maze.heights), made.scene.surroundings.head)


def _driven_graph(loop: Sequence[Cell], a: np.ndarray, b: np.ndarray) -> networkx.Graph:
    """Cells of the loop, joined in its order, with two points joined to both ends of the nearest link."""
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
    return graph


def shortest_driven(loop: Sequence[Cell], a: np.ndarray, b: np.ndarray) -> float:
    """Length of the shortest way between two points [2] over the cells of the loop, m: along the lines
    between their centres, which were driven."""
    return float(networkx.dijkstra_path_length(_driven_graph(loop, a, b), "from", "to", weight="length"))


def cells_between(loop: Sequence[Cell], a: np.ndarray, b: np.ndarray) -> list[Cell]:
    """The cells whose centres that way passes, in order."""
    way = networkx.dijkstra_path(_driven_graph(loop, a, b), "from", "to", weight="length")
    return way[1:-1]


def clearance(walls: Walls, path: np.ndarray) -> float:
    """Least distance of points of a path [N, 2 or 3] from the walls, in plan, m."""
    low, high = walls.box[:, :2], walls.box[:, 2:]
    place = path[:, None, :2]
    out = np.maximum(np.maximum(low - place, place - high), 0.0)
    return float(np.linalg.norm(out, axis=-1).min())


class GoalFigures(NamedTuple):
    """The drives on one map.

    Attributes:
        seed: of the maze. free, walled: drives without and with a wall put in the way. seconds: duration of
            all, by the arm. mapped: [n, 2] true path of the session that made the map, m. clearance: least
            distance of the head's axis from a wall on that path, m.
    """

    seed: int
    free: list[Drive]
    walled: list[Drive]
    seconds: float
    mapped: np.ndarray
    clearance: float

    def record(self) -> Record:
        """The figures of the drives on a map by name: numbers of drives, and lengths in m."""
        drives, done = self.free + self.walled, [drive for drive in self.free if drive.said_reached]
        lengths = sum(drive.length for drive in done), sum(drive.shortest for drive in done)
        return {
            "not_reached": sum(not drive.reached for drive in self.free),
            "wrongly_reached": sum(drive.said_reached and not drive.reached for drive in drives),
            "error": median(np.array([drive.error for drive in done])),
            "path_ratio": lengths[0] / lengths[1] if done else np.nan,
            "clearance": min(drive.clearance for drive in drives),
            "in_wall": sum(not drive.clear for drive in drives),
            "seconds": self.seconds,
            "wall_not_solved": sum(not _is_solved(drive) for drive in self.walled),
        }


def _measure_goals(task: MapTask) -> GoalFigures:
    """Drives on one map, each from where the last one ended."""
    recipe = ten_circuits(task.seed)
    made = driven_map(recipe, task.map_of(recipe))
    loop, random = ClosedLoop(made), stream(task.seed, "atlas.goals")
    mapped = made.stored.arrays.steps.truth[:, :2]
    return GoalFigures(
        seed=task.seed,
        free=[loop.drive(_draw_goal(loop, made, random)) for _ in range(PAIRS)],
        walled=[_drive_blocked(loop, made, random) for _ in range(WALLS)],
        seconds=loop.time,
        mapped=mapped,
        clearance=clearance(made.scene.surroundings.walls, mapped),
    )


def _is_solved(drive: Drive) -> bool:
    """Whether a drive with a wall in its way ended at its goal by a new way, or as blocked."""
    return drive.state is DriveState.BLOCKED or (drive.replans > 0 and drive.reached)


def _goal_lines(found: Sequence[GoalFigures]) -> Iterator[str]:
    """The lines of drives to goals."""
    yield HEADER
    free, walled = ([drive for one in found for drive in getattr(one, name)] for name in ("free", "walled"))
    n, done = len(free), [one for one in free if one.said_reached]
    yield table_line(
        f"reached (truly within {RIGHT.distance:g} m)",
        f"{n} of {n}",
        count([one.reached for one in free]),
        f"{count([one.reckoned <= RIGHT.distance for one in free])} by odometry alone, "
        f"{count([one.by_arm <= RIGHT.distance for one in free])} by the arm's exact motion alone",
    )
    yield table_line(
        "said to be reached at a wrong place",
        f"0 of {n + len(walled)}",
        count([one.said_reached and not one.reached for one in free + walled]),
        "-",
    )
    yield table_line(
        "error where reached, m, median (worst)",
        "-",
        spread([one.error for one in done], 3),
        f"{spread([one.reckoned for one in free], 3)} odometry, "
        f"{spread([one.by_arm for one in free], 3)} the arm's exact motion",
    )
    short = np.array([one.shortest for one in done])
    ratio = np.array([one.length for one in done]).sum() / max(short.sum(), 1e-9)
    yield table_line("path over the shortest driven way, all reached", f"{RATIO:g}", f"{ratio:.2f}", "-")
    least = min((one.clearance for one in free + walled), default=np.nan)
    mapping = min(one.clearance for one in found)
    yield table_line(
        "least distance of the head's axis from a wall, m",
        "-",
        f"{least:.3f}",
        f"{mapping:.3f} while mapping",
    )
    yield table_line(
        "no whisker at rest inside a wall on the way",
        f"{n + len(walled)} of {n + len(walled)}",
        count([one.clear for one in free + walled]),
        "-",
    )
    minutes = max(one.seconds for one in found) / 60
    yield table_line("duration of all drives, min", f"{MINUTES}", f"{minutes:.0f}", "-")
    yield table_line(
        "wall in the way: reached by a new way, or blocked",
        f"{len(walled)} of {len(walled)}",
        count([_is_solved(one) for one in walled]),
        f"{sum(one.state is DriveState.BLOCKED for one in free)} of {len(free)} blocked without a wall",
    )


def _draw_goals(found: Sequence[GoalFigures], png: Path) -> None:
    """Draws the drives of one maze, and how far from the goals all of them ended."""
    one, free = found[0], [drive for one in found for drive in one.free]
    gap = np.full((1, 2), np.nan)  # between the paths of two drives
    driven = np.concatenate([gap, *(np.concatenate([drive.path, gap]) for drive in one.free)])
    paths = PathPanel(
        "drives to goals, without a wall in the way",
        open_world(one.seed).maze,
        {"map": one.mapped, "drives": driven},
        goals=np.array([drive.goal for drive in one.free]).reshape(-1, 2),
    )
    dots = {
        "whiskers": [drive.error for drive in free if drive.said_reached],
        "odometry": [drive.reckoned for drive in free],
        "exact arm": [drive.by_arm for drive in free],
    }
    panel = Panel("distance from the goal at the end, m", "", dots=dots, limits={"right": RIGHT.distance})
    line = f"One map, then goal after goal: reached {count([drive.reached for drive in free])}."
    draw_panels(png, "Driving to goals on a map of touch", line, paths, panel)


GOALS = Figure("Drive to goals on a map", _measure_goals, _goal_lines, _draw_goals, 1)
