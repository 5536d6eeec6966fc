"""Main loop of the emulator, control steps at absolute times with client data in between, and its sessions.

One thread, no locks. Late steps are made up for, up to `BACKLOG`, so that the mean rate holds on a busy
machine; steps later than that are skipped, and the robot's clock jumps. Sources of the sessions: Universal
Robots, "Real-Time Data Exchange (RTDE) Guide" and "Dashboard Server", CB3 and e-Series.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import struct
import sys
import time
from collections.abc import Callable
from typing import Protocol

from robot.drivers.processes import urgent
from robot.drivers.ur10 import rtde_protocol
from robot.drivers.ur10.rtde_protocol import RTDE_PORT
from robot.emulators.listening import listening
from robot.emulators.ur10.controller import EmulatedController, RobotMode, Runtime, Value
from robot.emulators.ur10.emulated_arm import Unreachable
from robot.emulators.ur10.emulator_config import DASHBOARD_PORT, FAULT_PORT, SCRIPT_PORT, UrEmulatorConfig
from robot.emulators.ur10.fault_server import ControllerFaults, FaultSession
from tactile.base.errors import InputError

BACKLOG = 0.1  # s
PENDING = 1 << 18  # unread bytes of a client above which it gets no states


class _ClientSession(Protocol):
    """State of one client of a port."""

    def receive(self, data: bytes, host: float) -> bytes: ...

    def close(self) -> None: ...


class _Connection:
    """A socket with its session and its unsent bytes."""

    def __init__(self, link: socket.socket, session: _ClientSession) -> None:
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.link = link
        self.session = session
        self._pending = b""

    def send(self, data: bytes) -> None:
        """Sends now or later; drops them if the client does not read. Raises OSError if disconnected."""
        if self._pending:
            if len(self._pending) > PENDING:
                return
            data = self._pending + data
        try:
            self._pending = data[self.link.send(data) :]
        except BlockingIOError:
            self._pending = data


class _ControllerServer:
    """Four listening ports around one controller."""

    def __init__(self, config: UrEmulatorConfig) -> None:
        self.controller = EmulatedController(config)
        self.claims = Claims()
        self.faults = ControllerFaults(self)
        self.clients: list[_Connection] = []
        self._selector = selectors.SelectSelector()  # resolution 1 us; epoll has 1 ms
        self._steps = 0
        ports: dict[int, Callable[[], _ClientSession]] = {
            RTDE_PORT: lambda: RtdeSession(self.controller, self.claims),
            SCRIPT_PORT: lambda: ScriptSession(self.controller),
            DASHBOARD_PORT: lambda: DashboardSession(self.controller),
            FAULT_PORT: lambda: FaultSession(self.faults),
        }
        for port, make_session in ports.items():
            with listening(config.host, port, config.open_to_network):
                listener = socket.create_server((config.host, port), backlog=16)
            listener.setblocking(False)
            self._selector.register(listener, selectors.EVENT_READ, make_session)

    @property
    def rtde(self) -> list[tuple[_Connection, RtdeSession]]:
        """RTDE clients: connections and sessions."""
        return [(c, c.session) for c in self.clients if isinstance(c.session, RtdeSession)]

    def run(self) -> None:
        """Runs until the process is ended."""
        dt = self.controller.dt
        due = time.monotonic() + dt
        while True:
            for key, _ in self._selector.select(max(0.0, due - time.monotonic())):
                self._serve(key)
            now = time.monotonic()
            if now - due > BACKLOG:
                missed = int((now - due) / dt)
                self.controller.time += missed * dt
                due += missed * dt
            while due <= now:
                self._step(now)
                due += dt

    def close(self, connection: _Connection) -> None:
        """Closes a client's connection, if open."""
        if connection in self.clients:
            self.clients.remove(connection)
            self._selector.unregister(connection.link)
            connection.link.close()
            connection.session.close()

    def _step(self, now: float) -> None:
        self.controller.tick(now)
        self._steps += 1
        if not self.faults.sends_states(self._steps):
            return
        overrides = self.faults.overrides()
        for connection, session in self.rtde:
            if session.started and self._steps % session.every == 0:
                self.send(connection, session.state(overrides))

    def _serve(self, key: selectors.SelectorKey) -> None:
        if not isinstance(key.data, _Connection):
            assert isinstance(key.fileobj, socket.socket)
            with contextlib.suppress(OSError):
                joined = _Connection(key.fileobj.accept()[0], key.data())
                self.clients.append(joined)
                self._selector.register(joined.link, selectors.EVENT_READ, joined)
                if isinstance(joined.session, DashboardSession):
                    self.send(joined, WELCOME)
            return
        connection = key.data
        if connection not in self.clients:
            return
        if self.faults.stalled and isinstance(connection.session, RtdeSession):
            time.sleep(0.0005)  # the data stay unread, so `select` returns at once
            return
        try:
            data = connection.link.recv(1 << 16)
            reply = connection.session.receive(data, time.monotonic()) if data else b""
        except BlockingIOError:
            return
        except (OSError, ValueError):
            data = reply = b""
        if not data:
            self.close(connection)
        elif reply:
            self.send(connection, reply)

    def send(self, connection: _Connection, data: bytes) -> None:
        """Sends to a client; closes the connection if that fails."""
        try:
            connection.send(data)
        except OSError:
            self.close(connection)


def serve(config: UrEmulatorConfig) -> None:
    """Emulates a controller until the process is ended; prints "ready" when it listens.

    Raises:
        InputError: the arm cannot reach its start pose, or the address cannot be used.
    """
    try:
        server = _ControllerServer(config)
    except Unreachable as error:
        raise InputError("start", str(error), "a pose within 1.3 m of the base", "move it") from error
    with urgent():
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        server.run()


class ScriptSession:
    """One client. A program runs from a line `def ...` to `end` at the margin; any other line is one, too."""

    def __init__(self, controller: EmulatedController) -> None:
        self._controller = controller
        self._rest = b""
        self._program: list[str] | None = None

    def receive(self, data: bytes, host: float) -> bytes:
        """Uploads complete programs. Answers nothing (a real controller sends states)."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        for raw in lines:
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

    def close(self) -> None:
        """Discards an incomplete program; a running program continues."""


WELCOME = b"Connected: Universal Robots Dashboard Server\n"
LOCKED = "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop"
POWER = {
    "power on": (RobotMode.IDLE, "Powering on"),
    "brake release": (RobotMode.RUNNING, "Brake releasing"),
    "power off": (RobotMode.POWER_OFF, "Powering off"),
}
"""Power mode and answer of a command of the dashboard."""


class DashboardSession:
    """A client connection."""

    def __init__(self, controller: EmulatedController) -> None:
        self._controller = controller
        self._rest = b""

    def receive(self, data: bytes, host: float) -> bytes:
        """Executes complete lines; returns one line of answer for each."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        return b"".join(f"{self._answer(line.decode().strip())}\n".encode() for line in lines)

    def close(self) -> None:
        """Has no effect."""

    def _answer(self, command: str) -> str:
        """Executes a command; returns the answer."""
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
            answers |= {
                "is in remote control": str(controller.remote).lower(),
                "get serial number": "20163000000",
            }
        return answers.get(name, f"could not understand: '{command}'")


class Claims:
    """Owner of each input variable: one client at a time.

    Attributes:
        held_by_fieldbus: whether a fieldbus holds the integer registers.
    """

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
    """_Connection of one client.

    Args:
        controller: the emulated controller. claims: shared by all clients.

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
        types = [rtde_protocol.INPUT_TYPES.get(name, "NOT_FOUND") for name in names]
        types = [
            kind if self._claims.free(name, self) else "IN_USE"
            for name, kind in zip(names, types, strict=True)
        ]
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
