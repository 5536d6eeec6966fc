"""No invalid move reaches the controller, from the session or from the RTDE process."""

from __future__ import annotations

import math
import os
import time

import numpy as np
from hypothesis import HealthCheck, given, settings

from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.driver_config import SPEED_CAP
from robot.drivers.ur10.safety import TargetRefused
from tests.helpers.live import Faults, moves, until
from tests.robot.drivers.ur10.test_command_thread import poses, speeds


def test_no_invalid_move_reaches_the_controller(arm: Arm, controller: Faults) -> None:
    state = controller.state()
    first = len(state["targets"])
    # The first command is valid: after a target without joint solution no command is sent.
    requested: list[list[float]] = [[*state["tcp"][:2], state["tcp"][2] + 0.002, *state["tcp"][3:]]]
    arm.move(requested[0])
    until(arm.arrived)

    @settings(max_examples=60, suppress_health_check=list(HealthCheck))
    @given(poses, speeds)
    def ask(pose: list[float], speed: float) -> None:
        try:
            arm.move(pose, speed)
        except TargetRefused:
            return
        requested.append(pose)
        time.sleep(0.03)

    ask()
    arm.halt()
    until(arm.still)
    sent = moves(controller, first)
    assert arm.fault is None or arm.fault.outcome.name == "UNREACHABLE"
    assert sent
    for order in sent:
        assert order["goal"] in requested
        assert np.isfinite(order["goal"]).all()
        assert arm.config.box.contains(np.array(order["goal"]))
        assert 0 < order["speed"] <= SPEED_CAP
        assert order["acceleration"] == arm.config.acceleration
    top = max(math.hypot(*state["speed"][:3]) for state in arm.states())
    assert top <= arm.config.speed + 1e-9


def test_the_rtde_process_checks_every_command(arm: Arm, controller: Faults) -> None:
    first = len(controller.state()["targets"])
    here = controller.state()["tcp"]
    stops = int(arm.shared.control["stops"])
    process = arm.process
    assert process is not None
    for number, target in enumerate(([math.nan] * 6, [9.0, *here[1:]], here[:5], [*here[:3], 0.0, 0.0, 0.0])):
        process.send(do="move", number=number, target=target, speed=0.01, stops=stops)
    process.send(do="move", number=9, target=[here[0] + 0.05, *here[1:]], speed=0.3, stops=stops)
    until(lambda: arm.fault, "a fault")
    assert "refused" in arm.fault.detail
    assert moves(controller, first) == []
    assert controller.state()["tcp"] == here
    os.kill(arm.process.pid, 0)
