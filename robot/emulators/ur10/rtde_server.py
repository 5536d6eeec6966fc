"""Sessions of RTDE clients: handshake, recipes, inputs and states."""

from __future__ import annotations

import struct

from robot.drivers.ur10 import rtde_protocol
from robot.emulators.ur10.controller import EmulatedController
from robot.emulators.ur10.registers import Value


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
    """Connection of one client.

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

    def _answer(self, package: rtde_protocol.Package, host: float) -> bytes:
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
        names = split(body[8:])
        hz = self._controller.config.hz
        self.every = max(1, round(hz / frequency)) if 0 < frequency <= hz else 1
        types = [rtde_protocol.OUTPUT_TYPES.get(name, "NOT_FOUND") for name in names]
        known = "NOT_FOUND" not in types
        self._outputs = names if known else []
        self._layout = rtde_protocol.data_layout(types if known else [])
        return bytes([known]) + ",".join(types).encode()

    def _set_inputs(self, body: bytes) -> bytes:
        names = split(body)
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


def split(names: bytes) -> list[str]:
    """Names in a comma-separated list; a trailing comma is allowed."""
    return [name for name in names.decode("ascii", "replace").split(",") if name]
