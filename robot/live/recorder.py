"""Recorder of a live session.

Frames and arm states are collected for a short time and written as a block. All data reach the operating
system within 0.2 s, measured on the passed times, so a killed process loses no more than that.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from threading import Lock

import numpy as np

from robot.drivers.head.decoder import MAX_FRAMES, Cut, Frames
from robot.drivers.outcome import Fault, SessionOutcome
from robot.recordings.cdr import Event
from robot.recordings.mcap_writer import Recorder, RecordingWriteError
from robot.sources.source import Sample

BLOCK_TIME = 0.15
"""Time for which frames and states are collected into a block, s."""


class LiveRecorder(AbstractContextManager["LiveRecorder"]):
    """Writes a session to a new recording; a context manager.

    Any thread may add data; a call waits for the disk. When the disk is full, `fault` is set, later data are
    ignored, and the recording stays readable up to that point.

    Attributes:
        fault: the error that ended writing, or None.
    """

    def __init__(self, tape: Recorder) -> None:
        self.fault: Fault | None = None
        self._tape = tape
        self._lock = Lock()
        self._frames: list[Frames] = []
        self._states: list[np.ndarray] = []
        self._arrival = self._since = -np.inf  # times of the newest frames and of the oldest pending data
        self._known = np.full(MAX_FRAMES, -1, np.int64)  # sequence numbers of added frames

    def add_frames(self, frames: Frames, arrival: float) -> None:
        """Adds frames that arrived at a time, s; frames added before are ignored."""
        with self._writing(arrival) as able:
            if able:
                self._arrival = arrival
                self._gather(frames)
                self._write_if_due(arrival)

    def add_states(self, states: np.ndarray) -> None:
        """Adds arm states [N] (`robot.drivers.ur10.shared_state.ARM_STATE`), oldest first."""
        if not len(states):
            return
        newest = float(states["host"][-1])
        with self._writing(newest) as able:
            if able:
                self._states.append(states.copy())
                self._write_if_due(newest)

    def add_whisk(self, cut: Cut, frames: Frames, truth: np.ndarray | None = None) -> None:
        """Adds a whisk and flushes the file.

        Args:
            frames: all frames of the whisk; new ones are written first. truth: [3] true pose of the head.

        Raises:
            ValueError: the frames are not those of the cut.
        """
        mine = frames.select(cut.first, cut.last)
        if cut.seen and not 0 < len(mine.sequence) == cut.frames <= MAX_FRAMES:
            raise ValueError(f"{len(mine.sequence)} frames for a whisk of {cut.frames}")
        with self._writing(cut.time) as able:
            if able:
                self._arrival = max(self._arrival, cut.time)
                self._gather(mine)
                self._write()
                self._tape.write(cut, truth)
                self._tape.flush()

    def add(self, content: Sample | Event) -> None:
        """Adds a reading that holds all that was measured, or an event, after the frames so far, and flushes
        the file."""
        with self._writing(content.time) as able:
            if able:
                self._write()
                self._tape.write(content)
                self._tape.flush()

    def add_message(self, topic: str, kind: str, definition: str, arrival: int, content: bytes) -> None:
        """Adds a message of a robot's topic; see `Recorder.append_message`."""
        with self._writing(arrival / 1e9) as able:
            if able:
                self._tape.append_message(topic, kind, definition, arrival, content)
                self._write_if_due(arrival / 1e9)

    def add_event(self, time: float, name: str, text: str) -> None:
        """Adds an event and flushes the file.

        Args:
            time: s. name: one word. text: details.
        """
        self.add(Event(time, name, text))

    def close(self) -> None:
        """Writes pending data and finishes the file; may be called more than once."""
        with self._writing(self._arrival) as able:
            if able:
                self._write()
            self._tape.close()

    def _gather(self, frames: Frames) -> None:
        place = frames.sequence % MAX_FRAMES
        new = self._known[place] != frames.sequence
        self._known[place] = frames.sequence
        if new.any():
            self._frames.append(Frames(*(column[new] for column in frames)))

    def _write_if_due(self, time: float) -> None:
        """Writes the collected block if it is `BLOCK_TIME` old at this time, s."""
        if self._since == -np.inf:
            self._since = time
        elif time - self._since >= BLOCK_TIME:
            self._write()
            self._tape.flush()

    def _write(self) -> None:
        if self._frames:
            parts = zip(*self._frames, strict=True)
            block = Frames(*(np.concatenate(part) for part in parts))
            self._tape.write(block, arrival=self._arrival)
        if self._states:
            self._tape.write(np.concatenate(self._states))
        self._frames, self._states, self._since = [], [], -np.inf

    @contextmanager
    def _writing(self, time: float) -> Iterator[bool]:
        """Holds the lock on the file; yields whether it accepts data."""
        with self._lock:
            try:
                yield self.fault is None
            except RecordingWriteError as error:
                self.fault = Fault(SessionOutcome.DISK_FULL, str(error), time)

    def __exit__(self, *_: object) -> None:
        self.close()
