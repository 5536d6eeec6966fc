"""Whether an arm may be armed: what its controller says of itself, and what its first states show."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.config import ArmConfig
from robot.drivers.ur10.safety import in_box
from tactile.base.errors import InputError

MIN_RATE_SHARE = 0.9  # of the nominal rate of states
RATE_WINDOW = 0.25  # s of states that the rate is taken from
RATE_TIMEOUT = 1.5  # s in which it must have been enough once


class StartupRefused(InputError):
    """Why the arm was not armed; it never moved."""

    def __init__(self, found: str, expected: str = "", cure: str = "", *_: str, where: str = "arm") -> None:
        super().__init__(where, found, expected, cure)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.found, self.expected, self.cure)


def check_controller(config: ArmConfig) -> dashboard.ControllerStatus:
    """What the controller says of itself, if that speaks for starting; else raises Refusal."""
    try:
        with dashboard.Dashboard(config.host) as connection:
            controller = connection.controller()
            with contextlib.suppress(dashboard.DashboardSilent):
                if controller.program:  # a program that was just stopped may still be ending
                    time.sleep(0.3)
                    controller = connection.controller()
    except dashboard.DashboardSilent as silent:
        raise StartupRefused(
            str(silent), "", "look at the cable, the address and that the controller is on"
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
    """Look at the newest states: their rate, where the arm stands; raises Refusal.

    A host that was busy for a moment gets a second one; a controller that is slow stays so.

    Args:
        states: gives the states [N] (STATE) since the arm's process began.
    """
    until = time.monotonic() + RATE_TIMEOUT
    while (rate := state_rate(states(), config.hz)) < MIN_RATE_SHARE * config.hz:
        if time.monotonic() > until:
            raise StartupRefused(
                f"stream at {rate:.0f} of {config.hz} Hz",
                "",
                "a CB3 has 125 Hz only; look at the network and what else runs on this machine",
            )
        time.sleep(0.05)
    here = states()[-1]["tcp"]
    if not in_box(config, here):
        place = ", ".join(f"{v:.3f}" for v in here[:3])
        raise StartupRefused(f"the tool stands at ({place}) m, outside the box", "", "bring it in by hand")


def state_rate(states: np.ndarray, hz: int) -> float:
    """Hz, over the newest states, as many as should come in the measuring time."""
    recent = states["host"][-int(RATE_WINDOW * hz) :]
    return (len(recent) - 1) / float(np.ptp(recent)) if len(recent) > 1 else 0.0


def explain_refusal(detail: str) -> StartupRefused:
    """The refusal for what the library says."""
    if "in use" in detail:
        return StartupRefused(
            "registers in use",
            "",
            "end the other RTDE program, or disable EtherNet/IP, PROFINET and MODBUS on the controller",
        )
    return StartupRefused(detail)
