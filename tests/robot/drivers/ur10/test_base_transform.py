"""Transform between map and arm base: round trip, tool pointing down, rigid motion."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.ur10.driver_config import BaseTransformConfig, tcp_heading, tcp_tilt
from tactile.base.se2 import between, wrap

metres = st.floats(-2, 2)
angles = st.one_of(st.floats(-10, 10), st.sampled_from([0.0, np.pi, -np.pi, np.pi / 2, np.pi - 1e-9, 1e-9]))
poses = st.tuples(metres, metres, angles).map(np.array)
placings = st.builds(BaseTransformConfig, x=metres, y=metres, z=metres, yaw_deg=st.floats(-180, 180))


@given(placings, poses, metres)
def test_round_trip(config: BaseTransformConfig, pose: np.ndarray, lift: float) -> None:
    back, height = config.pose_from_tcp(config.tcp_from_pose(pose, lift))
    np.testing.assert_allclose(back[:2], pose[:2], atol=1e-12)
    assert abs(wrap(back[2] - pose[2])) < 1e-9
    assert -np.pi < back[2] <= np.pi
    np.testing.assert_allclose(height, lift, atol=1e-12)


@given(placings, poses)
def test_the_tool_points_down(config: BaseTransformConfig, pose: np.ndarray) -> None:
    assert tcp_tilt(config.tcp_from_pose(pose)) < 1e-6


@given(placings, poses, poses)
def test_motions_in_the_map_are_motions_of_the_tool(
    config: BaseTransformConfig, a: np.ndarray, b: np.ndarray
) -> None:
    tools = config.tcp_from_pose(np.stack([a, b]))
    seen = np.concatenate([tools[:, :2], tcp_heading(tools)[:, None]], axis=1)
    moved, meant = between(*seen), between(a, b)
    np.testing.assert_allclose(moved[:2], meant[:2], atol=1e-9)
    assert abs(wrap(moved[2] - meant[2])) < 1e-9


def test_the_rotation_is_rz_times_rx_pi() -> None:
    from scipy.spatial.transform import Rotation

    for heading in np.linspace(-3, 3, 13):
        tool = BaseTransformConfig(yaw_deg=0.0).tcp_from_pose(np.array([0.1, 0.2, heading]))
        meant = Rotation.from_euler("z", heading) * Rotation.from_euler("x", np.pi)
        np.testing.assert_allclose(Rotation.from_rotvec(tool[3:]).as_matrix(), meant.as_matrix(), atol=1e-12)


def test_tilt() -> None:
    from scipy.spatial.transform import Rotation

    for lean in (0.0, 0.1, 1.0, 3.0):
        turn = Rotation.from_euler("ZX", [0.7, np.pi + lean])
        assert abs(tcp_tilt(np.array([0, 0, 0, *turn.as_rotvec()])) - lean) < 1e-6
        assert abs(wrap(tcp_heading(np.array([0, 0, 0, *turn.as_rotvec()])) - 0.7)) < 1e-9


def test_shapes() -> None:
    tools = BaseTransformConfig().tcp_from_pose(np.zeros((4, 5, 3)), np.zeros((4, 5)))
    pose, lift = BaseTransformConfig().pose_from_tcp(tools)
    assert tools.shape == (4, 5, 6)
    assert pose.shape == (4, 5, 3)
    assert lift.shape == (4, 5)
