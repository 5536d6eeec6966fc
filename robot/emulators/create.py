"""An iRobot Create on a pseudo-terminal: `python -m robot.emulators.create`.

It prints the terminal's path, then executes JSON lines from standard input and answers each by a line on
standard output: `{"do": "state"}` returns true pose, mode and received commands; `bump`, `drop`, `cliff`,
`clear`, `off`; `garbage` (`bytes` before the next reply), `cut` (next reply to `bytes`), `lose` (`replies`),
`trickle` (`seconds` between bytes), `unplug`. Times are real; wheels react at once, without slip.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import select
import sys
import time
from typing import Any, NamedTuple

from robot.drivers.create.protocol import BAUD, TOP_SPEED, WHEEL_BASE, Bumps, Mode
from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.random_streams import stream

DATA = {128: 0, 131: 0, 132: 0, 145: 4}  # bytes after an opcode; a query's first byte gives its length


class CreateEmulatorConfig(Settings):
    """Settings of an emulated Create."""

    wheel_base: float = WHEEL_BASE
    """Distance between the wheels, m."""
    seed: int = 0
    """Random seed of the garbage bytes."""


class WheelState(NamedTuple):
    """Pose of the robot (m, rad), its total distance (m) and its total rotation (rad)."""

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    travelled: float = 0.0
    turned: float = 0.0

    def advance(self, right: float, left: float, wheel_base: float, seconds: float) -> WheelState:
        """The state after an arc of some seconds at these wheel speeds, m/s."""
        way, turn = (right + left) / 2 * seconds, (right - left) / wheel_base * seconds
        half = turn / 2
        chord = way * (math.sin(half) / half if half else 1.0)
        middle = self.heading + half
        return WheelState(
            self.x + chord * math.cos(middle),
            self.y + chord * math.sin(middle),
            self.heading + turn,
            self.travelled + way,
            self.turned + turn,
        )


class EmulatedCreate:
    """The robot without its serial line or a clock: bytes in, bytes out."""

    def __init__(self, config: CreateEmulatorConfig) -> None:
        self.config = config
        self.base, self.mode, self.bumps = WheelState(), Mode.OFF, Bumps(0)
        self.right = self.left = 0
        self.time = 0.0
        self.drives: list[tuple[float, int, int]] = []  # received drive commands: s, mm/s right, mm/s left
        self.queries = self.unknown = 0
        self._reported = [0, 0]  # sums of all replies: mm and degrees
        self._begun = b""  # an incomplete command

    def advance(self, seconds: float) -> None:
        """Advances time by some seconds."""
        self.base = self.base.advance(self.right / 1000, self.left / 1000, self.config.wheel_base, seconds)
        self.time += seconds

    def touch(self, bumps: Bumps, *, cliff: bool = False) -> None:
        """Sets bumper and wheel drops. In safe mode a drop or a cliff stops the robot, a bump does not."""
        self.bumps = bumps
        if self.mode == Mode.SAFE and (cliff or bumps & Bumps.DROPPED):
            self.mode, self.right, self.left = Mode.PASSIVE, 0, 0

    def receive(self, data: bytes) -> list[bytes]:
        """Executes the complete commands in the bytes received so far; returns one reply for each query."""
        self._begun += data
        replies = []
        while self._begun:
            opcode = self._begun[0]
            if opcode == 149:
                length = 2 + self._begun[1] if len(self._begun) > 1 else 2
            else:
                length = 1 + DATA.get(opcode, 0)
            if len(self._begun) < length:
                break
            command, self._begun = self._begun[:length], self._begun[length:]
            reply = self._execute(command[0], command[1:])
            replies += [reply] if reply else []
        return replies

    def _execute(self, opcode: int, data: bytes) -> bytes:
        if opcode == 128:
            self.mode, self.right, self.left = Mode.PASSIVE, 0, 0
        elif self.mode == Mode.OFF:
            pass
        elif opcode in (131, 132):
            self.mode = Mode.SAFE if opcode == 131 else Mode.FULL
            self.touch(self.bumps)
        elif opcode == 145:
            right, left = (int.from_bytes(part, "big", signed=True) for part in (data[:2], data[2:]))
            self.drives.append((self.time, right, left))
            if self.mode != Mode.PASSIVE:
                self.right, self.left = (max(-TOP_SPEED, min(TOP_SPEED, v)) for v in (right, left))
        elif opcode == 149:
            self.queries += 1
            return b"".join(self._packet(number) for number in data[1:])
        else:
            self.unknown += 1
        return b""

    def _packet(self, number: int) -> bytes:
        if number in (19, 20):  # the remainder below one unit is added to the next reply
            total = (1000 * self.base.travelled, math.degrees(self.base.turned))[number - 19]
            whole = math.trunc(total - self._reported[number - 19])
            whole = max(-(2**15), min(2**15 - 1, whole))
            self._reported[number - 19] += whole
            return whole.to_bytes(2, "big", signed=True)
        return bytes([{7: int(self.bumps), 35: int(self.mode)}.get(number, 0)])


class LineFaults:
    """Faults of the serial line."""

    def __init__(self, seed: int) -> None:
        self._random = stream(seed, "create garbage")
        self.garbage, self.lose, self.trickle = 0, 0, 0.0
        self.cut: int | None = None

    def disturb(self, reply: bytes) -> bytes:
        """The reply after the pending faults."""
        if self.lose:
            self.lose -= 1
            return b""
        if self.cut is not None:
            reply, self.cut = reply[: self.cut], None
        before, self.garbage = self._random.bytes(self.garbage), 0
        return before + reply

    def noise(self, reply: bytes) -> bytes:
        """The reply as received at another baud rate."""
        return self._random.bytes(len(reply))


class Terminal:
    """A pseudo-terminal that looks like a serial port to the program at its other end."""

    def __init__(self) -> None:
        try:
            import termios
            import tty
        except ImportError:
            raise InputError(sys.platform, "has no pseudo-terminals", "Linux or macOS") from None
        self._termios = termios
        self.master, self._slave = os.openpty()  # the slave stays open: without one, reads fail
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self.plugged = True

    def has_create_baud_rate(self) -> bool:
        """Whether the client has set the Create's baud rate."""
        return bool(self._termios.tcgetattr(self._slave)[5] == getattr(self._termios, f"B{BAUD}"))

    def unplug(self) -> None:
        """Closes the terminal, as an unplugged cable would."""
        if self.plugged:
            self.plugged = False
            os.close(self.master)
            os.close(self._slave)


def handle_request(
    order: dict[str, Any], robot: EmulatedCreate, faults: LineFaults, terminal: Terminal
) -> dict[str, Any]:
    """Executes a request from standard input; returns the answer."""
    do = order.get("do")
    if do == "bump":
        robot.touch(robot.bumps | Bumps.BUMPED)
    elif do == "drop":
        robot.touch(robot.bumps | Bumps.DROPPED_LEFT)
    elif do == "cliff":
        robot.touch(robot.bumps, cliff=True)
    elif do == "clear":
        robot.touch(Bumps(0))
    elif do == "off":
        robot.mode, robot.right, robot.left = Mode.OFF, 0, 0
    elif do in ("garbage", "cut"):
        setattr(faults, do, int(order["bytes"]))
    elif do == "lose":
        faults.lose = int(order["replies"])
    elif do == "trickle":
        faults.trickle = float(order["seconds"])
    elif do == "unplug":
        terminal.unplug()
    elif do == "state":
        return {
            **robot.base._asdict(),
            "time": robot.time,
            "wheels": [robot.right, robot.left],
            "mode": robot.mode.name,
            "drives": robot.drives,
            "queries": robot.queries,
            "unknown": robot.unknown,
        }
    else:
        return {"error": f"unknown: {do!r}"}
    return {"ok": True}


def _answer(line: bytes, *of: Any) -> dict[str, Any]:
    try:
        return handle_request(json.loads(line), *of)
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        return {"error": repr(error)}


def serve(config: CreateEmulatorConfig) -> None:
    """Emulates a Create until the process ends."""
    robot, faults, terminal = EmulatedCreate(config), LineFaults(config.seed), Terminal()
    print(terminal.path, flush=True)
    out: list[tuple[float, bytes]] = []  # (due time, bytes)
    orders, last, listening = b"", time.monotonic(), True
    while True:
        inputs = [terminal.master] * terminal.plugged + [0] * listening
        wait = None if not out else max(0.0, out[0][0] - time.monotonic())
        ready, _, _ = select.select(inputs, [], [], wait)
        now = time.monotonic()
        robot.advance(now - last)
        last = now
        if terminal.master in ready and terminal.plugged:
            for whole in robot.receive(os.read(terminal.master, 4096)):
                reply = faults.disturb(whole if terminal.has_create_baud_rate() else faults.noise(whole))
                step = faults.trickle
                pieces = [reply[i : i + 1] for i in range(len(reply))] if step else [reply]
                start = max(now, out[-1][0] if out else now)
                out += [(start + step * (i + 1), piece) for i, piece in enumerate(pieces)]
        if 0 in ready:
            data = os.read(0, 65536)
            listening = bool(data)
            *lines, orders = (orders + data).split(b"\n")
            for line in filter(None, lines):
                print(json.dumps(_answer(line, robot, faults, terminal)), flush=True)
        while out and out[0][0] <= time.monotonic():
            piece = out.pop(0)[1]
            if terminal.plugged:
                os.write(terminal.master, piece)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m robot.emulators.create", description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="random seed of garbage bytes")
    parser.add_argument("--wheel-base", type=float, default=WHEEL_BASE, help="distance between the wheels, m")
    arguments = parser.parse_args()
    serve(CreateEmulatorConfig(seed=arguments.seed, wheel_base=arguments.wheel_base))


if __name__ == "__main__":
    main()
