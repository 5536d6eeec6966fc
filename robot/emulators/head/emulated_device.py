"""An emulated head at its USB interface: descriptors, transfers, frames over time, and its faults.

Times are arguments: no function waits or reads a clock.
"""

from __future__ import annotations

import errno
import json
import os
import struct
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from robot.drivers.head import usb_protocol as usb
from robot.drivers.head.emulated_cable import usb_error
from robot.emulators.head.emulator_config import BridgeEmulatorConfig
from robot.emulators.head.whiskers import Block, SensorArray, block_samples
from robot.emulators.listening import do_fault
from tactile.base.random_streams import stream

STRINGS = ("", "ratslam", "emulated whisker head", "EMULATED")
"""String descriptors by index: none, manufacturer, product, serial."""
LANGUAGE = 0x0409
"""Language of the strings: English."""
PACKET = 512
"""Size of a high-speed bulk packet, bytes."""


_ENDS = b"".join(
    struct.pack("<BBBBHB", 7, 5, end, 2, PACKET, 0) for end in (usb.ENDPOINT_IN, usb.ENDPOINT_OUT)
)
DESCRIPTORS = (
    struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x0200, 0xFF, 0, 0, 64, usb.VENDOR, usb.PRODUCT, 0x0100, 1, 2, 3, 1)
    + struct.pack("<BBHBBBBB", 9, 2, 9 + 9 + len(_ENDS), 1, 1, 0, 0xC0, 0)
    + struct.pack("<9B", 9, 4, usb.INTERFACE, 0, 2, 0xFF, 0, 0, 0)
    + _ENDS
)
"""Descriptors of the device (USB 2.0, vendor-specific class) and of its only configuration (self-powered, one
interface, bulk endpoints in and out)."""

STRING, CONFIGURE, CONFIGURED, ALTERNATE = (0x80, 6), (0x00, 9), (0x80, 8), (0x01, 11)
"""Supported standard requests, by bmRequestType and bRequest."""


class EmulatedHead:
    """A powered head.

    Args:
        whiskers: the simulated whiskers. now: host time at which the head's clock starts, s.

    Attributes:
        fifo: frames for the host. faults: active faults. whiskers: as given. streaming: whether
        frames are made. received: number of commands by kind; "" counts ignored ones.
    """

    def __init__(self, config: BridgeEmulatorConfig, whiskers: SensorArray, now: float) -> None:
        self.config, self.whiskers, self.began = config, whiskers, now
        self.samples = block_samples(config.stream.rate)
        self.fifo = Fifo(config.fifo)
        self.faults = _HeadFaults(whiskers.count, stream(config.seed, "faults"))
        self.streaming = False
        self.received: Counter[str] = Counter()
        self._pace = 1 + config.drift_ppm * 1e-6  # clock rate
        self._made = 0  # samples
        self._first = round(config.age * config.stream.rate)

    @property
    def due(self) -> float:
        """Time at which the next block is complete, s."""
        return self._when(self._made + self.samples)

    def advance(self, now: float) -> bool:
        """Makes the next block if it is complete at `now`, s; returns whether it was."""
        end = self.due
        if now < end:
            return False
        if self.streaming or not self.whiskers.resting:
            block = self.whiskers.block(self._when(self._made), end)
            if self.streaming:
                self._send(block, end)
        else:
            self.whiskers.skip_block()
        self._made += self.samples
        return True

    def bulk_in(self, size: int, now: float) -> bytes:
        """Reads at most `size` bytes of frames.

        Raises:
            OSError: EPIPE while the endpoint is halted.
        """
        return self.fifo.take(size) if self.faults.check_in(now) else b""

    def bulk_out(self, packet: bytes, now: float) -> None:
        """Executes a command packet; an invalid one is ignored and counted."""
        command = usb.Command.unpack(packet)
        if command is None:
            self.received[""] += 1
            return
        self.received[command.kind.name] += 1
        self.whiskers.receive(command, now)

    def control(self, kind: int, request: int, value: int, size: int, now: float) -> bytes:
        """The answer to a control request, at most `size` bytes.

        Raises:
            OSError: EPIPE for an unsupported request.
        """
        answer: bytes | None = None
        if (kind, request) == STRING and value >> 8 == 3:
            number = value & 0xFF
            if number < len(STRINGS):  # index 0 gives the language
                text = STRINGS[number].encode("utf-16-le") if number else struct.pack("<H", LANGUAGE)
                answer = struct.pack("<BB", 2 + len(text), 3) + text
        elif (kind, request) == CONFIGURED:
            answer = b"\1"
        elif (kind, request) in (CONFIGURE, ALTERNATE):
            answer = b""
        elif kind & 0x60 == usb.REQUEST_IN & 0x60 and request in set(usb.Request):
            answer = self._vendor(usb.Request(request), now)
        if answer is None:
            raise usb_error(errno.EPIPE)
        return answer[:size]

    def do(self, request: dict[str, Any], now: float) -> dict[str, Any]:
        """Starts a fault, or returns counts or state (`robot.emulators.listening.do_fault`)."""
        self.faults.now = now
        known = self.faults.known | {"counts": self.counts, "state": lambda: self.state(now)}
        answer = do_fault(known, request)
        if request.get("do") == "unplug":
            self.halt()
        return answer

    def halt(self) -> None:
        """Retracts the whiskers, stops making frames and drops unread ones."""
        self.streaming = False
        self.whiskers.stop()
        self.fifo.clear()

    def counts(self) -> dict[str, int]:
        """Frames: made = sent + queued + lost (not read) + dropped (by a stop) + skipped (by a fault)."""
        fifo, skipped = self.fifo, self.faults.skipped
        return {
            "made": fifo.made + skipped,
            "sent": fifo.sent,
            "queued": len(fifo),
            "lost": fifo.lost,
            "dropped": fifo.dropped,
            "skipped": skipped,
        }

    def state(self, now: float) -> dict[str, Any]:
        """Pose and activity, as JSON values."""
        return {
            "plugged": self.faults.plugged,
            "streaming": self.streaming,
            **self.whiskers.state(now),
            "commands": dict(self.received),
            "sequence": self._first + self._made,
            "late": now - self.due + self.samples / (self.config.stream.rate * self._pace),
        }

    def _vendor(self, request: usb.Request, now: float) -> bytes:
        if request == usb.Request.START:
            self.fifo.clear()
            self.streaming = True
            self.whiskers.begin(self._when(self._made))
        elif request == usb.Request.STOP:
            self.halt()
        elif request == usb.Request.CLOCK:
            seconds = self.config.age + (now - self.began) * self._pace
            return max(round(seconds * 1e6) + self.faults.jump, 0).to_bytes(8, "little")
        else:
            identity = {
                "name": "emulated head",
                "version": f"{usb.VERSION}",
                "whiskers": self.whiskers.count,
                "channels": usb.CHANNELS,
                "rate": self.config.stream.rate,
            }
            return json.dumps(identity).encode()
        return b""

    def _send(self, block: Block, now: float) -> None:
        flags = np.where(block.begins, usb.FrameFlag.CYCLE, 0) | (usb.FrameFlag.RCP if block.fed_back else 0)
        values = usb.frame_values(block.angle, block.deflection)
        values = self.faults.saturate_values(values, self.config.stream.full_scale, now)
        some = slice(self.samples - self.faults.count_unskipped(self.samples), None)
        sample = self._made + np.arange(self.samples)[some]
        if len(sample) == 0:
            return
        flags = flags[some]
        flags[0] |= usb.FrameFlag.OVERRUN if self.fifo.overran else 0
        number = self._first + sample
        time = np.rint(number * (1e6 / self.config.stream.rate)).astype(np.int64) + self.faults.jump
        raw = usb.pack_frames(number, time, flags, values[some])
        size = len(raw) // len(sample)
        frames = [raw[k : k + size] for k in range(0, len(raw), size)]
        self.fifo.push(self.faults.damage_frames(frames))

    def _when(self, sample: int) -> float:
        """Host time of a sample, s."""
        return self.began + sample / (self.config.stream.rate * self._pace)


HEADER = 20 - 4
"""Length of a frame before its values, bytes."""


class _HeadFaults:
    """Active faults; times are the host's monotonic clock, s.

    Attributes:
        plugged: whether the head is on the bus. plugs: number of times it was plugged in; earlier connections
            are invalid. skipped: number of skipped frames. jump: offset of the head's clock, us.
    """

    def __init__(self, whiskers: int, random: np.random.Generator) -> None:
        self.plugged, self.plugs = True, 1
        self.skipped, self.jump = 0, 0
        self._whiskers, self._random = whiskers, random
        self._pending: Counter[str] = Counter()  # bytes of garbage; frames to corrupt, skip and swap
        self._saturated: dict[int, float] = {}
        self._halted, self._halted_until, self._silent_until = False, -np.inf, -np.inf
        self.now = 0.0  # of a request
        self.known: dict[str, Callable[..., Any]] = {
            "unplug": lambda: setattr(self, "plugged", False),
            "plug": self._plug,
            "stall": self._stall,
            "silence": lambda seconds=1.0: setattr(self, "_silent_until", self.now + float(seconds)),
            "garbage": lambda bytes=64: self._pending.update(garbage=int(bytes)),
            "corrupt": lambda frames=1: self._pending.update(corrupt=int(frames)),
            "skip": lambda frames=1: self._pending.update(skip=int(frames)),
            "swap": lambda frames=1: self._pending.update(swap=int(frames)),
            "clock": lambda jump_us: setattr(self, "jump", self.jump + int(jump_us)),
            "saturate": self._saturate,
            "die": lambda: os._exit(1),
        }
        """Faults by name; each takes its arguments."""

    def check_in(self, now: float) -> bool:
        """Whether the frame endpoint returns data."""
        if self._halted or now < self._halted_until:
            self._halted = True
            raise usb_error(errno.EPIPE)
        return now >= self._silent_until

    def clear_halt(self) -> None:
        """Clears the halt; it returns while its cause lasts."""
        self._halted = False

    def saturate_values(self, values: np.ndarray, full_scale: float, now: float) -> np.ndarray:
        """Values [T, W, 3], with the deflections of saturated whiskers at full scale (rad)."""
        for whisker, until in list(self._saturated.items()):
            if now < until:
                values[:, whisker, 1:] = usb.to_counts(np.array(full_scale))
            else:
                del self._saturated[whisker]
        return values

    def count_unskipped(self, count: int) -> int:
        """Number of frames to send of the next `count`; the first ones are skipped."""
        out = min(self._pending["skip"], count)
        self._pending["skip"] -= out
        self.skipped += out
        return count - out

    def damage_frames(self, frames: list[bytes]) -> list[bytes]:
        """The frames after pending faults (corrupt, garbage, swap); their number is unchanged."""
        for k in range(min(self._pending["corrupt"], len(frames))):
            place = HEADER + int(self._random.integers(len(frames[k]) - HEADER))
            frames[k] = frames[k][:place] + bytes([frames[k][place] ^ 0x55]) + frames[k][place + 1 :]
            self._pending["corrupt"] -= 1
        if self._pending["garbage"] and frames:
            frames[0] = self._random.bytes(self._pending.pop("garbage")) + frames[0]
        if self._pending["swap"] and len(frames) > 1:
            frames[-2:] = frames[:-3:-1]
            self._pending["swap"] -= 1
        return frames

    def _plug(self) -> None:
        self.plugs += not self.plugged
        self.plugged, self._halted, self._halted_until = True, False, -np.inf

    def _stall(self, seconds: float = 0.0) -> None:
        self._halted, self._halted_until = True, self.now + float(seconds)

    def _saturate(self, whisker: int = 0, seconds: float = 1.0) -> None:
        if not 0 <= whisker < self._whiskers:
            raise ValueError(f"whisker {whisker}; the head has 0 to {self._whiskers - 1}")
        self._saturated[whisker] = self.now + float(seconds)


class Fifo:
    """A bounded queue; frames made while it is full are lost.

    Attributes:
        made, sent, lost, dropped: number of frames pushed, completely read, lost because the queue was full,
            and dropped by `clear`; made = sent + lost + dropped + len(fifo).
        overran: whether the newest frame was lost.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.made = self.sent = self.lost = self.dropped = 0
        self.overran = False
        self._frames: deque[bytes] = deque()
        self._begun = b""  # the unread rest of a partly read frame

    def __len__(self) -> int:
        """Number of frames in the queue."""
        return len(self._frames) + bool(self._begun)

    def push(self, frames: Sequence[bytes]) -> None:
        """Adds the first frames that fit."""
        fits = frames[: self.capacity - len(self)]
        self._frames.extend(fits)
        self.made += len(frames)
        self.lost += len(frames) - len(fits)
        self.overran = len(fits) < len(frames)

    def take(self, size: int) -> bytes:
        """Removes and returns at most `size` bytes."""
        parts, left = [], size
        while left and (self._begun or self._frames):
            frame = self._begun or self._frames.popleft()
            parts.append(frame[:left])
            self._begun = frame[left:]
            left -= len(parts[-1])
            self.sent += not self._begun
        return b"".join(parts)

    def clear(self) -> None:
        """Drops all frames."""
        self.dropped += len(self)
        self._frames.clear()
        self._begun, self.overran = b"", False
