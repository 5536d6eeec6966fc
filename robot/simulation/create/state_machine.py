"""The Create's finite state machine (Fox et al. 2012, II-C): what it does next, and when a motion ends.

    FWD1 -> FWD1 ... HIT1 -> FWD2 -> HIT2 or ABORT -> BACK -> TURN -> FWD1

Driving on until a whisker touches; on, slowly, until a second one does or any is strained too much; back; a
turn. Whatever strains a whisker too much, or bumps the body, ends a motion early and has it go back.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from tactile.base.config import Settings
from tactile.base.types import MotionKind, StepEnd

Share = Annotated[float, Field(ge=0, le=1)]
MIN_TURN = 1e-6
"""Turn that is not worth a step, rad."""


class CreateState(IntEnum):
    """What the robot is doing."""

    FWD1 = 0
    FWD2 = 1
    BACK = 2
    TURN = 3

    @property
    def motion(self) -> MotionKind:
        return (MotionKind.FORWARD, MotionKind.FORWARD, MotionKind.BACK, MotionKind.TURN)[self]


class TurnConfig(Settings):
    """How far it turns: one of two Gaussians by chance, positive being anticlockwise. The paper gives them as
    N(0.14 pi, 0) and N(0.3 pi, 0.25 pi), not how often each is drawn."""

    rate: PositiveFloat = 0.3
    """rad/s"""
    small: float = 0.14 * np.pi
    """Mean of the one that follows walls, rad."""
    small_spread: NonNegativeFloat = 0.0
    """Its second number, rad or rad2."""
    large: float = 0.3 * np.pi
    """Mean of the one that leaves them."""
    large_spread: NonNegativeFloat = 0.25 * np.pi
    """Its second number, rad or rad2."""
    spread: Literal["sd", "variance"] = "sd"
    """What the second numbers are; the paper says variance of a quantity in rad."""
    share: Share = 0.8
    """Of turns drawn from the small one. This many give the paper's circuits."""
    step: PositiveFloat | None = 0.5
    """Duration of a step of it, s, as of all others; none: a turn is one step, however long."""


class BehaviourConfig(Settings):
    """The state machine; speeds, times and angles are the paper's, the rest is left open there."""

    fast: PositiveFloat = 0.05
    """Speed of FWD1 and BACK, m/s."""
    slow: PositiveFloat = 0.02
    """Of FWD2, m/s."""
    step: PositiveFloat = 0.5
    """Duration of FWD1 and BACK, s."""
    least: NonNegativeFloat = 0.1
    """Shortest FWD2, s: whiskers that touch at once are two contacts from the start."""
    patience: PositiveFloat = 2.0
    """Longest FWD2, s; it is given up (ABORT) without a second contact by then."""
    turn: TurnConfig = TurnConfig()
    """TURN."""
    period: PositiveFloat = 0.01
    """Time between looks at the strains within a motion, s."""
    contact: PositiveFloat = 2e-4
    """Strain that is a contact: a tip bent aside by 9 mm, less nearer to the base."""
    safety: PositiveFloat = 2e-3
    """Strain that is too much."""
    body: PositiveFloat = 0.17
    """Radius of the robot, m."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for less, more in (("contact", "safety"), ("period", "step"), ("least", "patience")):
            if getattr(self, less) >= getattr(self, more):
                raise ValueError(f"{less}: {getattr(self, less):g} is not less than {more}")
        return self


class WheelCommand(NamedTuple):
    """A motion: m/s ahead, rad/s counter-clockwise, for s at most."""

    speed: float
    rate: float
    duration: float


class MachineState(NamedTuple):
    """The machine's state, and how far it has yet to turn, rad (0 but in TURN)."""

    state: CreateState
    rest: float = 0.0


def wheel_command(config: BehaviourConfig, doing: MachineState) -> WheelCommand:
    """What the wheels are told to do for a step."""
    if doing.state == CreateState.FWD1:
        return WheelCommand(config.fast, 0.0, config.step)
    if doing.state == CreateState.FWD2:
        return WheelCommand(config.slow, 0.0, config.patience)
    if doing.state == CreateState.BACK:
        return WheelCommand(-config.fast, 0.0, config.step)
    whole = abs(doing.rest) / config.turn.rate
    return WheelCommand(
        0.0, float(np.copysign(config.turn.rate, doing.rest)), min(whole, config.turn.step or whole)
    )


def draw_turn(config: TurnConfig, random: np.random.Generator) -> float:
    """How far to turn, rad: half a turn at most either way."""
    which, normal = random.random(), random.standard_normal()
    small = which < config.share
    mean, spread = (config.small, config.small_spread) if small else (config.large, config.large_spread)
    sd = np.sqrt(spread) if config.spread == "variance" else spread
    return float(np.clip(mean + sd * normal, -np.pi, np.pi))


def drive(command: WheelCommand, pose: np.ndarray, time: np.ndarray) -> np.ndarray:
    """[T, 3] the poses at times [T] s of a motion from a pose: straight or on the spot."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    ahead, turned = command.speed * time, command.rate * time
    return np.column_stack([pose[0] + c * ahead, pose[1] + s * ahead, pose[2] + turned])


class MotionEnd(NamedTuple):
    """How a motion ended: at which row of what was monitored, and at which moment of the machine."""

    row: int
    moment: StepEnd


def motion_end(
    config: BehaviourConfig, state: CreateState, strain: np.ndarray, bumped: np.ndarray, before: np.ndarray
) -> MotionEnd:
    """When a motion in a state ends.

    Args:
        strain: [T, W, 2] and bumped: [T] bool, as monitored in it every `period`; the last row is the end as
            planned. before: [W] bool, whiskers that touched as it began.
    """
    last = len(strain) - 1
    level = np.abs(strain[..., 0])
    over = np.abs(strain).max(axis=2) > config.safety
    ends: list[tuple[int, int, StepEnd]] = [
        (last, 9, StepEnd.ABORT if state == CreateState.FWD2 else StepEnd.FREE)
    ]
    if state == CreateState.BACK:
        return MotionEnd(_first(bumped, last), StepEnd.FREE)  # nothing to go back to
    if state == CreateState.TURN:
        # What was strained too much already ends it only by getting worse.
        over &= level > 1.1 * level[0]
    stop = over.any(axis=1) | bumped
    if stop.any():
        ends.append((_first(stop, last), 1, StepEnd.ABORT))
    touching = level > config.contact
    if state == CreateState.FWD1 and touching.any():
        ends.append((_first(touching.any(axis=1), last), 2, StepEnd.HIT1))
    if state == CreateState.FWD2:
        ever = np.logical_or.accumulate(touching | before, axis=0).sum(axis=1) >= 2
        ever[: min(round(config.least / config.period), last)] = False
        if ever.any():
            ends.append((_first(ever, last), 2, StepEnd.HIT2))
    row, _, moment = min(ends)
    return MotionEnd(row, moment)


def _first(flags: np.ndarray, otherwise: int) -> int:
    return int(np.argmax(flags)) if flags.any() else otherwise


def next_state(
    config: BehaviourConfig, doing: MachineState, moment: StepEnd, turned: float, random: np.random.Generator
) -> MachineState:
    """What is done after a step that ended so, having turned by so much (rad)."""
    if doing.state == CreateState.BACK:
        return MachineState(CreateState.TURN, draw_turn(config.turn, random))
    if doing.state == CreateState.FWD2 or moment == StepEnd.ABORT:
        return MachineState(CreateState.BACK)
    rest = doing.rest - turned
    if doing.state == CreateState.TURN and abs(rest) > MIN_TURN:
        return MachineState(CreateState.TURN, rest)
    return MachineState(CreateState.FWD2 if moment == StepEnd.HIT1 else CreateState.FWD1)
