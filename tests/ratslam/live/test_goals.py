"""Drives to goals: legs, states, contacts, missing estimates; of an arm in virtual time, and live."""

import json
import shutil
from itertools import chain, pairwise, repeat
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import networkx
import numpy as np
import pytest

from evaluation.metrics.trajectory import write_tum
from evaluation.papers.maps.goals import VirtualArm
from evaluation.papers.maps.scenarios import Recipe
from evaluation.papers.maps.stored_maps import store_map
from evaluation.papers.tables.touch_table import MAIN, touch_config
from ratslam.live.arm_session import plan_goals
from ratslam.live.goal_drive import MOVED, SCATTER, DriveState, GoalDrive, GoalRoute, leg_heading, legs_of
from ratslam.live.goal_planner import RECENT, GoalPlanner, felt_points
from ratslam.places.contact_alignment import RememberedContacts
from ratslam.places.route import NoWay
from ratslam.runs.settings.run_config import load_config
from robot.drivers.ur10.safety import TargetRefused
from robot.live.arm_route import plan_path
from robot.live.live_config import GoalConfig, LiveConfig
from robot.world.maze import Maze, cell_centre, change_walls, random_maze, wall_boxes
from robot.world.scene import MotionConfig
from robot.world.walls import Surroundings
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import between, compose, line_distances
from tactile.frontend import Frontend, TouchConfig
from tactile.whisker_geometry import ur10_head
from tests.ratslam.live.test_complete_session import PATIENT, complete_session
from tests.ratslam.runs.test_saved_map import FILE

WAY = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.2, np.pi / 2]])
FREE, HOME, BLOCKING = np.zeros((0, 2)), np.zeros(3), NoWay("no other way")
THERE = np.array([0.5, 0.0, 0.0])
CONFIG = GoalConfig(map=Path("map.npz"), to=(0, 1), patience=3, replans=2, coast=0.1)


NO_CONTACTS = RememberedContacts(np.zeros((0, 3)), [], RECENT)


def known(x: float) -> SimpleNamespace:
    """A map with which contacts agree near one pose."""
    return SimpleNamespace(
        align=lambda pose, points: pose, agrees=lambda pose, points: abs(pose[0] - x) < 0.05
    )


def drive_on(*ways: np.ndarray | NoWay | None) -> tuple[GoalDrive, Mock]:
    """A drive, and its planner, which gives these ways one after the other."""
    planner, given = Mock(), ways or (WAY,)
    planner.plan.side_effect = chain(given, repeat(given[-1]))
    return GoalDrive(CONFIG, planner, 0.05), planner.plan


def route_on(*ways: np.ndarray | NoWay | None, contacts=NO_CONTACTS) -> GoalRoute:
    return GoalRoute(drive_on(*ways)[0], LiveConfig(), contacts)


def at(x, y, heading=0.0, points=FREE) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x, y, heading]), np.asarray(points, float)


def test_a_corner_has_two_legs_that_pass_all_poses_and_one_place_is_a_leg_without_length():
    scatter = 0.4 * SCATTER * np.random.default_rng(1).uniform(-1, 1, (20, 2))
    straight, none = np.linspace(0, 0.5, 10), np.zeros(10)
    place = np.vstack([np.column_stack([straight, none]), np.column_stack([none + 0.5, straight])])
    way = np.column_stack([place + scatter, np.repeat([0.0, np.pi / 2], 10)])
    legs = legs_of(way)
    assert [leg.heading for leg in legs] == pytest.approx([0.0, np.pi / 2], abs=0.1)
    assert line_distances(way[:, :2], np.array([legs[0].start, *(leg.end for leg in legs)])).max() <= SCATTER
    (leg,) = legs_of(np.array([[1.0, 2.0, 0.5]]))
    assert [*leg.start, *leg.end, leg.heading] == [1.0, 2.0, 1.0, 2.0, 0.5]


def test_a_way_driven_backwards_or_sideways_keeps_its_heading():
    place = np.column_stack([np.linspace(0, 1, 5), np.zeros(5)])
    for heading, expected in ((np.pi - 0.1, np.pi), (0.1, 0.0), (1.2, 1.2)):
        found = leg_heading(np.column_stack([place, np.full(5, heading)]))
        assert np.cos(found - expected) == pytest.approx(1.0)


def test_legs_are_driven_one_after_the_other_with_turns_on_the_spot():
    drive, _ = drive_on()
    assert drive.observe(*at(0.0, 0.0)) is DriveState.DRIVING
    assert np.allclose(drive.target, [0.2, 0.0, 0.0])
    drive.observe(*at(0.199, 0.0))
    assert np.allclose(drive.target, [0.199, 0.0, np.pi / 2])
    drive.observe(*at(0.2, 0.0, 1.55))
    assert np.allclose(drive.target, [0.2, 0.2, 1.55]), "small errors of heading are left alone"
    assert drive.observe(*at(0.2, 0.19, 1.55)) is DriveState.REACHED
    assert drive.target is None
    assert not drive.finished, "there is another goal"
    drive.next_goal()
    assert drive.observe(*at(0.2, 0.19, 1.55)) is not DriveState.BLOCKED


def test_a_contact_ahead_stops_at_once_and_blocks_when_confirmed():
    ahead, beside = [[0.15, 0.02]], [[0.15, 0.08]]
    drive, plan = drive_on(WAY, BLOCKING)
    assert drive.observe(*at(0.0, 0.0, points=beside)) is DriveState.DRIVING
    assert drive.observe(*at(0.02, 0.0, points=ahead)) is DriveState.WAITING
    assert drive.target is None
    assert drive.observe(*at(0.02, 0.0)) is DriveState.DRIVING, "a single contact is not confirmed"
    drive.observe(*at(0.02, 0.0, points=ahead))
    assert drive.observe(*at(0.02, 0.0, points=ahead)) is DriveState.BLOCKED
    assert drive.finished
    assert np.allclose(plan.call_args.args[2], ahead)
    assert drive.observe(*at(0.02, 0.0)) is DriveState.BLOCKED, "an end is final"

    drive, _ = drive_on()  # new ways are driven, and their number is limited
    states = [drive.observe(*at(0.02, 0.0, points=[[0.15, 0.0]])) for _ in range(6)]
    assert states == [DriveState.WAITING, DriveState.DRIVING] * 2 + [DriveState.WAITING, DriveState.BLOCKED]
    assert drive.replans == CONFIG.replans


def test_without_estimates_the_robot_rests_and_is_lost_in_the_end():
    drive, _ = drive_on()
    drive.observe(*at(0.0, 0.0))
    for _ in range(CONFIG.patience):
        assert drive.observe(None, FREE) is DriveState.WAITING
        assert drive.target is None
    assert drive.observe(None, FREE) is DriveState.LOST
    drive, _ = drive_on(None)
    ends = [drive.observe(*at(5.0, 5.0)) for _ in range(CONFIG.patience + 1)]
    assert ends == [DriveState.WAITING] * CONFIG.patience + [DriveState.LOST]


def test_a_robot_that_is_elsewhere_gets_a_new_way():
    drive, plan = drive_on()
    drive.observe(*at(0.0, 0.0))
    for off, asked in ((-0.01, 1), (0.01, 2)):
        drive.observe(*at(0.1, drive.off_way + off))
        assert plan.call_count == asked


def test_a_goal_is_reached_only_by_a_sure_pose():
    drive, _ = drive_on()
    here = np.array([0.2, 0.2, np.pi / 2])
    drive.observe(here, FREE, sure=False)
    ends = []
    while not drive.finished and len(ends) < 200:
        ends.append(drive.observe((drive.target if drive.target is not None else here), FREE, sure=False))
    assert drive.state is DriveState.LOST
    assert set(ends) == {DriveState.WAITING, DriveState.DRIVING, DriveState.LOST}  # some is driven again


def test_the_arm_is_moved_and_halted_as_the_drive_decides():
    route, arm = route_on(), Mock(fault=None)
    assert not route.advance(arm)
    assert not arm.method_calls, "nothing moves before the first estimate"
    route.see(HOME, FREE, HOME, HOME)
    assert not route.advance(arm)
    assert not route.advance(arm)
    assert arm.move.call_count == 1, "an unchanged target is sent once"
    route.rest()
    route.advance(arm)
    route.advance(arm)
    assert [call[0] for call in arm.method_calls] == ["move", "halt"]


def test_a_lost_method_coasts_by_the_arm_and_a_robot_without_a_place_rests_until_it_is_found_or_lost():
    route = route_on()
    route.see(HOME, FREE, HOME, HOME)
    moved, further = np.array([0.08, 0.0, 0.0]), np.array([0.12, 0.0, 0.0])
    assert route.see(None, FREE, moved, moved) is DriveState.DRIVING
    assert np.allclose(route.pose, moved)
    assert route.see(None, FREE, further, further) is DriveState.WAITING
    route, arm = route_on(), Mock(fault=None)
    assert route.see(None, FREE, HOME, HOME) is DriveState.WAITING
    route.advance(arm)
    assert not arm.method_calls
    assert route.see(HOME, FREE, HOME, HOME) is DriveState.DRIVING, "found"
    route = route_on()
    for _ in range(CONFIG.patience + 3):
        route.see(None, FREE, HOME, HOME)
    assert route.drive.state is DriveState.LOST


def test_single_wild_estimates_are_ignored_but_a_moved_robot_is_believed():
    route = route_on()
    for estimate in [HOME] * 10 + [THERE]:
        route.see(estimate, FREE, HOME, HOME)
    assert np.hypot(*route.pose[:2]) < 0.01
    for _ in range(MOVED):
        route.see(THERE, FREE, HOME, HOME)
    assert route.pose == pytest.approx(THERE, abs=0.02)


def test_a_refused_target_blocks_the_way_there():
    drive, plan = drive_on(WAY, BLOCKING)
    route = GoalRoute(drive, LiveConfig(), known(0.0))
    route.see(HOME, FREE, HOME, HOME)
    route.advance(Mock(fault=None, **{"move.side_effect": TargetRefused("outside the box")}))
    assert drive.state is DriveState.BLOCKED
    assert np.allclose(plan.call_args.args[2], [[0.2, 0.0]])


def test_contacts_decide_between_pose_and_estimate_and_that_do_not_fit_are_not_a_goal():
    for truth, believed in ((0.0, False), (0.5, True)):
        route = route_on(contacts=known(truth))
        for estimate in [HOME] * 3 + [THERE] * (MOVED + 1):
            route.see(estimate, FREE, HOME, HOME)
        assert (route.pose[0] > 0.4) == believed
    for truth, reached in ((5.0, False), (0.2, True)):
        route = route_on(WAY[-1:], contacts=known(truth))
        found = [route.see(WAY[-1], FREE, WAY[-1], WAY[-1]) for _ in range(4)]
        assert (DriveState.REACHED in found) == reached


LOOP = [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1)]
MAP_POSE = np.array([0.3, -0.2, 0.7])
"""Pose of the map's frame in the maze: drives must not depend on it."""
TOUCH, GOAL = TouchConfig(), 6
HEAD = ur10_head(TOUCH.head)


def maze(*closed: tuple) -> Maze:
    """A loop of cells with some passages closed."""
    return change_walls(random_maze(3, 2, LOOP, 1.0, stream(5, "maze")), closed, [])


def driven(loop_open: bool = True) -> networkx.DiGraph:
    """Experiences every 6 cm along the loop, with the heading of the motion, in the map's frame."""
    places, poses = [cell_centre(cell) for cell in LOOP + LOOP[:1] * loop_open], []
    for a, b in pairwise(places):
        heading = np.arctan2(*(b - a)[::-1])
        poses += [[*(a + share * (b - a)), heading] for share in (0.0, 1 / 3, 2 / 3)]
    if not loop_open:
        poses.append([*places[-1], poses[-1][2]])
    graph = networkx.DiGraph()
    for k, (x, y, heading) in enumerate(between(MAP_POSE, np.array(poses)).tolist()):
        graph.add_node(k, x=x, y=y, heading=heading)
    graph.add_edges_from(pairwise([*graph, 0] if loop_open else graph), traversals=1)
    return graph


def driven_to_goal(graph: networkx.DiGraph, made: Maze) -> tuple[GoalDrive, np.ndarray, float]:
    """Drives from the first cell; the estimate is the truth with an error. Returns the drive, the way
    [N, 2] and the distance of its end from the goal, m."""
    config = GoalConfig(map=Path("map.npz"), to=(GOAL,))
    live = LiveConfig.model_validate({"plan": {"motion": {"speed": 0.045}}})
    steered = GoalDrive(config, GoalPlanner(graph, config, live.plan.motion), 0.05)
    route = GoalRoute(steered, live, NO_CONTACTS)
    walls = Surroundings(wall_boxes(made, stream(5, "heights")), HEAD)
    arm = VirtualArm(live, walls, np.array([*cell_centre(LOOP[0]), 0.0]))
    frontend, random = Frontend(TOUCH), stream(5, "estimates")
    for _ in range(150):
        if route.advance(arm):
            break
        sample = arm.whisk()
        seen = frontend.observe(sample.reading)
        estimate = between(MAP_POSE, compose(sample.truth, random.normal(0, [0.005, 0.005, 0.03])))
        route.see(estimate, felt_points(seen, TOUCH), sample.truth, arm.poses[-1])
    way, node = np.array(arm.poses)[:, :2], graph.nodes[GOAL]
    goal = compose(MAP_POSE, np.array([node["x"], node["y"], 0.0]))[:2]
    return steered, way, float(np.hypot(*(way[-1] - goal)))


@pytest.mark.parametrize("wall", [[], [((1, 0), (2, 0))]], ids=["free", "walled"])
def test_the_goal_is_reached_along_the_way_or_around_a_wall(wall):
    steered, way, off = driven_to_goal(driven(), maze(*wall))
    assert steered.state is DriveState.REACHED
    assert (steered.replans > 0) == bool(wall)
    assert off < 0.03
    length = np.hypot(*np.diff(way, axis=0).T).sum()
    assert (length > 0.5) if wall else (length < 1.15 * 0.36)


def test_a_wall_on_the_only_way_ends_the_drive_before_it():
    steered, way, _ = driven_to_goal(driven(loop_open=False), maze(((0, 0), (0, 1)), ((1, 0), (2, 0))))
    assert steered.state is DriveState.BLOCKED
    assert "blocked" in steered.reason
    assert way[:, 0].max() < 0.36 - 0.05, "the wall is at 0.36 m"


@pytest.mark.parametrize(("goal", "found"), [(99, "experience 99"), ((5.0, 5.0), "m from experience")])
def test_goals_off_the_map_are_refused(goal, found):
    config = GoalConfig(map=Path("map.npz"), to=(goal,))
    with pytest.raises(InputError, match=rf"live\.plan\.goal\.to\[0\].*{found}"):
        GoalPlanner(driven(), config, MotionConfig())


def test_the_arm_begins_where_the_session_of_the_map_ended(tmp_path: Path) -> None:
    shutil.copy(FILE, tmp_path / "map.npz")
    goals = ["live.plan.goal.to=[0]", f"live.plan.goal.map={tmp_path}"]

    def path_of(*settings: str) -> list:
        config = load_config("live_maze", settings)
        config = plan_goals(config)[0] if settings else config
        return plan_path(config.live, ur10_head(config.touch.head)).pose.tolist()

    assert path_of(*goals) == path_of()[-1:]
    write_tum(tmp_path / "truth.tum", np.arange(2.0), np.array([[0.5, 0.1, 0.0], [0.4, 0.2, 1.0]]))
    assert path_of(*goals) == [pytest.approx([0.4, 0.2, 1.0])]
    assert path_of(*goals, "live.plan.goal.at=[0.3, 0.1, 90]") == [[0.3, 0.1, pytest.approx(np.pi / 2)]]


@pytest.mark.soak
@pytest.mark.timeout(1200)
def test_a_session_reaches_its_goals(loopback: str, tmp_path: Path) -> None:
    number, circuits = 31002, "CCC"
    made = store_map(Recipe(touch_config(number, 1, MAIN | {"path": {"circuits": circuits}})), tmp_path)
    settings = [
        *PATIENT, "live.budget=5", "live.plan.seed=1", f"live.plan.maze.seed={number}",
        f"live.plan.path.circuits={circuits}", "live.plan.motion.jitter.position=0.005",
        "live.plan.motion.jitter.yaw_deg=1.5", "live.plan.motion.jitter.speed=0.05",
        f"live.plan.goal.map={made.path}", "live.plan.goal.to=[60, 0]",
    ]  # fmt: skip
    directory = complete_session(loopback, tmp_path, *settings, longest=900, outcome="reached")
    report = json.loads((directory / "live.json").read_text())
    assert [goal["state"] for goal in report["goals"]] == ["reached", "reached"]
    assert (directory / "localisation.csv").exists()
