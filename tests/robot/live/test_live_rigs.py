"""What a live session measures: the arm's route and odometry, the work of a whisk, strain of a Create."""

import pickle
import sys
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.head.decoder import Frames
from robot.drivers.head.usb_protocol import frame_values
from robot.live.arm_route import arm_routes, plan_path
from robot.live.create_rig import StrainMonitor
from robot.live.live_config import LiveConfig
from robot.live.live_rig import ArmOdometry
from robot.simulation.head.odometry_errors import OdometryConfig
from robot.world.scene import make_scene, poses_at
from tactile.base.errors import InputError
from tactile.base.se2 import compose, integrate
from tactile.whisker_geometry import HeadConfig, ur10_head
from tests.robot.live.live_recordings import RATE, START, cut_of, open_recorder, some_frames, some_states
from tests.robot.live.live_recordings import rows as part

HEAD, HZ = ur10_head(HeadConfig()), 125


def route_of(config: LiveConfig):
    return arm_routes(config, plan_path(config, HEAD))[2]


def test_each_target_is_sent_once_after_arrival_at_the_last():
    route, arm = route_of(LiveConfig(waypoints=((0.1, 0.1, 0.0), (0.2, 0.1, 0.0), (0.2, 0.1, 90.0)))), Mock()
    route.resend_last()
    for count in (1, 2):
        assert not route.advance(arm)
        arm.arrived.return_value = False
        assert not route.advance(arm)
        assert arm.move.call_count == count
        arm.arrived.return_value = True
    assert route.advance(arm)
    assert route.advance(arm)
    sent = [call.args[0] for call in arm.move.call_args_list]
    assert np.array_equal(sent, route.targets)
    route.resend_last()
    assert not route.advance(arm)
    assert np.array_equal(arm.move.call_args.args[0], sent[-1])


def test_the_path_is_that_of_the_simulated_session():
    config = LiveConfig()
    plan, path = config.plan, plan_path(config, HEAD)
    scene = make_scene(plan.maze, plan.path, plan.motion, plan.kidnaps, HEAD, plan.seed)
    assert np.array_equal(path.pose, poses_at(scene.path, path.time))
    wanted = ((path.pose[:1], config.lift), (path.pose[:1], 0.0), (path.pose[1:], 0.0))
    for route, (expected, height) in zip(arm_routes(config, path), wanted, strict=True):
        pose, lift = config.arm.placing.pose_from_tcp(route.targets)
        assert np.allclose(pose[:, :2], expected[:, :2])
        assert np.allclose(np.cos(pose[:, 2] - expected[:, 2]), 1.0)
        assert np.allclose(lift, height)


def test_the_speed_is_the_lower_of_plan_and_arm_and_invalid_paths_are_refused():
    for arm, plan in ((0.02, 0.2), (0.2, 0.02)):
        config = {"arm": {"speed": arm}, "plan": {"motion": {"speed": plan}}}
        assert route_of(LiveConfig.model_validate(config)).speed == 0.02
    for key, settings in (
        ("live.waypoints", {"waypoints": [[0.1, 0.1, 0.0]]}),
        ("live.plan.kidnaps", {"plan": {"kidnaps": {"count": 2}}}),
    ):
        with pytest.raises(InputError, match=key):
            plan_path(LiveConfig.model_validate(settings), HEAD)


def arc(config: LiveConfig, seconds: float, speed: float, turn: float) -> tuple[np.ndarray, ...]:
    """Time [N], poses in the map [N, 3], tool poses and their rates [N, 6] of an arm on an arc."""
    time = np.arange(round(seconds * HZ)) / HZ
    heading = 0.3 + turn * time
    step = np.stack([np.cos(heading), np.sin(heading)], axis=1) * speed / HZ
    place = np.array([0.2, 0.4]) + np.concatenate([np.zeros((1, 2)), np.cumsum(step[:-1], axis=0)])
    pose = np.column_stack([place, heading])
    tcp, rate = config.arm.placing.tcp_from_pose(pose), np.zeros((len(time), 6))
    rate[:, :3] = np.gradient(tcp[:, :3], 1 / HZ, axis=0)
    rate[:, 5] = turn
    return time, pose, tcp, rate


def odometer(config: LiveConfig, *motion: float) -> tuple[ArmOdometry, np.ndarray]:
    """An odometer with the states of an arc from 100 s on, and the arc's poses."""
    time, pose, tcp, rate = arc(config, *motion)
    arm = ArmOdometry(config)
    arm.add(100.0 + time, tcp, rate)
    return arm, pose


@given(
    x=st.floats(-0.9, 0.9), yaw=st.floats(-175, 175), speed=st.floats(0.0, 0.25), turn=st.floats(-0.8, 0.8),
    when=st.floats(0.01, 2.9),
)  # fmt: skip
def test_poses_are_in_the_map_frame_for_any_base_transform(x, yaw, speed, turn, when):
    config = LiveConfig.model_validate({"arm": {"placing": {"x": x, "yaw_deg": yaw}}})
    arm, pose = odometer(config, 3.0, speed, turn)
    k, time = int(np.ceil(when * HZ)), np.arange(len(pose)) / HZ
    expected = pose[k - 1] + ((when - time[k - 1]) * HZ) * (pose[k] - pose[k - 1])
    assert np.allclose(arm.pose(100.0 + when), expected, atol=1e-9)


@pytest.mark.parametrize("kind", ["pose", "velocity"])
@pytest.mark.parametrize(("speed", "turn"), [(0.05, 0.0), (0.0, 0.4), (0.04, -0.3)])
def test_motions_sum_up_to_the_path(kind, speed, turn):
    arm, pose = odometer(LiveConfig(odometry=kind), 9.0, speed, turn)
    motions, truth = zip(*(arm.step(k, 100.0 + k) for k in range(9)), strict=True)
    moves = np.array([[m.dx, m.dy, m.dtheta] for m in motions], float)
    assert not moves[0].any()
    assert np.allclose([m.dt for m in motions[1:]], 1.0)
    reckoned = compose(truth[0], integrate(moves[1:], np.zeros(3)))
    # Velocities are means over a whisk, integrated along the middle heading.
    assert np.allclose(reckoned[-1, :2], truth[-1][:2], atol=1e-9 if kind == "pose" else 3e-3)
    assert np.allclose(truth[-1], compose(np.zeros(3), pose[8 * HZ]), atol=1e-9)


def test_errors_do_not_depend_on_later_whisks():
    noisy = LiveConfig(noise=OdometryConfig(noise="white"), seed=4)

    def steps(config: LiveConfig, count: int = 4) -> list:
        arm, _ = odometer(config, 9.0, 0.05, 0.1)
        return [arm.step(float(k), 100.0 + k)[0] for k in range(count)]

    first = steps(noisy)
    assert first == steps(noisy, 8)[:4]
    assert first != steps(noisy.model_copy(update={"seed": 5}))
    assert all(a.dx != b.dx and a.dy == b.dy for a, b in zip(first[1:], steps(LiveConfig())[1:], strict=True))


def test_old_states_are_dropped():
    arm, _ = odometer(LiveConfig(), 9.0, 0.05, 0.0)
    time, _, tcp, rate = arc(LiveConfig(), 20.0, 0.05, 0.0)
    arm.add(200.0 + time, tcp, rate)
    assert np.allclose(arm.pose(0.0), arm.pose(200.0 + time[-1] - 10.0))  # the oldest is as old as that
    assert not np.allclose(arm.pose(0.0), arm.pose(200.0 + time[-1] - 9.9))


def work_of_blocks(path, whisks: int, block: int, kind: str) -> np.ndarray:
    """Calls, bytes that the odometer keeps and bytes written, for each block of whisks [N, 3]."""
    config = LiveConfig(noise=OdometryConfig(noise="gated"), odometry=kind, seed=1)
    odometer, recorder = ArmOdometry(config), open_recorder(path)
    time, speed = np.arange(HZ) / HZ, np.full((HZ, 6), 0.02)
    states, frames = some_states(HZ), some_frames(RATE)
    events: list[str] = []

    def whisk(k: int) -> None:
        begin = START + k
        pose = np.column_stack([0.02 * np.sin(k + time), 0.02 * np.cos(k + time), 0.1 * (k + time)])
        odometer.add(begin + time, config.arm.placing.tcp_from_pose(pose), speed)
        states["host"] = begin + time
        recorder.add_states(states)
        mine = frames._replace(sequence=frames.sequence + k * RATE, time=frames.time + k * 1_000_000)
        recorder.add_frames(mine, begin + 1.0)
        odometry, truth = odometer.step(float(k), begin + 0.5)
        recorder.add_whisk(cut_of(k, mine)._replace(odometry=odometry), mine, truth)

    found = []
    with recorder:
        for first in range(0, whisks, block):
            sys.setprofile(lambda frame, event, argument: events.append(event))
            try:
                for k in range(first, first + block):
                    whisk(k)
            finally:
                sys.setprofile(None)
            calls = events.count("call") + events.count("c_call")
            events.clear()
            found.append((calls, path.stat().st_size, len(pickle.dumps(odometer))))
    work = np.array(found)
    return np.column_stack([work[1:, ::2], np.diff(work[:, 1])])


@pytest.mark.parametrize(("block", "blocks"), [(25, 8), pytest.param(1_600, 12, marks=pytest.mark.soak)])
@pytest.mark.parametrize("kind", ["pose", "velocity"])
def test_a_whisk_costs_the_same_work_late_in_a_session(tmp_path, kind, block, blocks):
    """What the odometer keeps bounds what it computes with; counted, not timed."""
    work = work_of_blocks(tmp_path / "a.mcap", blocks * block, block, kind)
    assert (work[-1] <= 1.05 * work[0]).all()


SAMPLED, PERIOD, SCALE, WHISKERS = 2000.0, 0.01, 0.01, 3
SIZE, ALL = 20, 10**6  # samples of a row; more rows than there are


def frames(first: int, count: int) -> Frames:
    """Samples from a number on, whose strain depends on the number."""
    number, angle = np.arange(first, first + count), np.zeros((count, WHISKERS))
    deflection = 0.01 * np.sin(number / 7)[:, None, None] * np.arange(1, 1 + WHISKERS * 2).reshape(1, -1, 2)
    return Frames(number, 500 * number, np.zeros(count, np.uint8), frame_values(angle, deflection))


def monitor(*blocks: Frames) -> StrainMonitor:
    made = StrainMonitor(SAMPLED, PERIOD, SCALE, WHISKERS)
    made.add(frames(0, 33))  # before the motion
    made.begin()
    for block in blocks:
        made.add(block)
    return made


@given(st.lists(st.integers(1, 50), min_size=1, max_size=12) | st.just([300 * SIZE]))
def test_rows_do_not_depend_on_the_pieces(sizes):
    places = 33 + np.cumsum([0, *sizes])
    pieces = monitor(*(frames(place, size) for place, size in zip(places, sizes, strict=False)))
    whole, count = monitor(frames(33, sum(sizes))), sum(sizes) // SIZE
    rows = pieces.rows(ALL)
    assert len(rows) == count
    assert np.allclose(rows, whole.rows(ALL), rtol=0, atol=1e-18)
    strain = whole.strain(frames(33, count * SIZE).values)
    assert np.allclose(rows, strain.reshape(count, SIZE, WHISKERS, 2).mean(axis=1), rtol=0, atol=1e-18)
    assert len(pieces.rows(2)) == min(count, 2)


def test_a_head_that_has_run_for_long_or_is_connected_again():
    late, jump = StrainMonitor(SAMPLED, PERIOD, SCALE, WHISKERS), 10**9 + 2**32
    late.begin()
    late.add(frames(10**9, SIZE))
    assert len(late.rows(9)) == 1
    late.restart()
    assert len(late.rows(9)) == 0
    late.add(frames(jump, 3 * SIZE))
    late.begin()
    late.add(frames(jump + 3 * SIZE, 2 * SIZE))
    assert (len(late.rows(9)), late.first) == (2, jump + 3 * SIZE)


def test_the_strain_at_rest_is_subtracted_and_a_row_of_lost_samples_repeats_the_one_before():
    block = frames(33, 4 * SIZE)
    number = block.sequence - 33
    cut, whole = monitor(), monitor(block)
    rest = cut.rest = np.arange(2 * WHISKERS).reshape(WHISKERS, 2) * 1e-4
    cut.add(part(block, (number < SIZE) | (number >= 2 * SIZE)))
    assert np.allclose(cut.rows(4), whole.rows(4)[[0, 0, 2, 3]] - rest, rtol=0, atol=1e-15)


def test_lost_samples_of_a_series_are_interpolated_up_to_a_gap():
    block = frames(33, 2 * SIZE)
    made = monitor(block)
    whole = made.series(block, 2, gap=5)
    assert whole.shape == (2 * SIZE, WHISKERS, 2)
    kept = np.ones(2 * SIZE, bool)
    kept[[7, 8, 20]] = False
    filled = made.series(part(block, kept), 2, gap=5)
    assert np.array_equal(filled[kept], whole[kept])
    assert np.abs(filled - whole).max() < 0.02 * np.abs(whole).max()
    kept[9:12] = False
    assert len(made.series(part(block, kept), 2, gap=5)) == 0
