"""Content of a session's recording, and moments by the devices' clocks."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from robot.drivers.head.decoder import Frames
from robot.recordings.cdr import Event
from robot.recordings.mcap_reader import McapScanner
from robot.sources.source import Sample

SAMPLES = 2000.0
"""Frames of the head in a second."""


class Moment(NamedTuple):
    """A moment by the devices' clocks: s of the controller, number of the head's newest sample."""

    robot: float
    sample: int


class RecordedData(NamedTuple):
    """Content of a recording."""

    sequence: np.ndarray
    robot: np.ndarray
    samples: list[Sample]
    events: list[Event]
    broken: str

    def lost(self, until: Moment) -> float:
        """Duration of the data missing at the end of the recording, of either device, s."""
        return max(until.robot - float(self.robot[-1]), (until.sample - int(self.sequence[-1])) / SAMPLES)

    def names(self) -> list[str]:
        return [event.name for event in self.events]


def read_recorded(path: Path) -> RecordedData:
    """Reads a recording, complete or not."""
    walk = McapScanner(path)
    sequence, robot, samples, events = [], [], [], []
    for entry in walk.entries():
        if isinstance(entry.content, Frames):
            sequence.append(entry.content.sequence)
        elif isinstance(entry.content, np.ndarray):
            robot.append(entry.content["robot"])
        elif isinstance(entry.content, Event):
            events.append(entry.content)
        else:
            samples.append(entry.content)
    return RecordedData(np.concatenate(sequence), np.concatenate(robot), samples, events, walk.broken)
