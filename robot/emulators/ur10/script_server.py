"""The script port: receives text, uploads complete programs to the controller."""

from __future__ import annotations

from robot.emulators.ur10.controller import EmulatedController


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
