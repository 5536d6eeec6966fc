"""Self-test of both devices and of this machine before the arm moves."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.startup_checks import check_controller
from robot.live.config import LiveConfig
from robot.live.rig import Rig
from tactile.base.errors import InputError

LISTEN_TIME = 1.5
"""Time for which both streams are observed, s."""
MIN_RATE_SHARE = 0.9
"""Required share of a stream's nominal rate."""


def check_disk(config: LiveConfig, directory: Path) -> str:
    """Checks the free disk space in a directory; returns a line of text.

    Raises:
        InputError: not enough free space.
    """
    there = next(folder for folder in (directory, *directory.resolve().parents) if folder.exists())
    free = shutil.disk_usage(there).free
    if free < config.room:
        found = f"{free / 1e9:.2g} GB free"
        raise InputError(
            str(directory), found, f"{config.room / 1e9:.2g} GB", "make room, or choose another disk with -o"
        )
    return f"disk: {free / 1e9:.0f} GB free"


def find_devices(rig: Rig) -> Iterator[str]:
    """Starts the head and asks the arm's controller for its status, which starts no program on it; yields a
    line of text for each device.

    Raises:
        InputError: a device is missing or not ready; the error gives its cure.
    """
    rig.head.start()
    identity = rig.head.identity
    assert identity is not None
    yield f"head: {identity.name} {identity.version}, {identity.whiskers} whiskers at {identity.rate:g} Hz"
    version = ".".join(map(str, check_controller(rig.config.arm).version))
    yield f"arm: {rig.config.arm.host}, PolyScope {version}, ready to start"


def start_and_check(rig: Rig) -> Iterator[str]:
    """Starts the arm and checks the streams of both devices; yields a line of text for each passed check.

    Raises:
        InputError: a check failed; the error gives its cure.
        robot.live.rig.SessionFault, robot.live.rig.OperatorStop.
    """
    identity = rig.head.identity
    assert identity is not None
    rig.arm.start()
    yield f"arm: {rig.config.arm.host}, admitted, states at {rig.config.arm.hz} Hz"
    before = rig.head.decoder.counts
    _listen(rig)
    after = rig.head.decoder.counts
    rate = (after.good - before.good) / LISTEN_TIME
    if rate < MIN_RATE_SHARE * identity.rate:
        raise InputError(
            "head", f"{rate:.0f} of {identity.rate:g} samples per second", "", "check the USB hub and cable"
        )
    if after.bad > before.bad:
        raise InputError(
            "head",
            f"{after.bad - before.bad} damaged samples in {LISTEN_TIME:g} s",
            "none",
            "change the cable",
        )
    if rig.clock.residual > rig.config.residual:
        found = f"clock residual of {rig.clock.residual * 1e3:.1f} ms"
        raise InputError("head", found, f"{rig.config.residual * 1e3:g} ms", "check the load of this machine")
    age = float(np.median(rig.state_ages[-100:]))
    yield f"clocks: head {rig.clock.residual * 1e3:.1f} ms, newest state {age * 1e3:.0f} ms old"


def _listen(rig: Rig) -> None:
    end = rig.now() + LISTEN_TIME
    rig.wait_until(lambda: rig.now() >= end, LISTEN_TIME + 5.0, SessionOutcome.HEAD_SILENT, "the self-test")
