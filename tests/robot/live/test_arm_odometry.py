"""Odometry of the arm: poses between states, motions between whisks, added errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.live.live_config import LiveConfig
from robot.live.live_rig import ArmOdometry
from robot.simulation.head.odometry_errors import OdometryConfig
from tactile.base.se2 import compose, integrate

HZ = 125.0


def arc(config: LiveConfig, seconds: float, speed: float, turn: float) -> tuple[np.ndarray, ...]:
    """Time [N], poses in the map [N, 3], tool poses and their rates [N, 6] of an arm on an arc."""
    time = np.arange(round(seconds * HZ)) / HZ
    heading = 0.3 + turn * time
    step = np.stack([np.cos(heading), np.sin(heading)], axis=1) * speed / HZ
    place = np.array([0.2, 0.4]) + np.concatenate([np.zeros((1, 2)), np.cumsum(step[:-1], axis=0)])
    pose = np.column_stack([place, heading])
    tcp = config.arm.placing.tcp_from_pose(pose)
    rate = np.zeros((len(time), 6))
    rate[:, :3] = np.gradient(tcp[:, :3], 1 / HZ, axis=0)
    rate[:, 5] = turn
    return time, pose, tcp, rate


def odometer(config: LiveConfig, *motion: float) -> tuple[ArmOdometry, np.ndarray, np.ndarray]:
    """An odometer with the states of an arc, and the arc's times and poses."""
    time, pose, tcp, rate = arc(config, *motion)
    arm = ArmOdometry(config)
    arm.add(100.0 + time, tcp, rate)
    return arm, 100.0 + time, pose


@given(
    st.floats(-0.9, 0.9),
    st.floats(-175, 175),
    st.floats(0.0, 0.25),
    st.floats(-0.8, 0.8),
    st.floats(0.01, 2.9),
)
def test_poses_are_in_the_map_frame_for_any_base_transform(x, yaw, speed, turn, when):
    config = LiveConfig.model_validate({"arm": {"placing": {"x": x, "yaw_deg": yaw}}})
    arm, time, pose = odometer(config, 3.0, speed, turn)
    k = int(np.searchsorted(time, 100.0 + when))
    share = (100.0 + when - time[k - 1]) * HZ
    expected = pose[k - 1] + share * (pose[k] - pose[k - 1])
    assert np.allclose(arm.pose(100.0 + when), expected, atol=1e-9)


@pytest.mark.parametrize("kind", ["pose", "velocity"])
@pytest.mark.parametrize(("speed", "turn"), [(0.05, 0.0), (0.0, 0.4), (0.04, -0.3)])
def test_motions_sum_up_to_the_path(kind, speed, turn):
    arm, _, pose = odometer(LiveConfig(odometry=kind), 9.0, speed, turn)
    motions, truth = zip(*(arm.step(k, 100.0 + k) for k in range(9)), strict=True)
    moves = np.array([[m.dx, m.dy, m.dtheta] for m in motions], float)
    assert not moves[0].any()
    assert np.allclose([m.dt for m in motions[1:]], 1.0)
    reckoned = compose(truth[0], integrate(moves[1:], np.zeros(3)))
    # Velocities are means over a whisk, integrated along the middle heading.
    assert np.allclose(reckoned[-1, :2], truth[-1][:2], atol=1e-9 if kind == "pose" else 3e-3)
    assert np.allclose(truth[-1], compose(np.zeros(3), pose[8 * int(HZ)]), atol=1e-9)


def test_errors_do_not_depend_on_later_whisks():
    noisy = LiveConfig(noise=OdometryConfig(noise="white"), seed=4)
    short, *_ = odometer(noisy, 9.0, 0.05, 0.1)
    long, *_ = odometer(noisy, 9.0, 0.05, 0.1)
    other, *_ = odometer(noisy.model_copy(update={"seed": 5}), 9.0, 0.05, 0.1)
    exact, *_ = odometer(LiveConfig(), 9.0, 0.05, 0.1)
    times = [(float(k), 100.0 + k) for k in range(8)]
    first = [short.step(*t)[0] for t in times[:4]]
    assert first == [long.step(*t)[0] for t in times][:4]
    assert first != [other.step(*t)[0] for t in times][:4]
    without = [exact.step(*t)[0] for t in times[:4]]
    assert all(a.dx != b.dx and a.dy == b.dy for a, b in zip(first[1:], without[1:], strict=True))


def test_old_states_are_dropped():
    arm, *_ = odometer(LiveConfig(), 9.0, 0.05, 0.0)
    time, _, tcp, rate = arc(LiveConfig(), 20.0, 0.05, 0.0)
    arm.add(200.0 + time, tcp, rate)
    assert np.allclose(arm.pose(0.0), arm.pose(200.0 + time[-1] - 10.0))  # the oldest is as old as that
    assert not np.allclose(arm.pose(0.0), arm.pose(200.0 + time[-1] - 9.9))
