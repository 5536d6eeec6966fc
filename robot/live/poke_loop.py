"""The poke loop: the arm stops at even distances along its route and pokes once in each direction."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.driver_config import ArmConfig, tcp_heading
from robot.drivers.ur10.safety import TargetRefused
from robot.live.arm_route import ArmRoute
from robot.live.live_rig import ArmRig
from robot.live.polling import TICK, AsyncMapper, check_mapper
from robot.live.whisk_loop import advance_route, refusal
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.base.se2 import between, wrap
from tactile.pokes import TURN_LENGTH, PokeConfig, learn_threshold, poke_angles, poke_observation

LONGEST_REST = 2.0
"""Time at rest on a route that waits after which a ring is poked again, s."""
SHARES = (1.0, 0.8, 0.6, 0.4, 0.2)
"""Shares of the way of a poke that are tried, if the arm has no joints for its end."""


class PokeReport(NamedTuple):
    """Report on a ring of pokes.

    Attributes:
        pose: [3] by the arm. depth: [D] of the pokes, m. contact: [D] bool. took: duration, s.
    """

    pose: np.ndarray
    depth: np.ndarray
    contact: np.ndarray
    took: float


class FreePokes(NamedTuple):
    """P pokes in free air, with their N states one after the other.

    Attributes:
        angle: [P] directions in the base frame, rad. touched: [P] ways up to a contact, m; NaN without one.
        back: [P] distances of the tool from its centre afterwards, m. states: [P] number of each. push: [N]
            force against the tool along its way, N. robot, host: [N] times of the states, s. ages: [M] age of
            the newest state at each poll, s.
    """

    angle: np.ndarray
    touched: np.ndarray
    back: np.ndarray
    states: np.ndarray
    push: np.ndarray
    robot: np.ndarray
    host: np.ndarray
    ages: np.ndarray

    def each(self, values: np.ndarray) -> list[np.ndarray]:
        """The values [N] of each poke."""
        return np.split(values, np.cumsum(self.states)[:-1])


def record_free_pokes(rig: ArmRig, pokes: PokeConfig) -> FreePokes:
    """Pokes in free air, once in each direction; of a long one at 500 states/s the last 8 s are recorded.

    Raises:
        robot.live.polling.SessionFault, robot.live.polling.OperatorStop.
    """
    centre, rows, parts, seen = _here(rig), [], [], len(rig.state_ages)
    for target in poke_targets(rig.config.arm, pokes, centre):
        way = target[:3] - centre[:3]
        if np.linalg.norm(way) <= rig.config.arm.arrive:  # at the border of the box
            continue
        first = rig.arm.shared.newest
        touched = _poke(rig, centre, target, pokes, float("inf"))
        new = rig.arm.states(first)
        push = -new["force"][:, :3] @ (way / np.linalg.norm(way))
        parts.append(np.stack([push, new["robot"], new["host"]]))
        _return(rig, centre, pokes)
        depth = np.nan if touched is None else np.linalg.norm((touched - centre)[:3])
        back = np.linalg.norm((_here(rig) - centre)[:3])
        rows.append((np.arctan2(way[1], way[0]), depth, back, len(new)))
    angle, depths, backs, states = np.array(rows).T
    push, robot, host = np.concatenate(parts, axis=1)
    ages = np.array(rig.state_ages[seen:])
    return FreePokes(angle, depths, backs, states.astype(int), push, robot, host, ages)


def learn_free_pokes(rig: ArmRig, pokes: PokeConfig) -> float:
    """Pokes in free air, once in each direction; returns the threshold of the rise, N.

    Raises:
        InputError: there was a contact, or the force is too uneven. robot.live.polling.SessionFault,
            robot.live.polling.OperatorStop.
    """
    record, arm = record_free_pokes(rig, pokes), rig.config.arm
    for angle, way in zip(np.degrees(record.angle), record.touched, strict=True):
        if np.isfinite(way):
            found = f"a contact in free air, {way:.3f} m towards {angle:.0f} degrees in the base frame"
            expected = f"{pokes.reach:g} m of free air around the tool above the start"
            raise InputError("live.lift", found, expected, "clear the way, or raise the lift")
    return learn_threshold(pokes, record.each(record.push), arm.hz, arm.force_limit)


def run_poke_loop(
    rig: ArmRig,
    route: ArmRoute,
    mapper: AsyncMapper,
    pokes: PokeConfig,
    threshold: float,
    tell: Callable[[PokeReport], None],
) -> None:
    """Pokes along the route and passes on every ring; ends with the ring where the arm arrives.

    Args:
        threshold: rise of the force that counts as a contact, N.

    Raises:
        robot.live.polling.SessionFault, robot.live.polling.OperatorStop.
    """
    number, most, arrived = 0, rig.config.whisks, False
    while True:
        tell(_poke_ring(rig, mapper, pokes, threshold))
        number += 1
        if arrived or number == most:
            return
        arrived = _move_on(rig, route, mapper, pokes.every)


def poke_targets(arm: ArmConfig, pokes: PokeConfig, centre: np.ndarray) -> list[np.ndarray]:
    """Tool poses [6] at the ends of the pokes around a tool pose [6]; each ends at the box at the latest."""
    low, high, found = np.array(arm.box.low[:2]), np.array(arm.box.high[:2]), []
    for angle in poke_angles(pokes) + tcp_heading(centre):
        along = np.array([np.cos(angle), np.sin(angle)])
        with np.errstate(divide="ignore"):
            room = np.where(along > 0, high - centre[:2], low - centre[:2]) / along
        way = min(pokes.reach, float(room[along != 0].min()))
        found.append(np.array([*(centre[:2] + max(way, 0.0) * along), *centre[2:]]))
    return found


def _here(rig: ArmRig) -> np.ndarray:
    state = rig.arm.latest()
    assert state is not None
    return state["tcp"].copy()


def _poke_ring(rig: ArmRig, mapper: AsyncMapper, pokes: PokeConfig, threshold: float) -> PokeReport:
    """Pokes in each direction, records the ring and passes it on."""
    rig.poll()
    began, centre = time.monotonic(), _here(rig)
    stamp = began - rig.epoch
    odometry, truth = rig.odometer.step(stamp, began)
    targets = poke_targets(rig.config.arm, pokes, centre)
    depth, contact = np.full(len(targets), pokes.reach), np.zeros(len(targets), bool)
    for k, target in enumerate(targets):
        check_mapper(mapper)
        touched = _poke(rig, centre, target, pokes, threshold)
        if touched is not None:
            depth[k], contact[k] = np.linalg.norm((touched - centre)[:3]), True
        _return(rig, centre, pokes)
    sample = Sample(stamp, poke_observation(pokes, depth, contact, odometry), truth)
    if rig.recorder is not None:
        rig.recorder.add(sample)
    mapper.offer(sample)
    return PokeReport(truth, depth, contact, time.monotonic() - began)


def _poke(
    rig: ArmRig, centre: np.ndarray, target: np.ndarray, pokes: PokeConfig, threshold: float
) -> np.ndarray | None:
    """Pokes from a centre towards a target [6], less far where the arm cannot reach it; returns the tool pose
    [6] at the contact, or None without one."""
    arm = rig.arm
    for share in SHARES:
        try:
            arm.poke(np.array([*(centre + share * (target - centre))[:3], *centre[3:]]), pokes, threshold)
        except TargetRefused as error:
            raise refusal(rig, error) from error
        _wait(rig, lambda: arm.touched is not None or arm.too_far or arm.arrived())
        if not arm.too_far:
            break
    return arm.touched


def _return(rig: ArmRig, centre: np.ndarray, pokes: PokeConfig) -> None:
    """Moves the tool back to the centre [6] of its ring."""
    _wait(rig, rig.arm.still)
    try:
        rig.arm.move(centre, min(pokes.retract, rig.config.arm.speed))
    except TargetRefused as error:
        raise refusal(rig, error) from error
    _wait(rig, rig.arm.arrived)


def _wait(rig: ArmRig, done: Callable[[], bool]) -> None:
    """Polls until a condition is true; the arm limits the time of each move by its plan."""
    rig.wait_until(done, float("inf"), SessionOutcome.NOT_ARRIVED, "a poke")


def _move_on(rig: ArmRig, route: ArmRoute, mapper: AsyncMapper, every: float) -> bool:
    """Moves along the route by `every` m, or until it rests; returns whether the arm is at its end."""
    before, rested = rig.odometer.pose(time.monotonic()), time.monotonic()
    while True:
        rig.poll()
        check_mapper(mapper)
        now = time.monotonic()
        if advance_route(rig, route):
            return True
        dx, dy, turn = between(before, rig.odometer.pose(now))
        if np.hypot(dx, dy) + TURN_LENGTH * abs(wrap(turn)) >= every:
            break
        if not rig.arm.still() or mapper.behind() > 0:
            rested = now
        elif now - rested > LONGEST_REST:
            break
        time.sleep(TICK)
    rig.arm.halt()
    _wait(rig, rig.arm.still)
    route.resend_last()
    return False
