"""Checks before the arm is armed: status of the controller and its first states."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.driver_config import ArmConfig
from robot.drivers.ur10.safety import in_box
from tactile.base.errors import InputError

MIN_RATE_SHARE = 0.9  # share of the nominal state rate that is required
RATE_WINDOW = 0.25  # s of states over which the rate is measured


class StartupRefused(InputError):
    """A startup check failed; the arm has not moved."""

    def __init__(self, found: str, expected: str = "", cure: str = "", *_: str, where: str = "arm") -> None:
        super().__init__(where, found, expected, cure)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.found, self.expected, self.cure)


def check_controller(config: ArmConfig) -> dashboard.ControllerStatus:
    """Asks for the status of the controller and checks it.

    Raises:
        StartupRefused: the controller is not ready."""
    try:
        with dashboard.Dashboard(config.host) as connection:
            controller = connection.controller()
            with contextlib.suppress(dashboard.DashboardSilent):
                if controller.program:  # a stopped program ends with a delay
                    time.sleep(0.3)
                    controller = connection.controller()
    except dashboard.DashboardSilent as silent:
        raise StartupRefused(
            str(silent), "", "check the cable, the address and that the controller is on"
        ) from None
    version = ".".join(map(str, controller.version))
    if controller.version < dashboard.MIN_POLYSCOPE:
        raise StartupRefused(f"PolyScope {version}", "3.4 or newer", "update the controller")
    if controller.mode != "RUNNING":
        raise StartupRefused(
            f"robot mode {controller.mode}", "RUNNING", "power the arm on and release its brakes"
        )
    if controller.safety not in ("NORMAL", "REDUCED"):
        raise StartupRefused(
            f"safety mode {controller.safety}", "NORMAL or REDUCED", "release the stop on the pendant"
        )
    if controller.remote is False:
        raise StartupRefused(
            "under local control", "remote control", "switch it on the pendant, at the upper right"
        )
    if controller.program:
        raise StartupRefused("a program runs on the controller", "none", "stop it on the pendant")
    return controller


def check_states(config: ArmConfig, states: Callable[[], np.ndarray]) -> None:
    """Checks the rate of the newest states and the position of the tool.

    The rate may recover within `config.connect` s, since the host may have been busy.

    Raises:
        StartupRefused: the stream is too slow, or the tool is outside the box.

    Args:
        states: returns the states [N] (ARM_STATE) since the start of the RTDE process.
    """
    until = time.monotonic() + config.connect
    while (rate := state_rate(states(), config.hz)) < MIN_RATE_SHARE * config.hz:
        if time.monotonic() > until:
            raise StartupRefused(
                f"stream at {rate:.0f} of {config.hz} Hz",
                "",
                "a CB3 has 125 Hz only; check the network and the load of this machine",
            )
        time.sleep(0.05)
    here = states()[-1]["tcp"]
    if not in_box(config, here):
        place = ", ".join(f"{v:.3f}" for v in here[:3])
        raise StartupRefused(
            f"the tool stands at ({place}) m, outside the box", "", "move it into the box by hand"
        )


def state_rate(states: np.ndarray, hz: int) -> float:
    """State rate over the last `RATE_WINDOW`, Hz."""
    recent = states["host"][-int(RATE_WINDOW * hz) :]
    return (len(recent) - 1) / float(np.ptp(recent)) if len(recent) > 1 else 0.0


def explain_refusal(detail: str) -> StartupRefused:
    """The refusal with the cause and cure for an error message of the library."""
    if "in use" in detail:
        return StartupRefused(
            "registers in use",
            "",
            "end the other RTDE program, or disable EtherNet/IP, PROFINET and MODBUS on the controller",
        )
    return StartupRefused(detail)
