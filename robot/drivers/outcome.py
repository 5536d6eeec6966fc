"""How a live session can end: every end has a name, and its sentence tells the cure."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class SessionOutcome(Enum):
    """How a live session ended; the value says what to do."""

    COMPLETE = "nothing is left to do"
    INTERRUPTED = "the operator stopped it; `run` on the recording maps what there is"
    REFUSED = "it never moved: mend what the self-test names and start again"
    ARM_GONE = "look at the controller and its network, then start again from where the arm stands"
    ARM_STALE = "states stopped coming: look at the network and the controller's load"
    ARM_MALFORMED = "what came is no state of an arm: look for another program on the controller's ports"
    PROTECTIVE_STOP = "look what was touched, release the stop on the pendant, start again"
    SAFEGUARD_STOP = "close the safeguard and start again; nothing resumes by itself"
    EMERGENCY_STOP = "release the button and power the arm on by hand"
    OUT_OF_BOX = "the tool left the workspace: widen `live.arm.box` or move the maze"
    CONTACT = "something was hit: the arm stopped and backed off; look at the tool before it moves again"
    UNREACHABLE = "the controller finds no joints for a target: move the maze or the base"
    NOT_ARRIVED = "the arm stands elsewhere than it was sent: look at its speed slider and program"
    HEAD_GONE = "plug the head in again and start again"
    HEAD_SILENT = "the head sends nothing: look at its supply, and whether another program reads it"
    HEAD_GARBLED = "what the head sends cannot be read: look at the cable and the decoder's settings"
    CLOCK_JUMPED = "a device's clock jumped: restart that device"
    DISK_FULL = "free room on the disk; the recording is whole up to there"
    MAPPER_GONE = "the SLAM process ended: its log says why; `run` on the recording maps what there is"


class Fault(NamedTuple):
    """What ended a session.

    Attributes:
        outcome: which end. detail: what was found, one sentence. time: s, host's monotonic clock.
    """

    outcome: SessionOutcome
    detail: str
    time: float

    def __str__(self) -> str:
        return f"{self.outcome.name.lower()}: {self.detail}; {self.outcome.value}"
