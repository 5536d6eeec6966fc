"""What a running robot publishes, and the configuration of a live session that maps it, as a `Diagnosis`."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from ratslam.service.recording_check import Diagnosis, diagnose_recording
from robot.live.topic_steps import ROLES, SEEN
from robot.live.topics_client import Channel, LiveMessages, Received, TopicsClient
from robot.live.topics_rig import open_client
from robot.recordings.bags.bag import TRANSFORMS
from robot.recordings.bags.bag_description import BagDescription, TopicDescription, describe_bag
from robot.recordings.bags.topics_config import TopicsConfig
from robot.recordings.bags.views import CLOUD, LONGEST, SCAN
from robot.recordings.bags.wrench_pokes import NO_RINGS
from robot.recordings.mcap_writer import MessageWriter
from tactile.base.errors import InputError

USED = TRANSFORMS.union(*ROLES.values())
"""Types of messages that are looked at."""
NO_ODOMETRY = "no topic of odometry: odometry of /tf, or of images alone, is for bags"
DISCOVERY, SETTLED = 2.0, 0.3
"""Time for which advertisements are awaited, and after which no more are expected, s."""
CLOCKS_DIFFER = 1.0
"""Age of stamps, or time by which they are ahead, from which the clocks of robot and host differ, s."""


def diagnose_topics(address: str, seconds: float) -> Diagnosis:
    """Listens to a robot, as `doctor` reads a bag, and writes nothing.

    Args:
        address: of its Foxglove bridge or Zenoh router. seconds: how long to listen.

    Raises:
        InputError: nothing answers there.
    """
    messages = LiveMessages(address, TopicsConfig(), lambda sentence: None)
    client = open_client(address, lambda channel: False)
    try:
        _await_topics(client)
        messages.list_topics(client.channels)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "heard.mcap"
            count = _record(client, messages, path, seconds)
            found = describe_bag(path) if count else None
            diagnosis = diagnose_recording(path) if count else Diagnosis("", faults=("no messages came",))
        return _of_robot(address, seconds, client, found, diagnosis, folder)
    finally:
        client.close()


def _await_topics(client: TopicsClient) -> None:
    """Waits until the robot has advertised its topics."""
    due, known = time.monotonic() + DISCOVERY, 0
    while time.monotonic() < due:
        time.sleep(SETTLED)
        if known and len(client.channels) == known:
            return
        known = len(client.channels)


def _record(client: TopicsClient, messages: LiveMessages, path: Path, seconds: float) -> int:
    """Writes what is published for some time to a new bag; returns the number of messages."""
    client.want(lambda channel: channel.kind in USED and messages.readable(channel))
    due, count = time.monotonic() + seconds, 0
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="topics")
        found = MessageWriter(writer)
        while (rest := due - time.monotonic()) > 0:
            for item in client.take(rest):
                if not isinstance(item, Received):
                    continue
                try:
                    content = messages.in_cdr(item)
                except InputError:
                    continue
                topic, kind, text = item.channel.topic, item.channel.kind, messages.definition(item.channel)
                found.add(topic, kind, text, item.time, content)
                count += 1
        writer.finish()
    return count


def _of_robot(
    address: str,
    seconds: float,
    client: TopicsClient,
    found: BagDescription | None,
    heard: Diagnosis,
    folder: str,
) -> Diagnosis:
    """The diagnosis of what was heard, for a live session."""
    name = f" ({client.name})" if client.name else ""
    what = f"{address}{name}: {len(client.channels)} topics, {seconds:g} s of messages"
    described = {} if found is None else {topic.name: topic for topic in found.topics}
    rows: list[tuple[str, ...]] = [("topic", "type", "Hz", "age", "holds", "serves as")]
    rows += [_row(channel, described.get(channel.topic)) for _, channel in sorted(client.channels.items())]
    faults = tuple(fault.replace(folder, "") for fault in heard.faults if NO_RINGS not in fault)
    notes = tuple(note for note in heard.notes if folder not in note)
    if len(faults) < len(heard.faults):
        notes = (*notes, f"{NO_RINGS} within {seconds:g} s: `--seconds` listens longer")
    for topic in described.values():
        if topic.stamped is not None and abs(topic.stamped.ahead) > CLOCKS_DIFFER:
            said = f"{topic.name}: the clock of the robot is {topic.stamped.ahead:+.3g} s off this machine's"
            notes = (*notes, f"{said}; the map does not mind")
    if not heard.config or faults:
        return Diagnosis(what, tuple(rows), notes, faults or ("no topic can serve as odometry",))
    config = dict(heard.config)
    recording = dict(config.pop("recording"))
    recording.pop("file")
    topics = dict(recording["topics"])
    if "topic" not in (wheels := _part(topics.get("odometry"))):
        return Diagnosis(what, tuple(rows), notes, (NO_ODOMETRY,))
    topics["samples"] = "views"
    sees = next((key for key in SEEN if key in topics), None)
    if sees is None:
        return Diagnosis(what, tuple(rows), notes, ("no topic of views, touch or a wrench",))
    if sees != "wrench":
        topics[sees] = _with_values(_part(topics[sees]), described, wheels["topic"])
        if "low" in topics[sees]:
            said = f"{seconds:g} s: its lowest and highest values count as 0 and 1"
            cure = "let it feel all that it can meanwhile, or set touch.low and high"
            notes = (*notes, f"{topics[sees]['topic']}, heard for {said}; {cure}")
    recording["topics"] = topics
    sections = {"live": {"topics": {"source": address}}, "recording": recording, **config}
    return Diagnosis(what, tuple(rows), notes, faults, heard.advice, sections)


def _part(setting: Any) -> dict[str, Any]:
    """A topic's settings; a bare name stands for the topic alone."""
    return {"topic": setting} if isinstance(setting, str) else dict(setting or {})


def _with_values(
    part: dict[str, Any], described: dict[str, TopicDescription], odometry: str
) -> dict[str, Any]:
    """The settings of views or touch, with values for what would be learned from a whole recording."""
    topic, steps = described[part["topic"]], described[odometry]
    clock = steps.stamped or steps.received
    if clock.rate_hz:
        part["tolerance"] = float(f"{1 / clock.rate_hz:.3g}")
    if topic.kind == SCAN and topic.shape is not None:
        part["max_range"] = float(f"{min(topic.shape.high, LONGEST):.6g}")
    elif topic.kind == CLOUD:
        part["max_range"] = LONGEST
    elif "touch" in topic.roles and topic.shape is not None:
        part["rows"], part["columns"] = (1, *topic.shape.size)[-2:]
    return part


def _row(channel: Channel, topic: TopicDescription | None) -> tuple[str, ...]:
    if topic is None:
        able = "silent" if channel.kind in USED else "-"
        return channel.topic, channel.kind, "", "", "", able
    clock = topic.stamped or topic.received
    age = "" if topic.stamped is None else f"{-1e3 * topic.stamped.ahead:.0f} ms"
    if topic.stamped is not None and abs(topic.stamped.ahead) > CLOCKS_DIFFER:
        age = f"{-topic.stamped.ahead:.3g} s"
    words = topic.shape.words if topic.shape else ""
    return channel.topic, channel.kind, f"{clock.rate_hz:.3g}", age, words, ", ".join(topic.roles) or "-"
