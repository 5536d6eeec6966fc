"""Configurations of emulators for a live session: an arm above its route's start, a head in its maze, a
Create in its arena."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from robot.drivers.head.driver_config import Address
from robot.emulators.create.emulator_config import CreateEmulatorConfig, CreateWorldConfig, FirmwareConfig
from robot.emulators.head.emulator_config import BridgeEmulatorConfig, HeadEmulatorConfig
from robot.emulators.ur10.emulator_config import PokedWallsConfig, UrEmulatorConfig
from robot.live.arm_route import plan_path, plan_scene
from robot.live.live_config import CreateLiveConfig, LiveConfig
from robot.simulation.head.beam import StreamConfig
from tactile.base.errors import InputError
from tactile.pokes import PokeConfig
from tactile.whisker_geometry import HeadConfig, ur10_head


def arm_emulator_config(
    config: LiveConfig, head: HeadConfig, host: str | None = None, radius: float = PokeConfig().radius
) -> UrEmulatorConfig:
    """A controller at the session's address, or another one; the arm starts above the first pose of the
    route. Where the arm pokes, its tool of this radius (m) meets the walls of the plan's maze."""
    arm, first = config.arm, plan_path(config, ur10_head(head)).pose[0]
    start = np.asarray(arm.placing.tcp_from_pose(first, config.lift / 2))
    walls = None
    if arm.touch == "force":
        boxes = () if config.waypoints else plan_scene(config.plan, ur10_head(head)).surroundings.walls.box
        walls = PokedWallsConfig(
            boxes=tuple(map(tuple, np.asarray(boxes).tolist())),
            placing=arm.placing,
            radius=radius,
            force=config.plan.force,
            seed=config.seed,
        )
    return UrEmulatorConfig(host=host or arm.host, hz=arm.hz, start=tuple(start.tolist()), poked=walls)


def head_emulator_config(config: LiveConfig, head: HeadConfig, host: str | None = None) -> HeadEmulatorConfig:
    """A head in the maze of the session's plan, carried by its arm."""
    where = Address.parse(config.head.address)
    alike = ("mechanics", "stream", "maze", "path", "motion", "seed")
    return HeadEmulatorConfig(
        host=host or where.host or config.arm.host,
        port=where.port,
        head=head,
        **{name: getattr(config.plan, name) for name in alike},
        arm=config.arm.host,
        arm_hz=config.arm.hz,
        placing=config.arm.placing,
    )


def create_emulator_config(
    create: CreateLiveConfig, address: str, open_to_network: bool = False
) -> CreateEmulatorConfig:
    """A Create in the arena of the session's plan, its serial port a link of the session's name.

    Args:
        address: of its whiskers, HOST or HOST:PORT. open_to_network: whether it need not be loopback.

    Raises:
        InputError: the address or the port is that of a real device.
    """
    where = Address.parse(address)
    if where.host is None:
        raise InputError("live.head.address", address, "HOST or HOST:PORT of the emulated whiskers")
    if Path(create.port).is_absolute() and Path("/dev") in Path(create.port).parents:
        cure = "--set live.create.port=create.tty"
        raise InputError("live.create.port", create.port, "a name for the emulated port", cure)
    plan, whiskers = create.plan, create.plan.whiskers
    bridge = BridgeEmulatorConfig(
        host=where.host,
        port=where.port,
        open_to_network=open_to_network,
        stream=StreamConfig(rate=whiskers.rate),
        seed=plan.seed,
    )
    world = CreateWorldConfig(
        arena=plan.arena,
        whiskers=whiskers,
        wheels=plan.wheels,
        body=plan.behaviour.body,
        bridge=bridge,
        strain_per_radian=create.strain_per_radian,
    )
    firmware = FirmwareConfig(model=create.model, wrap=create.wrap)
    return CreateEmulatorConfig(
        firmware=firmware, wheel_base=create.wheel_base, seed=plan.seed, port=create.port, world=world
    )
