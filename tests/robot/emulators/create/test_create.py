"""An emulated Create among walls: contact, odometry, strain of its whiskers."""

import numpy as np
import pytest

from robot.drivers.create.protocol import QUERY, REPLY, SAFE, START, Bumps, drive
from robot.drivers.head.decoder import Decoder
from robot.drivers.head.usb_protocol import ANGLE, REQUEST_OUT, Request, to_radians
from robot.emulators.create import CreateEmulatorConfig, EmulatedCreate
from robot.emulators.create.emulator_config import CreateWorldConfig
from robot.emulators.create.server import CreateWhiskers, Terminal
from robot.emulators.head.emulated_device import EmulatedHead
from robot.simulation.create.strain_sensors import WhiskersConfig, base_strains, bend_whiskers, fixed_whiskers
from robot.simulation.create.wheel_odometry import WheelsConfig
from robot.world.arena import Arena
from tactile.base.errors import InputError
from tactile.base.random_streams import stream

ROOM = Arena("room", 2.0 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), (), np.array([1.0, 1.0, 0.0]))
BODY = 0.17


def robot_in(world, arena=ROOM, seed=0):
    robot = EmulatedCreate(CreateEmulatorConfig(world=world, seed=seed), arena)
    robot.receive(START + SAFE)
    return robot


def move(robot, right, left, seconds):
    """Turns the wheels for some seconds, mm/s."""
    robot.receive(drive(right, left))
    robot.advance(seconds)


def test_a_wall_stops_the_body_and_presses_the_bumper_while_the_wheels_slip():
    robot = robot_in(CreateWorldConfig(wheels=WheelsConfig(noise="none")))
    move(robot, 200, 200, 10.0)
    assert robot.base.x == pytest.approx(2.0 - BODY, abs=0.003)
    assert robot.bumps == Bumps.BUMPED
    assert REPLY.unpack(robot.receive(QUERY)[0])[0] == pytest.approx(2000, abs=1)
    move(robot, 0, 0, 1.0)
    assert robot.bumps == Bumps.BUMPED  # still against the wall
    before = robot.base.heading
    move(robot, 100, -100, 1.0)
    assert robot.base.heading - before == pytest.approx(0.2 / 0.258), "turns are not blocked"
    assert robot.base.x == pytest.approx(2.0 - BODY, abs=0.003)
    move(robot, -100, 100, 1.0)
    move(robot, -200, -200, 0.5)
    assert robot.bumps == 0
    assert robot.base.x == pytest.approx(2.0 - BODY - 0.1, abs=0.005)


def test_odometry_has_one_error_for_the_whole_session():
    wide = ROOM._replace(outer=100 * ROOM.outer, start=np.array([50.0, 50.0, 0.0]))
    shares = []
    for seed in range(12):
        robot = robot_in(CreateWorldConfig(wheels=WheelsConfig(noise="bias", level=0.05)), wide, seed)
        for _ in range(5):
            move(robot, 200, 200, 5.0)
            robot.receive(drive(0, 0))
        measured = REPLY.unpack(robot.receive(QUERY)[0])[0]
        shares.append(measured / (1000 * (robot.base.x - 50.0)))
    assert 0.02 < np.std(shares) < 0.09
    assert abs(np.mean(shares) - 1) < 0.05


def test_the_strain_is_that_of_the_simulator():
    config = WhiskersConfig(noise=0.0, shake={"start": 0.0, "rumble": 0.0})
    world = CreateWorldConfig(whiskers=config)
    robot = robot_in(world, ROOM._replace(start=np.array([1.75, 1.0, 0.3])))
    whiskers = CreateWhiskers(world, robot, robot.advance_to, stream(0, "strain"))
    bridge = EmulatedHead(world.bridge, whiskers, now=0.0)
    bridge.control(REQUEST_OUT, Request.START, 0, 0, 0.0)
    robot.receive(drive(50, 50))
    got, poses, decoder = [], [], Decoder(whiskers.count)
    for block in range(20):
        before = robot.pose
        assert bridge.advance((block + 1) * 0.01 + 1e-9)
        share = (np.arange(bridge.samples) + 1)[:, None] / bridge.samples
        poses.append(before + share * (robot.pose - before))
        got.append(decoder.feed(bridge.bulk_in(1 << 20, 0.0)).values)
    fan = fixed_whiskers(config)
    bent = bend_whiskers(fan, np.concatenate(poses), robot.walls, np.zeros(whiskers.count, int))
    expected = base_strains(config, fan, bent)
    assert np.abs(expected).max() > 1e-3
    strain = to_radians(np.concatenate(got))[1] * world.strain_per_radian
    assert np.abs(strain - expected).max() <= 0.51 * ANGLE * world.strain_per_radian


def test_rolling_shakes_the_whiskers_and_standing_does_not():
    world = CreateWorldConfig()
    robot = robot_in(world)
    whiskers = CreateWhiskers(world, robot, robot.advance_to, stream(0, "strain"))
    blocks = [whiskers.block(0.01 * k, 0.01 * k + 0.01).deflection for k in range(50)]
    robot.receive(drive(50, 50))
    rolling = [whiskers.block(0.01 * k, 0.01 * k + 0.01).deflection for k in range(50, 100)]
    quiet, loud = (np.std(np.concatenate(part)) * world.strain_per_radian for part in (blocks, rolling))
    assert quiet == pytest.approx(3e-6, rel=0.1)
    assert loud > 2 * quiet


def test_a_file_is_not_replaced_by_the_link_of_the_port(tmp_path):
    pytest.importorskip("termios", reason="needs pseudo-terminals")
    name = tmp_path / "create.tty"
    for make in (lambda: name.write_text("mine"), lambda: name.symlink_to("/etc/hostname")):
        make()
        before = name.read_text()
        with pytest.raises(InputError, match="is no emulated port"):
            Terminal(str(name))
        assert name.read_text() == before
        name.unlink()
    name.symlink_to("/dev/pts/none")  # left by an emulator that was killed
    terminal = Terminal(str(name))
    assert name.resolve().exists()
    terminal.unplug()
    assert not name.is_symlink()
