"""A client of the Foxglove WebSocket protocol: topics of a robot on which `foxglove_bridge` runs.

The server advertises its topics with the definitions of their messages; the client subscribes to some of them
and gets each message as the robot published it (CDR of ROS 2, or the format of ROS 1). The client can publish
too, if the server allows it. A thread reads; a connection that is lost is made again until the client is
closed. Protocol: https://github.com/foxglove/ws-protocol (`foxglove.websocket.v1`), whose messages bridges
from version 3 on (`foxglove.sdk.v1`) send too.
"""

from __future__ import annotations

import json
import logging
import ssl
import struct
import threading
import time
from contextlib import ExitStack, suppress
from typing import Any

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

SUBPROTOCOLS: tuple[Any, ...] = ("foxglove.sdk.v1", "foxglove.websocket.v1")
RETRY, LONGEST_RETRY = 0.1, 2.0
"""Waiting time before a lost connection is made again, at first and at most, s."""
START = "on the robot: `ros2 launch foxglove_bridge foxglove_bridge_launch.xml`"
_QUIET = logging.getLogger("ratslam.foxglove")
_QUIET.addHandler(logging.NullHandler())
_QUIET.propagate = False  # what is wrong with a connection is a notice; the library logs tracebacks
_MESSAGE = struct.Struct("<BIQ")  # opcode, subscription, time of the server in ns


class FoxgloveClient(TopicsClient):
    """A connection to a server at `ws://HOST:PORT` or `wss://HOST:PORT`."""

    def __init__(self, address: str, wanted: Wanted) -> None:
        super().__init__(address, wanted)
        self._all: dict[int, Channel] = {}
        self._subscribed: dict[int, Channel] = {}  # by the number of the subscription, that of the channel
        self._published: dict[str, int] = {}
        self._lock = threading.Lock()
        self._socket, self._stack = _connect(address)
        self._thread = threading.Thread(target=self._read_on, daemon=True, name=f"topics of {address}")
        self._thread.start()

    def publish(self, topic: str, kind: str, content: bytes) -> None:
        if "cdr" not in self.accepts:
            return
        with self._lock, suppress(OSError, _closed_errors()):
            if topic not in self._published:
                self._published[topic] = len(self._published) + 1
                channel = {
                    "id": self._published[topic],
                    "topic": topic,
                    "encoding": "cdr",
                    "schemaName": kind,
                }
                self._socket.send(json.dumps({"op": "advertise", "channels": [channel]}))
            self._socket.send(struct.pack("<BI", 1, self._published[topic]) + content)

    def close(self) -> None:
        self._closed.set()
        with suppress(OSError, _closed_errors()):
            self._stack.close()
        while self._thread.is_alive():
            self.take(0.05)  # the thread may wait for room
        self._stack.close()  # a connection that was just made again

    def _read_on(self) -> None:
        """Reads the connection, and makes a new one when it is lost, until the client is closed."""
        while not self._closed.is_set():
            why = "closed by the robot's side"
            try:
                for message in self._socket:
                    self._receive(message, time.time_ns())
            except (OSError, _closed_errors()) as error:
                why = " ".join(str(error).split()) or type(error).__name__
            if self._closed.is_set():
                return
            self._note("lost", why)
            self._all, self.channels, self._subscribed, self._published = {}, {}, {}, {}
            wait = RETRY
            while not self._closed.wait(wait):
                wait = min(2 * wait, LONGEST_RETRY)
                with suppress(InputError):
                    self._socket, self._stack = _connect(self.address)
                    self._note("back", "connected again")
                    break

    def _receive(self, message: str | bytes, now: int) -> None:
        try:
            if isinstance(message, str):
                self._obey(json.loads(message))
            elif message[:1] == b"\x01":
                _, subscription, _ = _MESSAGE.unpack_from(message)
                channel = self._subscribed.get(subscription)
                if channel is not None:
                    self._put(Received(channel, now, message[_MESSAGE.size :]))
        except (ValueError, KeyError, TypeError, AttributeError, struct.error, RecursionError) as error:
            self._note("garbage", f"{len(message)} bytes that are no message of the protocol ({error!r})")

    def _obey(self, content: dict[str, Any]) -> None:
        """Does what a message of the server in JSON says."""
        kind = content.get("op")
        if kind == "serverInfo":
            self.name = str(content.get("name", ""))
            able = "clientPublish" in content.get("capabilities", [])
            self.accepts = tuple(map(str, content.get("supportedEncodings", ["cdr"]))) if able else ()
        elif kind == "advertise":
            for each in content["channels"]:
                if len(self._all) < MOST_TOPICS:
                    channel = _channel_of(each)
                    self._all[channel.number] = channel
            self._list_channels()
            self._subscribe()
        elif kind == "unadvertise":
            for number in content["channelIds"]:
                gone = self._all.pop(int(number), None)
                if gone is not None and self._subscribed.pop(gone.number, None) is not None:
                    self._note("vanished", f"{gone.topic} is no longer advertised", gone.topic)
            self._list_channels()
            self._subscribe()  # another of that name
        elif kind == "status" and int(content.get("level", 0)) >= 2:
            self._note("garbage", f"the robot's side reports: {content.get('message', '')}")

    def _list_channels(self) -> None:
        self.channels = {channel.topic: channel for channel in reversed(list(self._all.values()))}

    def _subscribe(self) -> None:
        with self._lock:  # two threads come here
            new = [each for number, each in list(self._all.items()) if number not in self._subscribed]
            taken = {each.topic for each in self._subscribed.values()}
            wanted = [each for each in reversed(new) if each.topic not in taken and self._wanted(each)]
            chosen = {each.number: each for each in {each.topic: each for each in wanted}.values()}
            if not chosen:
                return
            self._subscribed |= chosen
            asked = [{"id": number, "channelId": number} for number in chosen]
            with suppress(OSError, _closed_errors()):
                self._socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))


def _channel_of(each: dict[str, Any]) -> Channel:
    """The channel of an advertisement; names of types as in ROS 2."""
    kind = str(each["schemaName"])
    if kind.count("/") == 1:
        kind = kind.replace("/", "/msg/")
    encoding = str(each["encoding"])
    notation = str(each.get("schemaEncoding") or ("ros1msg" if encoding == "ros1" else "ros2msg"))
    texts = str(each["topic"]), encoding, kind, str(each.get("schema", "")), notation
    return Channel(int(each["id"]), *texts)


def _closed_errors() -> type[Exception]:
    """What websockets raises for a connection that has ended."""
    from websockets.exceptions import WebSocketException

    return WebSocketException


def _connect(address: str) -> tuple[Any, ExitStack]:
    """A new connection, and the stack that closes it."""
    try:
        from websockets.exceptions import InvalidURI, NegotiationError, WebSocketException
        from websockets.sync.client import connect
    except ImportError:
        raise InputError("websockets", "not installed", "", "pip install 'ratslam[live-ros]'") from None
    expected = "a Foxglove bridge, ws://HOST:8765 or wss://HOST:8765, or a router, zenoh://HOST:7447"
    stack = ExitStack()
    try:
        opened = connect(
            address, subprotocols=SUBPROTOCOLS, compression=None, proxy=None, max_size=LARGEST,
            open_timeout=CONNECT_TIMEOUT, close_timeout=1.0, ping_interval=5.0, ping_timeout=10.0,
            logger=_QUIET,
        )  # fmt: skip
        socket = stack.enter_context(opened)
    except ssl.SSLError as error:
        cure = "the certificate must be valid for this name, or its issuer's be given in SSL_CERT_FILE"
        raise InputError(address, f"no trusted connection ({error})", expected, cure) from None
    except (InvalidURI, ValueError):  # ValueError: of a port that cannot be
        raise InputError(address, "no address of a websocket", expected) from None
    except (OSError, NegotiationError, WebSocketException, TimeoutError) as error:
        words = " ".join(str(error).split()) or type(error).__name__
        raise InputError(address, f"no connection ({words})", expected, START) from None
    if socket.subprotocol not in SUBPROTOCOLS:
        stack.close()
        raise InputError(address, "another server than a Foxglove bridge", expected, START)
    return socket, stack
