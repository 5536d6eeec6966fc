"""Whisking commands of a head, and contact feedback on the host."""

from __future__ import annotations

import threading
from typing import Literal

import numpy as np

from robot.drivers.head import usb_protocol as wire
from robot.drivers.head.decoder import Frames
from robot.drivers.head.reader import HeadReader
from robot.drivers.head.usb_protocol import Command, CommandKind, FeedbackMode, FrameFlag, to_counts
from tactile.base.errors import InputError
from tactile.whisker_geometry import Head
from tactile.whisking import WhiskingConfig, check_amplitude, initial_drive, whisk_command, whisk_phase

WHERE = "live.plan.whisking"


def whisk_commands(
    whisking: WhiskingConfig,
    threshold: np.ndarray | None = None,
    centre: np.ndarray | None = None,
    rcp: Literal["head", "host"] = "head",
) -> list[Command]:
    """The commands that start whisking, in order.

    Args:
        threshold: [W] contact thresholds of y, rad from the centre, infinite for whiskers without feedback;
            None: no feedback. centre: [W] mean of y in free air, rad. rcp: where feedback is computed.
    """
    if whisking.mode == "spread" and rcp == "head":
        raise InputError(f"{WHERE}.mode", "spread", "rcp or open", "or set `live.head.rcp: host`")
    in_head = whisking.mode == "rcp" and rcp == "head" and threshold is not None
    numbers = np.zeros(0, np.int16)
    if threshold is not None:
        finite = np.isfinite(threshold)
        counts = np.minimum(to_counts(np.where(finite, threshold, 0.0)), wire.NO_THRESHOLD - 1)
        numbers = np.where(finite, counts, wire.NO_THRESHOLD).astype(np.int16)
    mode = FeedbackMode.RCP if in_head else FeedbackMode.OPEN
    amplitude, frequency = float(np.radians(whisking.amplitude_deg)), whisking.rate
    law = amplitude, frequency, whisking.gain, whisking.window
    drive = Command(CommandKind.DRIVE, mode, *law, numbers=numbers)
    return [drive] if centre is None else [Command(CommandKind.CENTRE, numbers=to_counts(centre)), drive]


class HostRcp:
    """Feedback on the host: the whisking law of `tactile.whisking`, a block of samples at a time.

    Args:
        shape: rows and columns of the head. threshold, centre: [W] of y, rad.
    """

    def __init__(
        self, whisking: WhiskingConfig, shape: tuple[int, int], threshold: np.ndarray, centre: np.ndarray
    ) -> None:
        self._whisking, self._shape = whisking, shape
        self._threshold, self._centre = threshold, centre
        self._full = np.full(len(threshold), np.radians(whisking.amplitude_deg))
        self._drive = initial_drive(len(threshold))
        self._amplitude = self._full
        self._sent: np.ndarray | None = None
        self._began: int | None = None

    def amplitudes(self, frames: Frames) -> np.ndarray | None:
        """Amplitudes [W] int16 to send; None without a change, or before the first whisk.

        They are sent in every cycle, since a late command of the previous cycle may have arrived in this one.
        """
        y = frames.values[..., 2] * wire.ANGLE - self._centre
        for time, flags, deflection in zip(frames.time.tolist(), frames.flags.tolist(), y, strict=True):
            if flags & FrameFlag.CYCLE:
                self._began = time
                self._drive = initial_drive(len(self._threshold))
                self._amplitude, self._sent = self._full, None
            if self._began is None:
                continue
            since = (time - self._began) * 1e-6
            aim, self._drive = whisk_command(
                self._whisking, self._drive, since, deflection, self._threshold, self._shape
            )
            share = float(whisk_phase(self._whisking, since))
            # At rest the amplitude does not follow from the aim.
            if share > 1e-3:
                self._amplitude = aim / share
        counts = to_counts(self._amplitude)
        if self._began is None or (self._sent is not None and (counts == self._sent).all()):
            return None
        self._sent = counts
        return counts


class HeadDriver:
    """Controls the whisking of a head."""

    def __init__(self, reader: HeadReader, head: Head) -> None:
        self._reader, self._head = reader, head
        self._feedback: HostRcp | None = None
        # Held while amplitudes are computed and queued: one queued after `rest` would keep the head awake.
        self._lock = threading.Lock()
        reader.listeners.append(self._on_frames)

    def whisk(
        self, whisking: WhiskingConfig, threshold: np.ndarray | None = None, centre: np.ndarray | None = None
    ) -> None:
        """Starts whisking with the next cycle; without a threshold (before calibration) there is no feedback.

        Args:
            threshold, centre: [W] of y, rad: column 1 of `threshold` and `mean` of
            `tactile.calibration.Calibration`.

        Raises:
            InputError: the amplitude exceeds the drives' limit, or the head does not support the mode.
        """
        check_amplitude(whisking, self._head, WHERE)
        rcp = self._reader.config.rcp
        commands = whisk_commands(whisking, threshold, centre, rcp)
        feedback = None
        if rcp == "host" and whisking.mode != "open" and threshold is not None:
            middle = np.zeros(len(threshold)) if centre is None else centre
            feedback = HostRcp(whisking, self._head.shape, threshold, middle)
        with self._lock:
            self._feedback = feedback
            for one in commands:
                self._reader.send(one)

    def rest(self) -> None:
        """Retracts the whiskers; samples continue."""
        with self._lock:
            self._feedback = None
            self._reader.rest()

    def _on_frames(self, frames: Frames, arrival: float) -> None:
        with self._lock:
            amplitude = None if self._feedback is None else self._feedback.amplitudes(frames)
            if amplitude is not None:
                self._reader.send(Command(CommandKind.AMPLITUDES, FeedbackMode.OPEN, numbers=amplitude))
