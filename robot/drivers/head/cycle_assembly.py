"""Assembles the frames of one whisk into a cycle: the same function live and in replay."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from robot.drivers.head.decoder import Frames
from robot.drivers.head.usb_protocol import CHANNELS, to_radians
from tactile.base.types import Cycle, Odometry

MAX_FRAMES = 1 << 16
"""Number of frames kept for later whisks: half a minute at 2 kHz."""


class Cut(NamedTuple):
    """The frames of a whisk, with its times and odometry.

    Attributes:
        number: of the whisk. time: of its sample, s. start: of the whisk, s, on the same clock.
        first, last: sequence numbers of its first and last frame. frames: number of these that arrived.
        odometry: motion since the previous whisk.
        seen: whether its frames become a reading; False where its image was dropped, which does not affect
            the motion.
    """

    number: int
    time: float
    start: float
    first: int
    last: int
    frames: int
    odometry: Odometry
    seen: bool


def make_cut(
    number: int, time: float, start: float, frames: Frames, odometry: Odometry, seen: bool = True
) -> Cut:
    """The cut of exactly these frames; not `seen` without frames."""
    count = len(frames.sequence)
    first, last = (int(frames.sequence.min()), int(frames.sequence.max())) if count else (0, -1)
    return Cut(number, float(time), float(start), first, last, count, odometry, bool(seen and count))


def select_frames(frames: Frames, first: int, last: int) -> Frames:
    """The frames from first to last, both included, ordered by sequence number."""
    rows = np.flatnonzero((frames.sequence >= first) & (frames.sequence <= last))
    rows = rows[np.argsort(frames.sequence[rows], kind="stable")]
    return Frames(*(np.ascontiguousarray(column[rows]) for column in frames))


def assemble_cycle(frames: Frames, cut: Cut) -> Cycle:
    """The whisk as a cycle; without samples if the cut is not `seen`.

    Args:
        frames: the frames of the cut, in any order; others are ignored.

    Raises:
        ValueError: frames of the cut are missing.
    """
    if not cut.seen:
        frames = select_frames(frames, 0, -1)
        return Cycle(np.zeros(0), *to_radians(frames.values), cut.odometry)
    mine = select_frames(frames, cut.first, cut.last)
    if len(mine.sequence) != cut.frames:
        raise ValueError(f"a whisk of {cut.frames} frames, of which {len(mine.sequence)} are present")
    # The memory layout matters: it decides the order of summation.
    angle, deflection = (np.ascontiguousarray(part) for part in to_radians(mine.values))
    time = cut.start + (mine.time - mine.time[0]) * 1e-6
    return Cycle(time, angle, deflection, cut.odometry)


def empty_frames(whiskers: int) -> Frames:
    """A block without frames, of a head with this number of whiskers."""
    return Frames(
        np.zeros(0, np.int64),
        np.zeros(0, np.int64),
        np.zeros(0, np.uint8),
        np.zeros((0, whiskers, CHANNELS), np.int16),
    )


class FrameWindow:
    """The most recent frames, in blocks as they arrived.

    Args:
        empty: a block without frames, which gives the shape.
    """

    def __init__(self, empty: Frames) -> None:
        self._empty = empty
        self._blocks: deque[Frames] = deque()
        self._count = 0

    def add(self, block: Frames) -> None:
        """Adds a block; drops the oldest ones beyond the last `MAX_FRAMES` frames."""
        if not len(block.sequence):
            return
        self._blocks.append(block)
        self._count += len(block.sequence)
        while self._count - len(self._blocks[0].sequence) >= MAX_FRAMES:
            self._count -= len(self._blocks.popleft().sequence)

    def between(self, first: int, last: int) -> Frames:
        """The present frames from first to last, both included, ordered by sequence number."""
        blocks = [
            block for block in self._blocks if block.sequence.min() <= last and block.sequence.max() >= first
        ]
        parts = zip(*(blocks or [self._empty]), strict=True)
        return select_frames(Frames(*(np.concatenate(part) for part in parts)), first, last)
