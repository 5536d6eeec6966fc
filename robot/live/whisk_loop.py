"""The whisk loop: moves along the route and passes each whisk to recorder and mapper."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from robot.drivers.head.cycle_assembly import assemble_cycle, make_cut
from robot.drivers.head.decoder import Frames
from robot.drivers.outcome import Fault, SessionOutcome
from robot.drivers.ur10.safety import TargetRefused
from robot.live.rig import TICK, Rig, SessionFault
from robot.live.route import Route
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Odometry
from tactile.whiskers.whisking import MID_PROTRACTION

MAX_ROUTE_TIME = 120.0
"""Longest duration of a route without whisks, s."""


class AsyncMapper(Protocol):
    """Asynchronous mapper interface."""

    @property
    def alive(self) -> bool:
        """Whether the mapper works."""
        ...

    @property
    def failure(self) -> str:
        """Why the mapper has ended."""
        ...

    def behind(self) -> float:
        """Waiting time of the oldest sample that is not mapped yet, s."""
        ...

    def offer(self, sample: Sample) -> None:
        """Passes the next sample; returns at once."""
        ...


class WhiskReport(NamedTuple):
    """How a whisk was passed on.

    Attributes:
        number: of the whisk. lateness: s from its end until then. seen: whether its image was included.
        missing: number of frames that had not arrived by then.
    """

    number: int
    lateness: float
    seen: bool
    missing: int


class WhiskSequence(NamedTuple):
    """A sequence of consecutive whisks, timed by the head's own clock.

    Attributes:
        number: of its first one. first: sequence of its first frame. device: s, that frame's time.
        start: s of the session. samples: frames of a whisk. period: s.
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
        """Time of a whisk, or of a moment in one, since the start of the sequence, s."""
        return (number - self.number) * self.period


def run_whisk_loop(rig: Rig, route: Route, mapper: AsyncMapper, tell: Callable[[WhiskReport], None]) -> None:
    """Moves along the route and passes on every whisk; ends with the whisk in which the arm arrives.

    The arm stands while the head sends no samples.

    Raises:
        robot.live.rig.SessionFault, robot.live.rig.OperatorStop.
    """
    number, most = 0, rig.config.whisks
    arrived = False
    while not arrived and number != most:
        sequence, life = next_sequence(rig, number), rig.restarts
        while rig.streaming and rig.restarts == life:
            _poll(rig, mapper)
            arrived = arrived or _advance(rig, route)
            handed = _hand_on(rig, sequence, number, mapper)
            if handed is None:
                time.sleep(TICK)
                continue
            tell(handed)
            number += 1
            if arrived or number == most:
                break
        else:
            wait_for_head(rig, route)


def follow_route(rig: Rig, route: Route) -> None:
    """Moves along a route without whisks."""
    rig.wait_until(lambda: _advance(rig, route), MAX_ROUTE_TIME, SessionOutcome.NOT_ARRIVED, "the way")


def wait_for_head(rig: Rig, route: Route) -> None:
    """Stops the arm until the head is back."""
    rig.arm.halt()
    rig.record_event("held", "the head sends nothing")
    # The reader limits the waiting time and turns it into a fault.
    rig.wait_until(lambda: rig.streaming, float("inf"), SessionOutcome.HEAD_GONE, "the head")
    rig.record_event("resumed", "the head is back")
    route.resend_last()


def next_sequence(rig: Rig, number: int) -> WhiskSequence:
    """The sequence that starts with the next whisk.

    Raises:
        InputError: the samples per whisk are not a whole number.
    """
    rate = rig.config.plan.whisking.rate
    assert rig.head.identity is not None
    count = rig.head.identity.rate / rate
    if abs(count - round(count)) > 1e-6:
        raise InputError("live.plan.whisking.rate", f"{count:g} samples a whisk", "a whole number of samples")
    rig.poll()  # samples sent since the head came back may be waiting
    known, life = len(rig.whisk_starts), rig.restarts

    def begun() -> int | None:
        """First frame of the first whisk to start from now on, also of a reconnected head."""
        return next(iter(rig.whisk_starts[known if rig.restarts == life else 0 :]), None)

    longest = rig.config.head.patience + 2 / rate + 1.0
    rig.wait_until(
        lambda: begun() is not None, longest, SessionOutcome.HEAD_SILENT, "the beginning of a whisk"
    )
    first = begun()
    assert first is not None
    device = float(rig.head.ring.between(first, first).time[0]) * 1e-6
    start = float(rig.clock.to_host(device)) - rig.epoch
    return WhiskSequence(number, first, device, start, round(count), 1 / rate)


def record_free_whisks(rig: Rig, count: int) -> list[Cycle]:
    """Whisks in free air, unprocessed, for the calibration."""
    sequence = next_sequence(rig, 0)
    record = []
    for number in range(count):
        first, last = sequence.frame_range(number)
        rig.wait_until(
            partial(_has_arrived, rig, last), 3 * sequence.period + 1.0, SessionOutcome.HEAD_SILENT, "a whisk"
        )
        frames = rig.head.ring.between(first, last)
        begin = sequence.start_of(number)
        cut = make_cut(number, begin, begin, frames, Odometry(0.0, 0.0, 0.0, 0.0))
        record.append(assemble_cycle(frames, cut))
    return record


def _hand_on(rig: Rig, sequence: WhiskSequence, number: int, mapper: AsyncMapper) -> WhiskReport | None:
    """Passes on a whisk that is complete or was awaited long enough; None while it is neither."""
    first, last = sequence.frame_range(number)
    due = float(rig.clock.to_host(sequence.device + sequence.start_of(number + 1)))
    now = time.monotonic()
    if not _has_arrived(rig, last) and now < due + rig.config.grace:
        return None
    frames = rig.head.ring.between(first, last)
    start = sequence.start + sequence.start_of(number)
    stamp = sequence.start + sequence.start_of(number + MID_PROTRACTION)
    odometry, truth = rig.odometer.step(
        stamp, float(rig.clock.to_host(sequence.device + sequence.start_of(number + MID_PROTRACTION)))
    )
    whole, slow = _is_complete(frames, first, last, rig.config.gap), mapper.behind() > rig.config.budget
    cut = make_cut(number, stamp, start, frames, odometry, seen=whole and not slow)
    if not cut.seen:
        rig.record_event(
            "dropped", f"whisk {number}: " + ("the mapper is behind" if whole else "samples are missing")
        )
    if rig.recorder is not None:
        rig.recorder.add_whisk(cut, frames, truth)
    mapper.offer(Sample(stamp, assemble_cycle(frames, cut), truth))
    return WhiskReport(number, time.monotonic() - due, cut.seen, sequence.samples - len(frames.sequence))


def _advance(rig: Rig, route: Route) -> bool:
    """Whether the arm has arrived at the end of the route; at a target, the next one is sent."""
    try:
        return route.advance(rig.arm)
    except TargetRefused as error:  # for what ends it anyway, or for the target
        fault = rig.arm.fault or Fault(SessionOutcome.OUT_OF_BOX, str(error), time.monotonic())
        raise SessionFault(fault) from error


def _poll(rig: Rig, mapper: AsyncMapper) -> None:
    rig.poll()
    if not mapper.alive:
        raise SessionFault(Fault(SessionOutcome.MAPPER_GONE, mapper.failure, time.monotonic()))


def _has_arrived(rig: Rig, last: int) -> bool:
    """Whether that sample or a later one has arrived."""
    newest = rig.head.ring.newest
    return newest is not None and newest[0] >= last


def _is_complete(frames: Frames, first: int, last: int, gap: int) -> bool:
    """Whether fewer than `gap` consecutive samples are missing, and the times have no larger gap either."""
    known = np.concatenate([[first - 1], frames.sequence, [last + 1]])
    step = np.diff(frames.time)
    even = len(step) > 0 and step.min() > 0 and step.max() <= gap * np.median(step)
    return bool(np.diff(known).max() <= gap and even)
