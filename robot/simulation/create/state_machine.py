"""The finite state machine of the Create (Fox et al. 2012, II-C): transitions, motions and their ends.

    FWD1 -> FWD1 ... HIT1 -> FWD2 -> HIT2 or ABORT -> BACK -> TURN -> FWD1

Forward until a whisker touches; slowly forward until a second one touches or the strain of one exceeds the
safe limit; back; a turn. Excessive strain or contact of the body ends a motion early and is followed by BACK.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from tactile.base.settings import Settings
from tactile.base.types import MotionKind, StepEnd

Share = Annotated[float, Field(ge=0, le=1)]
MIN_TURN = 1e-6
"""Smallest turn that is executed, rad."""


class CreateState(IntEnum):
    """State of the machine."""

    FWD1 = 0
    FWD2 = 1
    BACK = 2
    TURN = 3

    @property
    def motion(self) -> MotionKind:
        return (MotionKind.FORWARD, MotionKind.FORWARD, MotionKind.BACK, MotionKind.TURN)[self]


class TurnConfig(Settings):
    """Turn angles: drawn from one of two Gaussians, anticlockwise positive. The paper gives N(0.14 pi, 0) and
    N(0.3 pi, 0.25 pi), but not the probability of each."""

    rate: PositiveFloat = 0.3
    """Turn rate, rad/s."""
    small: float = 0.14 * np.pi
    """Mean of the small turn, which follows walls, rad."""
    small_spread: NonNegativeFloat = 0.0
    """Its second number, rad or rad2."""
    large: float = 0.3 * np.pi
    """Mean of the large turn, which leaves walls, rad."""
    large_spread: NonNegativeFloat = 0.25 * np.pi
    """Its second number, rad or rad2."""
    spread: Literal["sd", "variance"] = "sd"
    """Meaning of the spreads: standard deviation or variance; the paper says variance."""
    share: Share = 0.8
    """Probability of a small turn. The default reproduces the circuits of the paper."""
    step: PositiveFloat | None = 0.5
    """Duration of a step of a turn, s; null: a turn is one step of any duration."""


class BehaviourConfig(Settings):
    """Settings of the state machine; speeds, times and angles are from the paper, which has no others."""

    fast: PositiveFloat = 0.05
    """Speed of FWD1 and BACK, m/s."""
    slow: PositiveFloat = 0.02
    """Speed of FWD2, m/s."""
    step: PositiveFloat = 0.5
    """Duration of FWD1 and BACK, s."""
    least: NonNegativeFloat = 0.1
    """Shortest FWD2, s: simultaneous contacts of two whiskers count from its start on."""
    patience: PositiveFloat = 2.0
    """Longest FWD2, s; without a second contact it ends with ABORT."""
    turn: TurnConfig = TurnConfig()
    """Turns."""
    period: PositiveFloat = 0.01
    """Period of the strain monitor during a motion, s."""
    contact: PositiveFloat = 2e-4
    """Strain of a contact: a tip deflection of 9 mm, less nearer to the base."""
    safety: PositiveFloat = 2e-3
    """Strain beyond which a motion is aborted."""
    body: PositiveFloat = 0.17
    """Radius of the robot, m."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for less, more in (("contact", "safety"), ("period", "step"), ("least", "patience")):
            if getattr(self, less) >= getattr(self, more):
                raise ValueError(f"{less}: {getattr(self, less):g} is not less than {more}")
        return self


class WheelCommand(NamedTuple):
    """A motion: speed ahead (m/s), turn rate (rad/s counter-clockwise), longest duration (s)."""

    speed: float
    rate: float
    duration: float


class MachineState(NamedTuple):
    """State of the machine, and the remaining turn, rad (0 except in TURN)."""

    state: CreateState
    rest: float = 0.0


def wheel_command(config: BehaviourConfig, doing: MachineState) -> WheelCommand:
    """The wheel command of a step."""
    if doing.state == CreateState.FWD1:
        return WheelCommand(config.fast, 0.0, config.step)
    if doing.state == CreateState.FWD2:
        return WheelCommand(config.slow, 0.0, config.patience)
    if doing.state == CreateState.BACK:
        return WheelCommand(-config.fast, 0.0, config.step)
    whole = abs(doing.rest) / config.turn.rate
    rate = float(np.copysign(config.turn.rate, doing.rest))
    return WheelCommand(0.0, rate, min(whole, config.turn.step or whole))


def drive(command: WheelCommand, pose: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Poses [T, 3] at times [T] s of a motion from a pose, straight or on the spot."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    ahead, turned = command.speed * time, command.rate * time
    return np.column_stack([pose[0] + c * ahead, pose[1] + s * ahead, pose[2] + turned])


def planned_rows(config: BehaviourConfig, command: WheelCommand) -> int:
    """Rows of the monitor in a motion of the planned duration, at least 1."""
    return max(int(np.ceil(command.duration / config.period - 1e-9)), 1)


def motion_end(
    config: BehaviourConfig,
    state: CreateState,
    strain: np.ndarray,
    bumped: np.ndarray,
    before: np.ndarray,
    last: int,
) -> tuple[int, StepEnd] | None:
    """The end of a motion in a state, by whiskers, body or time: row of the monitored strain, and kind of
    end; None if the rows so far have none.

    Args:
        strain: [T, W, 2] and bumped: [T] bool, monitored every `period`. before: [W] bool, whiskers in
            contact at its start. last: row of the planned end.
    """
    ends = []
    if len(strain) > last:
        ends.append((last, 3, StepEnd.ABORT if state == CreateState.FWD2 else StepEnd.FREE))
    if state == CreateState.BACK:  # only a contact of the body ends BACK early
        ends += [(_first(bumped), 1, StepEnd.FREE)] if bumped.any() else []
    else:
        level = np.abs(strain[..., 0])
        over = np.abs(strain).max(axis=2) > config.safety
        if state == CreateState.TURN:
            # Whiskers above the safe limit from the start end a turn only if their strain increases.
            over &= level > 1.1 * level[0]
        stop = over.any(axis=1) | bumped
        if stop.any():
            ends.append((_first(stop), 1, StepEnd.ABORT))
        touching = level > config.contact
        if state == CreateState.FWD1 and touching.any():
            ends.append((_first(touching.any(axis=1)), 2, StepEnd.HIT1))
        if state == CreateState.FWD2:
            ever = np.logical_or.accumulate(touching | before, axis=0).sum(axis=1) >= 2
            ever[: min(round(config.least / config.period), last)] = False
            if ever.any():
                ends.append((_first(ever), 2, StepEnd.HIT2))
    if not ends:
        return None
    row, _, moment = min(ends)
    return row, moment


def _first(flags: np.ndarray) -> int:
    return int(np.argmax(flags))


def next_state(
    config: BehaviourConfig,
    doing: MachineState,
    moment: StepEnd,
    turned: float,
    random: np.random.Generator,
    least_turn: float = MIN_TURN,
) -> MachineState:
    """The next state after a step that ended at `moment` and turned by `turned` rad. The turn after BACK is
    drawn, at most half a turn either way.

    Args:
        least_turn: remaining turn that is not executed any more, rad: that which the odometry resolves.
    """
    if doing.state == CreateState.BACK:
        which, normal = random.random(), random.standard_normal()
        mean, spread = config.turn.small, config.turn.small_spread
        if which >= config.turn.share:
            mean, spread = config.turn.large, config.turn.large_spread
        sd = np.sqrt(spread) if config.turn.spread == "variance" else spread
        return MachineState(CreateState.TURN, float(np.clip(mean + sd * normal, -np.pi, np.pi)))
    if doing.state == CreateState.FWD2 or moment == StepEnd.ABORT:
        return MachineState(CreateState.BACK)
    rest = doing.rest - turned
    if doing.state == CreateState.TURN and abs(rest) > least_turn:
        return MachineState(CreateState.TURN, rest)
    return MachineState(CreateState.FWD2 if moment == StepEnd.HIT1 else CreateState.FWD1)
