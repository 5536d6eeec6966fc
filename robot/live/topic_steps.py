"""Messages of a running robot become samples, one by one, as `read_bag` makes them of a whole bag with
`samples: views`: each view is a sample, with the motion since the sample before by the odometry interpolated
at the view's stamp. The same numbers come out, to the bit, from the same messages.

What is not known yet is waited for, at most `max_wait`; a view whose odometry does not come is dropped, and
its motion is part of the next sample's. Where nobody knows how the robot moved (velocities over a gap, an
odometry that began anew), a sample begins a piece of the map instead of carrying a jump.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Iterator
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from robot.drivers.outcome import SessionOutcome
from robot.live.polling import session_fault
from robot.live.topics_client import LiveMessages
from robot.recordings.bags.bag import Messages, Topic
from robot.recordings.bags.bag_reader import TOUCHES, TouchReader
from robot.recordings.bags.topics_config import TopicsConfig
from robot.recordings.bags.transforms import POSES, TWISTS, frames_of, holds_velocities, value_of
from robot.recordings.bags.views import CLOUD, COVERED, IMAGES, SCAN, RangeReader, grey_image
from robot.recordings.bags.wrench_pokes import WRENCHES, PokeReader, force_of
from robot.recordings.cdr import RESET
from robot.recordings.input_judge import GAP, JUMP, LEAST_GAP, InputJudge, MotionTrack, UnitLimits
from robot.recordings.recording_config import RecordingConfig
from robot.recordings.video import image_view
from robot.sources.in_memory import NO_ODOMETRY
from robot.sources.odometry import from_poses, from_velocities
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose, integrate, inverse, wrap
from tactile.base.types import Observation, Odometry, observation
from tactile.pokes import DEFAULT_POKES, PokeConfig, ring_time

HISTORY = 30.0
"""Time for which odometry is kept, s: the largest delay of a view."""
TURN_LENGTH = 0.5
"""A turn counts as this much way, m/rad, where poses are compared."""
RESTART = 3.0
"""Time that a robot may have driven before the first message of an odometry that began anew, s."""
SLOWEST, FEW = 0.05, 20
"""Speed that any robot may have, m/s; messages after which its own speed is known."""
WAITING = 256
"""Views that wait for odometry, at most."""
JUDGED, MOST_PIECES = 512, 4
"""Messages of odometry that are judged together, and how many of them may begin a piece."""


class Row(NamedTuple):
    """Odometry at a time. Attributes: time: s. pose: (x m, y m, heading rad, not wrapped) of the path since
    the first message. piece: number of pieces begun before."""

    time: float
    pose: tuple[float, float, float]
    piece: int


class OdometryTrack:
    """The path of the robot, message by message, with the bits of `read_odometry` and `integrate`.

    Args:
        held: whether values are velocities. every: joins this many messages to one row. history: time for
            which rows are kept, s.

    Attributes:
        held: as given. rows: of the last `history` s. piece: number of pieces begun so far.
    """

    def __init__(self, held: bool, every: int, limits: UnitLimits, history: float) -> None:
        self.held, self._every, self._limits, self._history = held, every, limits, history
        self.rows = deque[Row]()
        self.piece = 0
        self._count = 0
        self._time: float | None = None
        self._value = np.zeros(3)
        self._latest = deque[tuple[float, np.ndarray]](maxlen=every)  # times and values of this piece
        self._paths: tuple[_Path, ...] = (_Path(), _Path()) if every > 1 else (_Path(),)
        self._joined, self._newest = np.zeros(3), np.zeros(3)  # poses of the last joined row and message
        self._steps = deque[float](maxlen=101)
        self._fastest = 0.0  # m/s
        self._heading = self._turns = 0.0  # of the newest row; whole turns to add to it, rad

    @property
    def newest(self) -> float:
        """The time of the newest row, s; -inf without one."""
        return self.rows[-1].time if self.rows else -np.inf

    def add(self, time: float, value: tuple[float, float, float], outage: bool) -> tuple[str, str]:
        """Adds a pose or velocities of a later time than those before.

        Args:
            outage: whether the connection was lost since the message before.

        Returns:
            the name of an event and what was found, both '' if nothing is remarkable.
        """
        new, last = np.array(value), self._time
        motion, event = np.zeros(3), ("", "")
        if last is not None:
            step = None if self.held else between(self._value, new)
            event = self._judge(time - last, step, new, outage)
            if event[0] == RESET:
                self.piece += 1
                self._latest.clear()
            elif step is None:
                forward, left, turn = np.array([self._value, new]).T
                motion = from_velocities(np.array([last, time]), forward, left, turn)[1, :3]
            else:
                motion = step
            self._steps.append(time - last)
        self._time, self._value = time, new
        self._latest.append((time, new))
        pose = self._newest = self._paths[0].add(motion)
        if self._every > 1:
            chosen = self._count % self._every == 0
            joined = between(self._joined, pose) if self._count else np.zeros(3)
            if chosen:
                self._joined, pose = pose, self._paths[1].add(joined)
        if self._count % self._every == 0:
            self._append(time, pose)
        self._count += 1
        return event

    def at(self, time: float) -> tuple[np.ndarray, int] | None:
        """The pose [3], heading not wrapped, and the piece at a time up to `newest`; None before the first
        row that is kept, or between pieces."""
        after = bisect_left(self.rows, time, key=itemgetter(0))
        if after == len(self.rows) or (after == 0 and self.rows[0].time != time):
            return None
        upper = self.rows[after]
        lower = self.rows[max(after - 1, 0)]
        if upper.time == time:
            return np.array(upper.pose), upper.piece
        if lower.piece != upper.piece:
            return None
        times = [lower.time, upper.time]
        pose = [np.interp(time, times, pair) for pair in zip(lower.pose, upper.pose, strict=True)]
        return np.array(pose), upper.piece

    def in_own_frame(self, pose: np.ndarray) -> np.ndarray | None:
        """A pose [3] of the present piece as the robot publishes it; None where it publishes velocities."""
        if self.held:
            return None
        return compose(compose(self._value, inverse(self._newest)), pose)

    def _append(self, time: float, pose: np.ndarray) -> None:
        x, y, heading = pose.tolist()
        step = heading - self._heading
        if self.rows and abs(step) >= np.pi:  # as np.unwrap does, whose corrections add up
            within = (step + np.pi) % (2 * np.pi) - np.pi
            self._turns += (np.pi if within == -np.pi and step > 0 else within) - step
        self._heading = heading
        self.rows.append(Row(time, (x, y, heading + self._turns), self.piece))
        while self.rows[0].time < time - self._history:
            self.rows.popleft()

    def _judge(self, dt: float, step: np.ndarray | None, new: np.ndarray, outage: bool) -> tuple[str, str]:
        """Whether the odometry goes on: the name of an event and what was found.

        Args:
            step: [3] motion between poses, None of velocities.
        """
        usual = sorted(self._steps)[len(self._steps) // 2] if len(self._steps) > 3 else np.inf
        gap = dt > max(GAP * usual, LEAST_GAP)
        if step is None:
            if not gap:
                return "", ""
            return RESET, f"no velocities for {dt:.3g} s: nobody knows how the robot moved meanwhile"
        began, first = self._latest[0]
        length, way = (float(np.hypot(*each[:2])) for each in (step, between(first, new)))
        pace = way / (dt + self._latest[-1][0] - began)
        if gap or outage:
            said = f"no odometry for {dt:.3g} s; the pose after it is {length:.3g} m away"
            if self._goes_on(step, new, dt) and pace < max(JUMP * self._fastest, SLOWEST):
                return "gap", f"{said} and bridges it"
            return RESET, f"{said}: the odometry began anew, or the robot was carried"
        wild = len(self._steps) > FEW and pace > JUMP * max(self._fastest, SLOWEST)
        if pace > self._limits.speed or (wild and not self._goes_on(step, new, dt)):
            return RESET, f"the odometry jumps by {length:.3g} m in {dt:.3g} s: it began anew"
        self._fastest = max(self._fastest, pace)
        return "", ""

    def _goes_on(self, step: np.ndarray, new: np.ndarray, dt: float) -> bool:
        """Whether a pose after a pause belongs to the path before: not if it is nearer to the origin, where
        odometry begins, than to the pose before, and no farther from it than `RESTART` s of driving."""
        reach = max(self._fastest, SLOWEST) * max(min(dt, RESTART), LEAST_GAP)
        return _way(step) <= _way(new) or _way(new) > reach


def _way(motion: np.ndarray) -> float:
    return float(np.hypot(*motion[:2]) + TURN_LENGTH * abs(wrap(motion[2])))


class _Path:
    """Motions added up one by one, with the bits of `integrate`."""

    def __init__(self) -> None:
        self._x = self._y = self._heading = 0.0

    def add(self, motion: np.ndarray) -> np.ndarray:
        """[3] the pose after a motion [3]."""
        dx, dy, turn = motion.tolist()
        c, s = float(np.cos(self._heading)), float(np.sin(self._heading))
        self._x += c * dx - s * dy
        self._y += s * dx + c * dy
        self._heading += turn
        return np.array([self._x, self._y, wrap(self._heading)])


class _View(NamedTuple):
    """A view that waits for odometry. Attributes: time: stamp, s. arrival: ns. reading: without motion."""

    time: float
    arrival: int
    reading: Observation


class Begun(NamedTuple):
    """A sample. Attributes: begins: whether it begins a piece of the map, to which no odometry leads.
    odometry: [3] the pose in the robot's own frame of odometry (m, m, rad), None of velocities."""

    sample: Sample
    begins: bool
    odometry: np.ndarray | None


class TopicSteps:
    """Makes samples of the messages of a robot.

    Args:
        config: topics and images. messages: of the robot. say: is told of events, by name and text. pokes:
            of another program, for `topics.wrench`.

    Attributes:
        topics: names of those that are used, besides transforms. odometry: name of its topic.
        pokes: of another program, which make the views; else None.
        shape: (R, C, 1) of the views; None before the first touch reading, whose layout may say it.
        whiskers: number of touch sensors, 0 for other views. dropped: views so far, by cause.
    """

    def __init__(
        self,
        config: RecordingConfig,
        messages: LiveMessages,
        max_wait: float,
        say: Callable[[str, str], None],
        pokes: PokeConfig = DEFAULT_POKES,
    ) -> None:
        assert config.topics is not None
        self._config, self._topics, self._messages, self._say = config, config.topics, messages, say
        self._wait, self._chosen = max_wait, chosen_topics(config.topics, messages)
        self.topics = {topic.name for topic in self._chosen.values()}
        self.odometry = self._chosen["odometry"].name
        self._seen = next(self._chosen[name].name for name in SEEN if name in self._chosen)
        odometry = self._topics.odometry
        assert odometry is not None
        held = holds_velocities(odometry, self._chosen["odometry"].kind)
        wrench = self._topics.wrench
        self.pokes = None if wrench is None else PokeReader(pokes, wrench, messages.warn)
        self._forces = deque[tuple[float, int, tuple[float, float, float]]]()  # time, arrival, N
        self._piece = 0  # of the last force
        history = HISTORY + (0.0 if wrench is None else ring_time(pokes))  # a ring is late by its last pokes
        self.track = OdometryTrack(held, odometry.every, config.limits, history)
        self._body: str | None = None  # of the first odometry message
        self._early = deque[tuple[int, int, Any, str]](maxlen=WAITING)  # views before it
        self._views = deque[_View](maxlen=WAITING)
        self._reader: Any = None
        self._image: tuple[int, ...] | None = None
        self._outside = list[float]()  # shares of touch values outside of their span
        self._last = dict[str, int]()  # newest stamp by topic, ns
        self._back = dict[str, int]()  # arrival of the first message since then with an earlier stamp
        self._outage = False
        self._before: tuple[float, np.ndarray, int] | None = None  # time, pose and piece of the last sample
        self._recent = deque[tuple[float, ...]](maxlen=JUDGED)  # time and value of odometry
        self._pieces = deque[bool](maxlen=JUDGED)  # whether each began a piece
        self.dropped = Counter[str]()
        self.shape, self.whiskers = self._known_shape()

    def _known_shape(self) -> tuple[tuple[int, int, int] | None, int]:
        views, touch = self._topics.views, self._topics.touch
        if self.pokes is not None:
            return (1, self.pokes.config.directions, 1), self.pokes.config.directions
        if touch is not None:
            if touch.rows is None or touch.columns is None:
                return None, 0
            return (touch.rows, touch.columns, 1), touch.rows * touch.columns
        assert views is not None
        like = self._config.image if self._chosen["views"].kind in IMAGES else views
        return (like.rows, like.columns, 1), 0

    @property
    def mounted(self) -> bool:
        """Whether the first view was seen, for whose sensor the transforms are."""
        return self._reader is not None or self.pokes is not None

    def interrupt(self) -> None:
        """Says that the connection was lost: messages may be missing."""
        self._outage = True

    def add(self, topic: str, arrival: int, content: Any) -> None:
        """Adds a message.

        Args:
            arrival: ns since 1970.

        Raises:
            InputError: its values cannot be used.
            SessionFault: the odometry cannot be believed, or the clock of the robot was set back.
        """
        messages = self._messages
        place = f"{messages.path}, {topic}, message {messages.counts[topic]}"
        if topic == self.odometry:
            self._add_odometry(topic, arrival, content, place)
        if topic == self._seen:
            stamp = messages.stamp(content, arrival)
            if self.pokes is not None:
                force = force_of(content, place)
                if self._in_order(topic, stamp, arrival):
                    self._forces.append((stamp / 10**9, arrival, force))
            elif self._body is None:
                self._early.append((stamp, arrival, content, place))
            elif self._in_order(topic, stamp, arrival):
                self._add_view(stamp, arrival, content, place)

    def ready(self, now: int, late: Callable[[], bool]) -> Iterator[Begun]:
        """The samples that are complete at a time, ns since 1970.

        Args:
            late: whether the mapper lags, so that views are dropped.
        """
        self._feel(now)
        while self._views:
            view = self._views[0]
            if view.time > self.track.newest:
                if now - view.arrival <= self._wait * 1e9:
                    return
                self._drop("odometry late")
                continue
            found = self.track.at(view.time)
            if found is None:
                self._drop("outside the odometry")
            elif late():
                self._drop("mapper late")
            else:
                self._views.popleft()
                yield self._sample(view, *found)

    def _feel(self, now: int) -> None:
        """Passes on the forces for which the pose of the tool is known by now; its rings become views."""
        while self.pokes is not None and self._forces:
            time, arrival, force = self._forces[0]
            if time > self.track.newest and now - arrival <= self._wait * 1e9:
                return
            self._forces.popleft()
            found = self.track.at(time)
            if found is None:
                self._lose("force", "without odometry")
                continue
            pose, piece = found
            if piece != self._piece:
                self._piece = piece
                self.pokes.interrupt()
            self.pokes.add((time, *pose.tolist(), *force))
            while self.pokes.rings:
                moment, reading = self.pokes.rings.popleft()
                self._views.append(_View(moment, arrival, reading))

    def _sample(self, view: _View, pose: np.ndarray, piece: int) -> Begun:
        motion, begins, took = np.zeros(3), False, 0.0
        if self._before is not None:
            time, before, last = self._before
            begins, took = piece != last, view.time - time
            motion = np.zeros(3) if begins else between(before, pose)
        self._before = view.time, pose, piece
        moved = Odometry._make(np.float64(value) for value in (*motion, took))
        reading = view.reading._replace(odometry=moved)
        return Begun(Sample(view.time, reading, None), begins, self.track.in_own_frame(pose))

    def _drop(self, cause: str) -> None:
        self._views.popleft()
        self._lose("views", cause)

    def _lose(self, what: str, cause: str) -> None:
        self.dropped[cause] += 1
        if self.dropped[cause] in (1, 10, 100) or self.dropped[cause] % 1000 == 0:
            self._say("dropped", f"{self.dropped[cause]} {what} so far: {cause}")

    def _in_order(self, topic: str, stamp: int, arrival: int) -> bool:
        """Whether a stamp is later than those before.

        Raises:
            SessionFault: for a second all stamps were earlier: the clock of the robot was set back.
        """
        last = self._last.get(topic, 0)
        if stamp > last:
            self._last[topic] = stamp
            self._back.pop(topic, None)
            return True
        self.dropped["out of order"] += 1
        since = self._back.setdefault(topic, arrival)
        if arrival - since <= 1_000_000_000:
            return False
        if stamp == last:
            found = f"{topic}: for 1 s all stamps are {last / 1e9:.3f} s: its node does not stamp messages"
            cure = "`--set recording.topics.clock=bag` takes the times of their arrival"
            raise session_fault(SessionOutcome.TOPIC_UNUSABLE, f"{found}; {cure}")
        found = f"{topic}: for 1 s all stamps are earlier than {last / 1e9:.3f} s"
        said = f"{found}, now by {(last - stamp) / 1e9:.3g} s: the robot's clock was set back"
        raise session_fault(SessionOutcome.CLOCK_JUMPED, said)

    def _add_odometry(self, topic: str, arrival: int, content: Any, place: str) -> None:
        config = self._topics.odometry
        assert config is not None
        value = value_of(config, self._chosen["odometry"].kind, content, place)
        stamp = self._messages.stamp(content, arrival)
        if value is None or not self._in_order(topic, stamp, arrival):
            return
        event, said = self.track.add(stamp / 10**9, value, self._outage)
        self._outage = False
        if event:
            self._say(event, said)
        self._recent.append((stamp / 10**9, *value))
        self._pieces.append(event == RESET)
        if event == RESET and sum(self._pieces) > MOST_PIECES:
            self._judge(topic)
            found = f"the odometry began anew {sum(self._pieces)} times in {len(self._pieces)} messages"
            raise session_fault(SessionOutcome.TOPIC_UNUSABLE, f"{topic}: {found}")
        whole = len(self._pieces) == JUDGED and not any(self._pieces)
        if whole and self._messages.counts[topic] % (JUDGED // 2) == 0:
            self._judge(topic)
        if self._body is None:
            frame, child = frames_of(content)
            kind = self._chosen["odometry"].kind
            self._body = self._topics.body or child or ("" if kind in POSES else frame)
            early, self._early = list(self._early), deque(maxlen=WAITING)
            for view in early:
                if self._in_order(self._seen, view[0], view[1]):
                    self._add_view(*view)

    def _judge(self, topic: str) -> None:
        """Raises the fault of odometry that cannot be believed: of a wrong unit, or of two nodes."""
        time, values = np.array(self._recent)[:, 0], np.array(self._recent)[:, 1:]
        held = self.track.held
        motion = from_velocities(time, *values.T) if held else from_poses(time, values)
        assert self._topics.odometry is not None
        if (every := self._topics.odometry.every) > 1:  # as `read_odometry` joins them
            time, values = time[::every], values[::every]
            motion = from_poses(time, integrate(motion[:, :3])[::every])
        poses = None if held else values
        track = MotionTrack(time, np.ones(len(time), bool), motion, None, held, poses)
        judge, where = (
            InputJudge(self._config.limits, self._config.odometry),
            f"{self._messages.path}, {topic}",
        )
        for error in judge.errors(track, lambda row: where, where):
            raise session_fault(SessionOutcome.TOPIC_UNUSABLE, str(error))

    def _add_view(self, stamp: int, arrival: int, content: Any, place: str) -> None:
        pixels = self.pixels(content, place)
        if pixels is None:
            self.dropped["empty"] += 1
            return
        if len(self._views) == WAITING:
            self._drop("odometry late")
        assert self.shape is not None
        reading = observation(NO_ODOMETRY, pixels, view_shape=self.shape, whiskers=self.whiskers)
        self._views.append(_View(stamp / 10**9, arrival, reading))

    def pixels(self, content: Any, place: str) -> np.ndarray | None:
        """The view [R, C, 1] in a message; None if it shows nothing."""
        if self._topics.touch is not None:
            self._reader = self._reader or TouchReader(self._chosen["touch"].kind, self._topics.touch)
            values = self._reader.values(content, place)
            if values is None:
                return None
            rows, columns = self._reader.shape
            self.shape, self.whiskers = (rows, columns, 1), rows * columns
            scaled, touch = self._reader.scaled(values), self._topics.touch
            self._outside.append(float(np.mean(np.abs(scaled - 0.5) > 0.5)))
            if len(self._outside) == JUDGED:
                if sum(self._outside) > JUDGED / 2:  # in a bag it is an error, by all values
                    found = f"most values of {touch.topic} are not within {touch.low:g} to {touch.high:g}"
                    self._say("outside", f"{found}; set recording.topics.touch.low and high")
                self._outside.clear()
            return np.clip(scaled, 0.0, 1.0).reshape(self.shape)
        kind, views = self._chosen["views"].kind, self._topics.views
        assert views is not None
        if kind in IMAGES:
            grey = grey_image(content, kind, place)
            self._image = self._image or grey.shape
            if grey.shape != self._image:
                found = f"{grey.shape[1]} x {grey.shape[0]} pixels"
                expected = f"{self._image[1]} x {self._image[0]}, as in the first image"
                raise InputError(place, found, expected)
            return image_view(self._config.image, grey, place)
        self._reader = self._reader or RangeReader(self._messages, kind, views, self._body or "")
        view = self._reader.view(content, place)
        if view is None or view.covered < COVERED:
            return None
        if view.lowest < 0:
            raise InputError(place, f"a range is {view.lowest}", "ranges of 0 m or more")
        return view.pixels.reshape(views.rows, views.columns, 1)


ROLES: dict[str, tuple[str, ...]] = {
    "odometry": (*POSES, *TWISTS),
    "views": (SCAN, CLOUD, *IMAGES),
    "touch": TOUCHES,
    "wrench": WRENCHES,
}
"""Types of messages that a part can have."""
SEEN = ("views", "touch", "wrench")  # a session has one of them


def chosen_topics(config: TopicsConfig, messages: Messages) -> dict[str, Topic]:
    """The topics of odometry and views, or touch, among those of a robot.

    Raises:
        InputError: a topic is missing or has another type, or the settings cannot be used live.
    """
    key = "recording.topics"
    if config.odometry is None or all(getattr(config, name) is None for name in SEEN):
        found = "no odometry" if config.odometry is None else "none of views, touch and wrench"
        expected = "odometry, and views, touch or wrench"
        raise InputError(key, found, expected, "`python -m ratslam topics` proposes them")
    if config.odometry.tf is not None:
        found, expected = "odometry between frames of /tf", "a topic with odometry"
        raise InputError(f"{key}.odometry", found, expected, "record a bag, or publish Odometry messages")
    if config.samples != "views":
        cure = f"--set {key}.samples=views"
        raise InputError(f"{key}.samples", config.samples, "views: a live session maps view by view", cure)
    found_topics = {}
    for name in ROLES:
        part = getattr(config, name)
        if part is not None:
            found_topics[name] = messages.topic(part.topic, f"{key}.{name}", ROLES[name])
    return found_topics
