"""A client of Zenoh: topics of a robot whose ROS 2 runs on `rmw_zenoh`, by way of its router.

A publisher of ROS 2 is announced by a liveliness token whose key holds its topic and type; its messages come
in CDR under `DOMAIN/TOPIC/TYPE/HASH`. Definitions of types do not come with them. The client is a *client* of
Zenoh: as a peer it would see nothing of robots that it cannot reach directly. It connects to the address
alone: no scouting, no listening. Keys: https://github.com/ros2/rmw_zenoh/blob/rolling/docs/design.md.
"""

from __future__ import annotations

import json
import os
import threading
import time
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from robot.live.topics_client import (
    CONNECT_TIMEOUT,
    LARGEST,
    MOST_TOPICS,
    Channel,
    Received,
    TopicsClient,
    Wanted,
)
from tactile.base.errors import InputError

PORT = 7447
"""Port of a router, if the address has none."""
SCHEMES = {"zenoh": "tcp", "zenoh+tls": "tls"}
START = "on the robot: `ros2 run rmw_zenoh_cpp rmw_zenohd`"
HUMBLE = "TypeHashNotSupported"
"""What Humble writes in the place of the hash of a type."""
TRANSIENT_LOCAL = "1"
"""Durability of publishers that repeat their last messages to those who come later."""


class ZenohClient(TopicsClient):
    """A connection to a router at `zenoh://HOST:PORT/DOMAIN`, or `zenoh+tls://`."""

    def __init__(self, address: str, wanted: Wanted) -> None:
        super().__init__(address, wanted)
        endpoint, self._domain = _parse(address)
        self._publishers: dict[str, tuple[Channel, str, str]] = {}  # by the key of their token
        self._subscribers: dict[str, Any] = {}  # by topic
        self._tokens: dict[str, tuple[str, Any]] = {}  # key and token of what is published, by topic
        self._sent = 0
        self._lock = threading.RLock()  # threads of Zenoh come here too
        self._session = _open(address, endpoint)
        self.name, self.accepts = f"rmw_zenoh, domain {self._domain}", ("cdr",)
        tokens = f"@ros2_lv/{self._domain}/**"
        self._events = self._session.info.declare_transport_events_listener(self._watch)
        self._listener = self._session.liveliness().declare_subscriber(tokens, self._hear, history=True)

    def publish(self, topic: str, kind: str, content: bytes) -> None:
        import zenoh
        from zenoh.ext import Int64, z_serialize

        with self._lock, suppress(zenoh.ZError):
            if topic not in self._tokens:
                self._tokens[topic] = self._announce(topic, kind, len(self._tokens))
            self._sent += 1
            number, now = Int64(self._sent), Int64(time.time_ns())
            sender = bytes.fromhex(str(self._session.info.zid()).zfill(32))
            # What `rmw_zenoh` expects beside a message.
            beside = z_serialize(("sequence_number", number, "source_timestamp", now, "source_gid", sender))
            self._session.put(self._tokens[topic][0], content, attachment=beside)

    def close(self) -> None:
        self._closed.set()
        self._session.close()

    def _watch(self, event: Any) -> None:
        """Says when the connection is lost and when Zenoh has made it again."""
        import zenoh

        if event.kind == zenoh.SampleKind.DELETE:
            self._note("lost", "no connection to the router")
        else:
            self._note("back", "connected again")

    def _hear(self, token: Any) -> None:
        """Takes note of a publisher that appears or vanishes."""
        import zenoh

        key = str(token.key_expr)
        publisher = _publisher_of(key)
        if publisher is None or str(self._session.info.zid()) in key:  # what is published here
            return
        topic = publisher[0].topic
        with self._lock:
            if token.kind == zenoh.SampleKind.DELETE:
                self._publishers.pop(key, None)
            elif len(self._publishers) < MOST_TOPICS:
                self._publishers[key] = publisher
            found = [channel for channel, *_ in self._publishers.values()]
            self.channels = {channel.topic: channel for channel in reversed(found)}
            gone = topic in self._subscribers and topic not in self.channels
        if gone:  # the subscriber stays: it hears a publisher that comes back
            self._note("vanished", f"{topic} is no longer advertised", topic)
        self._subscribe()

    def _subscribe(self) -> None:
        import zenoh

        with self._lock, suppress(zenoh.ZError):  # the session may be closed already
            for channel in list(self.channels.values()):
                if channel.topic not in self._subscribers and self._wanted(channel):
                    self._subscribers[channel.topic] = self._listen(channel)

    def _listen(self, channel: Channel) -> Any:
        """A new subscriber, who hears the last messages too where the publisher keeps them."""
        import zenoh
        from zenoh.ext import HistoryConfig, declare_advanced_subscriber

        def receive(sample: Any) -> None:
            self._put(Received(channel, time.time_ns(), sample.payload.to_bytes()))

        # The hash is left open: Humble writes none.
        key = f"{self._domain}/{channel.topic.strip('/')}/{_written(channel.kind)}/*"
        kept = {durability for each, _, durability in self._publishers.values() if each == channel}
        if TRANSIENT_LOCAL not in kept:
            return self._session.declare_subscriber(key, receive, allowed_origin=zenoh.Locality.REMOTE)
        history, others = HistoryConfig(detect_late_publishers=True), zenoh.Locality.REMOTE
        session = self._session
        return declare_advanced_subscriber(session, key, receive, history=history, allowed_origin=others)

    def _announce(self, topic: str, kind: str, number: int) -> tuple[str, Any]:
        """The key of a topic that is published here, and the token that announces it."""
        from rosbags.typesys import Stores, get_typestore

        hashed = get_typestore(Stores.ROS2_HUMBLE).hash_rihs01(kind)
        if any(known == HUMBLE for _, known, _ in self._publishers.values()):
            hashed = HUMBLE
        written, mangled = _written(kind), topic.replace("/", "%")
        node = f"@ros2_lv/{self._domain}/{self._session.info.zid()}/0"
        said = f"{node}/{number + 1}/MP/%/%/ratslam/{mangled}/{written}/{hashed}/::,10:,:,:,,"
        token = self._session.liveliness().declare_token(said)
        return f"{self._domain}/{topic.strip('/')}/{written}/{hashed}", token


def _parse(address: str) -> tuple[str, int]:
    """Where to connect to, as Zenoh writes it, and the domain of ROS 2."""
    parts = urlsplit(address)
    domain = parts.path.strip("/") or "0"
    try:
        port = parts.port or PORT
        known = parts.scheme in SCHEMES and parts.hostname and domain.isdecimal()
    except ValueError:
        known, port = False, 0
    if not known:
        expected = "zenoh://HOST:7447, with /DOMAIN if ROS_DOMAIN_ID is not 0, or zenoh+tls://"
        raise InputError(address, "no address of a Zenoh router", expected)
    host = f"[{parts.hostname}]" if ":" in str(parts.hostname) else parts.hostname
    return f"{SCHEMES[parts.scheme]}/{host}:{port}", int(domain)


def _open(address: str, endpoint: str) -> Any:
    try:
        import zenoh
    except ImportError:
        raise InputError("eclipse-zenoh", "not installed", "", "pip install 'ratslam[zenoh]'") from None
    settings: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": round(1e3 * CONNECT_TIMEOUT),
        "connect/exit_on_failure": True,
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/rx/max_message_size": LARGEST,
    }
    if (trusted := os.environ.get("SSL_CERT_FILE")) and endpoint.startswith("tls/"):
        settings["transport/link/tls/root_ca_certificate"] = trusted
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        words = " ".join(str(error).split())[:300]
        expected = "the address of a Zenoh router, zenoh://HOST:7447"
        raise InputError(address, f"no connection ({words})", expected, START) from None


def _publisher_of(key: str) -> tuple[Channel, str, str] | None:
    """The topic of the publisher that a token announces, with the hash of its type and its durability; None
    for nodes, subscribers and what else there is."""
    parts = key.split("/")
    if len(parts) != 13 or parts[5] != "MP":
        return None
    topic, written, hashed, quality = parts[9:]
    kind = written.replace("dds_::", "").replace("::", "/").removesuffix("_")
    return (
        Channel(0, topic.replace("%", "/"), "cdr", kind, "", "ros2msg"),
        hashed,
        f"{quality}::".split(":")[1],
    )


def _written(kind: str) -> str:
    package, _, name = kind.rpartition("/")
    return f"{package.replace('/', '::')}::dds_::{name}_"
