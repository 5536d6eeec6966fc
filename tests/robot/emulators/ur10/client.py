"""Runs the real client libraries in a process, as they may crash: `python -m ... HOST SCENARIO` prints JSON.

A scenario that prints "here" waits for a line on standard input, so that a test can change the controller
at that point.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any

STEP = 0.02  # m, upward move of the tool in a scenario


def control(host: str) -> Any:
    import rtde_control

    return rtde_control.RTDEControlInterface(host)


def receive(host: str) -> Any:
    import rtde_receive

    return rtde_receive.RTDEReceiveInterface(host)


def wait_for_test() -> None:
    """Prints "here" and waits for a line of the test."""
    print("here", flush=True)
    sys.stdin.readline()


def wait_until(condition: Callable[[], bool], seconds: float = 3.0) -> bool:
    """Waits for a condition; False after `seconds` without it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.002)
    return False


def distance(first: list[float], second: list[float]) -> float:
    """Distance of two tool positions, m."""
    return math.dist(first[:3], second[:3])


def all_clients(host: str) -> dict[str, Any]:
    import dashboard_client
    import rtde_io

    receiver = receive(host)
    controller = control(host)
    writer = rtde_io.RTDEIOInterface(host)
    dashboard = dashboard_client.DashboardClient(host)
    dashboard.connect()
    start, began = receiver.getTimestamp(), time.monotonic()
    pose = receiver.getActualTCPPose()
    reachable = [controller.isPoseWithinSafetyLimits(p) for p in (pose, [5.0, 0.0, 0.0, 0.0, 0.0, 0.0])]
    controller.setTcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    time.sleep(0.5)
    return {
        "connected": [receiver.isConnected(), controller.isConnected(), writer.isConnected()],
        "program": controller.isProgramRunning(),
        "mode": dashboard.robotmode(),
        "version": dashboard.polyscopeVersion(),
        "safety": [receiver.getSafetyMode(), receiver.getSafetyStatusBits()],
        "lowered": pose[2] - receiver.getActualTCPPose()[2],
        "reachable": reachable,
        "rate": clock_rate(receiver, start, began),
    }


def clock_rate(receiver: Any, start: float, began: float) -> float:
    """Seconds of the controller's clock per second since both were `start` and `began`.

    The window grows to 10 s while the rate is not 1, because a state can be a second old on a busy machine.
    """
    while True:
        elapsed = time.monotonic() - began
        rate = (receiver.getTimestamp() - start) / elapsed
        if abs(rate - 1) < 0.1 or elapsed > 10:
            return float(rate)
        time.sleep(0.1)


def moves(host: str) -> dict[str, Any]:
    receiver, controller = receive(host), control(host)
    home = receiver.getActualTCPPose()
    goal = [*home[:2], home[2] + STEP, *home[3:]]

    def operation() -> int:
        return int(controller.getAsyncOperationProgressEx().operationId())

    def running() -> bool:
        return bool(controller.getAsyncOperationProgressEx().isAsyncOperationRunning())

    before = operation()
    controller.moveL(goal, 0.01, 0.5, True)
    known = wait_until(lambda: operation() != before)
    time.sleep(0.3)
    under_way = distance(receiver.getActualTCPPose(), home)
    controller.stopL(2.0)
    stopped = wait_until(lambda: not any(receiver.getActualTCPSpeed()) and not running())
    stood = distance(receiver.getActualTCPPose(), home)
    done = controller.moveL(goal, 0.1, 1.0)
    arrived = wait_until(lambda: distance(receiver.getActualTCPPose(), goal) < 1e-5)
    done &= controller.moveL(home, 0.1, 1.0)
    back = wait_until(lambda: distance(receiver.getActualTCPPose(), home) < 1e-5)
    return {
        "accepted": [known, done],
        "seen": [stopped, arrived, back],
        "under_way": under_way,
        "stood": stood,
    }


def drive(host: str, watchdog: bool) -> dict[str, Any]:
    """Moves slowly and resets the watchdog, until killed."""
    receiver, controller = receive(host), control(host)
    if watchdog:
        controller.setWatchdog(10)
    x, y, *rest = receiver.getActualTCPPose()
    controller.moveL([x, y + 0.3, *rest], 0.01, 0.5, True)
    print("here", flush=True)
    while True:
        time.sleep(0.02)
        controller.kickWatchdog() if watchdog else controller.isProgramRunning()


def watch(host: str) -> list[dict[str, Any]]:
    """The receiver's state after each of two actions of the test."""
    receiver = receive(host)
    seen = []
    for _ in range(2):
        wait_for_test()
        start = receiver.getTimestamp()
        time.sleep(0.15)
        seen.append(
            {
                "connected": receiver.isConnected(),
                "went": receiver.getTimestamp() - start,
                "nan": [math.isnan(number) for number in receiver.getActualTCPPose()],
                "bits": receiver.getSafetyStatusBits(),
                "slider": receiver.getTargetSpeedFraction(),
                "force": receiver.getActualTCPForce(),
            }
        )
    return seen


def solve(host: str) -> dict[str, Any]:
    """Reachability of a pose before and after an action of the test; then a move to it."""
    receiver, controller = receive(host), control(host)
    pose = receiver.getActualTCPPose()
    before = controller.isPoseWithinSafetyLimits(pose)
    wait_for_test()
    after = controller.isPoseWithinSafetyLimits(pose)
    return {"before": before, "after": after, "moved": controller.moveL(pose)}


def unsupported_move(host: str) -> dict[str, Any]:
    """A move that is not emulated, and a linear one before and after the program is uploaded again."""
    receiver, controller = receive(host), control(host)
    home = receiver.getActualTCPPose()
    moved = controller.moveJ(receiver.getActualQ())
    stopped = wait_until(lambda: not controller.isProgramRunning(), 30.0)
    after = controller.moveL(home)
    controller.reuploadScript()
    wait_until(controller.isProgramRunning, 30.0)
    return {"moved": moved, "stopped": stopped, "after": after, "again": controller.moveL(home)}


def control_error(host: str) -> dict[str, Any]:
    """The library's error when control is refused; "" if it is granted."""
    try:
        control(host)
    except Exception as error:  # the test checks the message
        return {"error": str(error)}
    return {"error": ""}


def two_clients(host: str) -> dict[str, Any]:
    """A second control client beside a first."""
    first = control(host)
    result = control_error(host)
    return {**result, "unharmed": first.isConnected() and first.isProgramRunning()}


def slide(host: str) -> dict[str, Any]:
    """Sets the speed slider by the IO client."""
    import rtde_io

    receiver = receive(host)
    writer = rtde_io.RTDEIOInterface(host)
    writer.setSpeedSlider(0.25)
    seen = wait_until(lambda: abs(receiver.getTargetSpeedFraction() - 0.25) < 1e-9)
    writer.setSpeedSlider(1.0)
    wait_until(lambda: receiver.getTargetSpeedFraction() > 0.99)
    return {"seen": seen}


SCENARIOS: dict[str, Callable[[str], Any]] = {
    "all": all_clients,
    "moves": moves,
    "drive": lambda host: drive(host, False),
    "drive watched": lambda host: drive(host, True),
    "watch": watch,
    "solve": solve,
    "unsupported move": unsupported_move,
    "control error": control_error,
    "two clients": two_clients,
    "slide": slide,
}

if __name__ == "__main__":
    print(json.dumps(SCENARIOS[sys.argv[2]](sys.argv[1])), flush=True)
