"""The route: each target is sent after arrival at the previous one."""

from __future__ import annotations

import numpy as np
import pytest

from robot.live.arm_route import arm_routes, plan_path
from robot.live.live_config import LiveConfig
from robot.world.scene import make_scene, poses_at
from tactile.base.errors import InputError
from tactile.whisker_geometry import HeadConfig, ur10_head

HEAD = ur10_head(HeadConfig())


class StubArm:
    """An arm that reports arrival when the test sets it."""

    def __init__(self) -> None:
        self.sent: list[np.ndarray] = []
        self.there = False

    def move(self, tcp, speed=None):
        self.sent.append(tcp)
        self.speed, self.there = speed, False

    def arrived(self):
        return self.there


def test_each_target_is_sent_once_after_arrival_at_the_last():
    config = LiveConfig(waypoints=((0.1, 0.1, 0.0), (0.2, 0.1, 0.0), (0.2, 0.1, 90.0)))
    route, arm = arm_routes(config, plan_path(config, HEAD))[2], StubArm()
    assert [route.advance(arm) for _ in range(3)] == [False] * 3
    assert len(arm.sent) == 1
    arm.there = True
    assert not route.advance(arm)
    assert not route.advance(arm)
    assert len(arm.sent) == 2
    arm.there = True
    assert route.advance(arm)
    assert route.advance(arm)
    assert len(arm.sent) == 2
    assert np.array_equal(arm.sent, route.targets)


def test_the_target_of_a_stopped_arm_is_sent_again():
    config = LiveConfig(waypoints=((0.1, 0.1, 0.0), (0.2, 0.1, 0.0)))
    route, arm = arm_routes(config, plan_path(config, HEAD))[2], StubArm()
    route.resend_last()
    route.advance(arm)
    route.resend_last()
    assert not route.advance(arm)
    assert len(arm.sent) == 2
    assert np.array_equal(arm.sent[0], arm.sent[1])


def test_the_path_is_that_of_the_simulated_session():
    config = LiveConfig()
    plan, path = config.plan, plan_path(config, HEAD)
    scene = make_scene(plan.maze, plan.path, plan.motion, plan.kidnaps, HEAD, plan.seed)
    assert np.array_equal(path.pose, poses_at(scene.path, path.time))
    pose, lift = config.arm.placing.pose_from_tcp(arm_routes(config, path)[2].targets)
    assert np.allclose(pose[:, :2], path.pose[1:, :2])
    assert np.allclose(np.cos(pose[:, 2] - path.pose[1:, 2]), 1.0)
    assert np.allclose(lift, 0.0)
    for route, height in zip(arm_routes(config, path), (config.lift, 0.0), strict=False):
        pose, lift = config.arm.placing.pose_from_tcp(route.targets)
        assert np.allclose(pose[0, :2], path.pose[0, :2])
        assert np.allclose(lift, height)


def test_the_speed_is_the_lower_of_plan_and_arm():
    config = LiveConfig.model_validate({"arm": {"speed": 0.02}, "plan": {"motion": {"speed": 0.2}}})
    assert arm_routes(config, plan_path(config, HEAD))[2].speed == 0.02


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"waypoints": [[0.1, 0.1, 0.0]]}, "live.waypoints"),
        ({"plan": {"kidnaps": {"count": 2}}}, "live.plan.kidnaps"),
    ],
)
def test_invalid_paths_are_refused(settings, key):
    with pytest.raises(InputError, match=key):
        plan_path(LiveConfig.model_validate(settings), HEAD)
