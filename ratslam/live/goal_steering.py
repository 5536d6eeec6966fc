"""Steers the arm of a live session to goals by the estimates of its mapper."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from evaluation.metrics.trajectory import read_tum
from ratslam.live.mapper_process import Mapper
from ratslam.runs.goal_planner import GoalPlanner, contact_map
from ratslam.runs.localise import localising_for_goals
from ratslam.runs.saved_map import read_map
from ratslam.runs.settings.run_config import RunConfig
from robot.drivers.outcome import SessionOutcome
from robot.live.arm_route import MovableArm
from robot.live.goal_drive import DriveState, GoalDrive
from robot.live.goal_route import GoalRoute
from robot.live.live_rig import Rig
from robot.live.polling import SessionFault, session_fault
from robot.live.whisk_loop import WhiskReport
from tactile.whiskers.head_geometry import ur10_head

STALE = 3
"""Whisks without a result of the mapper after which the head rests."""
ENDS = {DriveState.BLOCKED: SessionOutcome.BLOCKED, DriveState.LOST: SessionOutcome.LOST}


def plan_goals(config: RunConfig) -> tuple[RunConfig, GoalRoute]:
    """The configuration of a session with goals, which localises in the map of the goals and begins where
    that one ended, and its route.

    Raises:
        InputError: the map cannot be read, or a goal is not on it.
    """
    live = config.live
    assert live is not None
    goal = live.plan.goal
    assert goal is not None
    saved = read_map(goal.map)
    truth = (goal.map if goal.map.is_dir() else goal.map.parent) / "truth.tum"
    if goal.at is None and truth.exists() and truth.stat().st_size:
        x, y, heading = read_tum(truth)[1][-1].tolist()
        goal = goal.model_copy(update={"at": (x, y, float(np.degrees(heading)))})
        live = live.model_copy(update={"plan": live.plan.model_copy(update={"goal": goal})})
        config = config.model_copy(update={"live": live})
    made = saved.open_session().map
    planner = GoalPlanner(made.graph(), goal, live.plan.motion)
    drive = GoalDrive(goal, planner, saved.config.pose_cells.cell_size, len(goal.to))
    contacts = contact_map(made, config.touch.image, ur10_head(config.touch.head))
    route = GoalRoute(drive, live, drive.off_way, goal.coast, contacts)
    return localising_for_goals(config, saved, goal.start), route


class GoalSteering:
    """The route of the whisk loop (`robot.live.arm_route.ArmRoute`) that follows the newest estimate.

    Args:
        whisks: reports of the whisks passed on so far; the list grows.

    Attributes:
        ends: of the goals so far, as JSON values.
    """

    def __init__(self, route: GoalRoute, rig: Rig, mapper: Mapper, whisks: Sequence[WhiskReport]) -> None:
        self.route, self.ends = route, list[dict[str, Any]]()
        self._rig, self._mapper, self._whisks = rig, mapper, whisks
        self._mapped = self._told = 0  # results taken; whisks of which the route was told

    def advance(self, arm: MovableArm) -> bool:
        """See `robot.live.arm_route.ArmRoute`."""
        if not self.route.drive.finished:
            self._take_results()
        return self.route.advance(arm)

    def resend_last(self) -> None:
        """See `robot.live.arm_route.ArmRoute`."""
        self.route.resend_last()

    def status(self) -> str:
        """Goal and state as text."""
        drive = self.route.drive
        return f"goal {drive.goal + 1}: {drive.state.name.lower()}, "

    def fault(self) -> SessionFault | None:
        """The end of a session whose last goal was not reached."""
        drive = self.route.drive
        outcome = ENDS.get(drive.state)
        return outcome and session_fault(outcome, f"goal {drive.goal + 1}: {drive.reason}")

    def _take_results(self) -> None:
        """Tells the route of the newest result, or of whisks that stay without one."""
        self._mapper.receive()
        mapped, count = self._mapper.mapped, len(self._whisks)
        if len(mapped) > self._mapped and mapped[-1].number < count:
            result, self._mapped, self._told = mapped[-1], len(mapped), count
            pose = None if result.lost else np.asarray(result.pose, np.float64)
            now, arm = self._rig.odometer.pose(time.monotonic()), self._whisks[result.number].pose
            self._note(self.route.see(pose, result.points, arm, now))
        elif count > self._told and count - len(mapped) > STALE:
            self._told = count
            self._note(self.route.rest())

    def _note(self, state: DriveState) -> None:
        """Notes the end of a goal."""
        drive = self.route.drive
        if state.ended:
            end = {"goal": drive.goal + 1, "state": drive.state.name.lower(), "reason": drive.reason}
            self.ends.append(end | {"replans": drive.replans, "whisk": len(self._whisks)})
            text = f"{drive.goal + 1}: {end['state']} {drive.reason}".strip()
            self._rig.record_event("goal", text)
