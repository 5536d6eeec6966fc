"""The stream of tool poses: values and reconnection."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Iterator

import numpy as np
import pytest

from robot.drivers.ur10.rtde_protocol import PoseListener
from tests.helpers.live import Faults, until, ur_emulator

START = (0.6, 0.0, 0.3, math.pi, 0.0, 0.0)


@pytest.fixture(scope="module")
def faults(loopback: str) -> Iterator[Faults]:
    with ur_emulator(loopback, START) as faults:
        yield faults


def test_pose_speed_and_time(faults: Faults) -> None:
    with PoseListener(faults.host) as poses:
        _, tcp, speed, _ = until(poses.latest)
        np.testing.assert_allclose(tcp, START)
        assert not speed.any()
        with socket.create_connection((faults.host, 30003)) as script:
            script.sendall(b"movel(p[0.6,0.02,0.3,3.141592653589793,0,0],a=1,v=0.02)\n")
            until(lambda: poses.latest().speed[1] == pytest.approx(0.02))
            first = poses.latest()
            then = until(lambda: (new := poses.latest()) is not first and new)
            assert first is not None
            assert then is not None
            steps = (then.robot_time - first.robot_time) / 0.008
            assert steps == pytest.approx(round(steps), abs=1e-6)
            assert then.tcp[1] - first.tcp[1] == pytest.approx(0.02 * (then.robot_time - first.robot_time))
            until(lambda: poses.latest().tcp[1] == pytest.approx(0.02))
        assert poses.latest().time <= time.monotonic()


@pytest.mark.parametrize("fault", ["close", "malformed"])
def test_a_lost_connection_is_restored(faults: Faults, fault: str) -> None:
    with PoseListener(faults.host, patience=0.3) as poses:
        before = until(poses.latest)
        faults(do=fault)
        until(lambda: poses.latest().robot_time > before.robot_time + 0.1)


def test_poses_stop_during_a_stall_and_resume(faults: Faults) -> None:
    with PoseListener(faults.host, patience=30.0) as poses:
        until(poses.latest)
        faults(do="stall", seconds=600)
        time.sleep(0.3)  # states sent before the stall
        stood = poses.latest()
        time.sleep(0.2)
        assert poses.latest() is stood
        faults(do="clear")
        until(lambda: poses.latest() is not stood)


def test_without_a_controller_there_is_no_pose() -> None:
    poses = PoseListener("127.0.0.1", port=1, patience=0.2)
    time.sleep(0.1)
    assert poses.latest() is None
    poses.close()
