"""RTDE protocol, version 2: packages, variables and their binary layout, for clients and the emulator.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". Everything is big-endian; a package is a
length of 2 bytes (which counts itself), a kind of 1 byte and a body.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

VERSION = 2
RTDE_PORT = 30004  # fixed in the client library
HEADER = struct.Struct(">HB")
PROTOCOL, CONTROLLER, TEXT = ord("V"), ord("v"), ord("M")
OUTPUTS, INPUTS, START, PAUSE, DATA = ord("O"), ord("I"), ord("S"), ord("P"), ord("U")

CODES = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "INT32": "i",
    "UINT64": "Q",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}
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


class Package(NamedTuple):
    """One package: its kind (character code) and body."""

    kind: int
    body: bytes


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

    def feed(self, data: bytes) -> Iterator[Package]:
        """The packages completed by these bytes.

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
            yield Package(kind, body)
