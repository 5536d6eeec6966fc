"""The whisk loop: moves along the route and passes each whisk to recorder and mapper."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from robot.drivers.head.decoder import Cut, assemble_cycle
from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.safety import TargetRefused
from robot.live.arm_route import ArmRoute
from robot.live.live_rig import ArmRig, Rig
from robot.live.polling import TICK, AsyncMapper, SessionFault, check_mapper, session_fault
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Odometry
from tactile.whisking import MID_PROTRACTION


class WhiskReport(NamedTuple):
    """Report on a passed-on whisk.

    Attributes:
        lateness: time from its end to passing on, s. seen: whether its image was included. missing: number of
            frames that had not arrived. pose: [3] by the arm, at mid-protraction.
    """

    lateness: float
    seen: bool
    missing: int
    pose: np.ndarray


class _WhiskSequence(NamedTuple):
    """A sequence of consecutive whisks, timed by the head's own clock.

    Attributes:
        number: of its first whisk. first: sequence number of its first frame. device: device time of that
            frame, s. start: session time, s. samples: frames per whisk. period: of a whisk, s.
    """

    number: int
    first: int
    device: float
    start: float
    samples: int
    period: float

    def frame_range(self, number: int) -> tuple[int, int]:
        """Sequence numbers of the first and last frame of a whisk."""
        first = self.first + (number - self.number) * self.samples
        return first, first + self.samples - 1

    def start_of(self, number: float) -> float:
        """Time from the start of the sequence to a whisk, or to a moment in one (fractional number), s."""
        return (number - self.number) * self.period


def run_whisk_loop(
    rig: Rig, route: ArmRoute, mapper: AsyncMapper, tell: Callable[[WhiskReport], None]
) -> None:
    """Moves along the route and passes on every whisk; ends with the whisk in which the arm arrives.

    The arm rests while the head sends no samples.

    Raises:
        robot.live.polling.SessionFault, robot.live.polling.OperatorStop.
    """
    number, most = 0, rig.config.whisks
    arrived = False
    while not arrived and number != most:
        sequence, life = _next_sequence(rig, number), rig.stream.restarts
        while rig.stream.streaming and rig.stream.restarts == life:
            rig.poll()
            check_mapper(mapper)
            arrived = arrived or advance_route(rig, route)
            handed = _hand_on(rig, sequence, number, mapper)
            if handed is None:
                time.sleep(TICK)
                continue
            tell(handed)
            number += 1
            if arrived or number == most:
                break
        else:
            rig.arm.halt()
            rig.await_samples("the head sends")
            route.resend_last()


def advance_route(rig: ArmRig, route: ArmRoute) -> bool:
    """Whether the arm has arrived at the end of the route; at a target, the next one is sent.

    Raises:
        robot.live.polling.SessionFault: the arm has a fault, or the target is invalid.
    """
    try:
        return route.advance(rig.arm)
    except TargetRefused as error:
        raise refusal(rig, error) from error


def refusal(rig: ArmRig, error: TargetRefused) -> SessionFault:
    """What ends a session whose arm refuses a target."""
    return (
        session_fault(SessionOutcome.OUT_OF_BOX, str(error))
        if rig.arm.fault is None
        else SessionFault(rig.arm.fault)
    )


def follow_route(rig: ArmRig, route: ArmRoute) -> None:
    """Moves along a route without whisks; the arm limits the time of each move by its plan."""
    rig.wait_until(lambda: advance_route(rig, route), float("inf"), SessionOutcome.NOT_ARRIVED, "the route")


def _next_sequence(rig: Rig, number: int) -> _WhiskSequence:
    """The sequence that starts with the next whisk.

    Raises:
        InputError: the number of samples per whisk is not an integer.
    """
    rate = rig.config.plan.whisking.rate
    assert rig.head.identity is not None
    count = rig.head.identity.rate / rate
    if abs(count - round(count)) > 1e-6:
        raise InputError("live.plan.whisking.rate", f"{count:g} samples per whisk", "an integer")
    rig.poll()  # samples since the head's return may be queued
    known, life = len(rig.stream.whisk_starts), rig.stream.restarts

    def first_frame() -> int | None:
        """First frame of the next whisk, also of a reconnected head."""
        return next(iter(rig.stream.whisk_starts[known if rig.stream.restarts == life else 0 :]), None)

    longest = rig.config.head.patience + 2 / rate + 1.0
    silent, what = SessionOutcome.HEAD_SILENT, "the beginning of a whisk"
    rig.wait_until(lambda: first_frame() is not None, longest, silent, what)
    first = first_frame()
    assert first is not None
    device = float(rig.head.ring.between(first, first).time[0]) * 1e-6
    start = float(rig.stream.clock.to_host(device)) - rig.epoch
    return _WhiskSequence(number, first, device, start, round(count), 1 / rate)


def record_free_whisks(rig: Rig, count: int, late: list[float] | None = None) -> list[Cycle]:
    """Records whisks in free air, as raw cycles, for the calibration.

    Args:
        late: takes the time from the end of each to its last sample, s.
    """
    sequence = _next_sequence(rig, 0)
    record = []
    for number in range(count):
        first, last = sequence.frame_range(number)
        arrived, longest = partial(_has_arrived, rig, last), 3 * sequence.period + 1.0
        rig.wait_until(arrived, longest, SessionOutcome.HEAD_SILENT, "a whisk")
        if late is not None:
            due = float(rig.stream.clock.to_host(sequence.device + sequence.start_of(number + 1)))
            late.append(time.monotonic() - due)
        frames = rig.head.ring.between(first, last)
        begin = sequence.start_of(number)
        cut = Cut.of(number, begin, begin, frames, Odometry(0.0, 0.0, 0.0, 0.0))
        record.append(assemble_cycle(frames, cut))
    return record


def _hand_on(rig: Rig, sequence: _WhiskSequence, number: int, mapper: AsyncMapper) -> WhiskReport | None:
    """Passes on a whisk that is complete or `grace` late; returns None before."""
    first, last = sequence.frame_range(number)
    due = float(rig.stream.clock.to_host(sequence.device + sequence.start_of(number + 1)))
    now = time.monotonic()
    if not _has_arrived(rig, last) and now < due + rig.config.grace:
        return None
    frames = rig.head.ring.between(first, last)
    start = sequence.start + sequence.start_of(number)
    middle = sequence.start_of(number + MID_PROTRACTION)
    stamp, moment = sequence.start + middle, float(rig.stream.clock.to_host(sequence.device + middle))
    odometry, truth = rig.odometer.step(stamp, moment)
    # An image needs fewer than `gap` consecutive missing samples, and times without a larger gap either.
    gap, step = rig.config.gap, np.diff(frames.time)
    even = len(step) > 0 and step.min() > 0 and step.max() <= gap * np.median(step)
    numbers = np.concatenate([[first - 1], frames.sequence, [last + 1]])
    whole, slow = bool(np.diff(numbers).max() <= gap and even), mapper.behind() > rig.config.budget
    cut = Cut.of(number, stamp, start, frames, odometry, seen=whole and not slow)
    if not cut.seen:
        reason = "the mapper is behind" if whole else "samples are missing"
        rig.record_event("dropped", f"whisk {number}: {reason}")
    if rig.recorder is not None:
        rig.recorder.add_whisk(cut, frames, truth)
    mapper.offer(Sample(stamp, assemble_cycle(frames, cut), truth))
    missing = sequence.samples - len(frames.sequence)
    return WhiskReport(time.monotonic() - due, cut.seen, missing, truth)


def _has_arrived(rig: Rig, last: int) -> bool:
    """Whether sample `last` or a later one has arrived."""
    newest = rig.head.ring.newest
    return newest is not None and newest[0] >= last
