"""Checks of targets and states, used in both processes, and checks before the arm is armed.

They complement the robot's own safety configuration and do not replace it. Checks of targets, commands and
states are pure functions. Where a time limit was exceeded, the finding tells whether this machine was late or
the controller: a machine that is late by half of a limit explains why it was exceeded.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.driver_config import ROUNDING, SPEED_CAP, ArmConfig, tcp_tilt
from tactile.base.errors import InputError

REACH = 3.0  # m; a UR-10 reaches 1.3. A larger distance means an invalid state
JOINT_RANGE = 2.2 * np.pi  # rad; a UR joint turns by 2 pi either way
MIN_LOADED = 2  # consecutive states above the force limit that count as a contact
RETREAT_SPEED = 0.02  # m/s; speed of backing off
MIN_SPEED = 1e-3  # m/s; lowest speed of a move
MOVED_ON = 1e-3  # m; possible motion of the arm since the session read a state

# Safety status bits of RTDE, most severe first.
SAFETY_BITS = (
    (0b11100000, SessionOutcome.EMERGENCY_STOP, "an emergency stop is pressed"),
    (1 << 2, SessionOutcome.PROTECTIVE_STOP, "the controller made a protective stop"),
    (1 << 4, SessionOutcome.SAFEGUARD_STOP, "a safeguard is open"),
    (1 << 3, SessionOutcome.PROTECTIVE_STOP, "the controller is in recovery mode"),
    (1 << 8, SessionOutcome.PROTECTIVE_STOP, "the controller reports a safety violation"),
    (1 << 9, SessionOutcome.PROTECTIVE_STOP, "the controller reports a safety fault"),
    (1 << 10, SessionOutcome.PROTECTIVE_STOP, "the controller stopped for safety"),
)
SAFETY_STOPS = {outcome for _, outcome, _ in SAFETY_BITS}
"""Outcomes after which a controller may resume its program: the program is ended."""


class TargetRefused(ValueError):
    """A rejected target."""


class Move(NamedTuple):
    """A checked straight move.

    Attributes:
        target: [6] tool pose. speed: m/s, as sent to the controller. seconds: expected duration.
        most: duration on a controller with 1 rad/s per m/s of commanded speed, s.
    """

    target: np.ndarray
    speed: float
    seconds: float
    most: float


class Finding(NamedTuple):
    """A reason to stop the arm: outcome and detail."""

    outcome: SessionOutcome
    detail: str


StateMemory = tuple[int, float]
"""Memory between checks of consecutive states: number of consecutive states above the force limit, and the
controller's time of the last state, s."""
NO_STATE: StateMemory = (0, -np.inf)


def check_target(config: ArmConfig, target: Any, from_tcp: Any) -> np.ndarray:
    """Checks that the arm may move to a target in a straight line from its present pose; returns the target
    [6].

    The box is convex: a line between two points in it stays in it.

    Raises:
        TargetRefused: the target or the present pose is invalid.
    """
    try:
        target = np.array(target, np.float64)
    except (TypeError, ValueError):
        raise TargetRefused(f"a target must be six numbers, not {target!r}") from None
    if target.shape != (6,):
        raise TargetRefused(f"a target must be six numbers, not of shape {target.shape}")
    if not np.isfinite(target).all():
        raise TargetRefused(f"a target must be finite: {target.tolist()}")
    if not config.box.contains(target):
        raise TargetRefused(f"{_place(target)} lies outside the box {_box(config)}")
    if math.hypot(*target[3:]) > 2 * np.pi:
        raise TargetRefused(f"a rotation vector is at most one turn long: {target[3:].tolist()}")
    lean = np.degrees(tcp_tilt(target))
    if lean > config.tilt_deg + ROUNDING:
        allowed = f"{config.tilt_deg:g} are allowed"
        raise TargetRefused(f"the tool would lean {lean:.1f} degrees from straight down; {allowed}")
    start = np.asarray(from_tcp, np.float64)
    if start.shape != (6,) or not np.isfinite(start).all() or not config.box.contains(start):
        found = f"the tool stands at {_place(start)}, outside the box {_box(config)}"
        raise TargetRefused(f"{found}: bring it in by hand")
    return target


def plan_move(config: ArmConfig, target: Any, from_tcp: Any, speed: float | None = None) -> Move:
    """Plans a checked move at a checked speed (m/s; None: the configured one).

    A controller gets the speed of the tool centre point only, and derives the turning rate from it
    (`turn_ratio`). A path shorter than speed^2 / acceleration, or than 1 mm, counts as a turn on the spot:
    the tool cannot exceed `speed` on it at any commanded speed. On longer paths the commanded speed is
    `speed`, or less where the turning rate derived from it would exceed that on the spot.
    """
    target = check_target(config, target, from_tcp)
    speed = config.speed if speed is None else speed
    if not (isinstance(speed, float | int) and MIN_SPEED <= speed <= config.speed):
        raise TargetRefused(f"a speed must be {MIN_SPEED:g} to {config.speed:g} m/s, not {speed!r}")
    start = np.asarray(from_tcp, np.float64)
    way, turn = float(np.linalg.norm(target[:3] - start[:3])), rotation_angle(start, target)
    if way <= max(speed**2 / config.acceleration, MOVED_ON) and turn / config.turn_rate > way / speed:
        commanded = config.turn_rate / config.turn_ratio
    else:
        commanded = min(speed, config.turn_rate / config.turn_ratio if turn > way else speed)
    seconds = max(way, turn / config.turn_ratio) / commanded + commanded / config.acceleration
    return Move(target, commanded, seconds, max(way, turn) / commanded + commanded / config.acceleration)


def check_command(config: ArmConfig, target: Any, from_tcp: Any, commanded: float) -> np.ndarray:
    """Checks target [6] and speed (m/s) just before a command is sent; returns the target.

    Raises:
        TargetRefused: a limit is exceeded.
    """
    target = check_target(config, target, from_tcp)
    way = float(np.linalg.norm(target[:3] - np.asarray(from_tcp, np.float64)[:3]))
    short = way <= max(config.speed**2 / config.acceleration, MOVED_ON) + MOVED_ON
    most = max(config.speed, config.turn_rate / config.turn_ratio) if short else config.speed
    if not (isinstance(commanded, float | int) and 0 < commanded <= min(most, SPEED_CAP)):
        found = f"a commanded speed of {commanded!r} m/s over {way:.3f} m"
        raise TargetRefused(f"{found}; at most {most:g} is allowed")
    return target


def rotation_angle(a: np.ndarray, b: np.ndarray) -> float:
    """Angle in [0, pi] between the rotations of two tool poses [6], rad."""
    p, q = _quaternion(a[3:]), _quaternion(b[3:])
    chord = min(np.linalg.norm(p - q), np.linalg.norm(p + q))  # q and -q are the same rotation
    return float(4 * np.arcsin(min(1.0, float(chord) / 2)))


def at_target(config: ArmConfig, tcp: np.ndarray, target: np.ndarray) -> bool:
    """Whether a tool pose is at the target, within the configured tolerances."""
    near = float(np.linalg.norm(tcp[:3] - target[:3])) <= config.arrive
    return near and np.degrees(rotation_angle(tcp, target)) <= config.arrive_turn_deg


def at_rest(state: np.ndarray) -> bool:
    """Whether a state (ARM_STATE) shows an arm at rest: under 0.5 mm/s and 0.3 degrees/s."""
    speed = state["speed"]
    return bool(np.linalg.norm(speed[:3]) < 0.5e-3 and np.linalg.norm(speed[3:]) < 5e-3)


def check_state(
    config: ArmConfig, watch: StateMemory, state: np.ndarray, rest: np.ndarray, most: float | None = None
) -> tuple[StateMemory, Finding | None]:
    """Checks a state (ARM_STATE); returns the memory for the next one and the reason to stop, or None.

    Args:
        watch: memory of the previous state. rest: [6] force of the arm at rest, N and Nm. most: force limit
            instead of the configured one, N.
    """
    numbers = [state["robot"], *state["tcp"], *state["speed"], *state["force"], *state["joints"]]
    limit = config.force_limit if most is None else most
    force = math.hypot(*(state["force"][:3] - rest[:3]))
    loaded = 0 if force <= limit else watch[0] + 1  # NaN counts as above the limit
    after = loaded, float(state["robot"])
    if not np.isfinite(numbers).all():
        return after, Finding(SessionOutcome.ARM_MALFORMED, "a state has values that are not finite")
    if np.abs(state["tcp"][:3]).max() > REACH or np.abs(state["joints"]).max() > JOINT_RANGE:
        found = f"an impossible state: tool at {_place(state['tcp'])}"
        return after, Finding(SessionOutcome.ARM_MALFORMED, found)
    if state["robot"] <= watch[1]:
        return after, Finding(SessionOutcome.CLOCK_JUMPED, "the controller's clock went back")
    for bits, outcome, text in SAFETY_BITS:
        if int(state["safety"]) & bits:
            return after, Finding(outcome, text)
    if not config.box.contains(state["tcp"]):
        found = f"{_place(state['tcp'])} lies outside the box {_box(config)}"
        return after, Finding(SessionOutcome.OUT_OF_BOX, found)
    if loaded >= MIN_LOADED:
        return after, Finding(SessionOutcome.CONTACT, f"{force:.0f} N at the tool at {_place(state['tcp'])}")
    return after, None


def retreat_target(config: ArmConfig, states: np.ndarray) -> np.ndarray | None:
    """Target of the retreat after a contact: `backoff` from the newest state towards earlier positions.

    Args:
        states: [N] ARM_STATE, oldest first, up to the contact.

    Returns:
        [6] tool pose in the box; None if the states do not show the motion before the contact.
    """
    here = states[-1]["tcp"]
    away = np.linalg.norm(states["tcp"][:, :3] - here[:3], axis=1)
    far = np.flatnonzero(away >= min(config.backoff, 0.002))
    if not len(far) or not config.backoff:
        return None
    back = np.flatnonzero(away >= config.backoff)
    from_tcp = states[back[-1] if len(back) else far[-1]]["tcp"]
    step = from_tcp[:3] - here[:3]
    place = here[:3] + config.backoff * step / np.linalg.norm(step)
    return np.concatenate([np.clip(place, config.box.low, config.box.high), here[3:]])


def _quaternion(vector: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle else np.zeros(3)
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)])


def _place(tcp: np.ndarray) -> str:
    return "(" + ", ".join(f"{float(v):.3f}" for v in np.atleast_1d(tcp)[:3]) + ") m"


def _box(config: ArmConfig) -> str:
    return f"{config.box.low} .. {config.box.high} m"


EXPLAINED_SHARE = 0.5


def stale_finding(age: float, late: float, limit: float) -> Finding:
    """No new state for `age` s, more than `limit` s.

    Args:
        late: lateness of this machine within the last second, s.
    """
    detail = f"no new state for {age:.3f} s"
    if late < EXPLAINED_SHARE * limit:
        return Finding(SessionOutcome.ARM_STALE, detail)
    return Finding(SessionOutcome.HOST_LATE, f"this machine was {late:.3f} s late: {detail}")


def ended_script_finding(config: ArmConfig, unreset: float, late: float) -> Finding:
    """The control script has ended on the controller.

    Args:
        unreset: longest time between two resets of its watchdog within the last second, s. late: lateness
            of this machine, s.
    """
    detail, limit = "the control script ended on the controller", 1 / config.watchdog_hz
    if unreset < limit:
        return Finding(SessionOutcome.ARM_GONE, detail)
    detail += f"; its watchdog was not reset for {unreset:.3f} s, and {limit:g} s are allowed"
    if late < EXPLAINED_SHARE * limit and not config.emulated:
        return Finding(SessionOutcome.ARM_GONE, detail)
    # An emulated controller answers late because this machine is.
    late = max(late, unreset - limit)
    return Finding(SessionOutcome.HOST_LATE, f"this machine was {late:.3f} s late: {detail}")


MIN_RATE_SHARE = 0.9  # share of the nominal state rate that is required
RATE_WINDOW = 0.25  # s of states over which the rate is measured


class StartupRefused(InputError):
    """A startup check failed; the arm has not moved."""

    def __init__(self, found: str, expected: str = "", cure: str = "") -> None:
        super().__init__("arm", found, expected, cure)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.found, self.expected, self.cure)


def check_controller(config: ArmConfig) -> dashboard.ControllerStatus:
    """Asks for the status of the controller and checks it."""
    try:
        with dashboard.Dashboard(config.host) as connection:
            controller = connection.controller()
            with contextlib.suppress(dashboard.DashboardSilent):
                if controller.program:  # a stopped program ends with a delay
                    time.sleep(0.3)
                    controller = connection.controller()
    except dashboard.DashboardSilent as silent:
        cure = "check the cable, the address and that the controller is on"
        raise StartupRefused(str(silent), "", cure) from None
    version, mode, safety, program, remote = controller
    polyscope = f"PolyScope {'.'.join(map(str, version))}"
    faulty, local = safety not in ("NORMAL", "REDUCED"), remote is False
    for wrong, *words in (
        (version < dashboard.MIN_POLYSCOPE, polyscope, "3.4 or newer", "update the controller"),
        (mode != "RUNNING", f"robot mode {mode}", "RUNNING", "power the arm on and release its brakes"),
        (faulty, f"safety mode {safety}", "NORMAL or REDUCED", "release the stop on the pendant"),
        (local, "under local control", "remote control", "switch it on the pendant, at the upper right"),
        (program, "a program runs on the controller", "none", "stop it on the pendant"),
    ):
        if wrong:
            raise StartupRefused(*words)
    return controller


def check_states(config: ArmConfig, states: Callable[[], np.ndarray]) -> None:
    """Checks the rate of the newest states and the position of the tool.

    The rate may recover within `config.connect` s, since the host may have been busy.

    Args:
        states: returns the states [N] (ARM_STATE) since the start of the RTDE process.

    Raises:
        StartupRefused: the stream is too slow, or the tool is outside the box.
    """
    until = time.monotonic() + config.connect
    while True:
        recent = states()["host"][-int(RATE_WINDOW * config.hz) :]
        rate = (len(recent) - 1) / float(np.ptp(recent)) if len(recent) > 1 else 0.0
        if not rate < MIN_RATE_SHARE * config.hz:
            break
        if time.monotonic() > until:
            cure = "a CB3 has 125 Hz only; check the network and the load of this machine"
            raise StartupRefused(f"stream at {rate:.0f} of {config.hz} Hz", "", cure)
        time.sleep(0.05)
    here = states()[-1]["tcp"]
    if not config.box.contains(here):
        found = f"the tool stands at {_place(here)}, outside the box"
        raise StartupRefused(found, "", "move it into the box by hand")
