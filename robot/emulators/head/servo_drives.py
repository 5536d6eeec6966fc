"""Drives of an emulated head: whisk, rest, and retract without commands.

A whisk starts with a block of samples or at the end of the one before.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import ValidationError

from robot.drivers.head.protocol import (
    ANGLE,
    COMMAND_TIMEOUT,
    NO_THRESHOLD,
    Command,
    CommandKind,
    FeedbackMode,
)
from robot.simulation.head.quasistatic import WhiskerBalance, whiskers_at_rest
from tactile.whiskers.head_geometry import Head
from tactile.whiskers.whisking import WhiskDrive, WhiskingConfig, whisk_command, whisk_phase

RETRACTION = 0.2
"""Duration of the retraction, s."""


class WhiskCommand(NamedTuple):
    """A commanded whisk.

    Attributes:
        whisking: the law. samples: of a cycle. offset: rad; the drives can reach it and the
            amplitude together. threshold: [W] rad. feedback: whether the law is told deflections; else the
            host tells amplitudes. amplitude: [W] rad, of a whisk without feedback.
    """

    whisking: WhiskingConfig
    samples: int
    offset: float
    threshold: np.ndarray
    feedback: bool
    amplitude: np.ndarray


class ServoDrives:
    """The drives of one head, sample by sample.

    Attributes:
        whisk: what they do now; None while they rest or retract. sample: of the cycle, that comes next.
    """

    def __init__(self, head: Head, rate: float) -> None:
        self.head, self.rate = head, rate
        self.whisk: WhiskCommand | None = None
        self.sample = 0
        self._next: WhiskCommand | None = None
        self._heard, self._stopped = -np.inf, False
        self._centre = np.zeros(len(head.length))
        self._from: np.ndarray | None = None  # where retraction began

    @property
    def resting(self) -> bool:
        """Whether they are at rest, with no command pending."""
        return self.whisk is None and self._next is None and self._from is None

    @property
    def left(self) -> int | None:
        """Samples until the next change; None while unknown."""
        if self.whisk is not None:
            return self.whisk.samples - self.sample
        return None if self._from is None else self._retraction - self.sample

    @property
    def _retraction(self) -> int:
        return round(RETRACTION * self.rate)

    def receive(self, told: Command, time: float) -> None:
        """Takes a command received at a time (s, of the clock passed to `begin`)."""
        self._heard = time
        if told.kind == CommandKind.DRIVE:
            self._next = self._made(told) or self._next
        elif told.kind == CommandKind.CENTRE and len(told.numbers) == len(self._centre):
            self._centre = told.numbers * ANGLE
        elif (
            told.kind == CommandKind.AMPLITUDES
            and self.whisk is not None
            and len(told.numbers) == len(self._centre)
            and not self.whisk.feedback
        ):
            most = self.head.limit - self.whisk.offset
            self.whisk = self.whisk._replace(amplitude=np.clip(told.numbers * ANGLE, 0.0, most))

    def stop(self) -> None:
        """Retracts, whatever was commanded before."""
        self._stopped, self._next = True, None

    def begin(self, time: float, balance: WhiskerBalance) -> WhiskerBalance:
        """What is to be done from here on; called at each beginning of a block and wherever `left` ended.

        Args:
            time: s. balance: where the whiskers are.

        Returns:
            where they are: still, at the beginning of a cycle.
        """
        silent = time - self._heard > COMMAND_TIMEOUT
        self._next = None if silent else self._next
        stop, self._stopped = silent or self._stopped, False
        if self.whisk is not None and stop:
            self.whisk, self._from, self.sample = None, balance.before[0].copy(), 0
        if self._from is not None:
            if self.sample < self._retraction:
                return balance
            self._from, self.sample = None, 0
            balance = whiskers_at_rest(*balance.before.shape)
        ended = self.whisk is not None and self.sample >= self.whisk.samples
        if (self.whisk is None and self._next is not None) or ended:
            if self._next is not None:
                self.whisk, self._next = self._next, None
            assert self.whisk is not None
            common = np.full(len(self._centre), np.radians(self.whisk.whisking.amplitude_deg))
            self.whisk, self.sample = self.whisk._replace(amplitude=common), 0
            return whiskers_at_rest(*balance.before.shape)
        return balance

    def law(self, drive: WhiskDrive, time: float, told: np.ndarray) -> tuple[np.ndarray, WhiskDrive]:
        """A `robot.simulation.head.quasistatic.WhiskingLaw`; time since the whisk or the retraction began."""
        if self.whisk is None:
            share = 0.0 if self._from is None else max(1 - time / RETRACTION, 0.0)
            return np.zeros_like(told) + (0.0 if self._from is None else self._from * share), drive
        whisk = self.whisk
        if whisk.feedback:
            heard = told - self._centre
            aim, drive = whisk_command(whisk.whisking, drive, time, heard, whisk.threshold, self.head.shape)
        else:
            aim = np.zeros_like(told) + whisk.amplitude * whisk_phase(whisk.whisking, time)
        return aim + whisk.offset if whisk.offset else aim, drive

    def _made(self, told: Command) -> WhiskCommand | None:
        """The whisk that a command requests; None, to continue as before, beyond the limits of the drives."""
        threshold = np.full(len(self._centre), np.inf)
        numbers = told.numbers[: len(threshold)]
        threshold[: len(numbers)] = np.where(numbers == NO_THRESHOLD, np.inf, numbers * ANGLE)
        feedback = told.mode == FeedbackMode.RCP
        offset = min(max(told.offset, 0.0), self.head.limit)
        amplitude = min(told.amplitude, self.head.limit - offset)
        try:
            whisking = WhiskingConfig(
                mode="rcp" if feedback else "open",
                rate=told.frequency,
                amplitude_deg=float(np.degrees(amplitude)),
                gain=told.gain,
                window=told.window if feedback else WhiskingConfig().window,
            )
        except ValidationError:
            return None
        samples = round(self.rate / whisking.rate)
        if samples < 2:
            return None
        return WhiskCommand(whisking, samples, offset, threshold, feedback, np.zeros(len(threshold)))
