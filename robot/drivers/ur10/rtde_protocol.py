"""RTDE protocol, version 2: packages, variables and their binary layout, for clients and the emulator.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". Everything is big-endian; a package is a
length of 2 bytes (which counts itself), a kind of 1 byte and a body.

`PoseListener` is a client that only reads the tool's pose. It writes nothing to the controller and claims no
registers, so it can run beside the program that moves the arm, with a real or an emulated controller.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

VERSION = 2
RTDE_PORT = 30004  # fixed in the client library
HEADER = struct.Struct(">HB")
PROTOCOL, CONTROLLER, TEXT = ord("V"), ord("v"), ord("M")
OUTPUTS, INPUTS, START, PAUSE, DATA = ord("O"), ord("I"), ord("S"), ord("P"), ord("U")

CODES = {"BOOL": "?", "UINT8": "B", "UINT32": "I", "INT32": "i", "UINT64": "Q", "DOUBLE": "d"}
CODES |= {"VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i"}
REGISTERS = 48
_REGISTER = {"int_register": "INT32", "double_register": "DOUBLE"}

_OUTPUTS = {
    "DOUBLE": """timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum
        actual_main_voltage actual_robot_voltage actual_robot_current standard_analog_input0
        standard_analog_input1 standard_analog_output0 standard_analog_output1 payload""",
    "VECTOR6D": """target_q target_qd target_qdd target_current target_moment actual_q actual_qd
        actual_current joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose
        target_TCP_speed joint_temperatures actual_joint_voltage ft_raw_wrench payload_inertia
        actual_current_as_torque""",
    "VECTOR3D": "actual_tool_accelerometer payload_cog",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
    "UINT32": "runtime_state robot_status_bits safety_status_bits",
    "INT32": "robot_mode safety_mode",
    "VECTOR6INT32": "joint_mode",
}
_INPUTS = {
    "UINT32": "speed_slider_mask",
    "UINT8": """standard_digital_output_mask standard_digital_output configurable_digital_output_mask
        configurable_digital_output tool_digital_output_mask tool_digital_output standard_analog_output_mask
        standard_analog_output_type""",
    "DOUBLE": "speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    "VECTOR6D": "external_force_torque",
}


def _types(direction: str, variables: dict[str, str]) -> dict[str, str]:
    named = {name: kind for kind, names in variables.items() for name in names.split()}
    for register, kind in _REGISTER.items():
        named |= {f"{direction}_{register}_{index}": kind for index in range(REGISTERS)}
    return named


OUTPUT_TYPES = _types("output", _OUTPUTS)
INPUT_TYPES = _types("input", _INPUTS)


def pack_package(kind: int, body: bytes = b"") -> bytes:
    """The bytes of a package."""
    return HEADER.pack(HEADER.size + len(body), kind) + body


def data_layout(types: Sequence[str]) -> struct.Struct:
    """Layout of a data package with variables of these types, after its recipe number."""
    return struct.Struct(">B" + "".join(CODES[name] for name in types))


class PackageSplitter:
    """Splits a byte stream into packages."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """The packages completed by these bytes: kind (character code) and body of each.

        Raises:
            ValueError: an invalid length."""
        self._rest += data
        while len(self._rest) >= HEADER.size:
            length, kind = HEADER.unpack_from(self._rest)
            if length < HEADER.size:
                raise ValueError(f"a package of {length} bytes")
            if len(self._rest) < length:
                return
            body = bytes(self._rest[HEADER.size : length])
            del self._rest[:length]
            yield kind, body


_FIELDS = ("timestamp", "actual_TCP_pose", "actual_TCP_speed")


class ToolPose(NamedTuple):
    """A tool pose with its time.

    Attributes:
        time: s, host's monotonic clock at receipt. tcp: [6] m and rotation vector in the base.
        speed: [6] m/s, rad/s. robot_time: s, the controller's clock.
    """

    time: float
    tcp: np.ndarray
    speed: np.ndarray
    robot_time: float


class PoseListener(contextlib.AbstractContextManager["PoseListener"]):
    """Reads poses in a separate thread, and reconnects when the connection is lost.

    Args:
        host: of the controller. hz: requested state rate, Hz. patience: time without a state before it
            reconnects, s. port: of RTDE.
    """

    def __init__(self, host: str, hz: float = 125, patience: float = 1.0, port: int = RTDE_PORT) -> None:
        self._address = (host, port)
        self._hz = hz
        self._patience = patience
        self._latest: ToolPose | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tool poses", daemon=True)
        self._thread.start()

    def latest(self) -> ToolPose | None:
        """The newest tool pose; None before the first."""
        return self._latest

    def close(self) -> None:
        """Ends the thread."""
        self._closing.set()
        self._thread.join(self._patience + 1.0)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        layout = data_layout([OUTPUT_TYPES[name] for name in _FIELDS])
        recipe = struct.pack(">d", self._hz) + ",".join(_FIELDS).encode()
        while not self._closing.is_set():
            # An invalid package makes the connection unusable.
            with (
                contextlib.suppress(OSError, ValueError, struct.error),
                socket.create_connection(self._address, timeout=self._patience) as link,
            ):
                splitter = PackageSplitter()
                link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                link.sendall(pack_package(PROTOCOL, struct.pack(">H", VERSION)))
                link.sendall(pack_package(OUTPUTS, recipe) + pack_package(START))
                while not self._closing.is_set() and (data := link.recv(1 << 14)):
                    host = time.monotonic()
                    for kind, body in splitter.feed(data):
                        if kind == DATA:
                            numbers = np.array(layout.unpack(body)[1:])
                            self._latest = ToolPose(host, numbers[1:7], numbers[7:13], float(numbers[0]))
            self._closing.wait(0.1)
