"""An emulated Create without its serial line or a clock: bytes in, bytes out, motion among walls."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from robot.drivers.create.protocol import COUNT, LIGHTS, MOST_LIGHT, TOP_SPEED, Bumps, Mode
from robot.emulators.create.emulator_config import CreateEmulatorConfig
from robot.simulation.create.wheel_odometry import simulate_wheel_odometry
from robot.world.arena import Arena, wall_segments
from robot.world.walls import segment_distance
from tactile.base.random_streams import stream

DATA = {128: 0, 131: 0, 132: 0, 145: 4}  # bytes after an opcode; a query's first byte gives its length
LIGHT_REACH = 0.03
"""Distance of a wall over which the signal of a light bumper falls to a third, m."""
LIGHT_NOISE = 2.0
"""Standard deviation of the noise of its signal."""
PIECE = 0.01
"""Longest arc between two checks for walls, s."""
MOVES = 4096
"""Moves after which the errors of the odometry repeat."""


class _WheelState(NamedTuple):
    """Pose of the robot (m, rad), total distance (m) and total rotation (rad) of its wheels."""

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    travelled: float = 0.0
    turned: float = 0.0

    def advance(self, way: float, turn: float) -> _WheelState:
        """The state after an arc: m, rad."""
        half = turn / 2
        chord = way * (math.sin(half) / half if half else 1.0)
        middle = self.heading + half
        x, y = self.x + chord * math.cos(middle), self.y + chord * math.sin(middle)
        return _WheelState(x, y, self.heading + turn, self.travelled + way, self.turned + turn)


class EmulatedCreate:
    """The robot without its serial line or a clock: bytes in, bytes out.

    Args:
        arena: the walls and the start; None: an empty plane.

    Attributes:
        base: true pose. mode, bumps: of the interface. right, left: speeds of the wheels, mm/s. time: s.
        drives: received drive commands (s, mm/s right, left). speeds: changes of the wheels, likewise.
    """

    def __init__(self, config: CreateEmulatorConfig, arena: Arena | None = None) -> None:
        self.config = config
        start = (0.0, 0.0, 0.0) if arena is None else tuple(arena.start.tolist())
        self.base, self.mode, self._forced = _WheelState(*start), Mode.OFF, Bumps(0)
        self.walls = np.zeros((0, 4)) if arena is None else wall_segments(arena)
        self._pressed = False
        self.right = self.left = 0
        self.time = 0.0
        self.drives: list[tuple[float, int, int]] = []
        self.speeds: list[tuple[float, int, int]] = []
        self.queries = self.unknown = 0
        self._scales = np.ones((1, 2))  # measured share of lengths and turns, for each move [M, 2]
        if config.world is not None:
            random, moves = stream(config.seed, "wheels"), np.ones((MOVES, 4))
            self._scales = simulate_wheel_odometry(config.world.wheels, moves, np.arange(MOVES) % 2, random)
            self._scales = self._scales[:, [0, 2]]
        self._moves, self._light_noise = 0, stream(config.seed, "light")
        self._measured = [0.0, 0.0]  # mm and degrees by the wheels' encoders
        self._reported = [0.0, 0.0]  # sums of all replies, and of lost remainders: mm and degrees
        self._begun = b""  # an incomplete command

    @property
    def bumps(self) -> Bumps:
        """Bumper and wheel drops, requested ones and those of a wall."""
        return self._forced | (Bumps.BUMPED if self._pressed else Bumps(0))

    @property
    def pose(self) -> np.ndarray:
        """True pose [3], m, m, rad."""
        return np.array(self.base[:3])

    def advance(self, seconds: float) -> None:
        """Advances time by some seconds. At a wall the wheels slip."""
        pieces = max(1, math.ceil(seconds / PIECE)) if len(self.walls) else 1
        for _ in range(pieces):
            self._advance_piece(seconds / pieces)
        self.time += seconds

    def advance_to(self, time: float) -> None:
        """Advances to a time of the robot, s, unless it has passed."""
        if time > self.time:
            self.advance(time - self.time)

    def _advance_piece(self, seconds: float) -> None:
        right, left = self.right / 1000, self.left / 1000
        way, turn = (right + left) / 2 * seconds, (right - left) / self.config.wheel_base * seconds
        scale = self._scales[self._moves % len(self._scales)]
        firmware = self.config.firmware
        self._measured[0] += 1000 * way * scale[0] * firmware.distance_scale
        self._measured[1] += math.degrees(turn * scale[1]) * firmware.turn_scale
        after = self.base.advance(way, turn)
        if len(self.walls) and self.config.world is not None:
            points = np.array([self.base[:2], after[:2]])
            room, then = segment_distance(self.walls, points).min(axis=1)
            blocked = then < self.config.world.body and then < room
            self._pressed = bool(blocked and way > 0) or (self._pressed and way == 0 and not turn)
            if blocked:
                after = after._replace(x=self.base.x, y=self.base.y)
        self.base = after

    def touch(self, bumps: Bumps, *, cliff: bool = False) -> None:
        """Sets bumper and wheel drops. In safe mode a drop or a cliff stops the robot, a bump does not."""
        self._forced = bumps
        if self.mode == Mode.SAFE and (cliff or bumps & Bumps.DROPPED):
            self.mode = Mode.PASSIVE
            self._set_wheels(0, 0)

    def switch_off(self) -> None:
        """Switches the robot off."""
        self.mode = Mode.OFF
        self._set_wheels(0, 0)

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
            self.mode = Mode.PASSIVE
            self._set_wheels(0, 0)
        elif self.mode == Mode.OFF:
            pass
        elif opcode in (131, 132):
            self.mode = Mode.SAFE if opcode == 131 else Mode.FULL
            self.touch(self._forced)
        elif opcode == 145:
            right, left = (int.from_bytes(part, "big", signed=True) for part in (data[:2], data[2:]))
            self.drives.append((self.time, right, left))
            if self.mode != Mode.PASSIVE:
                self._set_wheels(*(max(-TOP_SPEED, min(TOP_SPEED, v)) for v in (right, left)))
        elif opcode == 149:
            self.queries += 1
            return b"".join(map(self._packet, data[1:]))
        else:
            self.unknown += 1
        return b""

    def _packet(self, number: int) -> bytes:
        """The data of a sensor packet."""
        if number in (19, 20):
            place, lost = number - 19, self.config.firmware.remainders == "lost"
            whole = math.trunc(self._measured[place] - self._reported[place])
            whole = max(-(2**15), min(2**15 - 1, whole))
            self._reported[place] = self._measured[place] if lost else self._reported[place] + whole
            return whole.to_bytes(2, "big", signed=True)
        if number in (43, 44):
            side = 500 * self.config.wheel_base * math.radians(self._measured[1])
            way = self._measured[0] + (side if number == 44 else -side)
            firmware = self.config.firmware
            return ((firmware.counts + math.floor(way / COUNT)) % firmware.wrap).to_bytes(2, "big")
        if 46 <= number <= 51:
            return self._light(math.radians(LIGHTS[number - 46])).to_bytes(2, "big")
        return bytes([{7: int(self.bumps), 35: int(self.mode)}.get(number, 0)])

    def _light(self, angle: float) -> int:
        """The signal of a light bumper at this angle, rad: it falls with the distance of the walls there."""
        if not len(self.walls):
            return 0
        assert self.config.world is not None
        direction = self.base.heading + angle
        edge = self.config.world.body * np.array([math.cos(direction), math.sin(direction)])
        room = float(segment_distance(self.walls, self.pose[None, :2] + edge).min())
        signal = MOST_LIGHT * math.exp(-room / LIGHT_REACH) + self._light_noise.normal(0.0, LIGHT_NOISE)
        return min(max(round(signal), 0), MOST_LIGHT)

    def _set_wheels(self, right: int, left: int) -> None:
        if (right, left) != (self.right, self.left):
            self.right, self.left = right, left
            self._moves += 1
            self.speeds.append((self.time, right, left))
