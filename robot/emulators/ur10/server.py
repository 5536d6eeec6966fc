"""Control steps of the emulator at absolute times with client data in between, sessions, faults.

One thread, no locks. Late steps are made up for, up to `BACKLOG`, so that the mean rate holds on a busy
machine; steps later than that are skipped, and the robot's clock jumps. Sources of the sessions: Universal
Robots, "Real-Time Data Exchange (RTDE) Guide" and "Dashboard Server", CB3 and e-Series.
"""

from __future__ import annotations

import asyncio
import math
import os
import selectors
import struct
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from robot.drivers.processes import urgent
from robot.drivers.ur10 import dashboard, rtde_protocol
from robot.drivers.ur10.rtde_protocol import RTDE_PORT
from robot.emulators.listening import answer_fault, do_fault, open_ports
from robot.emulators.ur10.controller import EmulatedController, RobotMode, Runtime, Value
from robot.emulators.ur10.emulated_arm import Unreachable
from robot.emulators.ur10.emulator_config import FAULT_PORT, SCRIPT_PORT, UrEmulatorConfig, WallConfig
from robot.emulators.ur10.kinematics import vector6
from tactile.base.errors import InputError

BACKLOG = 0.1  # s
PENDING = 1 << 18  # unread bytes of a client above which it gets no states


class _ControllerServer:
    """Four listening ports around one controller.

    Attributes:
        rtde: the sessions of RTDE clients, with their connections.
    """

    def __init__(self, config: UrEmulatorConfig) -> None:
        self.controller = EmulatedController(config)
        self.claims = Claims()
        self.faults = _ControllerFaults(self)
        self.rtde: dict[RtdeSession, asyncio.StreamWriter] = {}

    async def run(self) -> None:
        """Listens, prints "ready" and runs until the process is ended."""
        sessions: dict[int, Callable[[], RtdeSession | _LineSession]] = {
            RTDE_PORT: lambda: RtdeSession(self.controller, self.claims),
            SCRIPT_PORT: lambda: ScriptSession(self.controller),
            dashboard.PORT: lambda: DashboardSession(self.controller),
            FAULT_PORT: lambda: _LineSession(self.faults.answer),
        }
        config = self.controller.config
        ports = [(partial(self._talk, make_session), port) for port, make_session in sessions.items()]
        async with open_ports(config.host, config.open_to_network, ports):
            print("ready", flush=True)
            await self._keep_time()

    async def _keep_time(self) -> None:
        dt, steps = self.controller.dt, 0
        due = time.monotonic() + dt
        while True:
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            now = time.monotonic()
            if now - due > BACKLOG:
                missed = int((now - due) / dt)
                self.controller.time += missed * dt
                due += missed * dt
            while due <= now:
                due, steps = due + dt, steps + 1
                self.controller.tick(now)
                if not self.faults.sends_states(steps):
                    continue
                overrides = self.faults.overrides()
                for session, connection in self.rtde.items():
                    if session.started and steps % session.every == 0:
                        send(connection, session.state(overrides))

    async def _talk(
        self,
        make_session: Callable[[], RtdeSession | _LineSession],
        reader: asyncio.StreamReader,
        connection: asyncio.StreamWriter,
    ) -> None:
        session = make_session()
        if isinstance(session, RtdeSession):
            self.rtde[session] = connection
        elif isinstance(session, DashboardSession):
            send(connection, WELCOME)
        try:
            while data := await reader.read(1 << 16):
                while session in self.rtde and self.faults.stalled:
                    await asyncio.sleep(0.001)
                if connection.is_closing():
                    return
                send(connection, session.receive(data, time.monotonic()))
        except ValueError:  # not of its protocol
            return
        finally:
            self.close(session)

    def close(self, session: RtdeSession | _LineSession) -> None:
        """Ends a session; closes the connection of an RTDE client at once."""
        session.close()
        if isinstance(session, RtdeSession) and session in self.rtde:
            self.rtde.pop(session).transport.abort()


def send(connection: asyncio.StreamWriter, data: bytes) -> None:
    """Sends to a client now or later; drops the data if the client has gone or does not read."""
    if not connection.is_closing() and connection.transport.get_write_buffer_size() <= PENDING:
        connection.write(data)


def serve(config: UrEmulatorConfig) -> None:
    """Emulates a controller until the process is ended; prints "ready" when it listens.

    Raises:
        InputError: the arm cannot reach its start pose, or the address cannot be used.
    """
    try:
        server = _ControllerServer(config)
    except Unreachable as error:
        raise InputError("start", str(error), "a pose within 1.3 m of the base", "move it") from error

    precise = partial(asyncio.SelectorEventLoop, selectors.SelectSelector())  # 1 us; epoll has 1 ms
    with urgent(), asyncio.Runner(loop_factory=precise) as runner:
        runner.run(server.run())


class _LineSession:
    """One client of a port whose requests are lines."""

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self._answer, self._rest = answer, b""

    def receive(self, data: bytes, host: float) -> bytes:
        """Executes complete lines; returns their answers."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        return b"".join(map(self._answer, lines))

    def close(self) -> None:
        """Discards an incomplete request; what earlier ones have started continues."""


class ScriptSession(_LineSession):
    """One client. A program runs from a line `def ...` to `end` at the margin; any other line is one, too.
    Nothing is answered (a real controller sends states)."""

    def __init__(self, controller: EmulatedController) -> None:
        super().__init__(self._take)
        self._controller = controller
        self._program: list[str] | None = None

    def _take(self, raw: bytes) -> bytes:
        line = raw.decode("utf-8", "replace").rstrip("\r")
        if self._program is not None:
            self._program.append(line)
            if line.startswith("end"):
                self._controller.upload("\n".join(self._program))
                self._program = None
        elif line.startswith("def "):
            self._program = [line]
        elif line.strip():
            self._controller.upload(line)
        return b""


WELCOME = b"Connected: Universal Robots Dashboard Server\n"
LOCKED = "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop"
POWER = {
    "power on": (RobotMode.IDLE, "Powering on"),
    "brake release": (RobotMode.RUNNING, "Brake releasing"),
    "power off": (RobotMode.POWER_OFF, "Powering off"),
}
"""Power mode and answer of a command of the dashboard."""


class DashboardSession(_LineSession):
    """One client of the dashboard, which answers each line by a line."""

    def __init__(self, controller: EmulatedController) -> None:
        super().__init__(lambda line: f"{self._execute(line.decode().strip())}\n".encode())
        self._controller = controller

    def _execute(self, command: str) -> str:
        controller, name = self._controller, command.lower()
        power = POWER.get(name)
        if power is not None:
            controller.power(power[0])
            return power[1]
        if name == "stop":
            controller.stop_program()
            return "Stopped"
        if name == "unlock protective stop":
            return "Protective stop releasing" if controller.unlock() else LOCKED
        answers = {
            "robotmode": f"Robotmode: {controller.robot_mode.name}",
            "safetymode": f"Safetymode: {controller.safety.name}",
            "running": f"Program running: {str(controller.runtime is Runtime.PLAYING).lower()}",
            "polyscopeversion": "URSoftware {}.{}.{}.0 (emulated)".format(*controller.config.version),
        }
        if controller.config.version >= (5, 6):
            answers["is in remote control"] = str(controller.remote).lower()
            answers["get serial number"] = "20163000000"
        return answers.get(name, f"could not understand: '{command}'")


class Claims:
    """Owner of each input variable: one client at a time."""

    def __init__(self) -> None:
        self.owners: dict[str, RtdeSession] = {}
        self.held_by_fieldbus = False

    def free(self, name: str, session: RtdeSession) -> bool:
        if self.held_by_fieldbus and name.startswith("input_int_register"):
            return False
        return self.owners.get(name, session) is session

    def release(self, session: RtdeSession) -> None:
        self.owners = {name: owner for name, owner in self.owners.items() if owner is not session}


class RtdeSession:
    """One client of RTDE.

    Attributes:
        started: whether states are sent. every: control steps per state. ignored: number of invalid inputs.
    """

    def __init__(self, controller: EmulatedController, claims: Claims) -> None:
        self.started = False
        self.every = 1
        self.ignored = 0
        self._controller = controller
        self._claims = claims
        self._splitter = rtde_protocol.PackageSplitter()
        self._outputs: list[str] = []
        self._layout = rtde_protocol.data_layout([])
        self._inputs: list[tuple[list[str], struct.Struct]] = []

    def receive(self, data: bytes, host: float) -> bytes:
        """Answers to bytes that arrived at a host time, s. Raises ValueError if they are not RTDE."""
        try:
            return b"".join(self._answer(package, host) for package in self._splitter.feed(data))
        except struct.error as error:
            raise ValueError(str(error)) from error

    def close(self) -> None:
        """Releases the client's input variables for other clients."""
        self._claims.release(self)

    def state(self, overrides: dict[str, Value]) -> bytes:
        """The current state as a package, in the client's output recipe."""
        fields = self._controller.registers.fields
        numbers: list[float] = []
        for name in self._outputs:
            numbers += overrides.get(name) or fields[name]
        return rtde_protocol.pack_package(rtde_protocol.DATA, self._layout.pack(1, *numbers))

    def _answer(self, package: tuple[int, bytes], host: float) -> bytes:
        kind, body = package
        if kind == rtde_protocol.DATA:
            self._take(body, host)
            return b""
        if kind == rtde_protocol.PROTOCOL:
            (version,) = struct.unpack(">H", body)
            return rtde_protocol.pack_package(kind, bytes([version == rtde_protocol.VERSION]))
        if kind == rtde_protocol.CONTROLLER:
            return rtde_protocol.pack_package(kind, struct.pack(">4I", *self._controller.config.version, 0))
        if kind == rtde_protocol.OUTPUTS:
            return rtde_protocol.pack_package(kind, self._set_outputs(body))
        if kind == rtde_protocol.INPUTS:
            return rtde_protocol.pack_package(kind, self._set_inputs(body))
        if kind in (rtde_protocol.START, rtde_protocol.PAUSE):
            self.started = kind == rtde_protocol.START
            return rtde_protocol.pack_package(kind, b"\1")
        return b""

    def _set_outputs(self, body: bytes) -> bytes:
        (frequency,) = struct.unpack_from(">d", body)
        names = _split(body[8:])
        hz = self._controller.config.hz
        self.every = max(1, round(hz / frequency)) if 0 < frequency <= hz else 1
        types = [rtde_protocol.OUTPUT_TYPES.get(name, "NOT_FOUND") for name in names]
        known = "NOT_FOUND" not in types
        self._outputs = names if known else []
        self._layout = rtde_protocol.data_layout(types if known else [])
        return bytes([known]) + ",".join(types).encode()

    def _set_inputs(self, body: bytes) -> bytes:
        names = _split(body)
        known, free = rtde_protocol.INPUT_TYPES, self._claims.free
        types = [known.get(name, "NOT_FOUND") if free(name, self) else "IN_USE" for name in names]
        if "NOT_FOUND" in types or "IN_USE" in types:
            return b"\0" + ",".join(types).encode()
        for name in names:
            self._claims.owners[name] = self
        self._inputs.append((names, rtde_protocol.data_layout(types)))
        return bytes([len(self._inputs)]) + ",".join(types).encode()

    def _take(self, body: bytes, host: float) -> None:
        """Stores inputs of a client; ignores a body shorter than its recipe, and excess bytes."""
        recipe = body[0] if body else 0
        if not 1 <= recipe <= len(self._inputs) or len(body) < self._inputs[recipe - 1][1].size:
            self.ignored += 1
            return
        names, layout = self._inputs[recipe - 1]
        numbers = layout.unpack_from(body)[1:]
        registers = self._controller.registers
        first = 0
        for name in names:
            length = 6 if rtde_protocol.INPUT_TYPES[name] == "VECTOR6D" else 1
            registers.write(name, numbers[first : first + length], host)
            first += length


def _split(names: bytes) -> list[str]:
    """Names in a comma-separated list; a trailing comma is allowed."""
    return [name for name in names.decode("ascii", "replace").split(",") if name]


NAN: Value = (math.nan,) * 6


class _ControllerFaults:
    """Active faults and their effect on published states, by requests of one JSON object a line:

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
    {"do": "wall", "x": 0.8}           a wall at x (or y, z); "solid" 1 or -1 (default: side without the
                                       tool), "stiffness" N/m; without an axis: removes all walls
    {"do": "clear"}                    ends all of these; a safeguarded program resumes
    {"do": "state"}                    state of the emulator, see `_state`
    {"do": "die"}                      ends the process at once
    """

    def __init__(self, server: _ControllerServer) -> None:
        self._server, self._controller = server, server.controller
        self._active: dict[str, Any] = {}  # by name, with their values

    @property
    def stalled(self) -> bool:
        return time.monotonic() < self._active.get("stall", -math.inf)

    def sends_states(self, step: int) -> bool:
        """Whether states are sent at this control step."""
        hz = self._controller.config.hz
        rate = self._active.get("rate", hz)
        return not self.stalled and math.floor(step * rate / hz) > math.floor((step - 1) * rate / hz)

    def overrides(self) -> dict[str, Value]:
        """Fields with replaced values."""
        return self._active.get("freeze", {}) | self._active.get("nan", {})

    def answer(self, line: bytes) -> bytes:
        """Executes a request; returns a JSON line, nothing for an empty one."""
        return answer_fault(line, lambda request: do_fault(self.known, request)) if line.strip() else b""

    @property
    def known(self) -> dict[str, Callable[..., object]]:
        """The functions of the faults, by name; each takes its arguments."""
        controller, active = self._controller, self._active
        arm, header, fields = controller.arm, rtde_protocol.HEADER, controller.registers.fields
        return {
            "stall": lambda seconds: active.update(stall=time.monotonic() + float(seconds)),
            "malformed": lambda: self._send(lambda _: header.pack(0, rtde_protocol.DATA)),
            "truncated": lambda: self._send(lambda state: state[: len(state) // 2]),
            "huge": lambda: self._send(lambda _: header.pack(0xFFFF, rtde_protocol.DATA)),
            "nan": lambda: active.update(nan={"actual_TCP_pose": NAN, "actual_TCP_speed": NAN}),
            "freeze": lambda all=False: active.update(
                freeze=dict(fields) if all else {"timestamp": fields["timestamp"]}
            ),
            "rate": lambda hz: active.update(rate=float(hz)),
            "close": self._close_clients,
            "protective": controller.protective_stop,
            "safeguard": controller.safeguard_stop,
            "emergency": controller.emergency_stop,
            "registers": lambda: setattr(self._server.claims, "held_by_fieldbus", True),
            "ik_fails": lambda: setattr(controller, "ik_fails", True),
            "slider": lambda fraction: setattr(arm, "scale", min(1.0, max(0.0, float(fraction)))),
            "remote": lambda on: setattr(controller, "remote", bool(on)),
            "place": lambda tcp: arm.place(vector6(map(float, tcp))),
            "wall": self._add_walls,
            "clear": self._clear,
            "state": self._state,
            "die": lambda: os._exit(1),
        }

    def _state(self) -> dict[str, Any]:
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
            "ignored": sum(session.ignored for session in self._server.rtde),
        }

    def _send(self, damage: Callable[[bytes], bytes]) -> None:
        """Sends a damaged state to all clients of states."""
        for session, connection in self._server.rtde.items():
            if session.started:
                send(connection, damage(session.state({})))

    def _close_clients(self) -> None:
        for session in list(self._server.rtde):
            self._server.close(session)

    def _add_walls(self, **request: Any) -> None:
        arm = self._controller.arm
        arm.walls = arm.walls if set("xyz") & set(request) else []
        for axis in set("xyz") & set(request):
            at = float(request[axis])
            beyond = 1 if arm.state.tcp["xyz".index(axis)] <= at else -1
            given = {key: request[key] for key in ("solid", "stiffness") if key in request}
            arm.walls.append(WallConfig.model_validate({"axis": axis, "at": at, "solid": beyond} | given))

    def _clear(self) -> None:
        self._active.clear()
        self._server.claims.held_by_fieldbus = False
        self._controller.ik_fails = False
        self._controller.remote = self._controller.config.remote
        self._controller.arm.scale = 1.0
        self._controller.clear()
