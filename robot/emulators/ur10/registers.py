"""Registers and state fields of the controller: published outputs, inputs from clients."""

from __future__ import annotations

from robot.drivers.ur10.rtde_protocol import OUTPUT_TYPES, REGISTERS

Value = tuple[float, ...]

_LENGTH = {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6}
_CONSTANT: dict[str, Value] = {
    "speed_scaling": (1.0,),
    "target_speed_fraction": (1.0,),
    "actual_main_voltage": (48.0,),
    "actual_robot_voltage": (48.0,),
    "actual_joint_voltage": (48.0,) * 6,
    "joint_temperatures": (30.0,) * 6,
    "actual_tool_accelerometer": (0.0, 0.0, 9.82),
    "joint_mode": (253,) * 6,  # running
}


class Registers:
    """Outputs and inputs of the controller.

    Attributes:
        fields: every output variable by name, as a tuple of its numbers.
        ints, doubles: input registers. written: host time at which each input integer was last written, s.
        inputs: the other input variables, by name.
    """

    def __init__(self) -> None:
        self.fields: dict[str, Value] = {
            name: _CONSTANT.get(name, (0,) * _LENGTH.get(kind, 1)) for name, kind in OUTPUT_TYPES.items()
        }
        self.ints = [0] * REGISTERS
        self.doubles = [0.0] * REGISTERS
        self.written = [0.0] * REGISTERS
        self.inputs: dict[str, Value] = {}

    def write(self, name: str, value: Value, time: float) -> None:
        """Stores an input variable of a client, received at a host time, s."""
        kind, _, index = name.rpartition("_")
        if kind == "input_int_register":
            self.ints[int(index)] = int(value[0])
            self.written[int(index)] = time
        elif kind == "input_double_register":
            self.doubles[int(index)] = value[0]
        else:
            self.inputs[name] = value

    def vector(self, first: int) -> tuple[float, float, float, float, float, float]:
        """Six consecutive input doubles."""
        a, b, c, d, e, f = self.doubles[first : first + 6]
        return a, b, c, d, e, f

    def put_int(self, index: int, value: int) -> None:
        self.fields[f"output_int_register_{index}"] = (value,)
