"""A robot in a room, mapped over its topics: the configuration is written, the session is that of the file
and of its own recording, to the bit, and the map goes back to the robot."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from evaluation.artifacts.run_reader import read_manifest
from evaluation.metrics.trajectory import ate, interpolate, read_tum
from ratslam.cli import main
from ratslam.service.topics_check import diagnose_topics
from robot.simulation.head.simulated_pokes import PokeSimulation
from robot.simulation.head.simulated_session import SimulationConfig
from tactile.pokes import PokeConfig
from tests.helpers.commands import ROOT, refused, said, start
from tests.helpers.poke_topics import poke_messages, poked_states
from tests.helpers.ros_bags import ROS2, Entry, write_bag
from tests.helpers.rounds import path_of_rounds, rounds, touched
from tests.helpers.stand_in_robot import PlainBridge, SdkBridge, ZenohRobot, in_cdr

KINDS = {
    "/odom": "nav_msgs/msg/Odometry",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/imu": "sensor_msgs/msg/Imu",
}
PATIENCE = 300.0  # beside busy programs a mapper, which stands back, gets a small share of the processors
pytestmark = pytest.mark.timeout(900)
SAME = ("trajectory.tum", "online.tum", "steps.csv", "closures.csv", "odometry.tum")


class Message(NamedTuple):
    """A message as it is sent. Attributes: time: ns."""

    time: int
    topic: str
    content: bytes


def written(entries: list[Entry]) -> list[Message]:
    return [Message(entry.time, entry.topic, in_cdr(entry)) for entry in entries]


class Player:
    """Plays messages to a bridge from a thread, at a multiple of their speed; again and again until `done`,
    if `endless`. All connections are cut before the messages of the numbers `cuts`."""

    def __init__(
        self, bridge, messages: list[Message], speed: float, endless: bool = False, cuts: Sequence[int] = ()
    ) -> None:
        self._bridge, self._messages, self._speed, self._endless = bridge, messages, speed, endless
        self._cuts = set(cuts)
        self.done = threading.Event()
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def _play(self) -> None:
        while True:
            self._play_once()
            if not self._endless or self.done.is_set():
                break
        self.done.set()

    def _play_once(self) -> None:
        began, first = time.monotonic(), self._messages[0].time
        for number, message in enumerate(self._messages):
            due = began + (message.time - first) / 1e9 / self._speed
            time.sleep(max(due - time.monotonic(), 0.0))
            if number in self._cuts:
                self._bridge.cut()
            self._bridge.send_raw(message.topic, message.content)
            if self._endless and self.done.is_set():
                return


PATIENT = "live.topics.max_wait=30", "live.budget=60"
"""Settings with which no view is dropped."""


def session(
    bridge, config: Path, folder: Path, messages: list[Message], speed: float, *more: object,
    settings: Sequence[str] = PATIENT, cuts: Sequence[int] = (),
) -> dict:  # fmt: skip
    """Runs a session while messages are played, ends it with Ctrl-C, and returns its report."""
    given = [word for setting in settings for word in ("--set", setting)]
    process = start("live", config, "-o", folder, *given, *more)
    try:
        due = time.monotonic() + PATIENCE
        while not (folder / "session.mcap").exists():
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < due
            time.sleep(0.05)
        time.sleep(0.3)
        player = Player(bridge, messages, speed, cuts=cuts)
        lasts = (messages[-1].time - messages[0].time) / 1e9 / speed
        assert player.done.wait(PATIENCE + 2 * lasts)
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=PATIENCE)
    finally:
        with process:  # closes its pipes
            process.kill()
    assert process.returncode == 130, told
    assert "Traceback" not in told
    return json.loads((folder / "live.json").read_text())


def maps_alike(folder: Path, again: Path) -> None:
    """Runs a session's own configuration again; the maps must be the same, to the bit."""
    assert main(["run", str(folder / "config.yaml"), "-o", str(again)]) == 0
    for name in SAME:
        if (folder / name).exists() or name != "closures.csv":  # of a session in a map
            assert (folder / name).read_bytes() == (again / name).read_bytes(), name
    doubts, repeated = (
        [said for said in read_manifest(run).warnings if said.startswith("live session")]
        for run in (folder, again)
    )
    assert doubts == repeated
    if json.loads((folder / "live.json").read_text())["outages"]:
        assert "the connection to the robot was lost" in " ".join(doubts)


def maps_of_file(folder: Path, config: Path, bag: Path, again: Path) -> None:
    """Runs the configuration of a session on the bag that was played; its first steps, but for those whose
    odometry was missing at the end, must be those of the session, to the bit."""
    settings = ["live=null", f"recording.file={bag}", "session.reserve=8208"]
    given = [word for setting in settings for word in ("--set", setting)]
    assert main(["run", str(config), "-o", str(again), *given]) == 0
    for name in ("online.tum", "steps.csv"):
        mapped, whole = ((run / name).read_bytes() for run in (folder, again))
        assert whole.startswith(mapped[: mapped.rfind(b"\n", 0, -1)]), name


@pytest.mark.parametrize(
    ("count", "speed"),
    [(1.3, 10.0), pytest.param(2.0, 1.0, marks=pytest.mark.soak)],
    ids=["fast", "real_time"],
)
def test_the_map_of_a_session_is_that_of_the_file_and_of_its_recording(
    count, speed, loopback, tmp_path, capsys
):
    entries, robot = rounds(count), PlainBridge(loopback, KINDS)
    config = tmp_path / "robot.yaml"
    try:
        player = Player(robot, written(rounds(0.2)), 1.0, endless=True)
        text = said(capsys, "topics", robot.address, "-o", config, "--seconds", "2")
        assert "/scan" in text
        assert "serves as" in text
        assert f"python -m ratslam live {config}" in text
        player.done.set()
        report = session(
            robot, config, tmp_path / "live", written(entries), speed, "--set", "live.topics.publish=true"
        )
        published = {topic for topic, _, _ in robot.published}
    finally:
        robot.close()
    scans = sum(entry.topic == "/scan" for entry in entries)
    assert report["messages"] == {"/odom": len(entries) - scans, "/scan": scans}
    assert report["dropped"] == {}
    assert report["views"] >= scans - 1
    assert published == {"/ratslam/pose", "/ratslam/path", "/tf", "/diagnostics"}
    pose = next(content for topic, _, content in reversed(robot.published) if topic == "/ratslam/pose")
    ROS2.deserialize_cdr(pose, "geometry_msgs/msg/PoseWithCovarianceStamped")
    link = next(content for topic, _, content in reversed(robot.published) if topic == "/tf")
    (moved,) = ROS2.deserialize_cdr(link, "tf2_msgs/msg/TFMessage").transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("map", "odom")
    maps_alike(tmp_path / "live", tmp_path / "again")
    (tmp_path / "bag").mkdir()
    bag = write_bag(tmp_path / "bag", "mcap", entries)
    maps_of_file(tmp_path / "live", config, bag, tmp_path / "file")
    closures = (tmp_path / "again" / "closures.csv").read_text().splitlines()
    assert len(closures) > 1  # the second round is recognised


@pytest.mark.parametrize("touch", ["/ir", "/bumps"])
def test_a_create_3_is_mapped_by_what_it_touches(touch, loopback, tmp_path, capsys):
    entries = touched(rounds(1.3, every=10), touch)
    kinds = {entry.topic: entry.kind for entry in entries}
    robot, config = PlainBridge(loopback, kinds), tmp_path / "robot.yaml"
    try:
        player = Player(robot, written(entries), 1.0, endless=True)
        said(capsys, "topics", robot.address, "-o", config, "--seconds", "2")
        player.done.set()
        report = session(robot, config, tmp_path / "live", written(entries), 10.0)
    finally:
        robot.close()
    touches = sum(entry.topic == touch for entry in entries)
    assert report["messages"] == {"/odom": len(entries) - touches, touch: touches}
    assert report["views"] >= touches - 1
    maps_alike(tmp_path / "live", tmp_path / "again")
    bag = write_bag(tmp_path, "mcap", entries)
    maps_of_file(tmp_path / "live", config, bag, tmp_path / "file")
    mapped, wheels = (read_tum(tmp_path / "again" / name) for name in ("trajectory.tum", "odometry.tum"))
    truth = interpolate(*path_of_rounds(1.3), mapped[0])
    worst = 0.5 if touch == "/ir" else 1.05  # the room is alike after half a turn
    assert ate(mapped[1], truth) <= worst * ate(wheels[1], truth)


def configured(folder: Path, address: str) -> Path:
    """The configuration of a session of `rounds`."""
    config = folder / "robot.yaml"
    config.write_text(
        f"live: {{topics: {{source: '{address}'}}}}\n"
        "recording: {topics: {odometry: /odom, views: {topic: /scan, max_range: 8.0}, samples: views}}\n"
        "pose_cells: {cells_xy: 61, cell_size: 0.62}\nrecall: {sector_fov: 6.2832}\n"
    )
    return config


@pytest.mark.soak
@pytest.mark.parametrize("bridge", [SdkBridge, ZenohRobot])
def test_a_session_goes_on_with_a_map_and_localises_in_one(bridge, loopback, tmp_path):
    messages, robot = written(rounds(1.2)), bridge(loopback, KINDS)
    config = configured(tmp_path, robot.address)
    try:
        first = session(robot, config, tmp_path / "first", messages, 20.0)
        on = session(robot, config, tmp_path / "on", messages, 20.0, "--continue", tmp_path / "first")
        there = session(robot, config, tmp_path / "there", messages, 20.0, "--localise", tmp_path / "first")
    finally:
        robot.close()
    assert first["views"] == on["views"] == there["views"]
    again = ["run", str(tmp_path / "on" / "config.yaml"), "-o", str(tmp_path / "again")]
    assert main([*again, "--continue", str(tmp_path / "first")]) == 0
    for name in SAME:
        assert (tmp_path / "on" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    steps = (tmp_path / "there" / "steps.csv").read_text().splitlines()
    assert len(steps) == there["views"] + 1


def test_a_session_in_a_map_says_where_it_was_and_what_ended_it(loopback, tmp_path, capsys):
    """It is refused with views made otherwise than those of the map, which is one of a bag."""
    entries, robot = rounds(1.2), PlainBridge(loopback, KINDS)
    config, bag = configured(tmp_path, robot.address), write_bag(tmp_path, "mcap", entries)
    made = ["--set", "live=null", "--set", f"recording.file={bag}"]
    assert main(["run", str(config), "-o", str(tmp_path / "map"), *made]) == 0
    session = ["live", config, "--localise", tmp_path / "map", "-o", tmp_path / "live"]
    brief = ["--set", "live.topics.patience=4", *(f"--set={each}" for each in PATIENT)]
    try:
        player = Player(robot, written(rounds(0.2)), 1.0, endless=True)
        other = refused(capsys, *session, "--set", "recording.topics.views.max_range=4")
        player.done.set()
        assert "recording.topics.views.max_range is 4.0 and was 8.0 when the map was made" in other
        assert not (tmp_path / "live").exists()
        process = start(*session, *brief)
        while not (tmp_path / "live" / "session.mcap").exists():
            assert process.poll() is None, process.communicate()
            time.sleep(0.05)
        Player(robot, written(entries), 10.0).done.wait(PATIENCE)
        printed, told = process.communicate(timeout=PATIENCE)
    finally:
        robot.close()
    assert process.returncode == 2, told
    assert "topic_silent: " in told
    assert re.search(r"^found after \d+ of \d+ steps, known in \d+ of them", printed, re.MULTILINE)
    warnings = read_manifest(tmp_path / "live").warnings
    assert any("live session: a fault ended it (1 x, first: topic_silent: " in said for said in warnings)
    maps_alike(tmp_path / "live", tmp_path / "again")


@pytest.mark.soak
@pytest.mark.timeout(900)
@pytest.mark.parametrize("number", range(20))
def test_any_session_is_that_of_its_recording(number, loopback, tmp_path):
    """At several speeds, beside busy processes, over connections that are cut; at the usual settings, so that
    views are dropped."""
    random = np.random.default_rng(number)
    speed, busy, cuts = (5.0, 1.0, 20.0, 10.0)[number % 4], number % 3, (0, 20, 5)[number // 2 % 3]
    messages, robot = written(rounds(1.3 if speed > 1 else 0.5)), PlainBridge(loopback, KINDS)
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(busy)]
    try:
        config, moments = configured(tmp_path, robot.address), random.integers(1, len(messages), cuts)
        report = session(
            robot, config, tmp_path / "live", messages, speed, settings=(), cuts=moments.tolist()
        )
    finally:
        robot.close()
        for loop in loops:
            loop.kill()
            loop.wait()
    words = [speed, busy, cuts, report["views"], report["dropped"], report["outages"], report["pieces"]]
    print("speed, busy, cuts, views, dropped, outages, pieces:", *words)
    assert report["views"] > 20
    maps_alike(tmp_path / "live", tmp_path / "again")


OTHERS = os.environ.get("RATSLAM_BAGS", "")
BAGS = ["turtlebot4_first_floor", *filter(None, OTHERS.split(os.pathsep))]


@pytest.mark.soak
@pytest.mark.timeout(900)
@pytest.mark.parametrize("number", range(10))
@pytest.mark.parametrize("name", BAGS)
def test_a_bag_that_is_played_gives_the_map_of_the_file(
    name, number, reference_data, loopback, tmp_path, capsys
):
    """In real time; on a machine that does nothing else, because a dropped view is another map."""
    bag = reference_data / "bags" / name
    with AnyReader([bag], default_typestore=ROS2) as reader:
        connections = [each for each in reader.connections if each.msgtype in ROS2.fielddefs]
        kinds = {each.topic: each.msgtype for each in connections}
        messages = [Message(at, each.topic, bytes(raw)) for each, at, raw in reader.messages(connections)]
    robot, config = PlainBridge(loopback, kinds), tmp_path / "robot.yaml"
    try:
        player = Player(robot, messages, 1.0, endless=True)
        said(capsys, "topics", robot.address, "-o", config, "--seconds", "4")
        player.done.set()
        report = session(robot, config, tmp_path / "live", messages, 1.0, settings=())
    finally:
        robot.close()
    print(report["views"], report["dropped"], report["latency_s"], config.read_text())
    maps_alike(tmp_path / "live", tmp_path / "again")
    assert "mapper late" not in report["dropped"]
    assert report["dropped"].get("odometry late", 0) <= 1  # the last: the odometry of the bag ends before it
    maps_of_file(tmp_path / "live", config, bag, tmp_path / "file")


MINUTES = os.environ.get("RATSLAM_TOPICS_MINUTES", "10")
PLAYS = """
import sys, time
import numpy as np
from tests.helpers.ros_bags import Entry, header
from tests.helpers.stand_in_robot import SdkBridge
from tests.helpers.rounds import rounds
from tests.ratslam.live.test_topics_session import KINDS
host, minutes = sys.argv[1], float(sys.argv[2])
picture = "sensor_msgs/msg/CompressedImage"
robot = SdkBridge(host, KINDS | {"/camera": picture})
entries = rounds(4 + 2 * minutes)
jpeg = np.random.default_rng(0).integers(0, 255, 50_000, np.uint8)
last = entries[0].time
content = {"header": header(last), "format": "jpeg", "data": jpeg}
beside = [Entry("/camera", picture, last + k * 33_333_333, content) for k in range(int(minutes * 1800))]
print(robot.address, flush=True)
sys.stdin.readline()
played = [entry for entry in entries if entry.time - last < minutes * 60e9]
began, count = time.time(), {"/odom": 0, "/scan": 0}
for entry in sorted([*played, *beside], key=lambda entry: entry.time):
    now = began + (entry.time - last) / 1e9
    time.sleep(max(now - time.time(), 0.0))
    robot.send(entry)
    if entry.topic in count:
        count[entry.topic] += 1
print(count["/odom"], count["/scan"], flush=True)
sys.stdin.readline()
robot.close()
"""


@pytest.mark.soak
@pytest.mark.timeout(1500)
def test_ten_minutes_lose_no_message_and_wait_for_none(loopback, tmp_path):
    """Odometry at 50 Hz, scans at 10, and pictures beside them at 30, which nobody asked for."""
    command = [sys.executable, "-c", PLAYS, loopback, MINUTES]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=ROOT, **pipes) as robot:
        config = configured(tmp_path, robot.stdout.readline().strip())
        process, told = start("live", config, "-o", tmp_path / "live"), list[str]()
        # Ten minutes of progress are more than a pipe holds: who does not read them stops the session.
        reader = threading.Thread(target=lambda: told.extend(process.stderr), daemon=True)
        reader.start()
        while not (tmp_path / "live" / "session.mcap").exists():
            assert process.poll() is None, told
            time.sleep(0.05)
        time.sleep(0.5)
        robot.stdin.write("\n")
        robot.stdin.flush()
        sent = [int(word) for word in robot.stdout.readline().split()]
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        with process:  # closes its pipes
            process.wait(timeout=PATIENCE)
            reader.join()
        robot.stdin.write("\n")
        robot.stdin.flush()
    assert process.returncode == 130, told
    report = json.loads((tmp_path / "live" / "live.json").read_text())
    print(report)
    assert report["messages"] == dict(zip(("/odom", "/scan"), sent, strict=True))
    assert sum(report["dropped"].values()) < 0.01 * sent[1]
    assert report["latency_s"]["p50"] < 0.005
    assert report["latency_s"]["p99"] < 0.03
    assert report["cpu"] < 0.05


def test_what_cannot_be_mapped_is_refused_before_a_session(loopback, tmp_path, capsys):
    robot, config = PlainBridge(loopback, KINDS), tmp_path / "robot.yaml"
    other = robot.address.rsplit(":", 1)[0] + ":9"
    assert "no connection" in refused(capsys, "topics", other, "-o", config)
    assert not config.exists()
    live = f"live: {{topics: {{source: '{robot.address}'}}}}\n"
    cases = {
        "recording.topics: missing": live,
        "no topic '/odo'; expected it among '/imu', '/odom', '/scan'; did you mean '/odom'?": live
        + "recording: {topics: {odometry: /odo, views: /scan, samples: views}}\n",
        "messages of type sensor_msgs/msg/Imu": live
        + "recording: {topics: {odometry: /odom, views: /imu, samples: views}}\n",
        "--set recording.topics.samples=views": live
        + "recording: {topics: {odometry: /odom, views: /scan}}\n",
        "topics and create": "live: {create: {}, topics: {source: 'ws://x:1'}}\n",
        "recording.file is missing": "recording: {topics: {odometry: /odom}}\n",
    }
    try:
        for expected, text in cases.items():
            config.write_text(text)
            assert expected in refused(capsys, "live", config, "-o", tmp_path / "run"), text
            assert not (tmp_path / "run").exists()
        config.write_text(live + "recording: {topics: {odometry: /odom, views: /scan, samples: views}}\n")
        assert "a live session" in refused(capsys, "run", config, "-o", tmp_path / "run")
        player = Player(robot, written(rounds(0.2)), 1.0, endless=True)
        assert "can start" in said(capsys, "doctor", "--live", config)
        player.done.set()
    finally:
        robot.close()


def test_the_wrench_of_a_tool_is_proposed_before_a_ring_is_whole(loopback):
    simulation = PokeSimulation(SimulationConfig(touch="force", path={"circuits": "C"}), PokeConfig())
    pose, _, felt = poked_states(simulation, rings=1)
    entries = poke_messages(pose, felt)
    robot = SdkBridge(loopback, {entry.topic: entry.kind for entry in entries})
    over = threading.Event()

    def talk():
        for first in range(0, len(entries), 20):
            if over.wait(0.1):
                return
            robot.send(*entries[first : first + 20])

    talker = threading.Thread(target=talk)
    talker.start()
    try:
        found = diagnose_topics(robot.address, 2.0)
    finally:
        over.set()
        talker.join()
        robot.close()
    assert found.faults == ()
    assert any("no ring of pokes within 2 s" in note for note in found.notes)
    assert found.config["recording"]["topics"] == {
        "odometry": "/tool_pose", "wrench": "/ft", "samples": "views",
    }  # fmt: skip
    assert ("/ft", "pokes (wrench)") in [(row[0], row[-1]) for row in found.table]
