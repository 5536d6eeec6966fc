"""Emulated heads: all frames are counted, faults have their effect, whiskers agree with the simulator."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.head import usb_protocol as wire
from robot.drivers.head.usb_protocol import Command, CommandKind, FeedbackMode, FrameFlag
from robot.drivers.ur10.driver_config import BaseTransformConfig
from robot.drivers.ur10.rtde_protocol import ToolPose
from robot.emulators.head.emulated_device import Fifo
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
from tests.helpers.live import until, ur_emulator
from tests.robot.emulators.head.heads import TABLE, HostedHead, drive, open_drive, running, started, world

STEP = st.tuples(st.just("push"), st.integers(1, 20)) | st.tuples(st.just("take"), st.integers(1, 900))


@given(st.integers(1, 30), st.lists(STEP))
def test_frames_are_sent_lost_or_waiting(capacity, steps):
    fifo, made, held, read = Fifo(capacity), 0, b"", b""
    for step, count in steps:
        if step == "push":
            frames = [bytes([k % 256]) * 32 for k in range(made, made + count)]
            held += b"".join(frames[: capacity - len(fifo)])
            lost = fifo.lost
            fifo.push(frames)
            made += count
            assert fifo.overran == (fifo.lost > lost)
        else:
            part = fifo.take(count)
            assert len(part) == min(count, len(held) - len(read))
            read += part
        assert len(fifo) <= capacity
        assert fifo.made == made == fifo.sent + fifo.lost + fifo.dropped + len(fifo)
        assert fifo.sent == len(read) // 32
    assert held.startswith(read)
    fifo.clear()
    assert (len(fifo), fifo.made) == (0, fifo.sent + fifo.lost + fifo.dropped)


def test_unread_frames_beyond_the_capacity_are_lost():
    head = started(fifo=100)
    assert len(head.pass_by(0.1).values) == 200
    assert len(head.pass_by(0.5, read=False).values) == 0
    rest = head.pass_by(0.1)
    counts = {"made": 1400, "sent": 480, "queued": 0, "lost": 920, "dropped": 0, "skipped": 0}
    assert head.do("counts") == counts
    # 100 frames were queued; the next one has the overrun flag.
    assert rest.sequence.tolist() == [*range(200, 300), *range(1220, 1400)]
    assert np.flatnonzero(rest.flags & FrameFlag.OVERRUN).tolist() == [100]
    assert (head.decoder.counts.missing, head.decoder.counts.bad) == (920, 0)


def test_times_follow_from_the_numbers_until_the_clock_jumps():
    head = started()
    head.pass_by(0.2)
    head.stop()
    assert len(head.pass_by(0.3).values) == 0
    head.start()
    frames = head.pass_by(0.1)
    assert frames.sequence.tolist() == list(range(1000, 1200))  # numbers advance while stopped
    assert (frames.time == 500 * frames.sequence).all()
    head.do("clock", jump_us=123_456)
    after = head.pass_by(0.1)
    assert (after.sequence[0], after.time[0]) == (1200, 500 * 1200 + 123_456)


def test_a_stop_drops_queued_frames_and_retracts():
    head = started(drive(), mechanics={"noise": 0.0})
    head.pass_by(0.4)
    head.pass_by(0.1, read=False)
    head.stop()
    assert head.read() == b""
    assert head.do("counts")["dropped"] == 200
    assert not head.do("state")["resting"]
    head.pass_by(0.5)
    state = head.do("state")
    assert (state["resting"], state["angle"]) == (True, [0.0] * 18)


def test_numbers_and_times_wrap():
    for age, name in ((wire.WRAP / 1e6 - 0.05, "time"), (wire.WRAP / 2000 - 0.05, "sequence")):
        head = started(age=age)
        frames = head.pass_by(0.2)
        assert (head.decoder.counts.good, head.decoder.counts.missing) == (400, 0)
        raw = getattr(frames, name) % wire.WRAP
        assert (np.diff(raw) < 0).sum() == 1


def test_clock_drift():
    head = started(drift_ppm=500.0)
    times, frames = [], 0
    for _ in range(2):
        answer = head.bridge.control(wire.REQUEST_IN, wire.Request.CLOCK, 0, 8, head.now)
        times.append(int.from_bytes(answer, "little"))
        frames += len(head.pass_by(1.0).values)
    assert times[1] - times[0] == 1_000_500
    assert 4_002 - head.bridge.samples <= frames <= 4_002


def test_counts_of_damaged_skipped_swapped_and_garbage_data():
    head = started()
    head.pass_by(0.1)
    head.do("corrupt", frames=33)
    head.pass_by(0.1)
    assert (head.decoder.counts.bad, head.decoder.counts.missing) == (33, 33)
    head.do("skip", frames=57)
    assert len(head.pass_by(0.1).values) == 143
    assert (head.decoder.counts.bad, head.decoder.counts.missing) == (33, 90)
    assert head.do("counts")["skipped"] == 57
    head.do("garbage", bytes=777)
    assert len(head.pass_by(0.1).values) == 200
    assert head.decoder.counts.skipped_bytes >= 777
    counted = head.do("counts")
    assert counted["made"] == counted["sent"] + counted["skipped"] == 800
    head.do("swap", frames=2)
    order = head.pass_by(0.1).sequence - 800
    assert sorted(order.tolist()) == list(range(200))
    assert order[[18, 19, 38, 39]].tolist() == [19, 18, 39, 38]
    assert head.decoder.counts.missing == 90


def test_a_saturated_whisker():
    head = started()
    head.do("saturate", whisker=5, seconds=0.2)
    y = head.pass_by(0.5).values[:, :, 2] * wire.ANGLE
    full = np.flatnonzero(np.isclose(y[:, 5], 1.5, atol=1e-3))
    assert full.tolist() == list(range(len(full)))
    assert len(full) == pytest.approx(400, abs=20)
    assert np.abs(np.delete(y, 5, axis=1)).max() < 0.1


def test_a_silence_delays_frames_and_a_stall_ends_when_cleared_after_its_duration():
    head = started()
    head.do("silence", seconds=1.0)
    assert len(head.pass_by(1.0 - BLOCK).values) == 0
    assert len(head.pass_by(0.1).values) == 2180
    assert head.do("counts")["lost"] == 0
    head.pass_by(0.1, read=False)
    head.do("stall", seconds=0.2)
    for _ in range(2):
        with pytest.raises(BrokenPipeError):
            head.read()
        head.bridge.faults.clear_halt()
    head.pass_by(0.3, read=False)
    assert len(head.read()) == 128 * 800
    head.do("stall")
    with pytest.raises(OSError, match="pipe"):
        head.read(later=60)


def test_unplugging_ends_the_stream():
    head = started(drive())
    head.pass_by(0.2)
    head.do("unplug")
    assert not head.do("state")["plugged"]
    head.do("plug")
    assert len(head.pass_by(0.5).values) == 0
    assert head.do("state")["resting"]
    head.start()
    assert len(head.pass_by(0.1).values) == 200


def test_identity_and_unknown_requests():
    head = HostedHead(HeadEmulatorConfig(head={"whiskers": 4}))
    identity = json.loads(head.bridge.control(wire.REQUEST_IN, wire.Request.IDENTITY, 0, 1024, 0.0))
    assert (identity["whiskers"], identity["channels"], identity["rate"]) == (12, 3, 2000.0)
    assert head.bridge.control(0x80, 6, 0x0303, 255, 0.0)[2:].decode("utf-16-le") == "EMULATED"
    assert len(head.bridge.control(wire.REQUEST_IN, wire.Request.IDENTITY, 0, 5, 0.0)) == 5
    for kind, request, value in ((wire.REQUEST_IN, 99, 0), (0x80, 6, 0x0309), (0x21, 9, 0)):
        with pytest.raises(OSError, match="pipe"):
            head.bridge.control(kind, request, value, 64, 0.0)


def test_invalid_commands_are_ignored_and_fault_requests_refused():
    head = started(drive())
    for packet in (b"", b"WHKC" + bytes(60), bytes(32)):
        head.bridge.bulk_out(packet, head.now)
    head.pass_by(0.1, awake=False)
    assert head.do("state")["commands"] == {"DRIVE": 1, "": 3}
    for fault in ({}, {"do": "explode"}, {"do": "saturate", "whisker": 18}, {"do": "clock"},
                  {"do": "stall", "for": 3}):  # fmt: skip
        with pytest.raises((TypeError, ValueError)):
            head.bridge.do(fault, 0.0)


PLACING = BaseTransformConfig(x=-0.4, y=0.3, z=0.12, yaw_deg=30.0)
NOISELESS = {"noise": 0.0}
QUIET = HeadEmulatorConfig(mechanics=NOISELESS)
ODD = 2100.0
"""A rate without a sample in the middle of a block, where the last bit of the time decides on the wall."""


class Arm:
    state = None

    def latest(self):
        return self.state

    def put(self, time, pose, lift=0.0, speed=(0.0,) * 6):
        self.state = ToolPose(time, PLACING.tcp_from_pose(np.array(pose), lift), np.array(speed), time)


WHISKS = [(FeedbackMode.OPEN, 1.0, HALL_BASELINE), (FeedbackMode.RCP, 1.0, HALL_BASELINE),
          (FeedbackMode.RCP, 2.0, BaselineConfig())]  # fmt: skip


@pytest.mark.parametrize(("mode", "frequency", "baseline"), WHISKS)
def test_samples_along_a_path_agree_with_the_simulator(mode, frequency, baseline):
    more = {"stream": {"rate": ODD}, "head": {"dead": (4,)}, "mechanics": {"baseline": baseline}}
    config = HeadEmulatorConfig(follow=True, path={"explore": 9}, seed=3, **more)
    scene = world(config)
    command = drive(mode, frequency=frequency)
    head = HostedHead(config, scene.surroundings.walls, AlongPath(scene.path)).start(command)
    frames = head.pass_by(3.0)
    samples = round(ODD / frequency)
    begins = np.flatnonzero(frames.flags & FrameFlag.CYCLE)
    assert begins.tolist() == list(range(0, len(frames.values), samples))
    whisking = WhiskingConfig(mode=mode.name.lower(), rate=frequency, gain=command.gain)
    settings = config.stream.model_copy(update={"batch": 1, "poses": samples // head.bridge.samples})
    setup = HeadSetup(scene.surroundings.head, settings, config.mechanics, whisking)
    start, random = np.arange(3 * frequency) / frequency, stream(config.seed, "sensor")
    rest = make_baseline(baseline, config.mechanics.noise, ODD, 18, config.seed)
    threshold = command.numbers * wire.ANGLE
    walls, path = scene.surroundings, scene.path
    raw = simulate_cycles(simulate_quasistatic, setup, walls, path, start, random, threshold, rest)
    expected = np.concatenate([wire.frame_values(cycle.angle, cycle.deflection) for cycle in raw])
    off = np.abs(expected.astype(int) - frames.values)
    assert np.abs(expected[..., 2] * wire.ANGLE).max() > 0.05
    assert off.max() <= 1
    assert (off == 0).mean() > 0.999
    assert (frames.flags & FrameFlag.RCP).any() == (mode == FeedbackMode.RCP)


def test_a_whisk_may_end_within_a_block():
    head = started(open_drive(frequency=1.3))
    frames = head.pass_by(3.0)
    samples = round(2000 / 1.3)
    assert samples % head.bridge.samples
    assert np.flatnonzero(frames.flags & FrameFlag.CYCLE).tolist() == list(range(0, 6000, samples))
    angle = wire.to_radians(frames.values)[0]
    assert (angle[samples - 2 : samples + 2] < 0.02).all()


@pytest.mark.parametrize("lift", [0.0, 0.02, -0.004])
def test_samples_of_a_carried_head_agree_with_a_fixed_one(lift):
    config = HeadEmulatorConfig(path={"explore": 9}, mechanics=NOISELESS)
    walls = world(config).surroundings.walls
    pose = np.array([0.63, 0.45, 2.0])
    arm = Arm()
    arm.put(0.0, pose.tolist(), lift)
    lower = walls._replace(height=walls.height - lift)
    stays = AlongPath(HeadPath(np.zeros(1), pose[None]))
    found = []
    for head in (HostedHead(config, walls, CarriedByArm(arm, PLACING)), HostedHead(config, lower, stays)):
        found.append(head.start(drive()).pass_by(1.0).values.astype(int))
    assert np.abs(found[0] - found[1]).max() <= 1
    expected = Surroundings(lower, head.whiskers.head).contact(pose[None]).angle[0] < np.radians(60)
    assert expected.any() == ((found[0][..., 2] * wire.ANGLE).max() > 0.05)


def test_no_contact_when_lifted_or_before_the_first_arm_state():
    arm = Arm()
    head = HostedHead(QUIET, TABLE, CarriedByArm(arm, PLACING)).start(drive())
    assert not head.readings(1.0)[1].any()
    arm.put(head.now, [0.0, 0.0, 0.0])
    assert head.readings(1.0)[1].max() > 0.05
    arm.put(head.now, [0.0, 0.0, 0.0], 0.2)
    assert not head.readings(1.0)[1][50:].any()
    assert head.do("state")["lift"] == pytest.approx(0.2)


def test_poses_between_arm_states_are_extrapolated():
    arm, home = Arm(), np.array([0.5, 0.4, 3.1])
    arm.put(10.0, home, speed=(0.03, -0.01, 0.02, 0.0, 0.0, 0.4))
    rows = [CarriedByArm(arm, PLACING).at(10.0 + ahead) for ahead in (0.0, 0.02, 0.05, AHEAD, 5.0)]
    poses, lifts = map(np.array, zip(*(row[:2] for row in rows), strict=True))
    np.testing.assert_allclose(poses[0], home, atol=1e-9)
    times = np.array([0.0, 0.02, 0.05, AHEAD, AHEAD])
    np.testing.assert_allclose(np.hypot(*(poses - home)[:, :2].T), np.hypot(0.03, 0.01) * times, atol=1e-9)
    np.testing.assert_allclose((poses - home)[:, 2], 0.4 * times, atol=1e-9)
    np.testing.assert_allclose(lifts, 0.02 * times, atol=1e-9)


def test_whiskers_retract_without_commands():
    head = started(open_drive(), mechanics=NOISELESS)
    assert head.readings(0.4)[0].max() > 0.5
    frames = head.pass_by(2.0, awake=False)
    angle = wire.to_radians(frames.values)[0]
    assert len(angle) == 4000  # the stream continues
    silent = round(wire.COMMAND_TIMEOUT * 2000)
    assert (angle[silent - 100] > 0.2).all()
    assert (angle[silent + 500 :] == 0).all()
    assert (np.diff(angle[silent + 60 : silent + 500], axis=0) <= 1e-9).all()
    assert not (frames.flags[silent + 20 :] & FrameFlag.CYCLE).any()
    assert not head.readings(1.0)[0].any()  # keep-alives do not start a whisk
    head.send(open_drive())
    assert head.readings(1.0)[0].max() > 0.5


def test_a_new_drive_command_starts_with_the_next_cycle():
    head = started(open_drive(), mechanics=NOISELESS)
    head.pass_by(0.3)
    head.send(open_drive(frequency=2.0, amplitude=0.3, offset=0.2))
    frames = head.pass_by(1.7)
    begins = np.flatnonzero(frames.flags & FrameFlag.CYCLE)
    assert begins.tolist() == [1400, 2400]
    angle = wire.to_radians(frames.values)[0]
    assert angle[:1400].max() > 0.8
    assert angle[1400:].max() == pytest.approx(0.5, abs=0.01)
    assert angle[1400:].min() == pytest.approx(0.2, abs=1e-3)


def test_amplitudes_from_the_host_last_one_cycle():
    head = HostedHead(QUIET, TABLE._replace(height=np.array([0.0]))).start(open_drive())
    head.pass_by(0.1)
    lower = np.linspace(0.1, 0.9, 18)
    head.send(Command(CommandKind.AMPLITUDES, numbers=wire.to_counts(lower)))
    angle = head.readings(1.9)[0]
    np.testing.assert_allclose(angle[:1800].max(axis=0), lower, atol=1e-3)
    np.testing.assert_allclose(angle[1800:].max(axis=0), np.radians(65), atol=1e-3)


def test_feedback_is_relative_to_the_centre():
    most = []
    for centre in (0.0, 0.3):
        offset = Command(CommandKind.CENTRE, numbers=wire.to_counts(np.full(18, centre)))
        head = started(offset, drive(), mechanics=NOISELESS | {"slip": 1.0})
        most.append(head.readings(1.0)[1].max())
    assert most[1] < 0.7 * most[0]  # counts as contact from the start


def test_invalid_drive_commands_are_ignored_and_drives_stop_at_their_limit():
    for bad in ({"frequency": 0.0}, {"frequency": 1e6}, {"amplitude": -0.1}, {"gain": -1.0}, {"window": 0.0}):
        assert np.abs(started(drive(**bad)).readings(0.5)[0]).max() < 0.02, bad
    head = started(open_drive(offset=0.3), head=HeadConfig(limit_deg=50.0), mechanics=NOISELESS)
    assert head.readings(1.0)[0].max() <= np.radians(50) + wire.ANGLE


def test_no_samples_are_computed_without_a_stream():
    quick, late = HostedHead(), HostedHead()
    late.pass_by(3 * BLOCK)
    assert np.array_equal(quick.start().pass_by(0.1).values, late.start().pass_by(0.1).values)


def test_a_head_in_a_process_follows_the_tool_of_a_controller(tmp_path, loopback):
    placing = BaseTransformConfig()
    here, there = np.array([0.27, 0.27, 0.5]), np.array([0.63, 0.45, -2.0])
    config = HeadEmulatorConfig(host=loopback, path={"explore": 5}, arm=loopback, placing=placing)
    with ur_emulator(loopback, placing.tcp_from_pose(here, 0.1)) as arm, running(config, tmp_path) as head:

        def is_at(pose, lift):
            state = head(do="state")
            level = state["lift"] is not None and abs(state["lift"] - lift) < 1e-6
            return level and bool(np.allclose(state["pose"], pose, atol=1e-6))

        until(lambda: is_at(here, 0.1), "the head is at the arm's start")
        arm(do="place", tcp=placing.tcp_from_pose(there).tolist())
        until(lambda: is_at(there, 0.0), "the head is at the arm's new place")
