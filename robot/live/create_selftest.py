"""Self-test of a Create, of its whiskers and of this machine; nothing moves."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from robot.drivers.create.driver_config import CommandRefused
from robot.drivers.create.protocol import Bumps
from robot.drivers.create.serial_link import open_port
from robot.drivers.outcome import SessionOutcome
from robot.live import selftest
from robot.live.create_rig import CreateRig, unusual_strain
from robot.live.live_config import LiveConfig
from tactile.base.errors import InputError

FEWEST_ALIVE = 1
"""Least number of whiskers with a signal."""


def check_create(config: LiveConfig, directory: Path) -> Iterator[str]:
    """Checks everything that a session needs, without a motion; yields a line for each passed check.

    Args:
        config: with a part `create`. directory: in which the session would make its run directory.

    Raises:
        InputError: a check failed; the error gives its cure.
        robot.live.polling.SessionFault: a device failed meanwhile.
    """
    yield selftest.check_disk(config, directory)
    with CreateRig(config, lambda: False) as rig:
        yield from find_devices(rig)
        yield from start_and_check(rig)


def find_devices(rig: CreateRig) -> Iterator[str]:
    """Starts the whiskers' stream and opens the robot's port once; yields a line for each device.

    Raises:
        InputError: a device is missing; the error gives its cure.
    """
    _check_speeds(rig)
    open_port(rig.create.port).close()
    yield f"Create: port {rig.create.port} can be opened"
    yield selftest.start_head(rig.head)
    identity, wanted = rig.head.identity, rig.create.plan.whiskers.rate
    assert identity is not None
    if abs(identity.rate - wanted) > 1e-6 * wanted:
        found, key = f"{identity.rate:g} samples per second", "live.create.plan.whiskers.rate"
        raise InputError("head", found, f"{wanted:g}, as in `{key}`", f"--set {key}={identity.rate:g}")


def start_and_check(rig: CreateRig) -> Iterator[str]:
    """Puts the robot into safe mode, at rest, and checks both devices; yields a line for each passed check.

    Raises:
        InputError: a check failed; the error gives its cure.
        robot.live.polling.SessionFault, robot.live.polling.OperatorStop.
    """
    rig.robot.start()
    rig.robot.refresh()
    reply = rig.robot.last_reply
    if reply is not None and reply.bumps & Bumps.BUMPED:
        found = f"{reply.bumps.describe()} pressed"
        raise InputError("live.create", found, "a free bumper", "move the robot away from what it touches")
    yield f"Create: {rig.create.port}, safe mode, at rest, guarded by a watchdog process"
    rig.monitor.begin()
    selftest.check_stream(rig.head, rig.stream, rig.config.residual, lambda: _listen(rig))
    yield _check_whiskers(rig)
    yield f"clocks: head {rig.stream.clock.residual * 1e3:.1f} ms"


def _check_speeds(rig: CreateRig) -> None:
    behaviour = rig.create.plan.behaviour
    try:
        for speed in (behaviour.fast, behaviour.slow):
            rig.create.wheel_speeds(speed, 0.0)
        rig.create.wheel_speeds(0.0, behaviour.turn.rate)
    except CommandRefused as error:
        cure = "a lower speed in the plan, or a higher limit"
        raise InputError("live.create.plan.behaviour", str(error), "", cure) from None


def _check_whiskers(rig: CreateRig) -> str:
    """Measures the strain at rest and finds whiskers without a signal."""
    newest = rig.head.ring.newest
    assert newest is not None
    values = rig.head.ring.between(newest[0] - round(rig.monitor.rate), newest[0]).values
    rig.alive &= (values[..., 1:] != values[:1, :, 1:]).any(axis=(0, 2))
    if rig.alive.sum() < FEWEST_ALIVE:
        raise InputError("head", "no whisker has a signal", "", "check the cables of the whiskers")
    rows = rig.monitor.rows(len(values))
    shaking = unusual_strain(rows * rig.alive[:, None], rig.create.plan.behaviour.contact)
    if shaking is not None:
        cure = "let the robot stand with its whiskers free, or raise `live.create.plan.behaviour.contact`"
        raise InputError(f"whisker {shaking}", "its strain changes while the robot rests", "", cure)
    rig.monitor.rest = rig.monitor.strain(values).mean(axis=0)
    level = 1e6 * float(np.abs(rows - rows.mean(axis=0)).std())
    dead = [str(k) for k in np.flatnonzero(~rig.alive)]
    without = f", without a signal: {', '.join(dead)}" if dead else ""
    return (
        f"whiskers: {int(rig.alive.sum())} of {len(rig.alive)} alive, noise {level:.1f} microstrain{without}"
    )


def _listen(rig: CreateRig) -> None:
    end = rig.now() + selftest.LISTEN_TIME
    longest = selftest.LISTEN_TIME + 5.0
    rig.wait_until(lambda: rig.now() >= end, longest, SessionOutcome.HEAD_SILENT, "the self-test")
