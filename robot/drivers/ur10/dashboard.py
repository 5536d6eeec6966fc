"""Client of the controller's dashboard server (a line of text per request): the second way to stop the arm.

Every call returns within a time limit.
"""

from __future__ import annotations

import re
import socket
from contextlib import AbstractContextManager, suppress
from typing import NamedTuple

PORT = 29999
MIN_POLYSCOPE = (3, 4)  # PolyScope; older versions lack functions of the control script


class DashboardSilent(ConnectionError):
    """No dashboard server answers."""


class ControllerStatus(NamedTuple):
    """Status of a controller.

    Attributes:
        version: of PolyScope, as in (5, 11). mode: robot mode (`RUNNING`). safety: safety mode (`NORMAL`).
        program: whether a program runs. remote: whether it is under remote control; None without such a
            switch (CB3, or PolyScope before 5.6).
    """

    version: tuple[int, ...]
    mode: str
    safety: str
    program: bool
    remote: bool | None


class Dashboard(AbstractContextManager["Dashboard"]):
    """A connection to the dashboard server; a context manager."""

    def __init__(self, host: str, timeout: float = 1.0) -> None:
        self.host = host
        self._rest = b""
        try:
            self._socket = socket.create_connection((host, PORT), timeout)
            self._socket.settimeout(timeout)
            self._line()  # the greeting
        except OSError as error:
            raise DashboardSilent(f"no dashboard server answers at {host}:{PORT} ({error})") from None

    def __exit__(self, *_: object) -> None:
        self.close()

    def ask(self, command: str) -> str:
        """Sends a command and returns the answer, one line."""
        try:
            self._socket.sendall(command.encode() + b"\n")
            return self._line()
        except OSError as error:
            raise DashboardSilent(f"{self.host}:{PORT} did not answer `{command}` ({error})") from None

    def stop(self) -> str:
        """Ends the controller's program, which stops the arm."""
        return self.ask("stop")

    def controller(self) -> ControllerStatus:
        """Asks for the status of the controller."""
        # (5, 11) of `URSoftware 5.11.0.1234 (Jan 01 2022)`.
        found = re.search(r"(\d+)\.(\d+)", self.ask("PolyscopeVersion"))
        version = (int(found[1]), int(found[2])) if found else (0, 0)
        safety = self.ask("safetymode")
        remote = "true" in self.ask("is in remote control").lower() if version >= (5, 6) else None
        program = "true" in self.ask("running").lower()
        return ControllerStatus(version, _value(self.ask("robotmode")), _value(safety), program, remote)

    def close(self) -> None:
        """Closes the connection."""
        with suppress(OSError):
            self._socket.close()

    def _line(self) -> str:
        while b"\n" not in self._rest:
            data = self._socket.recv(4096)
            if not data:
                raise OSError("the server closed the connection")
            self._rest += data
            if len(self._rest) > 65536:
                raise OSError("an answer without a line end")
        line, self._rest = self._rest.split(b"\n", 1)
        return line.decode(errors="replace").strip()


def stop_program(host: str, timeout: float = 0.5, tries: int = 3) -> str:
    """Ends the controller's program over a new connection; returns the answer, '' without one."""
    for _ in range(tries):
        with suppress(DashboardSilent), Dashboard(host, timeout) as dashboard:
            return dashboard.stop()
    return ""


def _value(line: str) -> str:
    """`RUNNING` of `Robotmode: RUNNING`."""
    return line.rsplit(":", 1)[-1].strip().upper()
