"""The script port: text comes in, whole programs go to the controller."""

from __future__ import annotations

from robot.emulators.ur10.controller import EmulatedController


class ScriptSession:
    """One client. A program is all from a line `def ...` to its `end` at the margin; so is a line alone."""

    def __init__(self, controller: EmulatedController) -> None:
        self._controller = controller
        self._rest = b""
        self._program: list[str] | None = None

    def received(self, data: bytes, host: float) -> bytes:
        """Nothing is answered: a real controller sends its state here, which no client of ours reads."""
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

    def closed(self) -> None:
        """A program that was not finished never runs; one that runs goes on."""
