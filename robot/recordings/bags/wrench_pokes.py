"""Pokes of another program, found in the pose of its tool and in the force at it, state by state.

A poke is an excursion: from a home along a line to the place where the tool turns, and back. Those about one
home are a ring and become one image (`tactile.pokes`). A contact is a rise of the force at the end of the way
out. The threshold is learned from the ways before, which were free, for the tool went on. The size of the
change counts and not its direction, so the frame of the wrench may be any.

Places within half a depth bin of each other count as one: a home that is not met exactly, noise of the pose.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from robot.recordings.alignment import interpolated_poses, no_overlap_error
from robot.recordings.bags.bag import Bag, Series, as_series
from robot.recordings.bags.topics_config import WrenchTopic
from robot.sources.in_memory import NO_ODOMETRY
from tactile.base.errors import InputError
from tactile.base.se2 import integrate, wrap
from tactile.base.types import Observation
from tactile.pokes import PokeConfig, force_rise, poke_observation

WRENCHES = ("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Wrench")
"""Types of messages with the force at a tool."""
NO_RINGS = "no ring of pokes"
MOST = 1 << 16  # states of an excursion that are kept
State = tuple[float, ...]  # time s, x m, y m, heading rad, force N (3)


def force_of(content: Any, place: str) -> tuple[float, float, float]:
    """The force in a message, N; an `InputError` if a number is not finite."""
    force = getattr(content, "wrench", content).force
    found = float(force.x), float(force.y), float(force.z)
    if not all(map(math.isfinite, found)):
        raise InputError(place, f"the force is {', '.join(map(str, found))}", "finite numbers")
    return found


def _away(one: State, other: State) -> float:
    return math.hypot(one[1] - other[1], one[2] - other[2])


class PokeReader:
    """Finds rings of pokes.

    Args:
        topic: where the force is. say: is told what is doubtful, a sentence.

    Attributes:
        config: of the pokes.
        rings: found so far and not yet taken: times at their home, s, and observations without motion.
        pokes, touched: numbers of pokes so far, and of those with a contact.
    """

    def __init__(self, config: PokeConfig, topic: WrenchTopic, say: Callable[[str], None]) -> None:
        self.config, self._topic, self._say = config, topic, say
        self._near = config.reach / config.bins / 2
        self._angle = 2 * np.pi / config.directions  # between two directions, rad
        self.rings = deque[tuple[float, Observation]]()
        self.pokes = self.touched = self._between = 0
        self._states = deque[State](maxlen=MOST)  # since the tool was at home
        self._ring: dict[int, float | None] = {}  # depth of the contact by direction, None without one
        self._centre: State = ()  # home of the ring
        self._at: State = ()  # the state there when its last poke began
        self._free = np.zeros(3)  # number, sum and sum of squares of the rises of free ways

    def interrupt(self) -> None:
        """Says that it is not known how the tool moved meanwhile."""
        self._states.clear()
        self._ring.clear()

    def add(self, state: State) -> None:
        """Adds a state: its time (s), pose (m, m, rad) and force (N, three numbers)."""
        if not self._states:
            self._begin([state])
        elif self._back is None:
            self._states.append(state)
            self._go_out(state)
        else:
            self._states.append(state)
            self._come_back(state, self._back)

    def _begin(self, states: list[State], home: State | None = None) -> None:
        """The tool is at a home in the first of these states, and moves through the others."""
        self._states = deque(states[:1], maxlen=MOST)
        self._home = self._far = home or states[0]
        self._rest = self._left = states[0]  # the state nearest to the home in this stay, and when it ended
        self._back: State | None = None  # on the way back: the state farthest from where the tool turned
        for state in states[1:]:
            self.add(state)

    def _go_out(self, state: State) -> None:
        config, near = self.config, self._near
        way, farthest = _away(state, self._home), _away(self._far, self._home)
        if way <= near and farthest <= near:
            if abs(wrap(state[3] - self._rest[3])) > self._angle / 16 or way < _away(self._rest, self._home):
                self._rest = state
            while self._states[0][0] < state[0] - config.before[1] - config.recent:
                self._states.popleft()
        if way > farthest:
            self._far = state
            if farthest <= near < way:
                self._left = self._rest
            if way > 2 * config.reach:  # no poke: a new home, later on this line, may be near its end
                self.end_ring()
                while _away(self._states[0], state) > 2 * config.reach:
                    self._states.popleft()
        elif farthest > near and _away(state, self._far) > near:
            # The tool has turned at its farthest place; its way there began at the last corner.
            out = [each for each in self._states if each[0] <= self._far[0]]
            corner = max(out, key=self._aside, default=state)
            if self._aside(corner) > near:
                self._begin(self._since(corner))
            else:
                self._back = state

    def _since(self, state: State) -> list[State]:
        return [each for each in self._states if each[0] >= state[0]]

    def _aside(self, state: State) -> float:
        """Distance of a place from the line between home and farthest place, m."""
        (x, y), (u, v) = ((end[1] - self._home[1], end[2] - self._home[2]) for end in (self._far, state))
        return abs(u * y - v * x) / math.hypot(x, y)

    def _come_back(self, state: State, back: State) -> None:
        near, far = self._near, self._far
        aside = self._aside(state) > near
        if _away(state, self._home) <= near:
            self._poke(self._home, self._left)
            self._begin([state], self._home)
        elif not aside and _away(state, far) > _away(back, far):
            self._back = state
        elif aside or _away(state, back) > near:  # it turns elsewhere: at a home on its way, or it moves on
            corner = max(self._since(far), key=lambda each: _away(far, each) + _away(each, state))
            shorter = _away(corner, far) < _away(self._home, far)
            if shorter and self._aside(corner) <= near:
                self._poke(corner, corner)
                self._begin(self._since(corner))
            else:
                self._begin(self._since(far))

    def _poke(self, home: State, left: State) -> None:
        """Adds the poke from a home to the farthest place to its ring; left: the state in which it began."""
        config, length = self.config, _away(self._far, home)
        turned = abs(wrap(self._states[-1][3] - left[3])) > self._angle / 8
        if turned or not self._near < length < 2 * config.reach:  # it has moved on
            return
        angle = math.atan2(self._far[2] - home[2], self._far[1] - home[1]) - left[3] - self._topic.yaw
        row = round(float(wrap(angle)) / self._angle)
        off = float(wrap(angle - self._angle * row))
        if abs(off) > self._angle / 4:
            self._between += 1
            if self._between == config.directions > self.pokes:
                found = (
                    f"pokes {np.degrees(off):.0f} degrees beside the directions of touch.pokes are left out"
                )
                yaw = f"recording.topics.wrench.yaw={self._topic.yaw + off:.3f}"
                self._say(f"{self._topic.topic}: {found}; --set {yaw}, or touch.pokes.directions")
            return
        depth, row = self._felt(home, length), row % config.directions
        self.pokes, self.touched = self.pokes + 1, self.touched + (depth is not None)
        if depth is None and length < config.reach - self._near:  # it is not known why it ended
            return
        centre, at = (self._centre, self._at) if self._ring else (home, left)
        moved = _away(home, centre) > 2 * self._near or abs(wrap(left[3] - at[3])) > self._angle / 4
        if moved or row in self._ring:
            self.end_ring()
        self._centre, self._at, self._ring[row] = home, left, depth
        if len(self._ring) == config.directions:
            self.end_ring()

    def _felt(self, home: State, length: float) -> float | None:
        """The depth of the contact in a poke of a length from a home, m; None without one."""
        config, states, until = self.config, list(self._states), self._far[0] + self.config.recent
        began = next((k for k, state in enumerate(states) if _away(state, home) <= self._near), 0)
        part = np.array([state for state in states[began:] if state[0] <= until])
        hz = (len(part) - 1) / (part[-1, 0] - part[0, 0])
        if hz * config.recent < 0.9 and not self.pokes:
            found = f"the force comes {hz:.3g} times a second, and short contacts are missed"
            cure = f"publish it {1 / config.recent:.3g} times, or raise touch.pokes.recent"
            self._say(f"{self._topic.topic}: {found}; {cure}")
        depth = np.hypot(part[:, 1] - home[1], part[:, 2] - home[2])
        rise = np.linalg.norm(force_rise(config, part[:, 4:].T, hz), axis=0)
        last = depth >= length - self._near
        free = rise[~last & (rise > 0)] if rise.any() else rise[~last]
        self._free += len(free), free.sum(), (free**2).sum()
        mean, square = self._free[1:] / max(self._free[0], 1.0)
        high = rise > mean + config.sds * math.sqrt(max(square - mean**2, 0.0))
        felt = last & high & (depth < config.reach + self._near)
        return float(depth[felt.argmax()]) if felt.any() else None

    def end_ring(self) -> None:
        """Ends the ring, if it has a poke."""
        if self._ring:
            config, found = self.config, [self._ring.get(k) for k in range(self.config.directions)]
            depth = np.array([config.reach if each is None else each for each in found])
            contact = np.array([each is not None for each in found])
            self.rings.append((self._at[0], poke_observation(config, depth, contact, NO_ODOMETRY)))
        self._ring.clear()


def read_forces(bag: Bag, config: WrenchTopic) -> Series:
    """Forces [M, 3] of a topic, N."""
    topic = bag.topic(config.topic, "recording.topics.wrench", WRENCHES)
    rows = list(bag.stamped(topic, force_of))
    numbers, stamps, forces = ([row[k] for row in rows] for k in range(3))
    return as_series(bag, f"{bag.path}, {topic.name}", numbers, stamps, np.array(forces).reshape(-1, 3))


def read_rings(
    bag: Bag, odometry: Series, forces: Series, config: WrenchTopic, pokes: PokeConfig
) -> tuple[Series, list[Observation]]:
    """The rings of pokes of a tool: images [M, 1, D, 1] at the times at their home, and observations without
    motion; an `InputError` if there are none."""
    path = integrate(odometry.values[:, :3])
    poses, _ = interpolated_poses(forces.time, odometry.time, path, "time", forces.where)
    inside = np.isfinite(poses[:, 0])
    if not inside.any():
        raise no_overlap_error(forces.time, odometry.time, "time", forces.where)
    reader = PokeReader(pokes, config, bag.warn)
    for state in np.column_stack([forces.time, poses, forces.values])[inside].tolist():
        reader.add(tuple(state))
    reader.end_ring()
    count = f"{reader.pokes} pokes, of which {reader.touched} touched something"
    if not reader.rings:
        expected = f"a tool that moves out along a line, {pokes.reach:g} m or up to a wall, and back"
        raise InputError(
            forces.where, f"{NO_RINGS}: {count}", expected, "see touch.pokes.reach and the topics"
        )
    if not reader.touched:
        bag.warn(f"{forces.where}: {count}: is this the force at the tool, and is its pose the odometry?")
    times, rings = zip(*reader.rings, strict=True)
    values, numbers = np.array([ring.view for ring in rings]), np.arange(len(rings))
    return forces._replace(time=np.array(times), values=values, numbers=numbers), list(rings)
