"""The real client libraries, in a process that they may take down: `python -m ... HOST SCENARIO` prints JSON.

A scenario that says "here" waits for a line on standard input before it goes on, so that a test can do
something to the controller at that moment.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any

STEP = 0.02  # m: how far a scenario moves the tool, upwards and back


def control(host: str) -> Any:
    import rtde_control

    return rtde_control.RTDEControlInterface(host)


def receive(host: str) -> Any:
    import rtde_receive

    return rtde_receive.RTDEReceiveInterface(host)


def here() -> None:
    """Let the test act."""
    print("here", flush=True)
    sys.stdin.readline()


def settled(condition: Callable[[], bool], seconds: float = 3.0) -> bool:
    """Wait for something; False where it does not come."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.002)
    return False


def apart(first: list[float], second: list[float]) -> float:
    """Distance of two tool positions, m."""
    return math.dist(first[:3], second[:3])


def everyone(host: str) -> dict[str, Any]:
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
        "rate": (receiver.getTimestamp() - start) / (time.monotonic() - began),
    }


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
    known = settled(lambda: operation() != before)
    time.sleep(0.3)
    under_way = apart(receiver.getActualTCPPose(), home)
    controller.stopL(2.0)
    stopped = settled(lambda: not any(receiver.getActualTCPSpeed()) and not running())
    stood = apart(receiver.getActualTCPPose(), home)
    done = controller.moveL(goal, 0.1, 1.0)
    arrived = settled(lambda: apart(receiver.getActualTCPPose(), goal) < 1e-5)
    done &= controller.moveL(home, 0.1, 1.0)
    back = settled(lambda: apart(receiver.getActualTCPPose(), home) < 1e-5)
    return {
        "told": [known, done],
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
    """What a receiver sees of two things that the test does."""
    receiver = receive(host)
    seen = []
    for _ in range(2):
        here()
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
    """Whether a pose can be reached, before and after something that the test does; then a move to it."""
    receiver, controller = receive(host), control(host)
    pose = receiver.getActualTCPPose()
    before = controller.isPoseWithinSafetyLimits(pose)
    here()
    after = controller.isPoseWithinSafetyLimits(pose)
    return {"before": before, "after": after, "moved": controller.moveL(pose)}


def unsupported(host: str) -> dict[str, Any]:
    """A move that is not emulated, and a linear one before and after the program is uploaded again."""
    receiver, controller = receive(host), control(host)
    home = receiver.getActualTCPPose()
    moved = controller.moveJ(receiver.getActualQ())
    stopped = settled(lambda: not controller.isProgramRunning(), 30.0)
    after = controller.moveL(home)
    controller.reuploadScript()
    settled(controller.isProgramRunning, 30.0)
    return {"moved": moved, "stopped": stopped, "after": after, "again": controller.moveL(home)}


def refused(host: str) -> dict[str, Any]:
    """What the library says where it cannot control."""
    try:
        control(host)
    except Exception as error:  # whatever it is: the test reads it
        return {"error": str(error)}
    return {"error": ""}


def second(host: str) -> dict[str, Any]:
    """One client, then another."""
    first = control(host)
    result = refused(host)
    return {**result, "unharmed": first.isConnected() and first.isProgramRunning()}


def slide(host: str) -> dict[str, Any]:
    """The speed slider through the IO client."""
    import rtde_io

    receiver = receive(host)
    writer = rtde_io.RTDEIOInterface(host)
    writer.setSpeedSlider(0.25)
    seen = settled(lambda: abs(receiver.getTargetSpeedFraction() - 0.25) < 1e-9)
    writer.setSpeedSlider(1.0)
    settled(lambda: receiver.getTargetSpeedFraction() > 0.99)
    return {"seen": seen}


SCENARIOS: dict[str, Callable[[str], Any]] = {
    "everyone": everyone,
    "moves": moves,
    "drive": lambda host: drive(host, False),
    "drive watched": lambda host: drive(host, True),
    "watch": watch,
    "solve": solve,
    "unsupported": unsupported,
    "refused": refused,
    "second": second,
    "slide": slide,
}

if __name__ == "__main__":
    print(json.dumps(SCENARIOS[sys.argv[2]](sys.argv[1])), flush=True)
