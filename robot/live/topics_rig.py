"""Maps a running robot by its topics: messages are recorded, become samples, and go to a mapper.

Nothing is sent to the robot but what `live.topics.publish` asks for. A connection that is lost is made again;
what cannot be used is left out and named, and what does not end within `patience` ends the session.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np

from robot.drivers.outcome import SessionOutcome
from robot.live.foxglove import FoxgloveClient
from robot.live.live_config import LiveConfig, TopicsLiveConfig
from robot.live.polling import (
    TICK,
    AsyncMapper,
    OperatorStop,
    PolledRig,
    SessionFault,
    check_mapper,
    session_fault,
)
from robot.live.topic_steps import TopicSteps, chosen_topics
from robot.live.topics_client import Channel, LiveMessages, Notice, Received, TopicsClient, Wanted
from robot.live.zenoh_client import ZenohClient
from robot.recordings.bags.bag import TRANSFORMS, Topic
from robot.recordings.bags.transforms import STATIC
from robot.recordings.cdr import PIECE, Event
from robot.recordings.recording_config import RecordingConfig
from robot.recordings.sanity_checks import SPOILT
from robot.sources.input_files import missing_error
from tactile.base.errors import InputError
from tactile.pokes import DEFAULT_POKES, PokeConfig

Tell = Callable[[float, np.ndarray | None], None]
DISCOVERY = 5.0
"""Time within which a robot must advertise its topics, s."""
FIRST = 10.0
"""Time within which a topic must send its first message, s."""
LONGEST_WAIT = 0.05
"""Time after which what is missing is looked at, if no message comes, s."""
HELD = 1.0
"""Time between two such looks above which this process itself was late, s."""
FEW = 20
"""Messages of a topic that may be unusable, however few there are."""


def open_client(address: str, wanted: Wanted) -> TopicsClient:
    """Connects to a robot by the way that its address names: Zenoh (`zenoh://`), else the Foxglove protocol.

    Raises:
        InputError: nothing answers at the address, or it is not one.
    """
    client: type[TopicsClient] = ZenohClient if address.startswith("zenoh") else FoxgloveClient
    return client(address, wanted)


def require_topics(live: TopicsLiveConfig, recording: RecordingConfig | None) -> RecordingConfig:
    """The section that assigns the topics of a robot.

    Raises:
        InputError: it is missing.
    """
    if recording is None or recording.topics is None:
        cure = f"`python -m ratslam topics {live.source} -o robot.yaml` writes them"
        raise InputError("recording.topics", "missing", "the topics of odometry and views", cure)
    return recording


class TopicsRig(PolledRig):
    """A running robot; a context manager.

    Args:
        recording: assigns its topics. say: called with one sentence for whatever is doubtful. pokes: of
            another program.

    Attributes:
        client: the connection. steps: of the session. latencies: from the arrival of the message that
            completed each sample to the mapper, s. events: of the session. spoilt: messages that could not be
            used, by topic. outages: number of connections lost. began: times of this process at the
            beginning, s: computing and on the clock.
    """

    def __init__(
        self,
        config: LiveConfig,
        recording: RecordingConfig,
        stopped: Callable[[], bool],
        say: Callable[[str], None],
        pokes: PokeConfig = DEFAULT_POKES,
    ) -> None:
        super().__init__(config, stopped)
        assert config.topics is not None
        assert recording.topics is not None
        self.topics, self._recording, self._pokes = config.topics, recording, pokes
        self.messages = LiveMessages(self.topics.source, recording.topics, say)
        self._kinds: dict[str, str] = {}  # of the topics that are used or recorded
        self.client = open_client(self.topics.source, self._wanted)
        try:
            chosen = self._discover()
        except BaseException:
            self.client.close()
            raise
        self._kinds |= {topic.name: topic.kind for topic in chosen.values()}
        known = self.messages.topics
        self._kinds |= {name: known[name].kind for name in self.topics.record if name in known}
        self.steps = self._new_steps()
        self.latencies, self.events = list[float](), list[Event]()
        self.spoilt, self.outages = Counter[str](), 0
        self.began = time.process_time(), time.monotonic()
        self._transforms = list[Received]()  # before the session
        self._heard = dict[str, float]()  # time of the newest message by topic, s
        self._lost: float | None = None
        self._looked = time.monotonic()  # time of the last look at what is missing
        self._ages = dict[str, float]()  # of the newest stamp at its arrival, by topic, s
        self.client.want(self._wanted)

    def _wanted(self, channel: Channel) -> bool:
        if channel.kind in TRANSFORMS:
            return self.messages.readable(channel)
        return self._kinds.get(channel.topic) == channel.kind

    def _discover(self) -> dict[str, Topic]:
        """The topics that the settings name, once the robot advertises them."""
        due, assigned = time.monotonic() + DISCOVERY, self._recording.topics
        assert assigned is not None
        while True:
            self.messages.list_topics(self.client.channels)
            try:
                chosen = chosen_topics(assigned, self.messages)
                missing = next(
                    (name for name in self.topics.record if name not in self.messages.topics), None
                )
                if missing is None:
                    return chosen
                raise missing_error(
                    self.topics.source, "topic", missing, list(self.messages.topics), "live.topics.record"
                )
            except InputError:
                if time.monotonic() > due:
                    raise
            time.sleep(TICK)

    def _new_steps(self) -> TopicSteps:
        longest = self.topics.max_wait
        return TopicSteps(self._recording, self.messages, longest, self._tell_event, self._pokes)

    def _tell_event(self, name: str, text: str) -> None:
        self.events.append(Event(self.now(), name, text))
        self.record_event(name, text)
        if name != "dropped":
            self.messages.warn(f"{name}: {text}")

    def now(self) -> float:
        return time.time()

    def find(self) -> Iterator[str]:
        """Lines of text that say what was found."""
        name = f" ({self.client.name})" if self.client.name else ""
        yield f"robot: {self.topics.source}{name}, {len(self.client.channels)} topics"
        for topic, kind in self._kinds.items():
            yield f"{topic}: {kind}"

    def check(self) -> Iterator[str]:
        """Waits for a message of each topic; yields a line of text with the age of its stamp."""
        for name in sorted(self.steps.topics):
            due = time.monotonic() + FIRST
            while name not in self._heard and time.monotonic() < due:
                self.poll()
                time.sleep(TICK)
            if name in self._heard:
                age, said = self._ages.get(name), f"{name}: messages come"
                if age is not None:
                    said += f", stamped {age * 1e3:.0f} ms before their arrival"
                if age is not None and abs(age) > 1.0:
                    said += ": the clocks of robot and host differ, which does no harm to the map"
                yield said
            else:
                wait = f"the session waits {self.topics.patience:g} s for it"
                yield f"{name}: no message in {FIRST:g} s; {wait}"

    def poll(self) -> None:
        """Takes what came before the session: transforms are kept, the rest is not used."""
        for item in self.client.take(0.0):
            if isinstance(item, Received):
                self._look_at(item)
            else:
                self._receive_notice(item)
        self._check()

    def _look_at(self, item: Received) -> None:
        topic = item.channel.topic
        try:
            content = self.messages.decode(item.channel, self.messages.in_cdr(item))
        except InputError as error:
            self.messages.warn(str(error))
            return
        if item.channel.kind in TRANSFORMS:
            self.messages.keep(topic, item.time, content)
            self._transforms.append(item)
        elif topic in self.steps.topics:
            self._heard[topic] = time.monotonic()
            if hasattr(content, "header"):
                self._ages[topic] = (item.time - self.messages.stamp(content, item.time, "header")) / 1e9
            if self.steps.shape is None:
                self.steps.pixels(content, f"{self.messages.path}, {topic}")

    def begin(self) -> None:
        """Begins the session: what comes from now on is recorded and mapped."""
        self.poll()
        shape = self.steps.shape, self.steps.whiskers
        self.steps = self._new_steps()
        self.steps.shape, self.steps.whiskers = shape
        now = time.monotonic()
        self.epoch, self._looked, self._heard = now, now, dict.fromkeys(self.steps.topics, now)
        self.began = time.process_time(), now
        self.messages.counts.clear()
        self.events.clear()
        for item in self._transforms:
            self._record(item, self.messages.in_cdr(item))
        self._transforms.clear()

    def _record(self, item: Received, content: bytes) -> None:
        if self.recorder is not None:
            channel = item.channel
            defined = self.messages.definition(channel)
            self.recorder.add_message(channel.topic, channel.kind, defined, item.time, content)

    def receive(self, item: Received | Notice) -> None:
        """Records a message and passes it on to the steps.

        Raises:
            SessionFault: too many messages of a topic cannot be used.
        """
        if isinstance(item, Notice):
            self._receive_notice(item)
            return
        channel, topic = item.channel, item.channel.topic
        self._heard[topic] = time.monotonic()
        try:
            content = self.messages.in_cdr(item)
            self._record(item, content)
            if channel.kind in TRANSFORMS:
                if topic.endswith(STATIC) or not self.steps.mounted:
                    self.messages.keep(topic, item.time, self.messages.decode(channel, content))
            elif topic in self.steps.topics:
                self.steps.add(topic, item.time, self.messages.decode(channel, content))
        except InputError as error:
            self.spoilt[topic] += 1
            if self.spoilt[topic] == 1:
                self._tell_event("unusable", str(error))
            if self.spoilt[topic] > max(FEW, SPOILT * self.messages.counts[topic]):
                raise session_fault(SessionOutcome.TOPIC_UNUSABLE, str(error)) from None
        self.messages.counts[topic] += 1

    def _receive_notice(self, item: Notice) -> None:
        if item.name == "lost":
            self._lost, self.outages = time.monotonic(), self.outages + 1
            self.steps.interrupt()
        elif item.name == "vanished" and item.topic == self.steps.odometry:
            self.steps.interrupt()  # the node that comes back may begin anew
        elif item.name == "back":
            self._lost = None
        if item.name == "garbage":
            self.spoilt["connection"] += 1
            if self.spoilt["connection"] > 1:
                return
        self._tell_event(item.name, item.text)

    def check_patience(self) -> None:
        """Raises the fault of a connection or a topic that has been silent for too long."""
        now, longest, source = time.monotonic(), self.topics.patience, self.topics.source
        held, self._looked = now - self._looked, now
        if held > HELD:  # this process stood still: the robot cannot be blamed for that time
            self._heard = {topic: heard + held for topic, heard in self._heard.items()}
            self._lost = None if self._lost is None else self._lost + held
        if self._lost is not None and now - self._lost > longest:
            detail = f"no connection to {source} for {longest:g} s"
            raise session_fault(SessionOutcome.CONNECTION_LOST, detail)
        for topic in sorted(self.steps.topics):
            if self._lost is None and now - self._heard[topic] > longest:
                detail = f"{topic}: no message for {longest:g} s{self._known_cause(topic)}"
                raise session_fault(SessionOutcome.TOPIC_SILENT, detail)
        self._check()

    def _known_cause(self, topic: str) -> str:
        """Why no messages of a topic come, as far as the robot says it."""
        channel, kind = self.client.channels.get(topic), self._kinds[topic]
        if channel is None:
            return ": it is no longer advertised"
        return f": it is advertised as {channel.kind} now, not as {kind}" if channel.kind != kind else ""

    def _check(self) -> None:
        if self.recorder is not None and self.recorder.fault:
            raise SessionFault(self.recorder.fault)
        if self._stopped():
            raise OperatorStop

    def over(self) -> bool:
        """Whether the session has lasted as long as it should."""
        minutes = self.topics.minutes
        return minutes is not None and time.monotonic() - self.epoch > 60 * minutes

    def rest(self) -> bool:
        """Nothing was moved."""
        return True

    def __exit__(self, *_: object) -> None:
        self.client.close()


def run_topics_loop(rig: TopicsRig, mapper: AsyncMapper, tell: Tell) -> None:
    """Maps what the robot publishes until the planned end.

    Args:
        tell: called with the time of each sample, s, and its pose in the robot's frame of odometry or None.

    Raises:
        robot.live.polling.SessionFault, robot.live.polling.OperatorStop.
    """
    budget, checked = rig.config.budget, 0.0
    while not rig.over():
        taken: list[Received | Notice | None] = [*rig.client.take(LONGEST_WAIT)]
        for item in taken or [None]:
            arrival = 0
            if item is not None:
                rig.receive(item)
                arrival = item.time
            for sample, begins, odometry in rig.steps.ready(time.time_ns(), lambda: mapper.behind() > budget):
                if rig.recorder is not None:
                    if begins:
                        rig.recorder.add(Event(sample.time, PIECE, "no odometry leads to the next sample"))
                    rig.recorder.add(sample)
                mapper.offer(sample, begins)
                if arrival:
                    rig.latencies.append((time.time_ns() - arrival) / 1e9)
                tell(sample.time, odometry)
        if time.monotonic() - checked >= LONGEST_WAIT:
            checked = time.monotonic()
            rig.check_patience()
            check_mapper(mapper)
