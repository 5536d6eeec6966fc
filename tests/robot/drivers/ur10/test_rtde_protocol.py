"""What reaches the controller when a session asks for anything at all: judged where it arrives."""

from __future__ import annotations

import math
import os
import time

import numpy as np
from hypothesis import HealthCheck, given, settings

from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.config import SPEED_CAP
from robot.drivers.ur10.safety import TargetRefused, in_box
from tests.helpers.live import Faults, moves, until
from tests.robot.emulators.ur10.test_urscript_moves import poses, speeds


def test_nothing_bad_is_told(arm: Arm, controller: Faults) -> None:
    state = controller.state()
    first = len(state["targets"])
    # One that is told for certain: after the first that no joints reach, nothing is.
    asked: list[list[float]] = [[*state["tcp"][:2], state["tcp"][2] + 0.002, *state["tcp"][3:]]]
    arm.move(asked[0])
    until(arm.arrived, 3.0)

    @settings(max_examples=60, suppress_health_check=list(HealthCheck))
    @given(poses, speeds)
    def ask(pose: list[float], speed: float) -> None:
        try:
            arm.move(pose, speed)
        except TargetRefused:
            return
        asked.append(pose)
        time.sleep(0.03)

    ask()
    arm.halt("enough")
    until(arm.still, 1.0)
    told = moves(controller, first)
    assert arm.fault is None or arm.fault.outcome.name == "UNREACHABLE"
    assert told
    for order in told:
        assert order["goal"] in asked
        assert np.isfinite(order["goal"]).all()
        assert in_box(arm.config, np.array(order["goal"]))
        assert 0 < order["speed"] <= SPEED_CAP
        assert order["acceleration"] == arm.config.acceleration
    top = max(math.hypot(*state["speed"][:3]) for state in arm.states())
    assert top <= arm.config.speed + 1e-9


def test_the_arms_process_trusts_no_order(arm: Arm, controller: Faults) -> None:
    first = len(controller.state()["targets"])
    here = controller.state()["tcp"]
    stops = int(arm._board.control["stops"])
    for number, target in enumerate(([math.nan] * 6, [9.0, *here[1:]], here[:5], [*here[:3], 0.0, 0.0, 0.0])):
        arm._supervisor.process.order(do="move", number=number, target=target, speed=0.01, stops=stops)
    arm._supervisor.process.order(
        do="move", number=9, target=[here[0] + 0.05, *here[1:]], speed=0.3, stops=stops
    )
    until(lambda: arm.fault, 1.0, "a fault")
    assert "refused" in arm.fault.detail
    assert moves(controller, first) == []
    assert controller.state()["tcp"] == here
    os.kill(arm.pid, 0)
