"""Outcomes of a live session, each with its cure."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class SessionOutcome(Enum):
    """How a live session ended; the value tells the operator what to do, if anything."""

    COMPLETE = ""
    REACHED = "the robot is at its last goal"
    BLOCKED = "no way to the goal is left: clear the way, or map it again"
    LOST = "the robot does not know where it is: start again where the map ended"
    INTERRUPTED = "stopped by the operator"
    REFUSED = "the robot has not moved: correct what the self-test reports and start again"
    ARM_GONE = "check the controller and its network, then start again from the present pose"
    ARM_STALE = "no states from the controller: check the network and the controller's load"
    ARM_MALFORMED = "invalid states: check whether another program uses the controller's ports"
    HOST_LATE = "this machine is too busy to control the robot: end other programs, then start again"
    LINK_LOST = "the robot may still roll: lift it or plug its cable in, which stops it; then start again"
    ROBOT_SILENT = "no replies from the robot, which may still roll: lift it, check battery and cable"
    ROBOT_GARBLED = "invalid replies from the robot: check the cable, and other programs on its port"
    BUMPER_STUCK = "the bumper stays pressed: free the robot and the bumper, then start again"
    WHEEL_DROP = "a wheel hangs: set the robot on its wheels, then start again"
    LEFT_SAFE_MODE = "the robot saw a cliff, its charger or a button: check where it stands, then start again"
    WATCHDOG_GONE = "the watchdog process of the robot hangs or has ended: start again"
    PROTECTIVE_STOP = "check what the arm touched, release the stop on the pendant, start again"
    SAFEGUARD_STOP = "close the safeguard and start again; nothing resumes automatically"
    EMERGENCY_STOP = "release the button and power the arm on at the pendant"
    OUT_OF_BOX = "the tool left the workspace: widen `live.arm.box` or move the maze"
    CONTACT = "collision: the arm stopped and backed off; check the tool before it moves again"
    UNREACHABLE = "no joint solution for a target: move the maze or the base"
    NOT_ARRIVED = "the arm is not at its target: check its speed slider and program"
    HEAD_GONE = "plug the head in and start again"
    HEAD_SILENT = "no data from the head: check its supply, and whether another program reads it"
    HEAD_GARBLED = "unreadable data from the head: check the cable and the decoder's settings"
    CLOCK_JUMPED = "a device's clock jumped: restart that device"
    CONNECTION_LOST = "no connection to the robot: check its bridge and the network, then start again"
    TOPIC_SILENT = "check the node that publishes and start again, or raise `live.topics.patience`"
    TOPIC_UNUSABLE = "messages cannot be used: correct what is reported and start again"
    DISK_FULL = "free disk space; the recording is complete up to that point"
    MAPPER_GONE = "the SLAM process ended: see its log; `run` on the recording, if there is one, maps it"

    @property
    def planned(self) -> bool:
        """Whether the session ended as planned."""
        return self in (SessionOutcome.COMPLETE, SessionOutcome.REACHED)


class Fault(NamedTuple):
    """The reason why a session ended.

    Attributes:
        outcome: kind of end. detail: finding, one sentence. time: s, host's monotonic clock.
    """

    outcome: SessionOutcome
    detail: str
    time: float

    def __str__(self) -> str:
        return "; ".join(filter(None, [f"{self.outcome.name.lower()}: {self.detail}", self.outcome.value]))
