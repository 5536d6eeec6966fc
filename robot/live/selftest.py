"""Self-tests of a session's devices and of this machine, for an arm with a head, a Create, and topics.

Nothing moves in a self-test. A session runs its two steps itself: it finds the devices, and later, when the
mapper is ready, starts and checks them.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from robot.drivers.create.driver_config import CommandRefused
from robot.drivers.create.protocol import MODELS, MOST_LIGHT, Bumps
from robot.drivers.create.serial_link import open_port
from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.safety import check_controller
from robot.live.arm_route import check_targets, plan_path
from robot.live.create_rig import RIGS, CreateRig, LightRig, WhiskeredRig
from robot.live.live_config import LiveConfig
from robot.live.live_rig import ArmRig, Rig
from robot.live.polling import HeadRig
from robot.live.topics_rig import TopicsRig, require_topics
from robot.recordings.recording_config import RecordingConfig
from tactile.base.errors import InputError, os_errors_of
from tactile.whisker_geometry import HeadConfig, ur10_head

LISTEN_TIME = 1.5
"""Time for which the streams are observed, s."""
MIN_RATE_SHARE = 0.9
"""Required share of a stream's nominal rate."""


def check_session(
    config: LiveConfig, head: HeadConfig, directory: Path, recording: RecordingConfig | None = None
) -> Iterator[str]:
    """Checks what a session needs, without a motion; yields a line of text for each passed check. No program
    is started on an arm, which then cannot move.

    Args:
        head: geometry of an arm's whisker head. directory: in which the session would make its run directory.
        recording: assigns the topics of a robot that publishes them.

    Raises:
        InputError: a check failed; the error gives its cure.
        robot.live.polling.SessionFault: a device failed meanwhile.
    """
    yield check_disk(config, directory)
    if config.topics is not None:
        told = list[str]()
        with TopicsRig(
            config, require_topics(config.topics, recording), lambda: False, told.append
        ) as talker:
            yield from talker.find()
            yield from talker.check()
        yield from told
        return
    if config.create is not None:
        with RIGS[config.create.touch](config, lambda: False) as robot:
            yield from find_devices(robot)
            yield from start_and_check(robot)
        return
    path = plan_path(config, ur10_head(head))
    check_targets(config, path)
    yield f"route: {path.duration:.0f} s, every target is within the arm's limits"
    if config.arm.touch == "force":
        with ArmRig(config, lambda: False) as arm:
            yield from find_devices(arm)
        return
    with Rig(config, head, lambda: False) as rig:
        yield from find_devices(rig)
        yield _check_stream(rig)


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


def find_devices(rig: ArmRig | CreateRig) -> Iterator[str]:
    """Starts the stream of the whiskers and finds the robot; yields a line of text for each device.

    It asks the arm's controller for its status, which starts no program on it, or opens the Create's port
    once.

    Raises:
        InputError: a device is missing or not ready; the error gives its cure.
    """
    if isinstance(rig, CreateRig):
        behaviour = rig.create.plan.behaviour
        try:
            for speed in (behaviour.fast, behaviour.slow):
                rig.create.wheel_speeds(speed, 0.0)
            rig.create.wheel_speeds(0.0, behaviour.turn.rate)
        except CommandRefused as error:
            cure = "a lower speed in the plan, or a higher limit"
            raise InputError("live.create.plan.behaviour", str(error), "", cure) from None
        open_port(rig.create.port, MODELS[rig.create.model].baud).close()
        yield f"Create: port {rig.create.port} can be opened"
    if isinstance(rig, HeadRig):
        rig.head.start()
        identity = rig.head.identity
        assert identity is not None
        sampled = f"{identity.whiskers} whiskers at {identity.rate:g} Hz"
        yield f"head: {identity.name} {identity.version}, {sampled}"
    if isinstance(rig, WhiskeredRig):
        assert identity is not None
        wanted = rig.create.plan.whiskers.rate
        if abs(identity.rate - wanted) > 1e-6 * wanted:
            found, key = f"{identity.rate:g} samples per second", "live.create.plan.whiskers.rate"
            raise InputError("head", found, f"{wanted:g}, as in `{key}`", f"--set {key}={identity.rate:g}")
    elif not isinstance(rig, CreateRig):
        version = ".".join(map(str, check_controller(rig.config.arm).version))
        yield f"arm: {rig.config.arm.host}, PolyScope {version}, ready to start"


def start_and_check(rig: ArmRig | CreateRig) -> Iterator[str]:
    """Starts the robot, a Create in safe mode and at rest, and checks the streams of the devices; yields a
    line of text for each passed check.

    Raises:
        InputError: a check failed; the error gives its cure.
        robot.live.polling.SessionFault, robot.live.polling.OperatorStop.
    """
    if isinstance(rig, CreateRig):
        rig.robot.start()
        rig.robot.refresh()
        reply = rig.robot.last_reply
        if reply is not None and reply.bumps & Bumps.BUMPED:
            found = f"{reply.bumps.describe()} pressed"
            cure = "move the robot away from what it touches"
            raise InputError("live.create", found, "a free bumper", cure)
        yield f"Create: {rig.create.port}, safe mode, at rest, guarded by a watchdog process"
        rig.monitor.begin()
        if isinstance(rig, LightRig):
            yield _learn_light(rig)
    else:
        rig.arm.start()
        yield f"arm: {rig.config.arm.host}, admitted, states at {rig.config.arm.hz} Hz"
    if not isinstance(rig, HeadRig):
        return
    clocks = _check_stream(rig)
    if isinstance(rig, WhiskeredRig):
        yield _check_whiskers(rig)
        yield clocks
    elif isinstance(rig, ArmRig):
        age = float(np.median(rig.state_ages[-100:]))
        yield f"{clocks}, newest state {age * 1e3:.0f} ms old"


def _check_stream(rig: HeadRig) -> str:
    """Listens to the head for a while and checks rate, damage and clock of its samples; returns a line of
    text."""
    head, residual = rig.head, rig.config.residual
    identity = head.identity
    assert identity is not None
    before = head.decoder.counts
    end = rig.now() + LISTEN_TIME
    rig.wait_until(lambda: rig.now() >= end, LISTEN_TIME + 5.0, SessionOutcome.HEAD_SILENT, "the self-test")
    after = head.decoder.counts
    rate = (after.good - before.good) / LISTEN_TIME
    if rate < MIN_RATE_SHARE * identity.rate:
        found = f"{rate:.0f} of {identity.rate:g} samples per second"
        raise InputError("head", found, "", "check the USB hub and cable")
    if after.bad > before.bad:
        found = f"{after.bad - before.bad} damaged samples in {LISTEN_TIME:g} s"
        raise InputError("head", found, "none", "change the cable")
    measured = rig.stream.clock.residual
    if measured > residual:
        found = f"clock residual of {measured * 1e3:.1f} ms"
        raise InputError("head", found, f"{residual * 1e3:g} ms", "check the load of this machine")
    return f"clocks: head {measured * 1e3:.1f} ms"


def _learn_light(rig: LightRig) -> str:
    """Learns the signals of the light bumpers in free air, in which the robot must stand."""
    signals = list[tuple[int, ...]]()
    for _ in range(round(LISTEN_TIME * rig.create.rate)):
        rig.robot.refresh()
        rig.poll()
        signals += [reply.light for reply in [rig.robot.last_reply] if reply is not None]
    rig.monitor.learn(np.array(signals, float))
    if (rig.monitor.free**2 > MOST_LIGHT).any():  # half of the span of its image, a logarithm
        found = f"something near, or dirt: {rig.monitor}"
        cure = "turn the robot to where nothing is near its front and sides; clean the windows"
        raise InputError("live.create.touch", found, "free light bumpers", cure)
    return f"light bumpers: {rig.monitor}"


def _check_whiskers(rig: WhiskeredRig) -> str:
    """Measures the strain at rest and finds whiskers without a signal."""
    newest = rig.head.ring.newest
    assert newest is not None
    values = rig.head.ring.between(newest[0] - round(rig.monitor.rate), newest[0]).values
    rig.alive &= (values[..., 1:] != values[:1, :, 1:]).any(axis=(0, 2))
    if not rig.alive.any():
        raise InputError("head", "no whisker has a signal", "", "check the cables of the whiskers")
    rows = rig.monitor.rows(len(values))
    # A whisker that shakes at rest by half the strain of a contact would report contacts.
    horizontal = (rows * rig.alive[:, None])[..., 0]
    swing = np.abs(horizontal - horizontal.mean(axis=0)).max(axis=0)
    if swing.max() > rig.create.plan.behaviour.contact / 2:
        cure = "let the robot stand with its whiskers free, or raise `live.create.plan.behaviour.contact`"
        where = f"whisker {int(swing.argmax())}"
        raise InputError(where, "its strain changes while the robot rests", "", cure)
    rig.monitor.rest = rig.monitor.strain(values).mean(axis=0)
    level = 1e6 * float(np.abs(rows - rows.mean(axis=0)).std())
    dead = [str(k) for k in np.flatnonzero(~rig.alive)]
    without = f", without a signal: {', '.join(dead)}" if dead else ""
    alive = f"{int(rig.alive.sum())} of {len(rig.alive)} alive"
    return f"whiskers: {alive}, noise {level:.1f} microstrain{without}"
