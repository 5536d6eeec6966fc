"""The drive to goals: states, contacts on the way, missing estimates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ratslam.live.goal_drive import MOVED, DriveState, GoalDrive, GoalRoute
from ratslam.live.goal_planner import RECENT
from ratslam.places.contact_alignment import RememberedContacts
from ratslam.places.route import NoWay
from robot.drivers.ur10.safety import TargetRefused
from robot.live.live_config import GoalConfig, LiveConfig

WAY = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.2, np.pi / 2]])
FREE = np.zeros((0, 2))
CONFIG = GoalConfig(map=Path("map.npz"), to=(0, 1), patience=3, replans=2, coast=0.1)


class StubPlanner:
    """Gives the ways of a list, one after the other, and remembers what it was asked."""

    def __init__(self, *ways: np.ndarray | NoWay | None) -> None:
        self.ways, self.asked = list(ways), []

    def plan(self, pose, goal, obstacles):
        self.asked.append((pose, goal, obstacles))
        way = self.ways.pop(0) if len(self.ways) > 1 else self.ways[0]
        if isinstance(way, NoWay):
            raise way
        return way


class StubArm:
    """An arm that remembers what it is told; `refuses` rejects targets."""

    fault = None

    def __init__(self, refuses: bool = False) -> None:
        self.told: list[object] = []
        self.refuses = refuses

    def move(self, tcp, speed=None):
        if self.refuses:
            raise TargetRefused("outside the box")
        self.told.append(tcp)

    def halt(self):
        self.told.append("halt")


def drive_on(*ways: np.ndarray | NoWay | None) -> tuple[GoalDrive, StubPlanner]:
    planner = StubPlanner(*(ways or (WAY,)))
    return GoalDrive(CONFIG, planner, 0.05), planner


def at(x, y, heading=0.0, points=FREE) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x, y, heading]), np.asarray(points, float)


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
    drive, planner = drive_on(WAY, NoWay("no other way"))
    assert drive.observe(*at(0.0, 0.0, points=beside)) is DriveState.DRIVING
    assert drive.observe(*at(0.02, 0.0, points=ahead)) is DriveState.WAITING
    assert drive.target is None
    assert drive.observe(*at(0.02, 0.0)) is DriveState.DRIVING, "a single contact is not confirmed"
    drive.observe(*at(0.02, 0.0, points=ahead))
    assert drive.observe(*at(0.02, 0.0, points=ahead)) is DriveState.BLOCKED
    assert drive.finished
    assert np.allclose(planner.asked[-1][2], ahead)
    assert drive.observe(*at(0.02, 0.0)) is DriveState.BLOCKED, "an end is final"


def test_a_new_way_is_driven_and_their_number_is_limited():
    drive, _ = drive_on()
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
    assert ends[-1] is DriveState.LOST
    assert DriveState.LOST not in ends[:-1]


def test_a_robot_that_is_elsewhere_gets_a_new_way():
    drive, planner = drive_on()
    drive.observe(*at(0.0, 0.0))
    drive.observe(*at(0.1, drive.off_way - 0.01))
    assert len(planner.asked) == 1
    drive.observe(*at(0.1, drive.off_way + 0.01))
    assert len(planner.asked) == 2


def route_of(drive: GoalDrive) -> GoalRoute:
    return GoalRoute(drive, LiveConfig(), RememberedContacts(np.zeros((0, 3)), [], RECENT))


def test_the_arm_is_moved_and_halted_as_the_drive_decides():
    drive, _ = drive_on()
    route, arm, pose = route_of(drive), StubArm(), np.zeros(3)
    assert not route.advance(arm)
    assert not arm.told, "nothing moves before the first estimate"
    route.see(pose, FREE, pose, pose)
    assert not route.advance(arm)
    assert not route.advance(arm)
    assert len(arm.told) == 1, "an unchanged target is sent once"
    route.rest()
    route.advance(arm)
    route.advance(arm)
    assert arm.told[1:] == ["halt"]


def test_a_lost_method_coasts_by_the_arm_for_a_while():
    drive, _ = drive_on()
    route, start = route_of(drive), np.zeros(3)
    route.see(start, FREE, start, start)
    moved = np.array([0.08, 0.0, 0.0])
    assert route.see(None, FREE, moved, moved) is DriveState.DRIVING
    assert np.allclose(route.pose, moved)
    moved = np.array([0.12, 0.0, 0.0])
    assert route.see(None, FREE, moved, moved) is DriveState.WAITING


def test_single_wild_estimates_are_ignored_but_a_moved_robot_is_believed():
    drive, _ = drive_on()
    route, here, there = route_of(drive), np.zeros(3), np.array([0.5, 0.0, 0.0])
    for _ in range(10):
        route.see(here, FREE, here, here)
    route.see(there, FREE, here, here)
    assert np.hypot(*route.pose[:2]) < 0.01
    for _ in range(MOVED):
        route.see(there, FREE, here, here)
    assert route.pose == pytest.approx(there, abs=0.02)


def test_a_refused_target_blocks_the_way_there():
    drive, planner = drive_on(WAY, NoWay("no other way"))
    route, pose = route_of(drive), np.zeros(3)
    route.see(pose, FREE, pose, pose)
    route.advance(StubArm(refuses=True))
    assert drive.state is DriveState.BLOCKED
    assert np.allclose(planner.asked[-1][2], [[0.2, 0.0]])


def test_a_goal_is_reached_only_by_a_sure_pose():
    drive, _ = drive_on()
    here = np.array([0.2, 0.2, np.pi / 2])
    drive.observe(here, FREE, sure=False)
    ends = []
    for _ in range(200):
        pose = drive.target if drive.target is not None else here
        ends.append(drive.observe(pose, FREE, sure=False))
        if drive.finished:
            break
    assert drive.state is DriveState.LOST
    assert DriveState.REACHED not in ends
    assert DriveState.DRIVING in ends, "some of the way is driven again before"


class Known:
    """A map with which contacts agree near one pose."""

    def __init__(self, x: float) -> None:
        self.x = x

    def align(self, pose, points):
        return pose

    def agrees(self, pose, points):
        return abs(pose[0] - self.x) < 0.05


@pytest.mark.parametrize(("truth", "believed"), [(0.0, False), (0.5, True)])
def test_contacts_decide_between_the_pose_and_an_estimate_elsewhere(truth, believed):
    drive, _ = drive_on()
    route = GoalRoute(drive, LiveConfig(), Known(truth))
    here, there = np.zeros(3), np.array([0.5, 0.0, 0.0])
    for estimate in [here] * 3 + [there] * (MOVED + 1):
        route.see(estimate, FREE, here, here)
    assert (route.pose[0] > 0.4) == believed


def test_a_robot_without_a_place_rests_until_it_is_found_or_lost():
    drive, _ = drive_on()
    route, arm, pose = route_of(drive), StubArm(), np.zeros(3)
    assert route.see(None, FREE, pose, pose) is DriveState.WAITING
    route.advance(arm)
    assert len(arm.told) == 0
    assert route.see(pose, FREE, pose, pose) is DriveState.DRIVING, "found"
    drive, _ = drive_on()
    route = route_of(drive)
    for _ in range(CONFIG.patience + 3):
        route.see(None, FREE, pose, pose)
    assert drive.state is DriveState.LOST


def test_contacts_that_do_not_fit_are_not_a_goal():
    end = np.array([0.2, 0.2, np.pi / 2])
    for truth, states in ((5.0, False), (0.2, True)):
        drive, _ = drive_on(WAY[-1:])
        route = GoalRoute(drive, LiveConfig(), Known(truth))
        found = [route.see(end, FREE, end, end) for _ in range(4)]
        assert (DriveState.REACHED in found) == states
