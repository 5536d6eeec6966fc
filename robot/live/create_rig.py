"""A Create in a live session, with whiskers or by its light bumpers: the rigs, the monitors, and the loop.

The loop runs the state machine of Fox et al. 2012 on the robot, each motion a reading.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from robot.drivers.create.driver import CreateDriver
from robot.drivers.create.driver_config import CommandRefused, StopReason
from robot.drivers.create.protocol import LIGHTS, MOST_LIGHT, Bumps
from robot.drivers.head.decoder import Frames
from robot.drivers.head.device import open_bridge
from robot.drivers.head.reader import HeadReader
from robot.drivers.head.usb_protocol import to_radians
from robot.drivers.outcome import Fault, SessionOutcome
from robot.live.live_config import LiveConfig
from robot.live.polling import (
    AsyncMapper,
    HeadRig,
    OperatorStop,
    PolledRig,
    SessionFault,
    check_mapper,
    session_fault,
)
from robot.recordings.cdr import Event
from robot.simulation.create import state_machine
from robot.simulation.create.state_machine import (
    BehaviourConfig,
    CreateState,
    MachineState,
    motion_end,
    next_state,
)
from robot.simulation.create.strain_sensors import fixed_whiskers
from robot.sources.source import Sample
from tactile.base.random_streams import stream
from tactile.base.types import MotionKind, Observation, Odometry, Report, StepEnd, observation

OUTCOMES = {
    StopReason.WHEEL_DROP: SessionOutcome.WHEEL_DROP,
    StopReason.LEFT_SAFE_MODE: SessionOutcome.LEFT_SAFE_MODE,
    StopReason.SILENT: SessionOutcome.ROBOT_SILENT,
    StopReason.GARBLED: SessionOutcome.ROBOT_GARBLED,
    StopReason.UNPLUGGED: SessionOutcome.LINK_LOST,
    StopReason.UNGUARDED: SessionOutcome.WATCHDOG_GONE,
}
"""Outcome of a session by the reason for a stop. A contact of the bumper ends only the motion."""
REST_TIME = 0.15
"""Time for which a robot at rest must not move, s."""
MAX_READ_TIME = 1.0
"""Longest wait for a reading, s: the robot has another fault before."""


class CreateRig(PolledRig):
    """A Create without its touch; a context manager that leaves it at rest.

    Attributes:
        create: settings of the robot. robot: the device. monitor: of its touch. alive: [W] bool, sensors with
            a signal.
    """

    monitor: LightMonitor | StrainMonitor
    alive: np.ndarray

    def __init__(self, config: LiveConfig, stopped: Callable[[], bool]) -> None:
        assert config.create is not None
        PolledRig.__init__(self, config, stopped)
        self.create = config.create
        self.robot = CreateDriver(self.create)
        self._free = self.epoch  # newest time at which the bumper was not pressed
        self.doubt: Event | None = None  # what speaks against the odometry

    @property
    def fault(self) -> Fault | None:
        """The fault of what is read and written beside the robot, or None."""
        return None if self.recorder is None else self.recorder.fault

    @property
    def connection(self) -> int | None:
        """Number of the connection to the sensors; None while they are silent."""
        return 0

    def poll(self) -> None:
        """Reads the state of the robot; see `PolledRig`."""
        fault, stop = self.fault, self.robot.active_stop
        if stop is not None and stop.reason in OUTCOMES:
            detail = stop.detail
            if stop.reason is StopReason.UNPLUGGED:
                wait, port = self.create.replug, self.create.port
                detail += f"; a watchdog process waits {wait:g} s for {port} to return"
            raise session_fault(OUTCOMES[stop.reason], detail)
        if fault:
            raise SessionFault(fault)
        reply, now = self.robot.last_reply, time.monotonic()
        if reply is None or not reply.bumps & Bumps.BUMPED:
            self._free = now
        elif now - self._free > self.create.stuck:
            detail = f"pressed for {now - self._free:.1f} s, although the robot has backed off"
            raise session_fault(SessionOutcome.BUMPER_STUCK, detail)
        if self._stopped():
            raise OperatorStop

    def begin(self) -> None:
        """Sets time 0 of the session to now."""
        self.robot.refresh()
        self.robot.odometry()
        self.robot.gap()
        self.epoch = self._free = time.monotonic()

    @property
    def bumped(self) -> bool:
        """Whether a contact of the bumper has stopped the robot."""
        stop = self.robot.active_stop
        return stop is not None and stop.reason is StopReason.BUMPED

    def motion(self) -> Odometry:
        """The motion up to a new reading since the last call, by the wheels."""

        motion = self.robot.odometry()

        def read() -> bool:
            nonlocal motion
            self.robot.refresh()
            motion = self.robot.odometry()
            return motion.dt > 0

        if motion.dt <= 0:
            self.wait_until(read, MAX_READ_TIME, SessionOutcome.ROBOT_SILENT, "a reading")
        if self.doubt is None and (text := self.robot.doubt):
            self.doubt = Event(self.now(), "remainders", text)
            self.record_event(self.doubt.name, text)
        if self.robot.gap():
            self.record_event("discontinuity", "a reply of the robot was lost, perhaps with its motion")
        return motion

    def rest(self) -> bool:
        """Stops the robot; returns whether it replies and rests."""
        if self.robot.last_reply is None:
            return False
        self.robot.stop()
        self.robot.refresh()
        self.robot.odometry()
        good = self.robot.counts.good
        time.sleep(REST_TIME)
        self.robot.refresh()
        motion = self.robot.odometry()
        return self.robot.counts.good > good and not any(motion[:3])

    def reading(self, report: Report) -> Report | Observation:
        """What is passed on of a motion."""
        return report

    def strain_series(self, state: CreateState, rows: int) -> np.ndarray:
        """The samples [T, W, 2] of the first rows of a slow drive; T is 0 for other motions, without
        whiskers, or if too many were lost."""
        del state, rows
        return np.zeros((0, len(self.alive), 2))

    def __exit__(self, *_: object) -> None:
        self.robot.close()


class LightRig(CreateRig):
    """A Create 2 that feels walls by its bumper and its light bumpers."""

    monitor: LightMonitor

    def __init__(self, config: LiveConfig, stopped: Callable[[], bool]) -> None:
        super().__init__(config, stopped)
        self.monitor, self.alive = LightMonitor(self.create.plan.behaviour), np.ones(len(LIGHTS), bool)

    def begin(self) -> None:
        super().begin()
        self.record_event("light", str(self.monitor))

    def reading(self, report: Report) -> Observation:
        """The image of the light bumpers at the end of a motion and, of a pressed bumper, a contact towards
        the strongest of them, if any is above free air."""
        reply = self.robot.last_reply
        assert reply is not None
        image, motion = self.monitor.image(np.array(reply.light)), MotionKind(report.motion)
        bumped = report.moment == StepEnd.ABORT
        contact = (np.arange(len(image)) == image.argmax()) & (image > 0) & bumped
        plain = observation(report.odometry, image[None, :, None], motion=motion, whiskers=len(image))
        return plain._replace(contact=contact, point=self.monitor.edge * contact[:, None])


class WhiskeredRig(HeadRig, CreateRig):
    """A Create and its whiskers; `head` is the link to these."""

    monitor: StrainMonitor

    def __init__(self, config: LiveConfig, stopped: Callable[[], bool]) -> None:
        CreateRig.__init__(self, config, stopped)
        plan = self.create.plan
        fan = fixed_whiskers(plan.whiskers)
        self.alive = fan.alive.copy()
        reader = HeadReader(lambda: open_bridge(config.head.address), len(fan.base), config.head)
        HeadRig.__init__(self, config, reader, stopped)
        rate, period = plan.whiskers.rate, plan.behaviour.period
        self.monitor = StrainMonitor(rate, period, self.create.strain_per_radian, len(fan.base))
        self._connections = 0  # of the whiskers, seen so far

    @property
    def fault(self) -> Fault | None:
        return self.stream.fault or super().fault

    @property
    def connection(self) -> int | None:
        return self.stream.restarts if self.stream.streaming else None

    def poll(self) -> None:
        """Reads the samples of the whiskers and the state of the robot; see `HeadRig`."""
        for frames, arrival in self.stream.take():
            if self.stream.restarts != self._connections:
                self._connections = self.stream.restarts
                self.monitor.restart()
            if self.recorder is not None:
                self.recorder.add_frames(frames, arrival - self.epoch)
            self.monitor.add(frames)
        CreateRig.poll(self)

    def strain_series(self, state: CreateState, rows: int) -> np.ndarray:
        nothing = super().strain_series(state, rows)
        if state is not CreateState.FWD2:
            return nothing
        frames = self.head.ring.between(self.monitor.first, self.monitor.last_sample(rows))
        strain = self.monitor.series(frames, rows, self.config.gap)
        if not len(strain):
            self.record_event("dropped", "the strain of a slow drive: samples are missing")
            return nothing
        return _known(self, strain)

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        self.head.close()


RIGS = {"light": LightRig, "whiskers": WhiskeredRig}
"""The rig of a session on a Create, by `live.create.touch`."""


FREE_SDS = 8.0
"""Standard deviations of the signal in free air above its mean up to which it says nothing."""


class LightMonitor:
    """The light bumpers as six range touches.

    Their signals have no unit, and how they fall with the distance depends on the wall. So the image has the
    logarithm of each, from what it is at most in free air (0), learned at rest, to the largest signal (1).

    Attributes:
        free: [6] signals up to which nothing is near. edge: [6, 2] of the robot before each sensor, m.
    """

    def __init__(self, behaviour: BehaviourConfig) -> None:
        self._period, self._began = behaviour.period, time.monotonic()
        self.free = np.ones(len(LIGHTS))
        angle = np.radians(LIGHTS)
        self.edge = behaviour.body * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def __str__(self) -> str:
        return f"in free air up to {', '.join(f'{level:.0f}' for level in self.free)}, of {MOST_LIGHT}"

    def begin(self) -> None:
        """Starts a motion now."""
        self._began = time.monotonic()

    def rows(self, most: int) -> np.ndarray:
        """Zeros [T, 6, 2] for the periods of the motion, at most so many: light ends no motion."""
        passed = int((time.monotonic() - self._began) / self._period)
        return np.zeros((min(passed, most), len(LIGHTS), 2))

    def learn(self, signals: np.ndarray) -> None:
        """Learns what signals are in free air from those [N, 6] at rest there."""
        self.free = np.maximum(signals.mean(axis=0) + FREE_SDS * signals.std(axis=0), 1.0)

    def image(self, signals: np.ndarray) -> np.ndarray:
        """Pixels [6] in 0..1 of signals [6]; the nearer the higher."""
        log = np.log(np.maximum(signals, self.free) / self.free)
        return log / np.log(MOST_LIGHT / self.free)


MAX_ROWS = 2**16
"""Rows that are kept of a motion; later ones are ignored."""


class StrainMonitor:
    """Averages samples over the period of the state machine; counts samples, not the host's time.

    Args:
        rate: samples per second. period: of a row, s. strain_per_radian: of the sensors. whiskers: W.

    Attributes:
        rest: [W, 2] strain at rest, subtracted from all others. first: number of the first sample of the
            motion.
    """

    def __init__(self, rate: float, period: float, strain_per_radian: float, whiskers: int) -> None:
        self.rate, self.samples = rate, max(round(rate * period), 1)
        self.rest = np.zeros((whiskers, 2))
        self.first = 0
        self._scale = strain_per_radian
        self._sum = np.zeros((64, whiskers, 2))
        self._count = np.zeros(64, np.int64)
        self._newest: int | None = None

    def begin(self) -> None:
        """Starts a motion with the next sample."""
        self.first = 0 if self._newest is None else self._newest + 1
        self._sum[:], self._count[:] = 0.0, 0

    def restart(self) -> None:
        """Starts with the next sample, of any number: the head was connected."""
        self._newest = None
        self.begin()

    def add(self, frames: Frames) -> None:
        """Adds samples; those before the motion are ignored."""
        if self._newest is None:
            self.first = int(frames.sequence.min())
            self._newest = self.first - 1
        self._newest = max(self._newest, int(frames.sequence.max()))
        place = (frames.sequence - self.first) // self.samples
        mine = (place >= 0) & (place < MAX_ROWS)
        if not mine.any():
            return
        while len(self._count) <= place[mine].max():
            self._sum = np.concatenate([self._sum, np.zeros_like(self._sum)])
            self._count = np.concatenate([self._count, np.zeros_like(self._count)])
        np.add.at(self._sum, place[mine], self.strain(frames.values[mine]))
        np.add.at(self._count, place[mine], 1)

    def strain(self, values: np.ndarray) -> np.ndarray:
        """Strain [N, W, 2], horizontal and vertical, of the values of samples."""
        return to_radians(values)[1] * self._scale - self.rest

    def rows(self, most: int) -> np.ndarray:
        """Mean strain [T, W, 2] of the complete periods of the motion, at most the first `most`.

        A period of which all samples were lost repeats the one before.
        """
        passed = 0 if self._newest is None else (self._newest + 1 - self.first) // self.samples
        whole = min(passed, len(self._count), most)
        count = self._count[:whole]
        mean = self._sum[:whole] / np.maximum(count, 1)[:, None, None]
        known = np.maximum.accumulate(np.where(count > 0, np.arange(whole), 0))
        return mean[known]

    def last_sample(self, rows: int) -> int:
        """Number of the last sample of the first `rows` periods."""
        return self.first + rows * self.samples - 1

    def series(self, frames: Frames, rows: int, gap: int) -> np.ndarray:
        """Strain [T, W, 2] of every sample of the first `rows` periods; lost ones are interpolated.

        Args:
            frames: the present ones. gap: number of consecutive lost samples that makes the series unusable;
                it is then empty.
        """
        wanted = np.arange(self.first, self.last_sample(rows) + 1)
        strain = self.strain(frames.values)
        if len(frames.sequence) == len(wanted):
            return strain
        edges = np.concatenate([[wanted[0] - 1], frames.sequence, [wanted[-1] + 1]])
        if np.diff(edges).max() > gap:
            return strain[:0]
        flat = strain.reshape(len(strain), -1).T
        filled = np.stack([np.interp(wanted, frames.sequence, channel) for channel in flat], axis=1)
        return filled.reshape(len(wanted), *strain.shape[1:])


TICK = 0.005
"""Period of the poll during a motion, s."""
RENEW = 0.1
"""Time after which a drive command is sent again, s."""
LEAST_TURN = np.radians(2.0)
"""Remaining turn that is not executed: the robot measures whole degrees, rad."""
MAPPER_WAIT = 60.0
"""Longest wait of a robot at rest for its mapper, s."""


def run_create_loop(
    rig: CreateRig, mapper: AsyncMapper, tell: Callable[[float, CreateState, StepEnd], None]
) -> None:
    """Explores as the state machine does and passes on a report of every motion, until the planned end; then,
    and at any fault, the robot is stopped.

    Raises:
        robot.live.polling.SessionFault, robot.live.polling.OperatorStop.
    """
    plan = rig.create.plan
    random = stream(plan.seed, "behaviour")
    doing, touching = MachineState(CreateState.FWD1), np.zeros(len(rig.alive), bool)
    stamp, number = 0.0, 0
    try:
        while number < plan.reports if plan.reports else stamp < 60 * plan.minutes:
            _wait_for_mapper(rig, mapper)
            moment, contact, strain, sampled = _execute(rig, mapper, doing, touching)
            odometry = rig.motion()
            stamp += odometry.dt
            report = Report(
                odometry=odometry,
                motion=int(doing.state.motion),
                moment=int(moment),
                alive=rig.alive & sampled,
                contact=contact,
                time=np.arange(len(strain)) / plan.whiskers.rate,
                strain=strain,
            )
            sample = Sample(stamp, rig.reading(report), None)
            if rig.recorder is not None:
                rig.recorder.add(sample)
            mapper.offer(sample)
            tell(stamp, doing.state, moment)
            if not sampled and isinstance(rig, HeadRig):
                rig.await_samples("the whiskers send")  # the robot rests
            doing = next_state(plan.behaviour, doing, moment, odometry.dtheta, random, LEAST_TURN)
            touching, number = contact, number + 1
    finally:
        rig.robot.stop()


def _execute(
    rig: CreateRig, mapper: AsyncMapper, doing: MachineState, before: np.ndarray
) -> tuple[StepEnd, np.ndarray, np.ndarray, bool]:
    """Drives until the planned end, an early one, or the last sample of whiskers that fall silent.

    Args:
        before: [W] contacts at the end of the previous motion.

    Returns:
        the kind of end of the motion; [W] contacts at its end; [T, W, 2] strain; whether the whiskers sent
        samples to its end.
    """
    behaviour, monitor = rig.create.plan.behaviour, rig.monitor
    command = state_machine.wheel_command(behaviour, doing)
    last = state_machine.planned_rows(behaviour, command) - 1
    if rig.bumped:
        rig.robot.release()
    life = rig.connection
    monitor.begin()
    bumped: list[bool] = []
    driven = _drive(rig, command)
    polled, end = driven, None
    while end is None:
        time.sleep(TICK)
        rig.poll()
        check_mapper(mapper)
        now, before_poll = time.monotonic(), polled
        polled = now
        if now - before_poll > rig.create.patience:
            detail = f"the session stood still for {now - before_poll:.2f} s"
            raise session_fault(SessionOutcome.HOST_LATE, detail)
        if rig.connection is None or rig.connection != life:
            rig.robot.stop()
            whiskers = len(rig.alive)
            nothing = np.zeros(whiskers, bool), np.zeros((0, whiskers, 2))
            return StepEnd.FREE, *nothing, False
        rows = monitor.rows(last + 1)
        bumped += [rig.bumped] * (len(rows) - len(bumped))
        if len(rows):
            end = motion_end(behaviour, doing.state, _known(rig, rows), np.array(bumped), before, last)
        if end is None and now - driven > RENEW:
            driven = _drive(rig, command)
    row, moment = end
    if doing.state in (CreateState.FWD1, CreateState.TURN) and moment is StepEnd.FREE:
        rig.robot.refresh()  # the next motion probably goes on
    else:
        rig.robot.stop()
    contact = np.abs(_known(rig, rows)[row, :, 0]) > behaviour.contact
    return moment, contact, rig.strain_series(doing.state, row + 1), True


def _drive(rig: CreateRig, command: state_machine.WheelCommand) -> float:
    """Sends or renews a command; returns the time. A stopped robot is left to the next poll."""
    try:
        rig.robot.drive(command.speed, command.rate)
    except CommandRefused:
        if rig.robot.active_stop is None:
            raise
    return time.monotonic()


def _known(rig: CreateRig, rows: np.ndarray) -> np.ndarray:
    """Rows with zeros for whiskers without a signal."""
    return np.where(rig.alive[:, None], rows, 0.0)


def _wait_for_mapper(rig: CreateRig, mapper: AsyncMapper) -> None:
    """Waits, with the robot at rest, for a mapper that lags."""
    if mapper.behind() <= rig.create.budget:
        return
    rig.robot.stop()
    rig.record_event("held", "the mapper is behind")

    def caught_up() -> bool:
        return mapper.behind() <= rig.create.budget or not mapper.alive

    rig.wait_until(caught_up, MAPPER_WAIT, SessionOutcome.MAPPER_GONE, "the mapper, to catch up,")
    check_mapper(mapper)
    rig.record_event("resumed", "the mapper has caught up")
