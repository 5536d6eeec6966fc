"""Configurations of emulators for a live session: an arm above its route's start, a head in its maze."""

from __future__ import annotations

import numpy as np

from robot.drivers.head.address import Address
from robot.drivers.ur10.base_transform import tcp_from_pose
from robot.emulators.head.config import HeadEmulatorConfig
from robot.emulators.ur10.config import UrEmulatorConfig
from robot.live.config import LiveConfig
from robot.live.route import plan_path
from tactile.whiskers.head_geometry import HeadConfig, ur10_head


def arm_emulator_config(config: LiveConfig, head: HeadConfig, host: str | None = None) -> UrEmulatorConfig:
    """A controller at the session's address, or another one; the arm starts above the first pose of the
    route."""
    start = plan_path(config, ur10_head(head)).pose[0]
    start = tcp_from_pose(config.arm.placing, start, config.lift / 2)
    return UrEmulatorConfig(
        host=host or config.arm.host, hz=config.arm.hz, start=tuple(np.asarray(start).tolist())
    )


def head_emulator_config(config: LiveConfig, head: HeadConfig, host: str | None = None) -> HeadEmulatorConfig:
    """A head in the maze of the session's plan, carried by its arm."""
    where = Address.parse(config.head.address)
    plan = config.plan
    return HeadEmulatorConfig(
        host=host or where.host or config.arm.host,
        port=where.port,
        head=head,
        mechanics=plan.mechanics,
        stream=plan.stream,
        maze=plan.maze,
        path=plan.path,
        motion=plan.motion,
        seed=plan.seed,
        arm=config.arm.host,
        arm_hz=config.arm.hz,
        placing=config.arm.placing,
    )
