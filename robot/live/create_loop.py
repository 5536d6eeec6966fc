"""The loop of a Create: the state machine of Fox et al. 2012 on the robot, each motion a report."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from robot.drivers.create.stop_reasons import CommandRefused
from robot.drivers.outcome import SessionOutcome
from robot.live.async_mapper import AsyncMapper, check_mapper
from robot.live.create_rig import CreateRig
from robot.live.polling import session_fault
from robot.simulation.create.state_machine import (
    CreateState,
    MachineState,
    MotionEnd,
    WheelCommand,
    early_end,
    next_state,
    planned_end,
    planned_rows,
    wheel_command,
)
from robot.sources.source import Sample
from tactile.base.random_streams import stream
from tactile.base.types import Report, StepEnd

TICK = 0.005
"""Period of the poll during a motion, s."""
RENEW = 0.1
"""Time after which a drive command is sent again, s."""
LEAST_TURN = np.radians(2.0)
"""Remaining turn that is not executed: the robot measures whole degrees, rad."""
MAPPER_WAIT = 60.0
"""Longest wait of a robot at rest for its mapper, s."""


class MotionReport(NamedTuple):
    """Report on a motion that was passed on.

    Attributes:
        number: of the motion. time: of its end, s. state: of the machine. moment: kind of end.
        sampled: whether the whiskers sent samples to its end.
    """

    number: int
    time: float
    state: CreateState
    moment: StepEnd
    sampled: bool


class _Motion(NamedTuple):
    """Attributes: end: of the motion; contact: [W] at its end; strain: [T, W, 2]; sampled: as above."""

    end: MotionEnd
    contact: np.ndarray
    strain: np.ndarray
    sampled: bool


def run_create_loop(rig: CreateRig, mapper: AsyncMapper, tell: Callable[[MotionReport], None]) -> None:
    """Explores as the state machine does and passes on a report of every motion, until the planned end; then,
    and at any fault, the robot is stopped.

    Raises:
        robot.live.polling.SessionFault, robot.live.polling.OperatorStop.
    """
    try:
        _explore(rig, mapper, tell)
    finally:
        rig.robot.stop()


def _explore(rig: CreateRig, mapper: AsyncMapper, tell: Callable[[MotionReport], None]) -> None:
    plan = rig.create.plan
    random = stream(plan.seed, "behaviour")
    doing, touching = MachineState(CreateState.FWD1), np.zeros(len(rig.alive), bool)
    stamp, number = 0.0, 0
    while number < plan.reports if plan.reports else stamp < 60 * plan.minutes:
        _wait_for_mapper(rig, mapper)
        motion = _execute(rig, mapper, doing, touching)
        odometry = rig.motion()
        stamp += odometry.dt
        report = Report(
            odometry=odometry,
            motion=int(doing.state.motion),
            moment=int(motion.end.moment),
            alive=rig.alive & motion.sampled,
            contact=motion.contact,
            time=np.arange(len(motion.strain)) / plan.whiskers.rate,
            strain=motion.strain,
        )
        sample = Sample(stamp, report, None)
        if rig.recorder is not None:
            rig.recorder.add_sample(sample)
        mapper.offer(sample)
        tell(MotionReport(number, stamp, doing.state, motion.end.moment, motion.sampled))
        if not motion.sampled:
            _wait_for_whiskers(rig)
        doing = next_state(plan.behaviour, doing, motion.end.moment, odometry.dtheta, random, LEAST_TURN)
        touching, number = motion.contact, number + 1


def _execute(rig: CreateRig, mapper: AsyncMapper, doing: MachineState, before: np.ndarray) -> _Motion:
    """Drives until the planned end, an early one, or the last sample of whiskers that fall silent."""
    behaviour, monitor = rig.create.plan.behaviour, rig.monitor
    command = wheel_command(behaviour, doing)
    last = planned_rows(behaviour, command) - 1
    if rig.bumped:
        rig.robot.release()
    life = rig.stream.restarts
    monitor.begin()
    bumped: list[bool] = []
    driven = _drive(rig, command)
    polled, end = driven, None
    while end is None:
        time.sleep(TICK)
        rig.poll()
        check_mapper(mapper)
        now, before_poll = time.monotonic(), polled
        polled = now
        if now - before_poll > rig.create.patience:
            detail = f"the session stood still for {now - before_poll:.2f} s"
            raise session_fault(SessionOutcome.HOST_LATE, detail)
        if not rig.stream.streaming or rig.stream.restarts != life:
            rig.robot.stop()
            return _unfelt_motion(rig)
        rows = monitor.rows(last + 1)
        bumped += [rig.bumped] * (len(rows) - len(bumped))
        if len(rows):
            end = early_end(behaviour, doing.state, _known(rig, rows), np.array(bumped), before, last)
            if end is None and len(rows) > last:
                end = planned_end(doing.state, last)
        if end is None and now - driven > RENEW:
            driven = _drive(rig, command)
    if doing.state in (CreateState.FWD1, CreateState.TURN) and end.moment is StepEnd.FREE:
        rig.robot.refresh()  # the next motion probably goes on
    else:
        rig.robot.stop()
    contact = np.abs(_known(rig, rows)[end.row, :, 0]) > behaviour.contact
    return _Motion(end, contact, _strain_series(rig, doing.state, end.row + 1), sampled=True)


def _drive(rig: CreateRig, command: WheelCommand) -> float:
    """Sends or renews a command; returns the time. A stopped robot is left to the next poll."""
    try:
        rig.robot.drive(command.speed, command.rate)
    except CommandRefused:
        if rig.robot.active_stop is None:
            raise
    return time.monotonic()


def _known(rig: CreateRig, rows: np.ndarray) -> np.ndarray:
    """Rows with zeros for whiskers without a signal."""
    return np.where(rig.alive[:, None], rows, 0.0)


def _strain_series(rig: CreateRig, state: CreateState, rows: int) -> np.ndarray:
    """The samples [T, W, 2] of the slow drive; none for other motions, or if too many were lost."""
    monitor = rig.monitor
    nothing = np.zeros((0, len(rig.alive), 2))
    if state is not CreateState.FWD2:
        return nothing
    frames = rig.head.ring.between(monitor.first, monitor.last_sample(rows))
    strain = monitor.series(frames, rows, rig.config.gap)
    if not len(strain):
        rig.record_event("dropped", "the strain of a slow drive: samples are missing")
        return nothing
    return _known(rig, strain)


def _unfelt_motion(rig: CreateRig) -> _Motion:
    whiskers = len(rig.alive)
    return _Motion(
        MotionEnd(0, StepEnd.FREE), np.zeros(whiskers, bool), np.zeros((0, whiskers, 2)), sampled=False
    )


def _wait_for_whiskers(rig: CreateRig) -> None:
    """Waits, with the robot at rest, for whiskers that send no samples; the reader limits the time."""
    rig.record_event("held", "the whiskers send no samples")
    rig.wait_until(lambda: rig.stream.streaming, float("inf"), SessionOutcome.HEAD_GONE, "the whiskers")
    rig.record_event("resumed", "the whiskers send samples")


def _wait_for_mapper(rig: CreateRig, mapper: AsyncMapper) -> None:
    """Waits, with the robot at rest, for a mapper that lags."""
    if mapper.behind() <= rig.create.budget:
        return
    rig.robot.stop()
    rig.record_event("held", "the mapper is behind")
    what = "the mapper, to catch up,"
    rig.wait_until(
        lambda: mapper.behind() <= rig.create.budget or not mapper.alive,
        MAPPER_WAIT,
        SessionOutcome.MAPPER_GONE,
        what,
    )
    check_mapper(mapper)
    rig.record_event("resumed", "the mapper has caught up")
