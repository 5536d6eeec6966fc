"""The whiskers behind an emulated bridge: what it asks of them."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from robot.drivers.head.usb_protocol import Command

BLOCK = 0.01
"""Samples are made and sent in blocks of this duration, s."""


def block_samples(rate: float) -> int:
    """Samples of a block at a rate, Hz."""
    return max(round(BLOCK * rate), 2)


class Block(NamedTuple):
    """T samples.

    Attributes:
        angle: [T, W] rad. deflection: [T, W, 2] rad. begins: [T] bool, the first sample of a whisk.
        fed_back: whether feedback has lowered an amplitude.
    """

    angle: np.ndarray
    deflection: np.ndarray
    begins: np.ndarray
    fed_back: bool


class SensorArray(Protocol):
    """Simulated whiskers, moved by drives or fixed. Times are the host's monotonic clock, s."""

    @property
    def count(self) -> int:
        """Number of whiskers."""
        ...

    @property
    def resting(self) -> bool:
        """Whether all drives rest, so that blocks nobody reads need not be made."""
        ...

    def begin(self, time: float) -> None:
        """The stream of samples starts."""
        ...

    def block(self, start: float, end: float) -> Block:
        """The samples between two times."""
        ...

    def skip_block(self) -> None:
        """Skips a block without samples or motion."""
        ...

    def receive(self, command: Command, now: float) -> None:
        """Executes a command."""
        ...

    def stop(self) -> None:
        """Retracts the whiskers and stops the drives."""
        ...

    def state(self, now: float) -> dict[str, Any]:
        """Pose and activity, as JSON values."""
        ...
