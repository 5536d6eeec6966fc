"""Connections to running robots, over the Foxglove protocol and over Zenoh."""

import ssl
import subprocess
from pathlib import Path

import pytest
from zenoh import ZBytes
from zenoh.ext import Int64, z_deserialize

from robot.live.topics_client import Received
from robot.live.topics_rig import open_client
from tactile.base.errors import InputError
from tests.helpers.ros_bags import tf, transform
from tests.helpers.stand_in_robot import PlainBridge, SdkBridge, ZenohRobot
from tests.robot.live.test_topics import KINDS, drive
from tests.robot.live.test_topics_rig import PATIENCE, wait

STATIC = {"/tf_static": "tf2_msgs/msg/TFMessage"}


def test_the_client_connects_only_where_it_is_told_and_bounds_what_it_takes(loopback):
    with pytest.raises(InputError, match="no connection"):
        open_client(f"ws://{loopback}:9", lambda channel: True)
    with pytest.raises(InputError, match="no address of a websocket"):
        open_client("robot:8765", lambda channel: True)
    with pytest.raises(InputError, match="no connection"):
        open_client(f"zenoh://{loopback}:9", lambda channel: True)
    with pytest.raises(InputError, match="no address of a websocket"):
        open_client("ws://robot:99999", lambda channel: True)
    for wrong in (
        "zenoh:robot",
        "zenoh://robot:99999",
        "zenoh://robot:x",
        "zenoh://robot/first",
        "zenohs://robot",
    ):
        with pytest.raises(InputError, match="no address of a Zenoh router"):
            open_client(wrong, lambda channel: True)
    robot = PlainBridge(loopback, KINDS)
    client = open_client(robot.address, lambda channel: channel.topic == "/scan")
    try:
        wait(lambda: robot.heard(["/scan"]))
        robot.send_raw("/scan", b"x" * (1 << 27))
        assert [item.name for item in client.take(PATIENCE)] == ["lost"]
    finally:
        client.close()
        robot.close()


def bridge_with_tls(host: str, secrets: tuple[Path, Path]) -> PlainBridge:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*reversed(secrets))
    return PlainBridge(host, KINDS, ssl=context)


def zenoh_with_tls(host: str, secrets: tuple[Path, Path]) -> ZenohRobot:
    return ZenohRobot(host, KINDS, secrets=secrets)


@pytest.mark.parametrize("start", [bridge_with_tls, zenoh_with_tls])
def test_a_connection_with_tls_needs_a_certificate_that_is_trusted(start, loopback, tmp_path, monkeypatch):
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    made = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=robot"]
    made += ["-addext", f"subjectAltName=IP:{loopback}", "-addext", "basicConstraints=critical,CA:FALSE"]
    subprocess.run([*made, "-keyout", str(key), "-out", str(certificate)], check=True, capture_output=True)
    robot = start(loopback, (key, certificate))
    try:
        with pytest.raises(InputError, match=r"no (trusted )?connection"):
            open_client(robot.address, lambda channel: True)
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        client = open_client(robot.address, lambda channel: True)
        try:
            wait(lambda: robot.heard(list(KINDS)))
            robot.send(drive(0.1)[0])
            assert [item.channel.topic for item in client.take(PATIENCE)] == ["/odom"]
        finally:
            client.close()
    finally:
        robot.close()


def received(client, count: int) -> list[Received]:
    """The next messages of a client."""
    found: list[Received] = []

    def enough() -> bool:
        found.extend(item for item in client.take(0.1) if isinstance(item, Received))
        return len(found) >= count

    wait(enough)
    return found


@pytest.mark.parametrize("humble", [False, True])
def test_a_robot_on_zenoh_is_heard_in_its_domain_and_what_it_keeps_is_repeated(humble, loopback):
    robot = ZenohRobot(loopback, KINDS | STATIC, domain=3, humble=humble)
    link, other = tf(5, transform(5, "base_link", "laser", 0.1, 0.0, {"w": 1.0}), topic="/tf_static"), None
    try:
        robot.send(link)  # before anybody listens
        client = open_client(robot.address, lambda channel: channel.topic != "/scan")
        try:
            wait(lambda: robot.heard(["/odom"]))
            wait(lambda: {each.topic: each.kind for each in client.channels.values()} == KINDS | STATIC)
            assert client.name == "rmw_zenoh, domain 3"
            wheels = drive(1.0)
            robot.send(*wheels)
            count = sum(entry.topic == "/odom" for entry in wheels)
            found = received(client, count + 1)
            topics = [item.channel.topic for item in found]
            assert (topics.count("/odom"), topics.count("/tf_static"), len(topics)) == (count, 1, count + 1)
        finally:
            client.close()
        other = open_client(robot.address.replace("/3", "/4"), lambda channel: True)
        assert other.take(0.5) == []
        assert other.channels == {}
    finally:
        if other is not None:
            other.close()
        robot.close()


@pytest.mark.parametrize("humble", [False, True])
def test_what_is_published_over_zenoh_has_what_ros_expects_beside_it(humble, loopback):
    robot = ZenohRobot(loopback, KINDS, humble=humble)
    client = open_client(robot.address, lambda channel: channel.topic == "/ratslam/pose")
    try:
        wait(lambda: set(client.channels) == set(KINDS))
        for content in (b"first", b"second"):
            client.publish("/ratslam/pose", KINDS["/odom"], content)
        wait(lambda: len(robot.published) == 2)
        assert client.take(0.5) == []  # not what was published here
        assert set(client.channels) == set(KINDS)
    finally:
        client.close()
        robot.close()
    written = "nav_msgs::msg::dds_::Odometry_"
    assert robot.published == [("/ratslam/pose", written, b"first"), ("/ratslam/pose", written, b"second")]
    kind = tuple[str, Int64, str, Int64, str, bytes]
    fields = [z_deserialize(kind, ZBytes(beside)) for beside in robot.beside]
    assert [each[::2] for each in fields] == [("sequence_number", "source_timestamp", "source_gid")] * 2
    assert [each[1] for each in fields] == [1, 2]
    assert len(fields[0][5]) == 16
    assert 0 < fields[0][3] <= fields[1][3]


def listening() -> int:
    """The ports at which this process and others listen."""
    lines = Path("/proc/self/net/tcp").read_text().splitlines()[1:]
    return sum(line.split()[3] == "0A" for line in lines)


@pytest.mark.skipif(not Path("/proc/self/net/tcp").exists(), reason="Linux alone lists ports so")
@pytest.mark.parametrize("bridge", [SdkBridge, PlainBridge, ZenohRobot])
def test_a_client_listens_nowhere(bridge, loopback):
    robot = bridge(loopback, KINDS)
    before = listening()
    client = open_client(robot.address, lambda channel: True)
    try:
        assert listening() == before
    finally:
        client.close()
        robot.close()
