"""The stream of poses: what it tells, and that it comes back by itself."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Iterator

import numpy as np
import pytest

from robot.drivers.ur10.pose_listener import PoseListener
from tests.helpers.live import Faults, until, ur_emulator

START = (0.6, 0.0, 0.3, math.pi, 0.0, 0.0)


@pytest.fixture(scope="module")
def faults(loopback: str) -> Iterator[Faults]:
    with ur_emulator(loopback, START) as faults:
        yield faults


def test_it_tells_the_pose_the_speed_and_when(faults: Faults) -> None:
    with PoseListener(faults.host) as poses:
        _, tcp, speed = until(poses.latest, 2.0)
        np.testing.assert_allclose(tcp, START)
        assert not speed.any()
        with socket.create_connection((faults.host, 30003)) as script:
            script.sendall(b"movel(p[0.6,0.02,0.3,3.141592653589793,0,0],a=1,v=0.02)\n")
            until(lambda: poses.latest()[2][1] == pytest.approx(0.02), 2.0)
            first = poses.newest()
            time.sleep(0.3)
            then = poses.newest()
            assert first is not None
            assert then is not None
            steps = (then.robot_time - first.robot_time) / 0.008
            assert steps == pytest.approx(round(steps), abs=1e-6)
            assert then.tcp[1] - first.tcp[1] == pytest.approx(0.02 * (then.robot_time - first.robot_time))
            until(lambda: poses.latest()[1][1] == pytest.approx(0.02), 3.0)
        assert time.monotonic() - poses.latest()[0] < 0.5


@pytest.mark.parametrize("fault", ["close", "malformed"])
def test_it_comes_back_after_what_ends_a_connection(faults: Faults, fault: str) -> None:
    with PoseListener(faults.host, patience=0.3) as poses:
        before = until(poses.newest, 2.0)
        faults(do=fault)
        until(lambda: poses.newest().robot_time > before.robot_time + 0.1, 3.0)


def test_a_stall_is_no_new_pose_and_then_there_are_some(faults: Faults) -> None:
    with PoseListener(faults.host, patience=0.3) as poses:
        until(poses.latest, 2.0)
        faults(do="stall", seconds=0.6)
        time.sleep(0.1)
        stood = poses.newest()
        time.sleep(0.2)
        assert poses.newest() is stood
        until(lambda: poses.newest() is not stood, 3.0)


def test_nobody_there_is_no_pose_and_closing_is_quick() -> None:
    poses = PoseListener("127.0.0.1", port=1, patience=0.2)
    time.sleep(0.1)
    assert poses.latest() is None
    began = time.monotonic()
    poses.close()
    assert time.monotonic() - began < 2.0
