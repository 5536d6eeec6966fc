"""The program that ur_rtde uploads, as far as clients can tell: commands come through registers.

The client writes a command's number into integer register 0 and its arguments into others. The program says 1
in output register 0 when it is ready and 2 when it has done a command; then the client writes 0. Commands in
`REALTIME` are carried out at every control step and never answered with 2. Output register 2 tells of the
newest asynchronous operation: its number, whether it runs, its progress.
Source: the interface described by ur_rtde 1.6.5 (its control script and its documentation).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping

from robot.emulators.ur10.arm import EmulatedArm
from robot.emulators.ur10.controller import EmulatedController, Program
from robot.emulators.ur10.rotation import Vector6
from robot.emulators.ur10.urscript_moves import MoveOrder, SpeedJ, StopJ, StopL, parse_orders

READY, DONE = 1, 2
REALTIME = frozenset([6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71])
"""Commands that the program carries out at every control step."""
IDLE, END = 0, 255
RUNNING_BIT = 1 << 15

_PATH = re.compile(r"# inject move path\n(.*?)^\s*end\s*$", re.DOTALL | re.MULTILINE)
_OFFSET = re.compile(r"# int register offset\n\s*(\d+)")


class ControlProgram:
    """The running control program of ur_rtde.

    Args:
        controller: on which it runs. text: as uploaded. commands: the action of each command number; other
            numbers are accepted and have no effect.

    Attributes:
        path: the moves that were uploaded with it. offset: its first register of either kind.
    """

    def __init__(self, controller: EmulatedController, text: str, commands: Commands) -> None:
        self._commands = commands
        offset = _OFFSET.search(text)
        path = _PATH.search(text)
        self.offset: int = int(offset[1]) if offset else 0
        self.path: list[MoveOrder] = parse_orders(path[1]) if path else []
        self.controller: EmulatedController = controller
        self.arm: EmulatedArm = controller.arm
        self._registers = controller.registers
        self._executing = False
        self._waiting = False  # for the arm, before a command is done
        self._moving = False  # an asynchronous move goes on
        self._stopping = False  # an asynchronous stop goes on
        self._stop_by_tool = False  # what a synchronous stop is, as the last asynchronous one left it
        self._repeated: MoveOrder | None = None
        self._writes = self._operation = 0
        self._progress(-1)
        self._answer(READY)

    def step(self) -> bool:
        """One control step; False when the program has ended. Raises `Unreachable`, which ends it too."""
        self._follow_asynchronous()
        if self._waiting:
            if self.arm.busy:
                return True
            self._waiting = False
            self._answer(DONE)
        command = self._registers.ints[self.offset]
        if command in REALTIME:
            self._do(command)
            self._answer(READY)
        elif command == IDLE:
            self._executing = False
            self._answer(READY)
        elif not self._executing:
            self._executing = True
            if command == END:
                return False
            self._do(command)
            if not self._waiting:
                self._answer(DONE)
        return True

    def vector(self, first: int = 0) -> Vector6:
        """Six of the command's arguments."""
        return self._registers.vector(first + self.offset)

    def number(self, index: int) -> float:
        """One of the command's arguments."""
        return self._registers.doubles[index + self.offset]

    def put(self, numbers: Iterable[float]) -> None:
        """A result of several numbers."""
        self._registers.put_vector(self.offset, numbers)

    def result(self, value: int) -> None:
        """A result that is a number or yes and no."""
        self._registers.put_int(self.offset + 1, value)

    def move(self, orders: Iterable[MoveOrder], kind: str) -> None:
        """Give orders in place of the present ones; wait for their end unless the client asked not to."""
        orders = list(orders)
        self._drop_move()
        self.controller.record_target(kind, orders)
        self.arm.order(orders)
        if self._asynchronous:
            self._moving = True
            self._progress(0)
        else:
            self._waiting = True

    def repeat(self, order: MoveOrder, kind: str) -> None:
        """An order that is given again at every step until it changes."""
        if order != self._repeated or not self.arm.busy:
            self.controller.record_target(kind, [order])
            self.arm.order([order])
        self._repeated = order

    def end_repeated(self, rate: float) -> None:
        """Stop what was repeated, the way it was told."""
        self.stop(StopJ(rate) if isinstance(self._repeated, SpeedJ) else StopL(rate))

    def stop(self, order: StopL | StopJ) -> None:
        """Stop and wait for it."""
        self.controller.record_target("stop", [order])
        self.arm.order([order])
        self._waiting = True

    def stop_either(self, rate: float) -> None:
        """stopL and stopJ alike: a synchronous one goes by joints until there was an asynchronous one."""
        if self._stopping:
            self._stopping = False
            self._progress(-1)
        else:
            self._drop_move()
        if not self._asynchronous:
            self.stop(StopL(rate) if self._stop_by_tool else StopJ(rate))
            return
        self._stop_by_tool = self._stopping = True
        self.controller.record_target("stop", [StopL(rate)])
        self.arm.order([StopL(rate)])
        self._progress(0)

    @property
    def _asynchronous(self) -> bool:
        return self._registers.ints[self.offset + 1] == 1

    def _do(self, command: int) -> None:
        action = self._commands.get(command)
        if action is not None:
            action(self)

    def _answer(self, word: int) -> None:
        self._registers.put_int(self.offset, word)

    def _progress(self, value: int) -> None:
        """The word of asynchronous progress; negative: finished, 0: a new operation."""
        self._writes = (self._writes + 1) % 128
        if value == 0:
            self._operation = (self._operation + 1) % 128
        word = self._writes << 16 | self._operation << 24
        if value >= 0:
            word |= min(value, RUNNING_BIT - 1) | RUNNING_BIT
        self._registers.put_int(self.offset + 2, word)

    def _follow_asynchronous(self) -> None:
        for mark in self.arm.marks:
            self._progress(mark)
        self.arm.marks.clear()
        if (self._moving or self._stopping) and not self.arm.busy:
            self._moving = self._stopping = False
            self._progress(-1)

    def _drop_move(self) -> None:
        if self._moving:
            self._moving = False
            self._progress(-1)


class ScriptProgram:
    """Any other program: its moves and stops in order, then the end, with the 2 that clients wait for."""

    def __init__(self, controller: EmulatedController, text: str) -> None:
        self._controller = controller
        self._answers = "write_output_integer_register" in text
        orders = parse_orders(text)
        controller.record_target("script", orders)
        controller.arm.order(orders)

    def step(self) -> bool:
        """One control step; False when the program has ended."""
        if self._controller.arm.busy:
            return True
        if self._answers:
            self._controller.registers.put_int(0, DONE)
        return False


Commands = Mapping[int, Callable[[ControlProgram], None]]


def load_program(commands: Commands, controller: EmulatedController, text: str) -> Program:
    """Starts uploaded program text on a controller: ur_rtde's control program, or any other script."""
    if "def rtde_control" in text:
        return ControlProgram(controller, text, commands)
    return ScriptProgram(controller, text)
