"""Main loop of the emulator: control steps at absolute times, client data in between.

One thread, no locks. Late steps are made up for, up to `BACKLOG`, so that the mean rate holds on a busy
machine; steps later than that are skipped, and the robot's clock jumps.

The dashboard port: answers each line of text with one line.

Source: Universal Robots, "Dashboard Server", CB3 and e-Series.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import sys
import time
from collections.abc import Callable
from typing import Protocol

from robot.drivers.process_priority import urgent
from robot.drivers.ur10.rtde_protocol import RTDE_PORT
from robot.emulators.listening import listening
from robot.emulators.ur10.config import DASHBOARD_PORT, FAULT_PORT, SCRIPT_PORT, UrEmulatorConfig
from robot.emulators.ur10.control_program import load_program
from robot.emulators.ur10.controller import EmulatedController, RobotMode, Runtime
from robot.emulators.ur10.fault_server import ControllerFaults, FaultSession
from robot.emulators.ur10.motion import Unreachable
from robot.emulators.ur10.rtde_server import Claims, RtdeSession
from tactile.base.errors import InputError

BACKLOG = 0.1  # s
PENDING = 1 << 18  # unread bytes of a client above which it gets no states


class ClientSession(Protocol):
    """State of one client of a port."""

    def receive(self, data: bytes, host: float) -> bytes: ...

    def close(self) -> None: ...


class Connection:
    """A socket with its session and its unsent bytes."""

    def __init__(self, link: socket.socket, session: ClientSession) -> None:
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


class ControllerServer:
    """Four listening ports around one controller."""

    def __init__(self, config: UrEmulatorConfig) -> None:
        self.controller = emulated_controller(config)
        self.claims = Claims()
        self.faults = ControllerFaults(self)
        self.clients: list[Connection] = []
        self._selector = selectors.SelectSelector()  # resolution 1 us; epoll has 1 ms
        self._steps = 0
        ports: dict[int, Callable[[], ClientSession]] = {
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
    def rtde(self) -> list[tuple[Connection, RtdeSession]]:
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

    def close(self, connection: Connection) -> None:
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
        if not isinstance(key.data, Connection):
            self._accept(key)
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

    def _accept(self, key: selectors.SelectorKey) -> None:
        assert isinstance(key.fileobj, socket.socket)
        with contextlib.suppress(OSError):
            connection = Connection(key.fileobj.accept()[0], key.data())
            self.clients.append(connection)
            self._selector.register(connection.link, selectors.EVENT_READ, connection)
            if isinstance(connection.session, DashboardSession):
                self.send(connection, WELCOME)

    def send(self, connection: Connection, data: bytes) -> None:
        """Sends to a client; closes the connection if that fails."""
        try:
            connection.send(data)
        except OSError:
            self.close(connection)


def emulated_controller(config: UrEmulatorConfig) -> EmulatedController:
    """A controller that runs the control program of ur_rtde."""
    return EmulatedController(config, load_program)


def serve(config: UrEmulatorConfig) -> None:
    """Emulates a controller until the process is ended; prints "ready" when it listens.

    Raises:
        InputError: the arm cannot reach its start pose, or the address cannot be used.
    """
    try:
        server = ControllerServer(config)
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
SINCE_5_6 = ("is in remote control", "get serial number")


class DashboardSession:
    """A client connection."""

    def __init__(self, controller: EmulatedController) -> None:
        self._controller = controller
        self._rest = b""

    def receive(self, data: bytes, host: float) -> bytes:
        """Executes complete lines; returns one line of answer for each."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        return b"".join(
            f"{answer_command(self._controller, line.decode().strip())}\n".encode() for line in lines
        )

    def close(self) -> None:
        """Has no effect."""


def answer_command(controller: EmulatedController, command: str) -> str:
    """Executes a command; returns the answer."""
    do = _COMMANDS.get(command.lower())
    if do is None or (command.lower() in SINCE_5_6 and controller.config.version < (5, 6)):
        return f"could not understand: '{command}'"
    return do(controller)


def _stop(controller: EmulatedController) -> str:
    controller.stop_program()
    return "Stopped"


def _unlock(controller: EmulatedController) -> str:
    if controller.unlock():
        return "Protective stop releasing"
    return "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop"


def _power(mode: RobotMode, answer: str) -> Callable[[EmulatedController], str]:
    def do(controller: EmulatedController) -> str:
        controller.power(mode)
        return answer

    return do


_COMMANDS: dict[str, Callable[[EmulatedController], str]] = {
    "stop": _stop,
    "unlock protective stop": _unlock,
    "power on": _power(RobotMode.IDLE, "Powering on"),
    "brake release": _power(RobotMode.RUNNING, "Brake releasing"),
    "power off": _power(RobotMode.POWER_OFF, "Powering off"),
    "robotmode": lambda c: f"Robotmode: {c.robot_mode.name}",
    "is in remote control": lambda c: str(c.remote).lower(),
    "get serial number": lambda c: "20163000000",
    "safetymode": lambda c: f"Safetymode: {c.safety.name}",
    "running": lambda c: f"Program running: {str(c.runtime is Runtime.PLAYING).lower()}",
    "polyscopeversion": lambda c: "URSoftware {}.{}.{}.0 (emulated)".format(*c.config.version),
}
