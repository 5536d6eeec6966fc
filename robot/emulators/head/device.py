"""An emulated head at its USB interface: transfers, and frames over time.

Times are arguments: no function waits or reads a clock.
"""

from __future__ import annotations

import errno
import json
import os
from collections import Counter
from typing import Any

import numpy as np

from robot.drivers.head.protocol import (
    CHANNELS,
    REQUEST_IN,
    VERSION,
    FrameFlag,
    Request,
    frame_values,
    pack_frames,
    unpack_command,
)
from robot.emulators.head import usb_descriptors
from robot.emulators.head.config import BridgeEmulatorConfig
from robot.emulators.head.faults import HeadFaults
from robot.emulators.head.fifo import Fifo
from robot.emulators.head.sensor_array import Block, SensorArray, block_samples
from tactile.base.random_streams import stream

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
        self.faults = HeadFaults(whiskers.count, stream(config.seed, "faults"))
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
        command = unpack_command(packet)
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
        if (kind, request) == STRING and value >> 8 == 3:
            answer = usb_descriptors.string(value & 0xFF)
        elif (kind, request) == CONFIGURED:
            answer = b"\1"
        elif (kind, request) in (CONFIGURE, ALTERNATE):
            answer = b""
        elif kind & 0x60 == REQUEST_IN & 0x60 and request in set(Request):
            answer = self._vendor(Request(request), now)
        else:
            answer = None
        if answer is None:
            raise OSError(errno.EPIPE, os.strerror(errno.EPIPE))
        return answer[:size]

    def do(self, request: dict[str, Any], now: float) -> dict[str, Any]:
        """Starts a fault, or returns counts or state: {"do": name, ...}.

        Raises:
            ValueError, TypeError: unknown fault or invalid arguments.
        """
        arguments = dict(request)
        name = str(arguments.pop("do", ""))
        if name == "counts":
            return self.counts()
        if name == "state":
            return self.state(now)
        self.faults.do(name, now, arguments)
        if name == "unplug":
            self.halt()
        return {"ok": True}

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

    def _vendor(self, request: Request, now: float) -> bytes:
        if request == Request.START:
            self.fifo.clear()
            self.streaming = True
            self.whiskers.begin(self._when(self._made))
        elif request == Request.STOP:
            self.halt()
        elif request == Request.CLOCK:
            return self._clock(now).to_bytes(8, "little")
        else:
            identity = {
                "name": "emulated head",
                "version": f"{VERSION}",
                "whiskers": self.whiskers.count,
                "channels": CHANNELS,
                "rate": self.config.stream.rate,
            }
            return json.dumps(identity).encode()
        return b""

    def _send(self, block: Block, now: float) -> None:
        flags = np.where(block.begins, FrameFlag.CYCLE, 0) | (FrameFlag.RCP if block.fed_back else 0)
        values = frame_values(block.angle, block.deflection)
        values = self.faults.saturate_values(values, self.config.stream.full_scale, now)
        some = slice(self.samples - self.faults.count_unskipped(self.samples), None)
        sample = self._made + np.arange(self.samples)[some]
        if len(sample) == 0:
            return
        flags = flags[some]
        flags[0] |= FrameFlag.OVERRUN if self.fifo.overran else 0
        number = self._first + sample
        time = np.rint(number * (1e6 / self.config.stream.rate)).astype(np.int64) + self.faults.jump
        raw = pack_frames(number, time, flags, values[some])
        size = len(raw) // len(sample)
        frames = [raw[k : k + size] for k in range(0, len(raw), size)]
        self.fifo.push(self.faults.damage_frames(frames))

    def _clock(self, now: float) -> int:
        """Time since power-on by the head's clock, us."""
        seconds = self.config.age + (now - self.began) * self._pace
        return max(round(seconds * 1e6) + self.faults.jump, 0)

    def _when(self, sample: int) -> float:
        """Host time of a sample, s."""
        return self.began + sample / (self.config.stream.rate * self._pace)
