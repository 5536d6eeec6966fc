"""The state machine: transitions, turn angles, and ends of motions."""

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
from tactile.base.random_streams import stream
from tactile.base.se2 import compose
from tactile.base.types import MotionKind, StepEnd

CONFIG = BehaviourConfig()
ROWS = 40
NONE = np.zeros(4, bool)


def quiet() -> np.ndarray:
    return np.zeros((ROWS, 4, 2))


def end_of(
    state: CreateState, strain: np.ndarray, bumped: int = ROWS, before: np.ndarray = NONE
) -> tuple[int, StepEnd] | None:
    return motion_end(CONFIG, state, strain, np.arange(ROWS) >= bumped, before, ROWS - 1)


@pytest.mark.parametrize(
    ("state", "moment", "then"),
    [
        (CreateState.FWD1, StepEnd.FREE, CreateState.FWD1),
        (CreateState.FWD1, StepEnd.HIT1, CreateState.FWD2),
        (CreateState.FWD1, StepEnd.ABORT, CreateState.BACK),
        (CreateState.FWD2, StepEnd.HIT2, CreateState.BACK),
        (CreateState.FWD2, StepEnd.ABORT, CreateState.BACK),
        (CreateState.BACK, StepEnd.FREE, CreateState.TURN),
        (CreateState.TURN, StepEnd.FREE, CreateState.FWD1),
        (CreateState.TURN, StepEnd.ABORT, CreateState.BACK),
    ],
)
def test_transitions(state: CreateState, moment: StepEnd, then: CreateState) -> None:
    doing = next_state(CONFIG, MachineState(state), moment, 0.0, stream(0, "behaviour"))
    assert doing.state == then
    assert (doing.rest != 0) == (then == CreateState.TURN)


def test_a_turn_is_made_in_steps_that_add_up() -> None:
    random = stream(0, "behaviour")
    for _ in range(50):
        doing = next_state(CONFIG, MachineState(CreateState.BACK), StepEnd.FREE, 0.0, random)
        whole, total, steps = doing.rest, 0.0, 0
        while doing.state == CreateState.TURN:
            command = wheel_command(CONFIG, doing)
            assert command.speed == 0
            assert command.duration <= 0.5
            total += command.rate * command.duration
            doing = next_state(CONFIG, doing, StepEnd.FREE, command.rate * command.duration, random)
            steps += 1
        assert doing.state == CreateState.FWD1
        assert total == pytest.approx(whole, abs=1e-5)
        assert steps == max(1, int(np.ceil(abs(whole) / 0.15 - 1e-4)))


def test_a_turn_can_be_one_step() -> None:
    config = BehaviourConfig(turn=TurnConfig(step=None))
    command = wheel_command(config, MachineState(CreateState.TURN, -1.2))
    assert command == WheelCommand(0.0, -0.3, pytest.approx(4.0))


def test_speeds_and_durations_are_those_of_the_paper() -> None:
    assert wheel_command(CONFIG, MachineState(CreateState.FWD1)) == (0.05, 0.0, 0.5)
    assert wheel_command(CONFIG, MachineState(CreateState.BACK)) == (-0.05, 0.0, 0.5)
    assert wheel_command(CONFIG, MachineState(CreateState.FWD2))[:2] == (0.02, 0.0)
    assert [state.motion for state in CreateState] == [
        MotionKind.FORWARD,
        MotionKind.FORWARD,
        MotionKind.BACK,
        MotionKind.TURN,
    ]


def draw_turns(**changes: object) -> np.ndarray:
    config, random = BehaviourConfig(turn=TurnConfig.model_validate(changes)), stream(1, "behaviour")
    back = MachineState(CreateState.BACK)
    return np.array([next_state(config, back, StepEnd.FREE, 0.0, random).rest for _ in range(4000)])


def test_turns_are_drawn_from_the_two_gaussians() -> None:
    angles = draw_turns(share=0.6)
    small = np.isclose(angles, 0.14 * np.pi)
    assert small.mean() == pytest.approx(0.6, abs=0.03)
    assert angles[~small].mean() == pytest.approx(0.3 * np.pi, abs=0.06)
    assert angles[~small].std() == pytest.approx(0.25 * np.pi, rel=0.05)
    wider = draw_turns(share=0.0, spread="variance")
    assert wider.std() > angles[~small].std() + 0.03
    assert np.abs(wider).max() <= np.pi
    assert (draw_turns()[:99] == draw_turns()[:99]).all()


def test_an_undisturbed_motion_ends_as_planned() -> None:
    for state in (CreateState.FWD1, CreateState.BACK, CreateState.TURN):
        assert end_of(state, quiet()) == (ROWS - 1, StepEnd.FREE)
    assert end_of(CreateState.FWD2, quiet()) == (ROWS - 1, StepEnd.ABORT)


@given(st.integers(0, ROWS - 2), st.integers(0, ROWS - 2), st.integers(0, ROWS - 2), st.sampled_from([-1, 1]))
def test_the_earliest_cause_ends_a_motion(touch: int, over: int, bump: int, sign: int) -> None:
    strain = quiet()
    strain[touch:, 1, 0] = sign * 1.5 * CONFIG.contact
    strain[over:, 2, 0] = sign * 1.5 * CONFIG.safety
    stop = min(over, bump)
    # Strain above the safe limit is also above the contact threshold: ABORT takes precedence.
    expected = (touch, StepEnd.HIT1) if touch < stop else (stop, StepEnd.ABORT)
    assert end_of(CreateState.FWD1, strain, bump) == expected
    assert end_of(CreateState.BACK, strain, bump) == (bump, StepEnd.FREE)


@given(st.integers(0, 3), st.integers(0, 3), st.integers(10, ROWS - 2))
def test_a_second_contact_needs_another_whisker(first: int, second: int, row: int) -> None:
    strain, before = quiet(), NONE.copy()
    before[first] = True
    strain[:, first, 0] = 2 * CONFIG.contact
    strain[row:, second, 0] = -2 * CONFIG.contact
    other = second != first
    expected = (row, StepEnd.HIT2) if other else (ROWS - 1, StepEnd.ABORT)
    assert end_of(CreateState.FWD2, strain, before=before) == expected
    # Also after the first whisker has slipped off.
    strain[row - 5 :, first] = 0
    strain[row:, second, 0] = -2 * CONFIG.contact
    assert end_of(CreateState.FWD2, strain, before=before) == expected


def test_two_simultaneous_contacts_last_the_shortest_fwd2() -> None:
    before = np.array([False, True, True, False])
    row, moment = end_of(CreateState.FWD2, quiet(), before=before)
    assert moment == StepEnd.HIT2
    assert row == round(CONFIG.least / CONFIG.period)


def test_excessive_strain_in_either_channel_aborts() -> None:
    for channel in (0, 1):
        strain = quiet()
        strain[7:, 3, channel] = -1.1 * CONFIG.safety
        assert end_of(CreateState.FWD2, strain) == (7, StepEnd.ABORT)


def test_a_turn_may_release_a_strained_whisker() -> None:
    strain = quiet()
    strain[:, 1, 0] = np.linspace(2.0, 0.5, ROWS) * CONFIG.safety
    assert end_of(CreateState.TURN, strain) == (ROWS - 1, StepEnd.FREE)
    strain[:, 1, 0] = np.linspace(1.2, 2.0, ROWS) * CONFIG.safety
    row, moment = end_of(CreateState.TURN, strain)
    assert moment == StepEnd.ABORT
    assert 0 < row < ROWS - 1


@given(*[st.floats(-3, 3)] * 3, st.sampled_from([(0.05, 0.0), (-0.05, 0.0), (0.0, 0.3), (0.0, -0.3)]))
def test_motions_are_straight_or_on_the_spot(
    x: float, y: float, heading: float, how: tuple[float, float]
) -> None:
    pose, time = np.array([x, y, heading]), np.linspace(0.0, 2.0, 9)
    command = WheelCommand(*how, 2.0)
    poses = drive(command, pose, time)
    steps = np.column_stack([how[0] * time, 0 * time, how[1] * time])
    there = compose(pose, steps)
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
    strain = quiet()
    strain[since:, :3] = np.array(levels[:3])[:, None]
    strain[(since + ROWS) // 2 :, :3] = np.array(levels[3:])[:, None]
    body = np.arange(ROWS) >= bumped
    ends = [
        motion_end(CONFIG, state, strain[:rows], body[:rows], NONE, ROWS - 1) for rows in range(1, ROWS + 1)
    ]
    assert next(filter(None, ends)) == ends[-1]
