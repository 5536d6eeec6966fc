"""Self-test of both devices and of this machine before the arm moves."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from robot.drivers.head.reader import HeadReader
from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.safety import check_controller
from robot.live.arm_route import check_targets, plan_path
from robot.live.live_config import LiveConfig
from robot.live.live_rig import Rig
from robot.live.polling import TICK, HeadStream, SessionFault
from tactile.base.errors import InputError, os_errors_of
from tactile.whisker_geometry import HeadConfig, ur10_head

LISTEN_TIME = 1.5
"""Time for which both streams are observed, s."""
MIN_RATE_SHARE = 0.9
"""Required share of a stream's nominal rate."""


def check_disk(config: LiveConfig, directory: Path) -> str:
    """Checks that a directory can be made, and the free disk space there; returns a line of text.

    Raises:
        InputError: it cannot be made, or there is not enough free space.
    """
    there = next(folder for folder in (directory, *directory.resolve().parents) if folder.exists())
    with os_errors_of(directory, "cannot be made", "a writable folder", "choose another with -o"):
        tempfile.TemporaryFile(dir=there).close()
    free = shutil.disk_usage(there).free
    if free < config.room:
        found = f"{free / 1e9:.2g} GB free"
        cure = "make room, or choose another disk with -o"
        raise InputError(str(directory), found, f"{config.room / 1e9:.2g} GB", cure)
    return f"disk: {free / 1e9:.0f} GB free"


def find_devices(rig: Rig) -> Iterator[str]:
    """Starts the head and asks the arm's controller for its status, which starts no program on it; yields a
    line of text for each device.

    Raises:
        InputError: a device is missing or not ready; the error gives its cure.
    """
    yield start_head(rig.head)
    version = ".".join(map(str, check_controller(rig.config.arm).version))
    yield f"arm: {rig.config.arm.host}, PolyScope {version}, ready to start"


def start_and_check(rig: Rig) -> Iterator[str]:
    """Starts the arm and checks the streams of both devices; yields a line of text for each passed check.

    Raises:
        InputError: a check failed; the error gives its cure.
        robot.live.polling.SessionFault, robot.live.polling.OperatorStop.
    """
    rig.arm.start()
    yield f"arm: {rig.config.arm.host}, admitted, states at {rig.config.arm.hz} Hz"
    check_stream(rig.head, rig.stream, rig.config.residual, lambda: _listen(rig))
    age = float(np.median(rig.state_ages[-100:]))
    yield f"clocks: head {rig.stream.clock.residual * 1e3:.1f} ms, newest state {age * 1e3:.0f} ms old"


def check_stream(head: HeadReader, stream: HeadStream, residual: float, listen: Callable[[], None]) -> None:
    """Checks rate, damage and clock of a head's samples.

    Args:
        residual: largest one of the clock synchronisation, s. listen: polls for `LISTEN_TIME`.

    Raises:
        InputError: a check failed; the error gives its cure.
    """
    identity = head.identity
    assert identity is not None
    before = head.decoder.counts
    listen()
    after = head.decoder.counts
    rate = (after.good - before.good) / LISTEN_TIME
    if rate < MIN_RATE_SHARE * identity.rate:
        raise InputError(
            "head", f"{rate:.0f} of {identity.rate:g} samples per second", "", "check the USB hub and cable"
        )
    if after.bad > before.bad:
        found = f"{after.bad - before.bad} damaged samples in {LISTEN_TIME:g} s"
        raise InputError("head", found, "none", "change the cable")
    if stream.clock.residual > residual:
        found = f"clock residual of {stream.clock.residual * 1e3:.1f} ms"
        raise InputError("head", found, f"{residual * 1e3:g} ms", "check the load of this machine")


def start_head(head: HeadReader) -> str:
    """Starts a head; returns a line of text about it.

    Raises:
        InputError: it is missing or has another shape; the error gives the cure.
    """
    head.start()
    identity = head.identity
    assert identity is not None
    return f"head: {identity.name} {identity.version}, {identity.whiskers} whiskers at {identity.rate:g} Hz"


def _listen(rig: Rig) -> None:
    end = rig.now() + LISTEN_TIME
    rig.wait_until(lambda: rig.now() >= end, LISTEN_TIME + 5.0, SessionOutcome.HEAD_SILENT, "the self-test")


def check_arm_session(config: LiveConfig, head: HeadConfig, directory: Path) -> Iterator[str]:
    """Checks what a session needs without starting a program on the arm, which then cannot move; yields
    a line of text for each passed check.

    Args:
        head: geometry of the whisker head. directory: in which the session would make its run directory.

    Raises:
        InputError: a check failed; the error gives its cure.
        robot.live.polling.SessionFault: the head failed meanwhile.
    """
    yield check_disk(config, directory)
    path = plan_path(config, ur10_head(head))
    check_targets(config, path)
    yield f"route: {path.duration:.0f} s, every target is within the arm's limits"
    with Rig(config, head, lambda: False) as rig:
        yield from find_devices(rig)
        check_stream(rig.head, rig.stream, config.residual, lambda: _listen_to_head(rig.stream))
        yield f"clocks: head {rig.stream.clock.residual * 1e3:.1f} ms"


def _listen_to_head(stream: HeadStream) -> None:
    end = time.monotonic() + LISTEN_TIME
    while time.monotonic() < end:
        for _ in stream.take():
            pass
        if stream.fault:
            raise SessionFault(stream.fault)
        time.sleep(TICK)
