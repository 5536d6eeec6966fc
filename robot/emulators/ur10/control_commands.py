"""Numbers of ur_rtde's commands to its control program.

The numbers were read from the register while ur_rtde 1.6.5 called the function of each name.
"""

from __future__ import annotations

from enum import IntEnum


class ControlCommand(IntEnum):
    """Commands that the emulated control program executes."""

    NONE = 0
    MOVE_L = 3
    SET_TCP = 29
    STOP_L = 33
    SET_WATCHDOG = 35
    POSE_WITHIN_SAFETY_LIMITS = 36
    END = 255


EMULATED = "moveL, setTcp, stopL, setWatchdog, isPoseWithinSafetyLimits, stopScript"
"""Functions of ur_rtde that send these commands."""

REFUSED = {
    1: "moveJ", 2: "moveJ_IK", 4: "moveL_FK", 6: "forceMode", 7: "forceModeStop", 8: "zeroFtSensor",
    9: "speedJ", 10: "speedL", 11: "servoJ", 12: "servoC", 15: "speedStop", 16: "servoStop", 17: "setPayload",
    18: "teachMode", 19: "endTeachMode", 20: "forceModeSetDamping", 21: "forceModeSetGainScaling",
    24: "servoL", 25: "toolContact", 26: "getStepTime", 27: "getActualJointPositionsHistory",
    28: "getTargetWaypoint", 31: "triggerProtectiveStop", 34: "stopJ", 37: "isJointsWithinSafetyLimits",
    38: "getJointTorques", 39: "poseTrans", 40: "getTCPOffset", 41: "jogStart", 42: "jogStop",
    43: "getForwardKinematics", 45: "movePath", 46: "getInverseKinematics", 47: "isSteady",
    51: "moveUntilContact", 52: "freedriveMode", 53: "endFreedriveMode", 54: "getFreedriveStatus",
    56: "ftRtdeInputEnable", 57: "enableExternalFtSensor", 58: "getActualToolFlangePose", 59: "setGravity",
    60: "getInverseKinematicsHasSolution", 62: "startContactDetection", 63: "stopContactDetection",
    64: "readContactDetection", 65: "setTargetPayload", 66: "directTorque", 67: "getMassMatrix",
    68: "getCoriolisAndCentrifugalTorques", 69: "getTargetJointAccelerations", 70: "getJacobian",
    71: "getJacobianTimeDerivative",
}  # fmt: skip
"""Functions of ur_rtde by the number of a command that is not emulated."""


def refusal_of(command: int) -> str:
    """Reason for refusing a command, one line; empty if it is emulated."""
    if command in set(ControlCommand):
        return ""
    name = REFUSED.get(command, "an unknown function")
    return f"{name} (command {command}) is not emulated and ends the control program; emulated are {EMULATED}"
