"""Faults of an emulated head, on request."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from typing import Any

import numpy as np

from robot.drivers.head.protocol import to_counts

HEADER = 20 - 4
"""Length of a frame before its values, bytes."""


class HeadFaults:
    """Active faults; times are the host's monotonic clock, s.

    Attributes:
        plugged: whether the head is on the bus. plugs: number of times it was plugged in; earlier connections
            are invalid. skipped: number of skipped frames. jump: offset of the head's clock, us.
    """

    def __init__(self, whiskers: int, random: np.random.Generator) -> None:
        self.plugged, self.plugs = True, 1
        self.skipped, self.jump = 0, 0
        self._whiskers, self._random = whiskers, random
        self._skip = self._corrupt = self._garbage = self._swap = 0
        self._saturated: dict[int, float] = {}
        self._halted, self._halted_until, self._silent_until = False, -np.inf, -np.inf
        self.known: dict[str, Callable[..., None]] = {
            "unplug": self._unplug,
            "plug": self._plug,
            "stall": self._stall,
            "silence": self._silence,
            "garbage": lambda now, bytes=64: self._count("_garbage", bytes),
            "corrupt": lambda now, frames=1: self._count("_corrupt", frames),
            "skip": lambda now, frames=1: self._count("_skip", frames),
            "swap": lambda now, frames=1: self._count("_swap", frames),
            "clock": lambda now, jump_us: self._jump(jump_us),
            "saturate": self._saturate,
            "die": lambda now: os._exit(1),
        }
        """Faults by name; each takes the time and its arguments."""

    def do(self, name: str, now: float, arguments: dict[str, Any]) -> None:
        """Starts a fault.

        Raises:
            ValueError, TypeError: unknown fault or invalid arguments.
        """
        if name not in self.known:
            raise ValueError(f"{name!r}; known are {', '.join(self.known)}, counts, state")
        self.known[name](now, **arguments)

    def check_in(self, now: float) -> bool:
        """Whether the frame endpoint returns data.

        Raises:
            OSError: EPIPE while the endpoint is halted.
        """
        if self._halted or now < self._halted_until:
            self._halted = True
            raise OSError(errno.EPIPE, os.strerror(errno.EPIPE))
        return now >= self._silent_until

    def clear_halt(self) -> None:
        """Clears the halt; it returns while its cause lasts."""
        self._halted = False

    def saturate_values(self, values: np.ndarray, full_scale: float, now: float) -> np.ndarray:
        """Values [T, W, 3], with the deflections of saturated whiskers at full scale (rad)."""
        for whisker, until in list(self._saturated.items()):
            if now < until:
                values[:, whisker, 1:] = to_counts(np.array(full_scale))
            else:
                del self._saturated[whisker]
        return values

    def count_unskipped(self, count: int) -> int:
        """Number of frames to send of the next `count`; the first ones are skipped."""
        out = min(self._skip, count)
        self._skip -= out
        self.skipped += out
        return count - out

    def damage_frames(self, frames: list[bytes]) -> list[bytes]:
        """The frames after pending faults (corrupt, garbage, swap); their number is unchanged."""
        for k in range(min(self._corrupt, len(frames))):
            place = HEADER + int(self._random.integers(len(frames[k]) - HEADER))
            frames[k] = frames[k][:place] + bytes([frames[k][place] ^ 0x55]) + frames[k][place + 1 :]
            self._corrupt -= 1
        if self._garbage and frames:
            frames[0] = self._random.bytes(self._garbage) + frames[0]
            self._garbage = 0
        if self._swap and len(frames) > 1:
            frames[-2:] = frames[:-3:-1]
            self._swap -= 1
        return frames

    def _count(self, name: str, more: int) -> None:
        setattr(self, name, getattr(self, name) + int(more))

    def _unplug(self, now: float) -> None:
        self.plugged = False

    def _plug(self, now: float) -> None:
        self.plugs += not self.plugged
        self.plugged, self._halted, self._halted_until = True, False, -np.inf

    def _stall(self, now: float, seconds: float = 0.0) -> None:
        self._halted, self._halted_until = True, now + float(seconds)

    def _silence(self, now: float, seconds: float = 1.0) -> None:
        self._silent_until = now + float(seconds)

    def _jump(self, jump_us: int) -> None:
        self.jump += int(jump_us)

    def _saturate(self, now: float, whisker: int = 0, seconds: float = 1.0) -> None:
        if not 0 <= whisker < self._whiskers:
            raise ValueError(f"whisker {whisker}; the head has 0 to {self._whiskers - 1}")
        self._saturated[whisker] = now + float(seconds)
