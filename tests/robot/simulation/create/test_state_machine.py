"""The state machine: transitions, turn angles, ends of motions; and the errors of wheel odometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from robot.simulation.create.state_machine import (
    BehaviourConfig,
    CreateState,
    MachineState,
    TurnConfig,
    WheelCommand,
    drive,
    motion_end,
    next_state,
    wheel_command,
)
from robot.simulation.create.wheel_odometry import WheelsConfig, simulate_wheel_odometry
from tactile.base.random_streams import stream
from tactile.base.se2 import compose
from tactile.base.types import MotionKind, StepEnd

CONFIG, ROWS, NONE = BehaviourConfig(), 40, np.zeros(4, bool)
FWD1, FWD2, BACK, TURN = CreateState.FWD1, CreateState.FWD2, CreateState.BACK, CreateState.TURN


def quiet() -> np.ndarray:
    return np.zeros((ROWS, 4, 2))


def end_of(
    state: CreateState, strain: np.ndarray, bumped: int = ROWS, before: np.ndarray = NONE
) -> tuple[int, StepEnd] | None:
    return motion_end(CONFIG, state, strain, np.arange(ROWS) >= bumped, before, ROWS - 1)


@pytest.mark.parametrize(
    ("state", "moment", "then"),
    [
        (FWD1, StepEnd.FREE, FWD1),
        (FWD1, StepEnd.HIT1, FWD2),
        (FWD1, StepEnd.ABORT, BACK),
        (FWD2, StepEnd.HIT2, BACK),
        (FWD2, StepEnd.ABORT, BACK),
        (BACK, StepEnd.FREE, TURN),
        (TURN, StepEnd.FREE, FWD1),
        (TURN, StepEnd.ABORT, BACK),
    ],
)
def test_transitions(state: CreateState, moment: StepEnd, then: CreateState) -> None:
    doing = next_state(CONFIG, MachineState(state), moment, 0.0, stream(0, "behaviour"))
    assert doing.state == then
    assert (doing.rest != 0) == (then == TURN)


def test_a_turn_is_made_in_steps_that_add_up() -> None:
    random = stream(0, "behaviour")
    for _ in range(50):
        doing = next_state(CONFIG, MachineState(BACK), StepEnd.FREE, 0.0, random)
        whole, total, steps = doing.rest, 0.0, 0
        while doing.state == TURN:
            command = wheel_command(CONFIG, doing)
            assert command.speed == 0
            assert command.duration <= 0.5
            total += command.rate * command.duration
            doing = next_state(CONFIG, doing, StepEnd.FREE, command.rate * command.duration, random)
            steps += 1
        assert doing.state == FWD1
        assert total == pytest.approx(whole, abs=1e-5)
        assert steps == max(1, int(np.ceil(abs(whole) / 0.15 - 1e-4)))
    once = wheel_command(BehaviourConfig(turn=TurnConfig(step=None)), MachineState(TURN, -1.2))
    assert once == WheelCommand(0.0, -0.3, pytest.approx(4.0))


def test_speeds_and_durations_are_those_of_the_paper() -> None:
    assert wheel_command(CONFIG, MachineState(FWD1)) == (0.05, 0.0, 0.5)
    assert wheel_command(CONFIG, MachineState(BACK)) == (-0.05, 0.0, 0.5)
    assert wheel_command(CONFIG, MachineState(FWD2))[:2] == (0.02, 0.0)
    kinds = [MotionKind.FORWARD, MotionKind.FORWARD, MotionKind.BACK, MotionKind.TURN]
    assert [state.motion for state in CreateState] == kinds


def draw_turns(**changes: object) -> np.ndarray:
    config, random = BehaviourConfig(turn=TurnConfig.model_validate(changes)), stream(1, "behaviour")
    return np.array(
        [next_state(config, MachineState(BACK), StepEnd.FREE, 0.0, random).rest for _ in range(4000)]
    )


def test_turns_are_drawn_from_the_two_gaussians() -> None:
    angles = draw_turns(share=0.6)
    small = np.isclose(angles, 0.14 * np.pi)
    assert small.mean() == pytest.approx(0.6, abs=0.03)
    assert angles[~small].mean() == pytest.approx(0.3 * np.pi, abs=0.06)
    assert angles[~small].std() == pytest.approx(0.25 * np.pi, rel=0.05)
    wider = draw_turns(share=0.0, spread="variance")
    assert wider.std() > angles[~small].std() + 0.03
    assert np.abs(wider).max() <= np.pi


def test_an_undisturbed_motion_ends_as_planned() -> None:
    for state in (FWD1, BACK, TURN):
        assert end_of(state, quiet()) == (ROWS - 1, StepEnd.FREE)
    assert end_of(FWD2, quiet()) == (ROWS - 1, StepEnd.ABORT)


@given(st.integers(0, ROWS - 2), st.integers(0, ROWS - 2), st.integers(0, ROWS - 2), st.sampled_from([-1, 1]))
def test_the_earliest_cause_ends_a_motion(touch: int, over: int, bump: int, sign: int) -> None:
    strain = quiet()
    strain[touch:, 1, 0] = sign * 1.5 * CONFIG.contact
    strain[over:, 2, 0] = sign * 1.5 * CONFIG.safety
    stop = min(over, bump)
    # Strain above the safe limit is also above the contact threshold: ABORT takes precedence.
    expected = (touch, StepEnd.HIT1) if touch < stop else (stop, StepEnd.ABORT)
    assert end_of(FWD1, strain, bump) == expected
    assert end_of(BACK, strain, bump) == (bump, StepEnd.FREE)


@given(st.integers(0, 3), st.integers(0, 3), st.integers(10, ROWS - 2))
def test_a_second_contact_needs_another_whisker(first: int, second: int, row: int) -> None:
    strain, before = quiet(), np.arange(4) == first
    strain[:, first, 0] = 2 * CONFIG.contact
    strain[row:, second, 0] = -2 * CONFIG.contact
    expected = (row, StepEnd.HIT2) if second != first else (ROWS - 1, StepEnd.ABORT)
    assert end_of(FWD2, strain, before=before) == expected
    # Also after the first whisker has slipped off.
    strain[row - 5 :, first] = 0
    strain[row:, second, 0] = -2 * CONFIG.contact
    assert end_of(FWD2, strain, before=before) == expected


def test_two_simultaneous_contacts_last_the_shortest_fwd2() -> None:
    before = np.array([False, True, True, False])
    assert end_of(FWD2, quiet(), before=before) == (round(CONFIG.least / CONFIG.period), StepEnd.HIT2)


def test_excessive_strain_aborts_but_a_turn_may_release_a_strained_whisker() -> None:
    for channel in (0, 1):
        strain = quiet()
        strain[7:, 3, channel] = -1.1 * CONFIG.safety
        assert end_of(FWD2, strain) == (7, StepEnd.ABORT)
    strain = quiet()
    strain[:, 1, 0] = np.linspace(2.0, 0.5, ROWS) * CONFIG.safety
    assert end_of(TURN, strain) == (ROWS - 1, StepEnd.FREE)
    strain[:, 1, 0] = np.linspace(1.2, 2.0, ROWS) * CONFIG.safety
    assert end_of(TURN, strain) == (6, StepEnd.ABORT)


@given(*[st.floats(-3, 3)] * 3, st.sampled_from([(0.05, 0.0), (-0.05, 0.0), (0.0, 0.3), (0.0, -0.3)]))
def test_motions_are_straight_or_on_the_spot(
    x: float, y: float, heading: float, how: tuple[float, float]
) -> None:
    pose, time = np.array([x, y, heading]), np.linspace(0.0, 2.0, 9)
    poses = drive(WheelCommand(*how, 2.0), pose, time)
    there = compose(pose, np.column_stack([how[0] * time, 0 * time, how[1] * time]))
    assert np.allclose(poses[:, :2], there[:, :2])
    assert np.allclose(np.exp(1j * poses[:, 2]), np.exp(1j * there[:, 2]))


@pytest.mark.parametrize("changes", [{"contact": 3e-3}, {"period": 0.6}, {"least": 2.0}, {"safety": 0.0}])
def test_contradicting_settings_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        BehaviourConfig.model_validate(changes)


@given(
    st.sampled_from(list(CreateState)),
    st.lists(st.sampled_from([0.0, 1.5e-4, 3e-4, 1.9e-3, 2.1e-3]), min_size=6, max_size=6),
    st.integers(0, ROWS),
    st.integers(0, ROWS),
)
def test_a_motion_ends_at_the_same_row_when_its_rows_come_one_by_one(
    state: CreateState, levels: list[float], since: int, bumped: int
) -> None:
    """The live robot sees a row at a time, the simulated one all of them."""
    strain, body = quiet(), np.arange(ROWS) >= bumped
    strain[since:, :3] = np.array(levels[:3])[:, None]
    strain[(since + ROWS) // 2 :, :3] = np.array(levels[3:])[:, None]
    ends = [motion_end(CONFIG, state, strain[:n], body[:n], NONE, ROWS - 1) for n in range(1, ROWS + 1)]
    assert next(filter(None, ends)) == ends[-1]


def drive_and_turn(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Motions [N, 4] and kinds [N]: seven steps ahead, one back, two of turning, repeated."""
    phase = np.arange(count) % 10
    kind = np.where(phase < 7, MotionKind.FORWARD, np.where(phase < 8, MotionKind.BACK, MotionKind.TURN))
    way = np.where(kind == MotionKind.FORWARD, 0.025, np.where(kind == MotionKind.BACK, -0.025, 0.0))
    turn = np.where(kind == MotionKind.TURN, 0.15, 0.0)
    return np.column_stack([way, np.zeros(count), turn, np.full(count, 0.5)]), kind


def measured(noise: str, motion: np.ndarray, kind: np.ndarray, seed: int = 0, level: float = 0.05):
    config = WheelsConfig(noise=noise, level=level)
    return simulate_wheel_odometry(config, motion, kind, stream(seed, "wheels"))


@given(st.integers(0, 10**6), st.sampled_from(["white", "move", "bias", "none"]))
def test_only_moving_parts_have_errors(seed: int, noise: str) -> None:
    motion, kind = drive_and_turn(40)
    found = measured(noise, motion, kind, seed)
    assert (found[motion == 0] == 0).all()
    assert (found[:, 3] == motion[:, 3]).all()
    assert (found == motion).all() == (noise == "none")
    assert (motion == drive_and_turn(40)[0]).all()
    assert (measured("move", motion, kind, seed, level=0.0) == motion).all()
    assert measured(noise, motion[:0], kind[:0]).shape == (0, 4)


def test_a_seed_gives_the_same_errors_for_ever() -> None:
    known = {
        "white": [0.59778608, 1.21823274, 0.14835760, 0.16114506],
        "move": [0.58469252, 1.21442510, 0.14835760, 0.14521466],
        "bias": [0.59635291, 1.12434954, 0.13975939, 0.14231689],
        "measured": [0.69067938, 1.39989779, 0.16579383, 0.17029438],
    }
    for noise, values in known.items():
        found = measured(noise, *drive_and_turn(40), seed=3)
        np.testing.assert_allclose([*found[:, [0, 2]].sum(axis=0), *found[[8, 39], 2]], values, atol=1e-7)
