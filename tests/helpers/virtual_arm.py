"""The arm of a session in virtual time: the driver's checks and orders, and the emulator's arm and forces, in
one thread without sockets. What the driver waits for passes at once."""

from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from robot.drivers.ur10 import arm as arm_module
from robot.drivers.ur10 import rtde_process
from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.rtde_process import ArmCommand, CommandThread
from robot.drivers.ur10.shared_state import ARM_STATE
from robot.emulators.ur10.controller import SAFETY_BITS, EmulatedController
from robot.emulators.ur10.emulated_arm import MoveL, StopL, Unreachable
from robot.emulators.ur10.emulator_config import UrEmulatorConfig
from robot.live import live_rig, poke_loop, polling

DELAY = 3
"""States from a command to its effect: a call of the library takes 20 ms."""


class _Control:
    """The library's control interface."""

    def __init__(self, controller: EmulatedController) -> None:
        self.controller, self.operation = controller, 0
        self._due = deque[tuple[int, Any]]()  # commands under way

    def stopL(self, deceleration: float, _: bool) -> None:
        self._due.append((DELAY, StopL(deceleration)))

    def moveL(self, target: list[float], speed: float, acceleration: float, _: bool) -> None:
        x, y, z, rx, ry, rz = target
        self._due.append((DELAY, MoveL((x, y, z, rx, ry, rz), speed, acceleration)))

    def isPoseWithinSafetyLimits(self, target: list[float]) -> bool:
        try:
            self.controller.solve(tuple(target))  # type: ignore[arg-type]
        except Unreachable:
            return False
        return True

    def kickWatchdog(self) -> None:
        pass

    def tick(self) -> None:
        self._due = deque((left - 1, order) for left, order in self._due)
        while self._due and self._due[0][0] <= 0:
            _, order = self._due.popleft()
            self.controller.arm.order([order])
            self.operation += 1


class VirtualArm(Arm):
    """An arm in virtual time: `sleep` moves it on.

    Attributes:
        controller: the emulated one. now: s. spoil: changes a state before it is published.
    """

    emulated = UrEmulatorConfig()

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self.controller = EmulatedController(self.emulated)
        self.now = 1000.0
        self.spoil: Callable[[np.ndarray], None] = lambda state: None
        self._control = _Control(self.controller)
        self._told = list[dict[str, Any]]()
        self.commands = CommandThread(
            config, self.shared, self._control, lambda **said: self._told.append(said)
        )

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        for _ in range(max(round(seconds * self.config.hz), 1)):
            self.tick()

    def tick(self) -> None:
        """Passes the time of one state."""
        self.now += self.controller.dt
        self.controller.tick(self.now)
        self._control.tick()
        state, arm = np.zeros((), ARM_STATE), self.controller.arm
        state["host"], state["robot"], state["runtime"] = self.now, self.controller.time, 2
        state["tcp"], state["speed"] = arm.state.tcp, arm.state.speed
        state["force"], state["joints"] = arm.force, arm.state.joints
        state["safety"] = SAFETY_BITS[self.controller.safety]
        state["operation"] = self._control.operation % 128
        state["progress"] = 0 if arm.busy else -1
        self.spoil(state)
        self.shared.publish(state)
        self.commands.check_state(state)
        if not self.commands.script_unusable:
            self.commands.act()
        self.supervise(self.now)

    # What the driver expects of its process.
    def send(self, **fields: Any) -> None:
        self.commands.put(ArmCommand(**fields))

    def reports(self) -> list[dict[str, Any]]:
        told, self._told[:] = list(self._told), []
        return told

    def exit_finding(self) -> None:
        return None

    def kill(self) -> None:
        pass

    def start(self) -> None:
        self.sleep(0.4)
        self.commands.set_rest_force(np.median(self.states()["force"], axis=0))
        self.process = self  # type: ignore[assignment]
        self.ready = self.armed = True

    def close(self) -> None:
        self.process = None
        self.shared.close()


def in_virtual_time(monkeypatch: Any, rig: Any) -> VirtualArm:
    """Lets the modules of the driver and of the poke loop use the time of a rig's virtual arm."""
    arm = rig.arm
    assert isinstance(arm, VirtualArm)
    clock = SimpleNamespace(monotonic=arm.monotonic, sleep=arm.sleep)
    for module in (arm_module, rtde_process, live_rig, poke_loop, polling):
        monkeypatch.setattr(module, "time", clock)
    rig.epoch = arm.now
    return arm
