"""A live session on an arm: self-test, calibration, route, and whisks of its head or, without one, pokes; and
the steering to goals by the estimates of the mapper."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.metrics.trajectory import read_tum
from ratslam.live.goal_drive import DriveState, GoalDrive, GoalRoute
from ratslam.live.goal_planner import GoalPlanner, contact_map
from ratslam.live.live_robot import LiveRobot, mapped_config, mapper_status, quantiles
from ratslam.live.mapper_process import Mapper, MappingJob
from ratslam.runs.localise import localising
from ratslam.runs.saved_map import read_map
from ratslam.runs.settings.run_config import RunConfig
from robot.drivers.outcome import SessionOutcome
from robot.live import arm_route
from robot.live.live_rig import ArmRig, Rig
from robot.live.poke_loop import PokeReport, learn_free_pokes, run_poke_loop
from robot.live.polling import SessionFault, session_fault
from robot.live.whisk_loop import WhiskReport, follow_route, record_free_whisks, run_whisk_loop
from robot.sources.source import SourceDescription, SourceInfo
from robot.world.maze import POSE_CELL_SIZE
from robot.world.scene import HeadPath, maze_info, moved_length
from tactile.calibration import Calibration, calibrate
from tactile.whisker_geometry import ur10_head
from tactile.whisker_image import view_shape

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
    drive = GoalDrive(goal, planner, saved.config.pose_cells.cell_size)
    contacts = contact_map(made, config.touch)
    return localising(config, saved, goal.start), GoalRoute(drive, live, contacts)


class GoalSteering:
    """The route of the whisk loop (`robot.live.arm_route.ArmRoute`) that follows the newest estimate.

    Args:
        whisks: reports of the whisks, or rings of pokes, passed on so far; the list grows.

    Attributes:
        ends: of the goals so far, as JSON values.
    """

    def __init__(
        self, route: GoalRoute, rig: ArmRig, mapper: Mapper, whisks: Sequence[WhiskReport | PokeReport]
    ) -> None:
        self.route, self.ends = route, list[dict[str, Any]]()
        self._rig, self._mapper, self._whisks = rig, mapper, whisks
        self._mapped = self._seen = 0  # results taken; whisks that the route has taken note of

    def advance(self, arm: arm_route.MovableArm) -> bool:
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
            result, self._mapped, self._seen = mapped[-1], len(mapped), count
            pose = None if result.lost else np.asarray(result.pose, np.float64)
            now, arm = self._rig.odometer.pose(time.monotonic()), self._whisks[result.number].pose
            self._note(self.route.see(pose, result.points, arm, now))
        elif count > self._seen and count - len(mapped) > STALE:
            self._seen = count
            self._note(self.route.rest())

    def _note(self, state: DriveState) -> None:
        """Notes the end of a goal."""
        drive = self.route.drive
        if state.ended:
            end = {"goal": drive.goal + 1, "state": drive.state.name.lower(), "reason": drive.reason}
            self.ends.append(end | {"replans": drive.replans, "whisk": len(self._whisks)})
            text = f"{drive.goal + 1}: {end['state']} {drive.reason}".strip()
            self._rig.record_event("goal", text)


def prepare_arm_session(config: RunConfig, directory: Path) -> Callable[[Callable[[], bool]], _ArmSession]:
    """Checks the route of a session, all of its targets; returns the function that opens the devices.

    Raises:
        InputError: a target is rejected.
    """
    assert config.live is not None
    config, goals = (config, None) if config.live.plan.goal is None else plan_goals(config)
    assert config.live is not None
    path = arm_route.plan_path(config.live, ur10_head(config.touch.head))
    arm_route.check_targets(config.live, path)
    session = PokeSession if config.live.arm.touch == "force" else WhiskSession
    return lambda stopped: session(config, path, directory, stopped, goals)


class _ArmSession(LiveRobot):
    """The arm's part of a session.

    Args:
        rig: its devices. path: the route. goals: the route to goals, if there are any. count: expected number
            of readings along a path. described: the readings, without the facts that every arm shares.
    """

    rig: ArmRig

    def __init__(
        self,
        config: RunConfig,
        rig: ArmRig,
        path: HeadPath,
        directory: Path,
        goals: GoalRoute | None,
        count: Callable[[HeadPath], float],
        described: SourceDescription,
    ) -> None:
        assert config.live is not None
        self._config, self.rig = config, rig
        self._approach, self._descent, self._route = arm_route.arm_routes(config.live, path)
        live, plan, head = config.live, config.live.plan, ur10_head(config.touch.head)
        whole = arm_route.whole_path(live, head)
        rows = ceil(1.5 * count(whole)) if live.whisks is None else live.whisks
        maze = (
            None if live.waypoints else maze_info(arm_route.plan_scene(plan, head).maze, plan.maze, plan.seed)
        )
        provenance = {"live": live.model_dump(mode="json", exclude={"plan": {"maze": {"file"}}})}
        shared = {"cell_size": POSE_CELL_SIZE, "maze": maze, "provenance": provenance}
        source = replace(described, info=described.info.model_copy(update=shared))
        extent = float(np.abs(whole.pose[:, :2] - whole.pose[0, :2]).max())
        self.job = MappingJob(mapped_config(config, directory, rows), source, directory, extent)
        self.total = live.whisks or (None if goals else ceil(count(path)))
        self._goals = goals
        self._steering: GoalSteering | None = None
        self._reports: list[WhiskReport | PokeReport] = []

    @property
    def end(self) -> SessionOutcome:
        """The outcome of a session that ends as planned."""
        steered = self._steering is not None and self._steering.route.drive.finished
        return SessionOutcome.REACHED if steered else SessionOutcome.COMPLETE

    def run(self, mapper: Mapper, tell: Callable[[str], None]) -> None:
        route: arm_route.ArmRoute = self._route
        if self._goals is not None:
            route = self._steering = GoalSteering(self._goals, self.rig, mapper, self._reports)
        self.run_loop(route, mapper, tell)
        fault = self._steering and self._steering.fault()
        if fault:
            raise fault

    def run_loop(self, route: arm_route.ArmRoute, mapper: Mapper, tell: Callable[[str], None]) -> None:
        """Passes on the readings along a route."""
        raise NotImplementedError

    def _count(self, report: WhiskReport | PokeReport, mapper: Mapper) -> str:
        """Counts a reading; returns the state of mapper and steering as text."""
        self._reports.append(report)
        self.count += 1
        return f"{mapper_status(mapper)}{self._steering.status() if self._steering else ''}"

    def report(self) -> dict[str, Any]:
        return {
            **({} if self._steering is None else {"goals": self._steering.ends}),
            "state_age_s": quantiles(self.rig.state_ages),
        }


class WhiskSession(_ArmSession):
    """The part of a session of an arm with a whisker head."""

    unit = "whisk"
    rig: Rig

    def __init__(
        self,
        config: RunConfig,
        path: HeadPath,
        directory: Path,
        stopped: Callable[[], bool],
        goals: GoalRoute | None = None,
    ) -> None:
        live, head = config.live, ur10_head(config.touch.head)
        assert live is not None
        rate, info = live.plan.whisking.rate, SourceInfo(raw_whiskers=True, head=config.touch.head)
        source = SourceDescription(view_shape(config.touch.image, head), len(head.length), rate, info)
        rig = Rig(live, config.touch.head, stopped)
        super().__init__(config, rig, path, directory, goals, lambda path: path.duration * rate, source)
        self._dropped = self._lost = 0
        self._lateness = list[float]()

    def calibrate(self, log: Callable[[str], None]) -> Calibration:
        """Records free whisks above the start of the route."""
        rig, plan = self.rig, self.rig.config.plan
        log("arm: moving above the start of the route")
        follow_route(rig, self._approach)
        count = ceil(plan.calibration.min_duration * plan.whisking.rate)
        log(f"head: {count} whisks in free air")
        rig.driver.whisk(plan.whisking.model_copy(update={"mode": "open"}))
        record = record_free_whisks(rig, count)
        window = self._config.touch.contact.slope_window
        return calibrate(plan.calibration, record, window, "free whisking")

    def lower(self, calibration: Calibration | None) -> None:
        """Lowers the head and starts whisking."""
        assert calibration is not None
        follow_route(self.rig, self._descent)
        whisking = self.rig.config.plan.whisking
        self.rig.driver.whisk(whisking, calibration.threshold[:, 1], calibration.mean[:, 1])

    def run_loop(self, route: arm_route.ArmRoute, mapper: Mapper, tell: Callable[[str], None]) -> None:
        def count(whisk: WhiskReport) -> None:
            self._lateness.append(whisk.lateness)
            self._dropped, self._lost = self._dropped + (not whisk.seen), self._lost + whisk.missing
            lost = f"{self._lost} samples lost, {self._dropped} images dropped"
            tell(f"{self._count(whisk, mapper)}late {1e3 * whisk.lateness:.0f} ms, {lost}")

        run_whisk_loop(self.rig, route, mapper, count)

    def report(self) -> dict[str, Any]:
        head = self.rig.head
        return super().report() | {
            "head": head.decoder.counts._asdict() | {"stalls": head.stalls},
            "dropped": self._dropped,
            "missing": self._lost,
            "lateness_s": quantiles(self._lateness),
        }


class PokeSession(_ArmSession):
    """The part of a session of an arm without a head, which pokes (`tactile.pokes`)."""

    unit = "ring"

    def __init__(
        self,
        config: RunConfig,
        path: HeadPath,
        directory: Path,
        stopped: Callable[[], bool],
        goals: GoalRoute | None = None,
    ) -> None:
        assert config.live is not None
        pokes, count = config.touch.pokes, config.touch.pokes.directions
        source = SourceDescription((1, count, 1), count, 0.0, SourceInfo(pokes=pokes))
        rig = ArmRig(config.live, stopped)

        def rings(path: HeadPath) -> float:
            return float(moved_length(path)[-1]) / pokes.every + 1

        super().__init__(config, rig, path, directory, goals, rings, source)
        self._threshold = 0.0

    def calibrate(self, log: Callable[[str], None]) -> None:
        """Pokes in free air above the start of the route."""
        log("arm: moving above the start of the route")
        follow_route(self.rig, self._approach)
        log(f"arm: {self._config.touch.pokes.directions} pokes in free air")
        self._threshold = learn_free_pokes(self.rig, self._config.touch.pokes)
        log(f"arm: a rise of {self._threshold:.1f} N is a contact")

    def lower(self, calibration: Calibration | None) -> None:
        """Lowers the tool."""
        del calibration
        follow_route(self.rig, self._descent)

    def run_loop(self, route: arm_route.ArmRoute, mapper: Mapper, tell: Callable[[str], None]) -> None:
        def count(ring: PokeReport) -> None:
            felt = f"{int(ring.contact.sum())} of {len(ring.contact)} pokes touched, {ring.took:.0f} s"
            tell(f"{self._count(ring, mapper)}{felt}")

        run_poke_loop(self.rig, route, mapper, self._config.touch.pokes, self._threshold, count)

    def report(self) -> dict[str, Any]:
        return super().report() | {"threshold_N": self._threshold}
