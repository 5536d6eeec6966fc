"""Whiskers of an emulated head agree with the simulator, along a path and on an arm."""

from __future__ import annotations

import numpy as np
import pytest

from robot.drivers.head.usb_protocol import (
    ANGLE,
    COMMAND_TIMEOUT,
    Command,
    CommandKind,
    FeedbackMode,
    FrameFlag,
    frame_values,
    to_counts,
    to_radians,
)
from robot.drivers.ur10.driver_config import BaseTransformConfig
from robot.drivers.ur10.rtde_protocol import ToolPose
from robot.emulators.head.emulator_config import HeadEmulatorConfig
from robot.emulators.head.whiskers import AHEAD, BLOCK, AlongPath, CarriedByArm
from robot.simulation.head.baseline import HALL_BASELINE, BaselineConfig, make_baseline
from robot.simulation.head.kinematic import HeadSetup
from robot.simulation.head.whisk_stream import simulate_cycles, simulate_quasistatic
from robot.world.scene import HeadPath
from robot.world.walls import Surroundings
from tactile.base.random_streams import stream
from tactile.whisker_geometry import HeadConfig
from tactile.whisking import WhiskingConfig
from tests.robot.emulators.head.heads import TABLE, HostedHead, drive, world

PLACING = BaseTransformConfig(x=-0.4, y=0.3, z=0.12, yaw_deg=30.0)
ODD = 2100.0
"""A rate without a sample in the middle of a block, where the nearest wall changes and would depend on the
last bit of the time."""


class Arm:
    """An arm with the state that the test sets."""

    def __init__(self) -> None:
        self.state: ToolPose | None = None

    def latest(self) -> ToolPose | None:
        return self.state

    def put(self, time: float, pose: list[float], lift: float = 0.0) -> None:
        self.state = ToolPose(time, PLACING.tcp_from_pose(np.array(pose), lift), np.zeros(6), time)


@pytest.mark.parametrize("mode", [FeedbackMode.OPEN, FeedbackMode.RCP])
@pytest.mark.parametrize(("frequency", "baseline"), [(1.0, HALL_BASELINE), (2.0, BaselineConfig())])
def test_samples_along_a_path_agree_with_the_simulator(
    mode: FeedbackMode, frequency: float, baseline: BaselineConfig
) -> None:
    config = HeadEmulatorConfig(
        follow=True,
        path={"explore": 9},
        seed=3,
        stream={"rate": ODD},
        head={"dead": (4,)},
        mechanics={"baseline": baseline},
    )
    scene = world(config)
    head = HostedHead(config, scene.surroundings.walls, AlongPath(scene.path))
    command = drive(mode, frequency=frequency)
    head.start()
    head.send(command)
    frames = head.pass_by(3.0)
    samples = round(ODD / frequency)
    assert np.flatnonzero(frames.flags & FrameFlag.CYCLE).tolist() == list(
        range(0, len(frames.values), samples)
    )

    whisking = WhiskingConfig(mode=mode.name.lower(), rate=frequency, gain=command.gain)
    start = np.arange(3 * frequency) / frequency
    knots = {"batch": 1, "poses": samples // head.bridge.samples}
    settings = config.stream.model_copy(update=knots)
    raw = simulate_cycles(
        simulate_quasistatic,
        HeadSetup(scene.surroundings.head, settings, config.mechanics, whisking),
        scene.surroundings,
        scene.path,
        start,
        stream(config.seed, "sensor"),
        command.numbers * ANGLE,
        make_baseline(baseline, config.mechanics.noise, ODD, 18, config.seed),
    )
    expected = np.concatenate([frame_values(cycle.angle, cycle.deflection) for cycle in raw])
    off = np.abs(expected.astype(int) - frames.values)
    assert np.abs(expected[..., 2] * ANGLE).max() > 0.05
    assert off.max() <= 1
    assert (off == 0).mean() > 0.999
    assert (frames.flags & FrameFlag.RCP).any() == (mode == FeedbackMode.RCP)


def test_a_whisk_may_end_within_a_block() -> None:
    head = HostedHead()
    head.start()
    head.send(drive(FeedbackMode.OPEN, frequency=1.3))
    frames = head.pass_by(3.0)
    samples = round(2000 / 1.3)
    assert samples % head.bridge.samples
    assert np.flatnonzero(frames.flags & FrameFlag.CYCLE).tolist() == list(range(0, 6000, samples))
    angle = to_radians(frames.values)[0]
    assert (angle[samples - 2 : samples + 2] < 0.02).all()


@pytest.mark.parametrize("lift", [0.0, 0.02, -0.004])
def test_samples_of_a_carried_head_agree_with_a_fixed_one(lift: float) -> None:
    """A lift has the effect of walls lower by that lift."""
    config = HeadEmulatorConfig(path={"explore": 9}, mechanics={"noise": 0.0})
    walls = world(config).surroundings.walls
    pose = np.array([0.63, 0.45, 2.0])
    arm = Arm()
    arm.put(0.0, pose.tolist(), lift)
    lower = walls._replace(height=walls.height - lift)
    stays = AlongPath(HeadPath(np.zeros(1), pose[None]))
    found = []
    for head in (HostedHead(config, walls, CarriedByArm(arm, PLACING)), HostedHead(config, lower, stays)):
        head.start()
        head.send(drive())
        found.append(head.pass_by(1.0).values.astype(int))
    assert np.abs(found[0] - found[1]).max() <= 1
    expected = Surroundings(lower, head.whiskers.head).contact(pose[None]).angle[0] < np.radians(60)
    assert expected.any() == ((found[0][..., 2] * ANGLE).max() > 0.05)


def test_no_contact_when_lifted_or_before_the_first_arm_state() -> None:
    arm = Arm()
    head = HostedHead(HeadEmulatorConfig(mechanics={"noise": 0.0}), TABLE, CarriedByArm(arm, PLACING))
    head.start()
    head.send(drive())
    assert not to_radians(head.pass_by(1.0).values)[1].any()
    arm.put(head.now, [0.0, 0.0, 0.0])
    assert to_radians(head.pass_by(1.0).values)[1].max() > 0.05
    arm.put(head.now, [0.0, 0.0, 0.0], 0.2)
    assert not to_radians(head.pass_by(1.0).values)[1][50:].any()
    assert head.do("state")["lift"] == pytest.approx(0.2)


def test_poses_between_arm_states_are_extrapolated() -> None:
    arm, home = Arm(), np.array([0.5, 0.4, 3.1])
    place = CarriedByArm(arm, PLACING)
    tcp = PLACING.tcp_from_pose(home)
    arm.state = ToolPose(10.0, tcp, np.array([0.03, -0.01, 0.02, 0.0, 0.0, 0.4]), 10.0)
    rows = [place.at(10.0 + ahead) for ahead in (0.0, 0.02, 0.05, AHEAD, 5.0)]
    poses, lifts = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    np.testing.assert_allclose(poses[0], home, atol=1e-9)
    times = np.array([0.0, 0.02, 0.05, AHEAD, AHEAD])
    np.testing.assert_allclose(np.hypot(*(poses - home)[:, :2].T), np.hypot(0.03, 0.01) * times, atol=1e-9)
    np.testing.assert_allclose((poses - home)[:, 2], 0.4 * times, atol=1e-9)
    np.testing.assert_allclose(lifts, 0.02 * times, atol=1e-9)


def test_whiskers_retract_without_commands() -> None:
    head = HostedHead(HeadEmulatorConfig(mechanics={"noise": 0.0}))
    head.start()
    head.send(drive(FeedbackMode.OPEN))
    assert to_radians(head.pass_by(0.4).values)[0].max() > 0.5
    frames = head.pass_by(2.0, awake=False)
    angle = to_radians(frames.values)[0]
    assert len(angle) == 4000  # the stream continues
    silent = round(COMMAND_TIMEOUT * 2000)
    assert (angle[silent - 100] > 0.2).all()
    assert (angle[silent + 500 :] == 0).all()
    assert (np.diff(angle[silent + 60 : silent + 500], axis=0) <= 1e-9).all()
    assert not (frames.flags[silent + 20 :] & FrameFlag.CYCLE).any()
    assert not to_radians(head.pass_by(1.0).values)[0].any()  # keep-alives do not start a whisk
    head.send(drive(FeedbackMode.OPEN))
    assert to_radians(head.pass_by(1.0).values)[0].max() > 0.5


def test_a_new_drive_command_starts_with_the_next_cycle() -> None:
    head = HostedHead(HeadEmulatorConfig(mechanics={"noise": 0.0}))
    head.start()
    head.send(drive(FeedbackMode.OPEN))
    head.pass_by(0.3)
    head.send(drive(FeedbackMode.OPEN, frequency=2.0, amplitude=0.3, offset=0.2))
    frames = head.pass_by(1.7)
    begins = np.flatnonzero(frames.flags & FrameFlag.CYCLE)
    assert begins.tolist() == [1400, 2400]
    angle = to_radians(frames.values)[0]
    assert angle[:1400].max() > 0.8
    assert angle[1400:].max() == pytest.approx(0.5, abs=0.01)
    assert angle[1400:].min() == pytest.approx(0.2, abs=1e-3)


def test_amplitudes_from_the_host_last_one_cycle() -> None:
    head = HostedHead(HeadEmulatorConfig(mechanics={"noise": 0.0}), TABLE._replace(height=np.array([0.0])))
    head.start()
    head.send(drive(FeedbackMode.OPEN))
    head.pass_by(0.1)
    lower = np.linspace(0.1, 0.9, 18)
    head.send(Command(CommandKind.AMPLITUDES, numbers=to_counts(lower)))
    angle = to_radians(head.pass_by(1.9).values)[0]
    np.testing.assert_allclose(angle[:1800].max(axis=0), lower, atol=1e-3)
    np.testing.assert_allclose(angle[1800:].max(axis=0), np.radians(65), atol=1e-3)


def test_feedback_is_relative_to_the_centre() -> None:
    most = []
    for centre in (0.0, 0.3):
        head = HostedHead(HeadEmulatorConfig(mechanics={"noise": 0.0, "slip": 1.0}))
        head.start()
        head.send(Command(CommandKind.CENTRE, numbers=to_counts(np.full(18, centre))))
        head.send(drive())
        most.append(to_radians(head.pass_by(1.0).values)[1].max())
    assert most[1] < 0.7 * most[0]  # counts as contact from the start


@pytest.mark.parametrize(
    "bad",
    [
        {"frequency": 0.0},
        {"frequency": -1.0},
        {"frequency": 1e6},
        {"amplitude": -0.1},
        {"gain": -1.0},
        {"window": 0.0},
    ],
)
def test_invalid_drive_commands_are_ignored(bad: dict[str, float]) -> None:
    head = HostedHead()
    head.start()
    head.send(drive(**bad))
    assert np.abs(to_radians(head.pass_by(0.5).values)[0]).max() < 0.02


def test_drives_stop_at_their_limit() -> None:
    head = HostedHead(HeadEmulatorConfig(head=HeadConfig(limit_deg=50.0), mechanics={"noise": 0.0}))
    head.start()
    head.send(drive(FeedbackMode.OPEN, offset=0.3))
    angle = to_radians(head.pass_by(1.0).values)[0]
    assert angle.max() <= np.radians(50) + ANGLE


def test_no_samples_are_computed_without_a_stream() -> None:
    """A head at rest computes nothing, and its noise starts with the first frame."""
    quick, late = HostedHead(), HostedHead()
    late.pass_by(3 * BLOCK)
    for head in (quick, late):
        head.start()
    assert np.array_equal(quick.pass_by(0.1).values, late.pass_by(0.1).values)
