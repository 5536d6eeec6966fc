"""Robots that publish topics on loopback: a bridge played by `foxglove-sdk`, and one written here that speaks
the older protocol and can be cut, fall silent and send garbage."""

import json
import struct
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import foxglove
from websockets.sync.server import ServerConnection, serve

from tests.helpers.ros_bags import ROS1, ROS2, Entry, built


def in_cdr(entry: Entry) -> bytes:
    return bytes(ROS2.serialize_cdr(built(ROS2, entry.kind, entry.fields), entry.kind))


class SdkBridge:
    """A bridge of `foxglove-sdk`. Args: kinds: type of each topic."""

    def __init__(self, host: str, kinds: Mapping[str, str]) -> None:
        self._context = context = foxglove.Context()  # channels live as long as it does
        options: dict[str, Any] = {"context": context, "message_backlog_size": 4096, "name": "stand-in"}
        self._server = foxglove.start_server(host=host, port=0, **options)
        self.address = f"ws://{host}:{self._server.port}"
        self._channels = {}
        for topic, kind in kinds.items():
            text = ROS2.generate_msgdef(kind, ros_version=2)[0]
            schema = foxglove.Schema(name=kind, encoding="ros2msg", data=text.encode())
            options = {"message_encoding": "cdr", "schema": schema, "context": context}
            self._channels[topic] = foxglove.Channel(topic, **options)

    def send(self, *entries: Entry) -> None:
        for entry in entries:
            self._channels[entry.topic].log(in_cdr(entry))

    def heard(self, topics: Sequence[str]) -> bool:
        """Whether a client is subscribed to all of these topics."""
        return all(self._channels[topic].has_sinks() for topic in topics)

    def close(self) -> None:
        self._server.stop()


class PlainBridge:
    """A bridge of the protocol's older version, for any number of clients.

    Args:
        kinds: type of each topic. ros1: whether it is a bridge of ROS 1. ssl: context, for TLS.

    Attributes:
        published: messages of clients, as (topic, type, bytes).
    """

    def __init__(
        self, host: str, kinds: Mapping[str, str], *, ros1: bool = False, port: int = 0, ssl: Any = None
    ) -> None:
        self.kinds, self._ros1 = dict(kinds), ros1
        self._clients: dict[ServerConnection, dict[str, int]] = {}
        self.published: list[tuple[str, str, bytes]] = []
        protocols: Any = ["foxglove.websocket.v1"]
        self._server = serve(self._meet, host, port, subprotocols=protocols, compression=None, ssl=ssl)
        self.port = self._server.socket.getsockname()[1]
        self.address = f"ws{'s' if ssl else ''}://{host}:{self.port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def _meet(self, client: ServerConnection) -> None:
        able = {"capabilities": ["clientPublish"], "supportedEncodings": ["cdr"]}
        client.send(json.dumps({"op": "serverInfo", "name": "plain", **able}))
        client.send(json.dumps({"op": "advertise", "channels": self._channels()}))
        self._clients[client] = {}
        offered: dict[int, tuple[str, str]] = {}
        for message in client:
            if isinstance(message, bytes):
                number = struct.unpack_from("<I", message, 1)[0]
                self.published.append((*offered[number], message[5:]))
                continue
            said = json.loads(message)
            if said["op"] == "subscribe":
                names = list(self.kinds)
                for each in said["subscriptions"]:
                    self._clients[client][names[each["channelId"]]] = each["id"]
            elif said["op"] == "advertise":
                offered |= {each["id"]: (each["topic"], each["schemaName"]) for each in said["channels"]}

    def _channels(self) -> list[dict[str, Any]]:
        found = []
        for number, (topic, kind) in enumerate(self.kinds.items()):
            if self._ros1:
                text, name, encoding = ROS1.generate_msgdef(kind)[0], kind.replace("/msg/", "/"), "ros1"
            else:
                text, name, encoding = ROS2.generate_msgdef(kind, ros_version=2)[0], kind, "cdr"
            found.append(
                {"id": number, "topic": topic, "encoding": encoding, "schemaName": name, "schema": text}
            )
        return found

    def send(self, *entries: Entry) -> None:
        for entry in entries:
            store = ROS1 if self._ros1 else ROS2
            message = built(store, entry.kind, entry.fields)
            write = store.serialize_ros1 if self._ros1 else store.serialize_cdr
            self.send_raw(entry.topic, bytes(write(message, entry.kind)), entry.time)

    def send_raw(self, topic: str, content: bytes, time: int = 0) -> None:
        """Sends bytes as a message of a topic to all who subscribed to it."""
        for client, subscribed in list(self._clients.items()):
            if topic in subscribed:
                self._tell(client, struct.pack("<BIQ", 1, subscribed[topic], time) + content)

    def say(self, message: str | bytes) -> None:
        """Sends bytes or text as they are to all clients."""
        for client in list(self._clients):
            self._tell(client, message)

    def _tell(self, client: ServerConnection, message: str | bytes) -> None:
        try:
            client.send(message)
        except Exception:
            self._clients.pop(client, None)

    def heard(self, topics: Sequence[str]) -> bool:
        return any(set(topics) <= set(subscribed) for subscribed in self._clients.values())

    def cut(self) -> None:
        """Breaks all connections, without a word."""
        for client in list(self._clients):
            self._clients.pop(client, None)
            client.socket.close()

    def close(self) -> None:
        self._server.shutdown()
        self.cut()
