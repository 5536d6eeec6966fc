"""What both robots share in a live session: polling, the samples of a head, faults that end it, the mapper.

`PolledRig` is the base of the rigs: it waits for conditions while the devices are polled, and records events;
`HeadRig` is that of robots with whiskers.
`_HeadStream` collects the samples of a head, with its clock. `AsyncMapper` is the mapper as the loops see it.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from typing import Protocol, Self

import numpy as np

from robot.drivers.clock_sync import ClockSync
from robot.drivers.head.decoder import Frames
from robot.drivers.head.reader import HeadReader, LinkState
from robot.drivers.head.usb_protocol import FrameFlag
from robot.drivers.outcome import Fault, SessionOutcome
from robot.live.live_config import LiveConfig
from robot.live.recorder import LiveRecorder
from robot.sources.source import Sample

TICK = 0.01
"""Period of the poll, s."""


class SessionFault(Exception):
    """A fault ends the session."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(str(fault))
        self.fault = fault


class OperatorStop(Exception):
    """The operator ends the session."""


def session_fault(outcome: SessionOutcome, detail: str) -> SessionFault:
    """The exception that ends a session now."""
    return SessionFault(Fault(outcome, detail, time.monotonic()))


MAX_CLOCK_STEP = 2e-3
"""Largest step of the head's clock against its sample count, s."""


class _HeadStream:
    """Collects the blocks of a reader, from its thread, for the thread that polls.

    Attributes:
        clock: of the head, in host time. whisk_starts: sequence numbers of the first frames of whisks.
        restarts: number of connections of the head.
    """

    def __init__(self, head: HeadReader) -> None:
        self._head = head
        self.clock = ClockSync()
        self.whisk_starts: list[int] = []
        self.restarts = 0
        self._ahead: float | None = None  # s by which the head's clock leads its sample count
        self._uneven = 0.0
        self._blocks: queue.SimpleQueue[tuple[Frames, float] | None] = queue.SimpleQueue()
        head.on_restart.append(lambda device, host: self._blocks.put(None))
        head.listeners.append(lambda frames, arrival: self._blocks.put((frames, arrival)))

    @property
    def streaming(self) -> bool:
        """Whether the head sends samples."""
        return self._head.state is LinkState.STREAMING

    def take(self) -> Iterator[tuple[Frames, float]]:
        """The blocks since the last call, with their arrival times, s, host."""
        while not self._blocks.empty():
            block = self._blocks.get()
            if block is None:  # the head was reconnected: its clock may have changed
                self.clock, self.whisk_starts = ClockSync(), []
                self.restarts += 1
                self._ahead = None
                continue
            frames, arrival = block
            self.clock.observe(float(frames.time.max()) * 1e-6, arrival)
            # The head's clock and its sample count are both independent of the host's load.
            assert self._head.identity is not None
            ahead = frames.time * 1e-6 - frames.sequence / self._head.identity.rate
            before = ahead[0] if self._ahead is None else self._ahead
            self._uneven = max(self._uneven, float(np.abs(ahead - before).max()))
            self._ahead = float(ahead[-1])
            begins = (frames.flags & np.uint8(FrameFlag.CYCLE)) > 0
            self.whisk_starts += frames.sequence[begins].tolist()
            yield frames, arrival

    @property
    def fault(self) -> Fault | None:
        """The fault of the head or of its clock, or None."""
        if self._head.fault:
            return self._head.fault
        if self.clock.jumps:
            return Fault(SessionOutcome.CLOCK_JUMPED, "the head's clock jumped", time.monotonic())
        if self._uneven > MAX_CLOCK_STEP:
            detail = f"the head's clock is {self._uneven * 1e3:.1f} ms off its sample count"
            return Fault(SessionOutcome.CLOCK_JUMPED, detail, time.monotonic())
        return None


class PolledRig:
    """What a session polls.

    Args:
        stopped: whether the operator has requested the end.

    Attributes:
        epoch: time 0 of the session on the host's clock, s. recorder: recorder of all data, or None.
    """

    def __init__(self, config: LiveConfig, stopped: Callable[[], bool]) -> None:
        self.config = config
        self.epoch = time.monotonic()
        self.recorder: LiveRecorder | None = None
        self._stopped = stopped

    def now(self) -> float:
        """Session time, s."""
        return time.monotonic() - self.epoch

    def poll(self) -> None:
        """Reads the data of all devices.

        Raises:
            SessionFault, OperatorStop: the session must end.
        """
        raise NotImplementedError

    def wait_until(self, done: Callable[[], bool], longest: float, late: SessionOutcome, what: str) -> None:
        """Polls until a condition is true.

        Args:
            longest: time limit, s. late: outcome after that time. what: the awaited event, for the fault.
        """
        due = time.monotonic() + longest
        while not done():
            if time.monotonic() > due:
                raise session_fault(late, f"{what} took more than {longest:g} s")
            self.poll()
            time.sleep(TICK)

    def __enter__(self) -> Self:
        return self

    def record_event(self, name: str, text: str) -> None:
        """Records an event."""
        if self.recorder is not None:
            self.recorder.add_event(self.now(), name, text)


class HeadRig(PolledRig):
    """The devices of a robot with whiskers.

    Args:
        head: of the whiskers.

    Attributes:
        stream: samples and clock of the head.
    """

    def __init__(self, config: LiveConfig, head: HeadReader, stopped: Callable[[], bool]) -> None:
        PolledRig.__init__(self, config, stopped)
        self.head, self.stream = head, _HeadStream(head)

    def await_samples(self, whose: str) -> None:
        """Waits until the head (`whose`: its name and verb) sends samples again. The reader limits the time
        and turns it into a fault; see `wait_until`."""
        self.record_event("held", f"{whose} no samples")
        self.wait_until(lambda: self.stream.streaming, float("inf"), SessionOutcome.HEAD_GONE, whose)
        self.record_event("resumed", f"{whose} samples")


class AsyncMapper(Protocol):
    """The methods of `ratslam.live.mapper_process.Mapper` that a loop calls."""

    @property
    def alive(self) -> bool: ...
    @property
    def failure(self) -> str: ...
    def behind(self) -> float: ...
    def offer(self, sample: Sample, begins: bool = False) -> None: ...


def check_mapper(mapper: AsyncMapper) -> None:
    """Raises the `SessionFault` of a mapper that has ended."""
    if not mapper.alive:
        raise session_fault(SessionOutcome.MAPPER_GONE, mapper.failure)
