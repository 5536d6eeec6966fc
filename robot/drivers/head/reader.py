"""Reader thread of a head: reads samples, sends commands, reconnects.

Only this thread uses the bridge.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from enum import Enum

import numpy as np

from robot.drivers.head.decoder import Decoder, Frames, FrameWindow
from robot.drivers.head.device import Bridge, Disconnected, HeadIdentity, Stalled
from robot.drivers.head.driver_config import HeadLinkConfig
from robot.drivers.head.usb_protocol import ANGLE, CHANNELS, KEEP_ALIVE, Command, CommandKind, Request
from robot.drivers.outcome import Fault, SessionOutcome
from tactile.base.errors import InputError

READ_SIZE = 4096
"""Bytes requested by a read: 16 ms of 18 whiskers at 2 kHz."""
READ_TIMEOUT = 0.02
"""Time-out of a read, and so about the longest delay of a command, s."""
RETRY_PERIOD = 0.25
"""Time between attempts to find a disconnected head or to start a silent one, s."""


class LinkState(Enum):
    """State of the link."""

    STREAMING = "the head sends samples"
    SILENT = "the head is connected but sends no samples"
    GARBLED = "the head sends no valid samples"
    AWAY = "the head is not connected"
    CLOSED = "the reader is closed"


DEFAULT = HeadLinkConfig()
OUTCOMES = {
    LinkState.SILENT: SessionOutcome.HEAD_SILENT,
    LinkState.GARBLED: SessionOutcome.HEAD_GARBLED,
    LinkState.AWAY: SessionOutcome.HEAD_GONE,
}


class HeadReader:
    """Reads a head from `start` to `close`.

    Args:
        connect: opens the bridge; called again when the head was disconnected. whiskers: required number.
        config: time limits. decoder: of the stream; None for that of `robot.drivers.head.usb_protocol`.
        alive: [W] whiskers checked for overload; None for all. on_overload: called with the whisker for each
            block of samples with an overload.

    Attributes:
        ring: the newest samples. listeners: called with every block of samples and its arrival time (s,
            host). on_restart: called with the device clock (us) and the host's (s) after each connection:
            numbers and clock may have restarted. All are called on the reader's thread and must return
            quickly.
        identity: of the last connected head. stalls: number of failed transfers.
    """

    def __init__(
        self,
        connect: Callable[[], Bridge],
        whiskers: int,
        config: HeadLinkConfig = DEFAULT,
        *,
        decoder: Decoder | None = None,
        alive: np.ndarray | None = None,
        on_overload: Callable[[int], None] = lambda whisker: None,
    ) -> None:
        self.config = config
        self.decoder = Decoder(whiskers) if decoder is None else decoder
        self.ring = FrameWindow(whiskers)
        self.listeners: list[Callable[[Frames, float], None]] = []
        self.on_restart: list[Callable[[int, float], None]] = []
        self.identity: HeadIdentity | None = None
        self.stalls = 0
        self._connect, self._whiskers, self._on_overload = connect, whiskers, on_overload
        checked = np.ones(whiskers, bool) if alive is None else alive
        self._overload = OverloadDetector(config.overload, checked)
        self._queue = _CommandQueue()
        self._ending, self._tried = threading.Event(), threading.Event()
        self._refusal: Exception | None = None
        self._fault: Fault | None = None
        self._away = False
        self._sample = self._bytes = -np.inf
        self._thread = threading.Thread(target=self._run, name="head reader", daemon=True)

    def start(self, timeout: float = 5.0) -> HeadReader:
        """Connects to the head and starts its stream.

        Raises:
            InputError: no head within `timeout` s, or one of another shape.
        """
        self._sample, self._away = time.monotonic(), True
        self._thread.start()
        if not self._tried.wait(timeout) or self._refusal is not None:
            self.close()
            if isinstance(self._refusal, InputError):
                raise self._refusal
            cure = "plug it in, or correct `head.address`"
            raise InputError("head", str(self._refusal or "no answer"), "", cure) from self._refusal
        return self

    def close(self) -> None:
        """Stops the head and releases it."""
        self._ending.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(5.0)

    def __enter__(self) -> HeadReader:
        return self.start()

    def __exit__(self, *error: object) -> None:
        self.close()

    def send(self, command: Command) -> None:
        """Queues a command, to be sent within about `READ_TIMEOUT`; the head is kept awake from now on."""
        self._queue.put(command)

    def rest(self) -> None:
        """Stops the keep-alive commands, so that the head retracts within `COMMAND_TIMEOUT`."""
        self._queue.rest()

    @property
    def state(self) -> LinkState:
        """State of the link; also correct while the thread hangs in a transfer."""
        now, sample, away = time.monotonic(), self._sample, self._away
        if self._ending.is_set() or not self._thread.is_alive():
            return LinkState.CLOSED
        if away:
            return LinkState.AWAY
        if now - sample <= self.config.silence:
            return LinkState.STREAMING
        return LinkState.GARBLED if self._bytes > sample else LinkState.SILENT

    @property
    def age(self) -> float:
        """Age of the newest sample, s."""
        return time.monotonic() - self._sample

    @property
    def fault(self) -> Fault | None:
        """The reason to end the session, or None; a fault stays."""
        link = self.state
        lost = link in OUTCOMES and self.age > self.config.patience
        if self._fault is None and lost:
            why = f" ({self._refusal})" if self._refusal else ""
            detail = f"{link.value}{why}, {self.age:.1f} s after the last sample"
            self._fault = Fault(OUTCOMES[link], detail, time.monotonic())
        return self._fault

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                try:
                    with contextlib.closing(self._open()) as bridge:
                        self._serve(bridge)
                except (Disconnected, Stalled, InputError) as error:
                    self._refusal = error
                self._tried.set()
                self._away = True
                self._ending.wait(RETRY_PERIOD)
        except Exception as error:
            detail = f"the reader thread ended: {type(error).__name__}: {error}"
            self._fault = Fault(SessionOutcome.HEAD_GONE, detail, time.monotonic())
            raise

    def _open(self) -> Bridge:
        """Opens the bridge, checks the head and sends it the persistent commands."""
        bridge = self._connect()
        try:
            self.identity = found = HeadIdentity.read(bridge)
            if (found.whiskers, found.channels) != (self._whiskers, CHANNELS):
                shape = f"{found.whiskers} whiskers of {found.channels} channels"
                raise InputError("head", f"{found.name} has {shape}", f"{self._whiskers} of {CHANNELS}")
            clock = int.from_bytes(bridge.request(Request.CLOCK)[:8], "little")
            self.decoder.restart(clock)
            for callback in self.on_restart:
                callback(clock, time.monotonic())
            self._queue.resend_persistent()
            bridge.request(Request.START)
        except BaseException:
            bridge.close()
            raise
        self._refusal, self._away = None, False
        self._tried.set()
        return bridge

    def _serve(self, bridge: Bridge) -> None:
        started = time.monotonic()
        while not self._ending.is_set():
            data = b""
            with self._ignore_stall():
                data = bridge.read(READ_SIZE, READ_TIMEOUT)
            now = time.monotonic()
            if data:
                self._bytes = now
                self._accept(self.decoder.feed(data), now)
            elif now - max(started, self._sample) > max(RETRY_PERIOD, self.config.silence):
                started = now
                with self._ignore_stall():
                    bridge.request(Request.START)
            with self._ignore_stall():
                while (command := self._queue.next(now)) is not None:
                    bridge.write(command.pack())
                    self._queue.mark_sent(command, now)
        with self._ignore_stall():
            bridge.request(Request.STOP)

    def _accept(self, frames: Frames, now: float) -> None:
        if not len(frames.sequence):
            return
        self._sample = now
        self.ring.add(frames, now)
        whisker = self._overload.check(frames.values)
        if whisker is not None:
            self._on_overload(whisker)
        for listener in self.listeners:
            listener(frames, now)

    @contextlib.contextmanager
    def _ignore_stall(self) -> Iterator[None]:
        """Ignores a failed transfer and waits 5 ms, since the next one may fail too."""
        try:
            yield
        except Stalled:
            self.stalls += 1
            self._ending.wait(0.005)


KEEP_ALIVE_PERIOD = 0.2
"""Longest time between commands, s; a head retracts 0.5 s after the last one."""
PERSISTENT = (CommandKind.CENTRE, CommandKind.DRIVE)
"""Commands that stay valid until replaced, in the order in which they are sent again."""


class _CommandQueue:
    """Any thread adds commands; the reader's thread sends them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[Command] = deque()
        self._lasting: dict[CommandKind, Command] = {}
        self._awake = False
        self._sent = -float("inf")

    def put(self, command: Command) -> None:
        """Adds a command. Amplitudes replace queued ones."""
        with self._lock:
            if command.kind == CommandKind.AMPLITUDES:
                self._waiting = deque(other for other in self._waiting if other.kind != command.kind)
            if command.kind in PERSISTENT:
                self._lasting[command.kind] = command
            self._waiting.append(command)
            self._awake = True

    def rest(self) -> None:
        """Ends the keep-alive commands, so that the head retracts."""
        with self._lock:
            self._waiting.clear()
            self._lasting.clear()
            self._awake = False

    def resend_persistent(self) -> None:
        """Queues the persistent commands again, which a restarted head has lost."""
        with self._lock:
            self._waiting = deque(self._lasting[kind] for kind in PERSISTENT if kind in self._lasting)

    def next(self, now: float) -> Command | None:
        """The command to send at a host time, s, or None; a keep-alive if the queue is empty."""
        with self._lock:
            if self._waiting:
                return self._waiting[0]
            return KEEP_ALIVE if self._awake and now - self._sent >= KEEP_ALIVE_PERIOD else None

    def mark_sent(self, command: Command, now: float) -> None:
        """Removes a command sent at a host time, s."""
        with self._lock:
            self._sent = now
            if self._waiting and self._waiting[0] is command:
                self._waiting.popleft()


FULL_SCALE = 32767
"""Least counts at the end of the sensor's range."""


class OverloadDetector:
    """Finds whiskers overloaded in two consecutive samples; a single one is a transmission error or a knock.

    Args:
        limit: deflection of x or y, rad. alive: [W] bool, whiskers to check.
    """

    def __init__(self, limit: float, alive: np.ndarray) -> None:
        self._limit = min(limit / ANGLE, FULL_SCALE)
        self._alive = np.asarray(alive, bool)
        self._before = np.zeros(len(self._alive), bool)

    def check(self, values: np.ndarray) -> int | None:
        """The first whisker overloaded in values [N, W, 3], int16 counts, or between these and the previous
        ones; None without one."""
        if not len(values):
            return None
        size = np.abs(values.astype(np.int32))  # int16 has no 32768
        beyond = ((size[..., 0] >= FULL_SCALE) | (size[..., 1:] >= self._limit).any(axis=-1)) & self._alive
        twice = beyond & np.concatenate([self._before[None], beyond[:-1]])
        self._before = beyond[-1]
        return int(np.flatnonzero(twice.any(axis=0))[0]) if twice.any() else None
