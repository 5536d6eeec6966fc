"""Robots that publish topics on loopback: a bridge played by `foxglove-sdk`, one written here that speaks the
older protocol and can be cut, fall silent and send garbage, and a robot on `rmw_zenoh`."""

import json
import socket
import struct
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import foxglove
import zenoh
from websockets.sync.server import ServerConnection, serve
from zenoh.ext import CacheConfig, Int64, declare_advanced_publisher, z_serialize

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
            self.send_raw(entry.topic, in_cdr(entry))

    def send_raw(self, topic: str, content: bytes, time: int = 0) -> None:
        self._channels[topic].log(content)

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
        self._topics, self._ros1 = dict(enumerate(kinds.items())), ros1
        self._count = len(kinds)
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
        client.send(json.dumps({"op": "advertise", "channels": self._channels(self._topics)}))
        self._clients[client] = {}
        offered: dict[int, tuple[str, str]] = {}
        for message in client:
            if isinstance(message, bytes):
                number = struct.unpack_from("<I", message, 1)[0]
                self.published.append((*offered[number], message[5:]))
                continue
            said = json.loads(message)
            if said["op"] == "subscribe":
                for each in said["subscriptions"]:
                    self._clients[client][self._topics[each["channelId"]][0]] = each["id"]
            elif said["op"] == "advertise":
                offered |= {each["id"]: (each["topic"], each["schemaName"]) for each in said["channels"]}

    def advertise(self, topic: str, kind: str) -> None:
        new = {self._count: (topic, kind)}
        self._topics |= new
        self._count += 1
        self.say(json.dumps({"op": "advertise", "channels": self._channels(new)}))

    def withdraw(self, topic: str) -> None:
        number = next(number for number, (name, _) in self._topics.items() if name == topic)
        del self._topics[number]
        for subscribed in self._clients.values():
            subscribed.pop(topic, None)
        self.say(json.dumps({"op": "unadvertise", "channelIds": [number]}))

    def _channels(self, topics: Mapping[int, tuple[str, str]]) -> list[dict[str, Any]]:
        found = []
        for number, (topic, kind) in topics.items():
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


WRITTEN = {
    "nav_msgs/msg/Odometry": "nav_msgs::msg::dds_::Odometry_",
    "sensor_msgs/msg/LaserScan": "sensor_msgs::msg::dds_::LaserScan_",
    "sensor_msgs/msg/Imu": "sensor_msgs::msg::dds_::Imu_",
    "tf2_msgs/msg/TFMessage": "tf2_msgs::msg::dds_::TFMessage_",
}
"""Types as `rmw_zenoh` writes them."""


def opened(**settings: Any) -> Any:
    """A session of Zenoh that finds nobody by itself."""
    config = zenoh.Config()
    own = {"scouting/multicast/enabled": False, "timestamping/enabled": True, "listen/endpoints": []}
    for name, value in (own | settings).items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


class ZenohRobot:
    """A robot on `rmw_zenoh`: its router, and a node that publishes by way of it.

    Args:
        kinds: type of each topic; `/tf_static` is repeated to those who come later. domain: of ROS 2.
            humble: whether types have no hashes. secrets: files of a key and a certificate, for TLS.

    Attributes:
        published: messages of clients, as (topic, type, bytes); beside them, what came with each.
    """

    def __init__(
        self, host: str, kinds: Mapping[str, str], *, domain: int = 0, humble: bool = False,
        secrets: tuple[Path, Path] | None = None,
    ) -> None:  # fmt: skip
        with socket.socket() as probe:
            probe.bind((host, 0))
            there = f"{host}:{probe.getsockname()[1]}"
        self._endpoint = f"tls/{there}" if secrets else f"tcp/{there}"
        self.address = f"zenoh{'+tls' if secrets else ''}://{there}/{domain}"
        key, certificate = map(str, secrets or ("", ""))
        self._secrets = {
            "transport/link/tls/listen_private_key": key,
            "transport/link/tls/listen_certificate": certificate,
            "transport/link/tls/root_ca_certificate": certificate,
        } if secrets else {}  # fmt: skip
        self.published: list[tuple[str, str, bytes]] = []
        self.beside: list[bytes] = []
        self._domain, self._humble = domain, humble
        self._sent = 0
        self._publishers: dict[str, Any] = {}
        self._tokens: dict[str, Any] = {}
        self.route()
        self._node = opened(**self._secrets, **{"mode": "peer", "connect/endpoints": [self._endpoint]})
        beginning = f"@ros2_lv/{domain}/{self._node.zid()}/0"
        alive = self._node.liveliness()
        self._others = [
            alive.declare_token(f"{beginning}/0/NN/%/%/driver"),
            alive.declare_token(
                f"{beginning}/1/MS/%/%/driver/%heard/{WRITTEN['sensor_msgs/msg/Imu']}/x/::,1:,:,:,,"
            ),
        ]
        self._ears = self._node.declare_subscriber(
            f"{domain}/ratslam/**", self._hear, allowed_origin=zenoh.Locality.REMOTE
        )
        for topic, kind in kinds.items():
            self.advertise(topic, kind)

    def advertise(self, topic: str, kind: str) -> None:
        fixed, written, number = topic.endswith("tf_static"), WRITTEN[kind], len(self._publishers) + 2
        hashed = "TypeHashNotSupported" if self._humble else ROS2.hash_rihs01(kind)
        key = f"{self._domain}/{topic[1:]}/{written}/{hashed}"
        if fixed:
            options: dict[str, Any] = {"cache": CacheConfig(1), "publisher_detection": True}
            self._publishers[topic] = declare_advanced_publisher(self._node, key, **options)
        else:
            block = zenoh.CongestionControl.BLOCK
            self._publishers[topic] = self._node.declare_publisher(key, congestion_control=block)
        mangled, quality = topic.replace("/", "%"), ":1:,1:,:,:,," if fixed else "::,10:,:,:,,"
        said = f"@ros2_lv/{self._domain}/{self._node.zid()}/0/{number}/MP/%/%/driver/{mangled}/{written}"
        self._tokens[topic] = self._node.liveliness().declare_token(f"{said}/{hashed}/{quality}")

    def withdraw(self, topic: str) -> None:
        self._tokens.pop(topic).undeclare()
        self._publishers.pop(topic).undeclare()

    def _hear(self, sample: Any) -> None:
        topic, kind, _ = str(sample.key_expr).partition("/")[2].rsplit("/", 2)
        self.published.append((f"/{topic}", kind, sample.payload.to_bytes()))
        self.beside.append(sample.attachment.to_bytes())

    def send(self, *entries: Entry) -> None:
        for entry in entries:
            self.send_raw(entry.topic, in_cdr(entry))

    def send_raw(self, topic: str, content: bytes, time: int = 0) -> None:
        self._sent += 1
        number, at = Int64(self._sent), Int64(time)
        beside = z_serialize(("sequence_number", number, "source_timestamp", at, "source_gid", bytes(16)))
        self._publishers[topic].put(content, attachment=beside)

    def heard(self, topics: Sequence[str]) -> bool:
        return all(self._publishers[topic].matching_status.matching for topic in topics)

    def route(self) -> None:
        """Starts the router."""
        self._router = opened(**self._secrets, **{"mode": "router", "listen/endpoints": [self._endpoint]})

    def cut(self) -> None:
        """Breaks all connections: the router ends and starts anew."""
        self._router.close()
        self.route()

    def close(self) -> None:
        self._node.close()
        self._router.close()
