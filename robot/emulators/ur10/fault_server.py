"""The fault port of the emulator: one JSON object per line, answered by one JSON line.

{"do": "stall", "seconds": 3}      nothing is sent to or read from RTDE clients; the arm continues
{"do": "malformed"}                sends an empty data package
{"do": "truncated"}                sends half a state, then complete states
{"do": "huge"}                     sends a package header with a length of 65535 bytes
{"do": "nan"}                      pose and speed are NaN, until "clear"
{"do": "freeze", "all": false}     the timestamp (or the whole state) is constant, until "clear"
{"do": "rate", "hz": 80}           states are sent at this rate, until "clear"
{"do": "close"}                    RTDE clients are disconnected
{"do": "protective"}, {"do": "safeguard"}, {"do": "emergency"}
{"do": "registers"}                a fieldbus holds the integer registers, until "clear"
{"do": "ik_fails"}                 inverse kinematics fails, until "clear"
{"do": "slider", "fraction": 0.1}  sets the speed slider
{"do": "remote", "on": false}      switches remote control
{"do": "place", "tcp": [6]}        sets the tool pose at once
{"do": "wall", "x": 0.8}           a wall at x (or y, z); "solid" 1 or -1 (default: side without the tool),
                                   "stiffness" N/m; without an axis: removes all walls
{"do": "clear"}                    ends all of these; a safeguarded program resumes
{"do": "state"}                    state of the emulator, see `ControllerFaults.state`
{"do": "die"}                      ends the process at once
"""

from __future__ import annotations

import json
import math
import os
import time
from typing import Any, Protocol

from robot.drivers.ur10 import rtde_protocol
from robot.emulators.ur10.controller import EmulatedController, Value
from robot.emulators.ur10.emulator_config import WallConfig

NAN: Value = (math.nan,) * 6


class _FaultyServer(Protocol):
    """What faults need of a server: its controller, the owners of its inputs, its clients of states."""

    controller: EmulatedController
    claims: Any

    @property
    def rtde(self) -> list[tuple[Any, Any]]:
        """Connections and sessions."""

    def send(self, connection: Any, data: bytes) -> None:
        """Sends data to a client."""

    def close(self, connection: Any) -> None:
        """Closes a client's connection."""


class ControllerFaults:
    """Active faults and their effect on published states."""

    def __init__(self, server: _FaultyServer) -> None:
        self._server = server
        self._controller = server.controller
        self._stalled_until = -math.inf
        self._hz: float | None = None
        self._nan = False
        self._frozen: dict[str, Value] = {}

    @property
    def stalled(self) -> bool:
        return time.monotonic() < self._stalled_until

    def sends_states(self, step: int) -> bool:
        """Whether states are sent at this control step."""
        if self.stalled:
            return False
        hz = self._controller.config.hz
        return self._hz is None or math.floor(step * self._hz / hz) > math.floor((step - 1) * self._hz / hz)

    def overrides(self) -> dict[str, Value]:
        """Fields with replaced values."""
        if self._nan:
            return {**self._frozen, "actual_TCP_pose": NAN, "actual_TCP_speed": NAN}
        return self._frozen

    def do(self, request: dict[str, Any]) -> dict[str, Any]:
        """Executes a request. Raises ValueError, KeyError or TypeError for an invalid one."""
        what = request["do"]
        if what == "state":
            return self.state()
        method = getattr(self, f"_do_{what}", None)
        if method is None:
            raise ValueError(f"unknown fault {what!r}")
        method(request)
        return {"ok": True}

    def state(self) -> dict[str, Any]:
        """Robot time, s; tool pose, speed and force; joints; the last targets; counts; modes by name."""
        controller, arm = self._controller, self._controller.arm
        return {
            "time": controller.time,
            "host_time": time.monotonic(),
            "tcp": list(arm.state.tcp),
            "speed": list(arm.state.speed),
            "joints": list(arm.state.joints),
            "force": list(arm.force),
            "moving": arm.moving,
            "targets": list(controller.targets),
            "penetration_max": arm.penetration_max,
            "watchdog_stops": controller.watchdog_stops,
            "program_stops": controller.program_stops,
            "programs": controller.programs,
            "runtime": controller.runtime.name,
            "safety": controller.safety.name,
            "mode": controller.robot_mode.name,
            "clients": len(self._server.rtde),
            "ignored": sum(session.ignored for _, session in self._server.rtde),
        }

    def _raw(self, data: bytes) -> None:
        for connection, session in self._server.rtde:
            if session.started:
                self._server.send(connection, data)

    def _do_stall(self, request: dict[str, Any]) -> None:
        self._stalled_until = time.monotonic() + float(request["seconds"])

    def _do_malformed(self, request: dict[str, Any]) -> None:
        self._raw(rtde_protocol.HEADER.pack(0, rtde_protocol.DATA))

    def _do_truncated(self, request: dict[str, Any]) -> None:
        for connection, session in self._server.rtde:
            if session.started:
                whole = session.state({})
                self._server.send(connection, whole[: len(whole) // 2])

    def _do_huge(self, request: dict[str, Any]) -> None:
        self._raw(rtde_protocol.HEADER.pack(0xFFFF, rtde_protocol.DATA))

    def _do_nan(self, request: dict[str, Any]) -> None:
        self._nan = True

    def _do_freeze(self, request: dict[str, Any]) -> None:
        fields = self._controller.registers.fields
        self._frozen = dict(fields) if request.get("all") else {"timestamp": fields["timestamp"]}

    def _do_rate(self, request: dict[str, Any]) -> None:
        self._hz = float(request["hz"])

    def _do_close(self, request: dict[str, Any]) -> None:
        for connection, _ in self._server.rtde:
            self._server.close(connection)

    def _do_protective(self, request: dict[str, Any]) -> None:
        self._controller.protective_stop()

    def _do_safeguard(self, request: dict[str, Any]) -> None:
        self._controller.safeguard_stop()

    def _do_emergency(self, request: dict[str, Any]) -> None:
        self._controller.emergency_stop()

    def _do_registers(self, request: dict[str, Any]) -> None:
        self._server.claims.held_by_fieldbus = True

    def _do_ik_fails(self, request: dict[str, Any]) -> None:
        self._controller.ik_fails = True

    def _do_slider(self, request: dict[str, Any]) -> None:
        self._controller.arm.scale = min(1.0, max(0.0, float(request["fraction"])))

    def _do_remote(self, request: dict[str, Any]) -> None:
        self._controller.remote = bool(request["on"])

    def _do_place(self, request: dict[str, Any]) -> None:
        x, y, z, rx, ry, rz = map(float, request["tcp"])
        self._controller.arm.place((x, y, z, rx, ry, rz))

    def _do_wall(self, request: dict[str, Any]) -> None:
        arm = self._controller.arm
        arm.walls = arm.walls if set("xyz") & set(request) else []
        for axis in set("xyz") & set(request):
            at = float(request[axis])
            beyond = 1 if arm.state.tcp["xyz".index(axis)] <= at else -1
            arm.walls.append(
                WallConfig.model_validate(
                    {"axis": axis, "at": at, "solid": request.get("solid", beyond)}
                    | {key: request[key] for key in ("stiffness",) if key in request}
                )
            )

    def _do_clear(self, request: dict[str, Any]) -> None:
        self._stalled_until, self._hz, self._nan, self._frozen = -math.inf, None, False, {}
        self._server.claims.held_by_fieldbus = False
        self._controller.ik_fails = False
        self._controller.remote = self._controller.config.remote
        self._controller.arm.scale = 1.0
        self._controller.clear()

    def _do_die(self, request: dict[str, Any]) -> None:
        os._exit(1)


class FaultSession:
    """A client connection of the fault port."""

    def __init__(self, faults: ControllerFaults) -> None:
        self._faults = faults
        self._rest = b""

    def receive(self, data: bytes, host: float) -> bytes:
        """Executes complete lines; returns one JSON line of answer for each."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        answers: list[dict[str, Any]] = []
        for line in filter(bytes.strip, lines):
            try:
                answers.append(self._faults.do(json.loads(line)))
            except (ArithmeticError, LookupError, TypeError, ValueError) as error:
                answers.append({"ok": False, "error": f"{type(error).__name__}: {error}"})
        return b"".join(json.dumps(answer).encode() + b"\n" for answer in answers)

    def close(self) -> None:
        """Has no effect: faults stay active."""
