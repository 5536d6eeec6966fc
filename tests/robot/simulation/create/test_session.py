"""Sessions of the Create: reproducibility, statistics; state machine; errors of wheel odometry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from robot.simulation.create import simulated_session as simulated
from robot.simulation.create import state_machine as machine
from robot.simulation.create.simulated_session import CreateSimulation, CreateSimulationConfig
from robot.simulation.create.state_machine import BehaviourConfig, CreateState, MachineState, motion_end
from robot.simulation.create.wheel_odometry import WheelsConfig, simulate_wheel_odometry
from robot.world.arena import arena_text, wall_segments
from robot.world.walls import segment_distance
from tactile.base.random_streams import stream
from tactile.base.se2 import between, compose, integrate, wrap
from tactile.base.types import MotionKind, Report, StepEnd
from tests.robot.conftest import bits

CONFIG, ROWS, NONE = BehaviourConfig(), 40, np.zeros(4, bool)
FWD1, FWD2, BACK, TURN = CreateState.FWD1, CreateState.FWD2, CreateState.BACK, CreateState.TURN


def simulate(**changes: object) -> CreateSimulation:
    return CreateSimulation(CreateSimulationConfig.model_validate({"reports": 60} | changes))


def column(simulation: CreateSimulation, name: str) -> np.ndarray:
    return np.array([getattr(step, name) for step in simulation.steps])


def test_a_seed_gives_the_same_session_for_ever_and_the_beginning_of_a_longer_one():
    made, longer, other = simulate(), simulate(reports=80), simulate(seed=1)
    with made as source:
        first = bits([*source])
        assert bits([*source]) == first
    assert bits([*longer][:60]) == first
    assert made.length == 60
    assert len({source.digest for source in (made, longer, other)}) == 3
    state, moment = ("".join(str(int(one)) for one in column(made, name)) for name in ("state", "moment"))
    assert state == 35 * "0" + "1233323233301233333333333"
    assert moment == 34 * "0" + "13000303000013000000000000"
    motion = made.odometry.sum(axis=0)
    strain = np.abs(np.concatenate([step.strain for step in made.steps])).mean(axis=(0, 1))
    np.testing.assert_allclose(made.truth[-1], [0.898759, 0.893567, -3.065888], atol=1e-6)
    np.testing.assert_allclose(motion, [0.878438, 0, 2.39396, 31.60608], atol=1e-5)
    np.testing.assert_allclose(strain, [0.000202554, 3.26076e-05], rtol=1e-5)


def test_streams_are_independent_and_the_digest_depends_on_the_configuration(tmp_path):
    base, other = simulate(), simulate(wheels={"noise": "bias"})
    assert (other.odometry != base.odometry).any()
    assert (other.truth == base.truth).all()
    assert all((a.strain == b.strain).all() for a, b in zip(base.steps, other.steps, strict=True))
    elsewhere = simulate(behaviour={"turn": {"share": 0.0}})
    assert arena_text(elsewhere.arena) == arena_text(base.arena)
    assert (elsewhere.truth != base.truth).any()
    one, two = (simulate(seed=seed, arena={"seed": 7}, reports=20) for seed in (1, 2))
    assert arena_text(one.arena) == arena_text(two.arena)
    assert (one.odometry != two.odometry).any()
    base = simulate(reports=9)
    path, again = tmp_path / "room.txt", tmp_path / "copy.txt"
    room = base.arena._replace(objects=base.arena.objects[1:])
    path.write_text(arena_text(room))
    again.write_text("# the same\n" + arena_text(room))
    changes = ({"whiskers": {"noise": 1e-6}}, {"arena": {"side": 2.5}}, {"arena": {"file": path}})
    *others, filed = (simulate(reports=9, **change) for change in changes)
    assert len({one.digest for one in (base, *others, filed)}) == 4
    copied = simulate(reports=9, arena={"file": again})
    assert copied.digest == filed.digest  # the content counts, not the path
    assert str(tmp_path) not in filed.info.to_json()
    config = CreateSimulationConfig.model_validate({"arena": {"file": "room.txt"}}).resolved(tmp_path)
    assert config.arena.file == path
    assert arena_text(filed.arena) == arena_text(room)


def test_samples_agree_with_the_session():
    simulation = simulate(minutes=1.0, reports=None)
    samples = list(simulation)
    assert len(samples) == simulation.length
    assert (simulation.whiskers, simulation.view_shape, simulation.info.raw_whiskers) == (4, (1, 4, 1), True)
    assert samples[-1].time >= 60 > samples[-2].time
    before = simulation.arena.start
    for sample, step in zip(samples, simulation.steps, strict=True):
        report = sample.reading
        assert report.motion == step.state.motion
        assert report.odometry.dt == pytest.approx(step.duration)
        assert report.contact.shape == report.alive.shape == (4,)
        assert report.strain.shape == (len(report.time), 4, 2)
        assert len(report.time) == (round(step.duration * 2000) if step.state == FWD2 else 0)
        assert np.allclose(report.time, np.arange(len(report.time)) / 2000)
        moved = between(before, sample.truth)
        assert (report.odometry.dx != 0) == (report.motion != MotionKind.TURN)
        if report.motion == MotionKind.TURN:
            assert np.allclose(moved[:2], 0, atol=1e-12)
        else:
            assert abs(moved[2]) < 1e-12
            assert np.sign(moved[0]) == np.sign(report.odometry.dx)
        before = sample.truth
    assert (np.abs(simulation.truth[:, 2]) <= np.pi).all()
    samples[0].truth[:] = 9  # a copy
    samples[0].reading.contact[:] = True
    assert not np.all(next(iter(simulation)).truth == 9)
    assert not next(iter(simulation)).reading.contact.all()


@pytest.mark.parametrize(("seed", "side"), [(0, 1.25), (2, 2.5)])
def test_steps_end_as_they_should_and_the_body_stays_out_of_walls(seed, side):
    simulation = simulate(seed=seed, arena={"side": side}, reports=250)
    state, moment, contact = (column(simulation, name) for name in ("state", "moment", "contact"))
    assert contact[moment == StepEnd.HIT1].any(axis=1).all()
    assert not contact[(state == FWD1) & (moment == StepEnd.FREE)].any()
    durations = column(simulation, "duration")
    assert durations[state != FWD2].max() <= 0.5 + 1e-9
    assert durations[state == FWD2].max() <= 2.0 + 1e-9
    assert durations.min() > 0
    assert simulation.arena.in_free_space(simulation.truth[:, :2]).all()
    room = segment_distance(wall_segments(simulation.arena), simulation.truth[:, :2]).min()
    assert room > 0.17 - 0.05 * 0.01 - 1e-6  # motion between two checks


@pytest.mark.soak
def test_six_minutes_have_the_statistics_of_the_paper():
    """30 contacts or more, some without a second contact, in 3 to 4 anticlockwise circuits."""
    counts = []
    for seed in range(12):
        simulation = simulate(seed=seed, reports=None)
        state, moment = column(simulation, "state"), column(simulation, "moment")
        middle = simulation.arena.outer.mean(axis=0)
        bearing = np.unwrap(np.arctan2(*(simulation.truth[:, :2] - middle).T[::-1]))
        circuits = (bearing[-1] - bearing[0]) / (2 * np.pi)
        second = (moment[state == FWD2] == StepEnd.HIT2).mean()
        stuck = ((state == TURN) & (moment == StepEnd.ABORT)).sum()
        counts.append([simulation.length, (moment == StepEnd.HIT1).sum(), circuits, second, stuck])
    reports, hits, circuits, seconds, stuck = np.array(counts).T
    assert 600 < reports.mean() < 760
    assert hits.min() >= 30
    assert hits.mean() < 60
    assert 2.2 < circuits.mean() < 4
    assert circuits.min() > 0.5
    assert 0.15 < seconds.mean() < 0.5
    assert stuck.max() < 60


def test_dead_whiskers_never_report_and_odometry_without_noise_integrates_to_the_truth():
    simulation = simulate(whiskers={"dead": [0, 3]})
    assert not column(simulation, "contact")[:, [0, 3]].any()
    assert next(iter(simulation)).reading.alive.tolist() == [False, True, True, False]
    alone = simulate(whiskers={"dead": [0, 1, 2, 3]})  # only the bumper
    assert not column(alone, "contact").any()
    assert (column(alone, "moment") == StepEnd.ABORT).any()
    exact = simulate(wheels={"noise": "none"})
    off = integrate(exact.odometry[:, :3], exact.arena.start) - exact.truth
    assert np.abs(np.column_stack([off[:, :2], wrap(off[:, 2])])).max() < 1e-9


def into(angle_deg: float, **changes: object) -> Report:
    config = CreateSimulationConfig.model_validate(changes)
    return simulated.drive_into_wall(config, np.radians(angle_deg), stream(0, "templates"))


def test_first_contact_with_a_wall_is_at_its_position(refused):
    for angle, first in ((20, [3]), (50, [3]), (60, [1, 2]), (90, [1, 2]), (130, [0])):
        report = into(angle)
        assert report.strain.shape == (4000, 4, 2)
        assert (report.odometry.dx, report.odometry.dt) == (0.04, 2.0)
        # [20, 4] horizontal strain without vibration: means over a tenth of a second.
        level = np.abs(report.strain[..., 0].reshape(-1, 200, 4).mean(axis=1))
        assert level[0].argmax() in first
        assert 1.5e-4 < level[0].max() < 8e-4
        assert level[-1].max() > 2 * level[0].max()
    for angle in (0, 180, 270):
        with pytest.raises(ValueError, match="does not drive"):
            into(angle)
    numb = {"contact": 0.9, "safety": 1.0}
    refused(lambda: into(90, behaviour=numb), "create_simulation.behaviour.contact")


def quiet() -> np.ndarray:
    return np.zeros((ROWS, 4, 2))


def end_of(state, strain, bumped=ROWS, before=NONE) -> tuple[int, StepEnd] | None:
    return motion_end(CONFIG, state, strain, np.arange(ROWS) >= bumped, before, ROWS - 1)


def test_transitions():
    for state, moment, then in (
        (FWD1, StepEnd.FREE, FWD1), (FWD1, StepEnd.HIT1, FWD2), (FWD1, StepEnd.ABORT, BACK),
        (FWD2, StepEnd.HIT2, BACK), (FWD2, StepEnd.ABORT, BACK), (BACK, StepEnd.FREE, TURN),
        (TURN, StepEnd.FREE, FWD1), (TURN, StepEnd.ABORT, BACK),
    ):  # fmt: skip
        doing = machine.next_state(CONFIG, MachineState(state), moment, 0.0, stream(0, "behaviour"))
        assert (doing.state, doing.rest != 0) == (then, then == TURN)


def test_a_turn_is_made_in_steps_that_add_up():
    random = stream(0, "behaviour")
    for _ in range(50):
        doing = machine.next_state(CONFIG, MachineState(BACK), StepEnd.FREE, 0.0, random)
        whole, total, steps = doing.rest, 0.0, 0
        while doing.state == TURN:
            command = machine.wheel_command(CONFIG, doing)
            assert command.speed == 0
            assert command.duration <= 0.5
            total += command.rate * command.duration
            doing = machine.next_state(CONFIG, doing, StepEnd.FREE, command.rate * command.duration, random)
            steps += 1
        assert doing.state == FWD1
        assert total == pytest.approx(whole, abs=1e-5)
        assert steps == max(1, int(np.ceil(abs(whole) / 0.15 - 1e-4)))
    once = BehaviourConfig(turn=machine.TurnConfig(step=None))
    assert machine.wheel_command(once, MachineState(TURN, -1.2)) == (0.0, -0.3, pytest.approx(4.0))
    assert machine.wheel_command(CONFIG, MachineState(FWD1)) == (0.05, 0.0, 0.5)
    assert machine.wheel_command(CONFIG, MachineState(BACK)) == (-0.05, 0.0, 0.5)
    assert machine.wheel_command(CONFIG, MachineState(FWD2))[:2] == (0.02, 0.0)
    kinds = [MotionKind.FORWARD, MotionKind.FORWARD, MotionKind.BACK, MotionKind.TURN]
    assert [state.motion for state in CreateState] == kinds


def draw_turns(**changes: object) -> np.ndarray:
    config, random = BehaviourConfig(turn=machine.TurnConfig.model_validate(changes)), stream(1, "behaviour")
    ended = MachineState(BACK), StepEnd.FREE, 0.0
    return np.array([machine.next_state(config, *ended, random).rest for _ in range(4000)])


def test_turns_are_drawn_from_the_two_gaussians():
    angles = draw_turns(share=0.6)
    small = np.isclose(angles, 0.14 * np.pi)
    assert small.mean() == pytest.approx(0.6, abs=0.03)
    assert angles[~small].mean() == pytest.approx(0.3 * np.pi, abs=0.06)
    assert angles[~small].std() == pytest.approx(0.25 * np.pi, rel=0.05)
    wider = draw_turns(share=0.0, spread="variance")
    assert wider.std() > angles[~small].std() + 0.03
    assert np.abs(wider).max() <= np.pi


@given(st.integers(0, ROWS - 2), st.integers(0, ROWS - 2), st.integers(0, ROWS - 2), st.sampled_from([-1, 1]))
def test_the_earliest_cause_ends_a_motion(touch, over, bump, sign):
    strain = quiet()
    strain[touch:, 1, 0] = sign * 1.5 * CONFIG.contact
    strain[over:, 2, 0] = sign * 1.5 * CONFIG.safety
    stop = min(over, bump)
    # Strain above the safe limit is also above the contact threshold: ABORT takes precedence.
    assert end_of(FWD1, strain, bump) == ((touch, StepEnd.HIT1) if touch < stop else (stop, StepEnd.ABORT))
    assert end_of(BACK, strain, bump) == (bump, StepEnd.FREE)


@given(st.integers(0, 3), st.integers(0, 3), st.integers(10, ROWS - 2))
def test_a_second_contact_needs_another_whisker(first, second, row):
    strain, before = quiet(), np.arange(4) == first
    strain[:, first, 0] = 2 * CONFIG.contact
    strain[row:, second, 0] = -2 * CONFIG.contact
    expected = (row, StepEnd.HIT2) if second != first else (ROWS - 1, StepEnd.ABORT)
    assert end_of(FWD2, strain, before=before) == expected
    strain[row - 5 :, first] = 0
    strain[row:, second, 0] = -2 * CONFIG.contact
    assert end_of(FWD2, strain, before=before) == expected


def test_undisturbed_motions_end_as_planned_and_excessive_strain_aborts():
    """But a turn may release a strained whisker, and two contacts at once last the shortest FWD2."""
    for state in CreateState:
        assert end_of(state, quiet()) == (ROWS - 1, (StepEnd.ABORT if state == FWD2 else StepEnd.FREE))
    before = np.array([False, True, True, False])
    assert end_of(FWD2, quiet(), before=before) == (round(CONFIG.least / CONFIG.period), StepEnd.HIT2)
    for channel in (0, 1):
        strain = quiet()
        strain[7:, 3, channel] = -1.1 * CONFIG.safety
        assert end_of(FWD2, strain) == (7, StepEnd.ABORT)
    strain = quiet()
    strain[:, 1, 0] = np.linspace(2.0, 0.5, ROWS) * CONFIG.safety
    assert end_of(TURN, strain) == (ROWS - 1, StepEnd.FREE)
    strain[:, 1, 0] = np.linspace(1.2, 2.0, ROWS) * CONFIG.safety
    assert end_of(TURN, strain) == (6, StepEnd.ABORT)
    for changes in ({"contact": 3e-3}, {"period": 0.6}, {"least": 2.0}, {"safety": 0.0}):
        with pytest.raises(ValidationError):
            BehaviourConfig.model_validate(changes)


@given(*[st.floats(-3, 3)] * 3, st.sampled_from([(0.05, 0.0), (-0.05, 0.0), (0.0, 0.3), (0.0, -0.3)]))
def test_motions_are_straight_or_on_the_spot(x, y, heading, how):
    pose, time = np.array([x, y, heading]), np.linspace(0.0, 2.0, 9)
    poses = machine.drive(machine.WheelCommand(*how, 2.0), pose, time)
    there = compose(pose, np.column_stack([how[0] * time, 0 * time, how[1] * time]))
    assert np.allclose(poses[:, :2], there[:, :2])
    assert np.allclose(np.exp(1j * poses[:, 2]), np.exp(1j * there[:, 2]))


LEVELS = st.lists(st.sampled_from([0.0, 1.5e-4, 3e-4, 1.9e-3, 2.1e-3]), min_size=6, max_size=6)


@given(st.sampled_from(list(CreateState)), LEVELS, st.integers(0, ROWS), st.integers(0, ROWS))
def test_a_motion_ends_at_the_same_row_when_its_rows_come_one_by_one(state, levels, since, bumped):
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
def test_only_moving_parts_have_errors(seed, noise):
    motion, kind = drive_and_turn(40)
    found = measured(noise, motion, kind, seed)
    assert (found[motion == 0] == 0).all()
    assert (found[:, 3] == motion[:, 3]).all()
    assert (found == motion).all() == (noise == "none")
    assert (motion == drive_and_turn(40)[0]).all()
    assert (measured("move", motion, kind, seed, level=0.0) == motion).all()
    assert measured(noise, motion[:0], kind[:0]).shape == (0, 4)


def test_a_seed_gives_the_same_errors_for_ever():
    known = {
        "white": [0.59778608, 1.21823274, 0.14835760, 0.16114506],
        "move": [0.58469252, 1.21442510, 0.14835760, 0.14521466],
        "bias": [0.59635291, 1.12434954, 0.13975939, 0.14231689],
        "measured": [0.69067938, 1.39989779, 0.16579383, 0.17029438],
    }
    for noise, values in known.items():
        found = measured(noise, *drive_and_turn(40), seed=3)
        np.testing.assert_allclose([*found[:, [0, 2]].sum(axis=0), *found[[8, 39], 2]], values, atol=1e-7)


def analyse(seed: int) -> np.ndarray:
    """Of 75 windows of 10 s, as the recordings were analysed: truth over odometry of length and turn, heading
    drift (rad/s), spread of a window's distance as a share of it, turn residual of a window (rad)."""
    turn = np.repeat(stream(seed, "drive").choice([-0.0925, 0.0925], 75), 20)
    motion = np.column_stack([np.full(1500, 0.0275), np.zeros(1500), turn / 2, np.full(1500, 0.5)])
    found = measured("measured", motion, np.ones(1500, int), seed)
    true, odometry = (rows.reshape(-1, 20, 4).sum(axis=1) for rows in (motion, found))
    length, known = true[:, 0].sum() / odometry[:, 0].sum(), odometry[:, [2, 3]]
    turn, drift = np.linalg.lstsq(known, true[:, 2], rcond=None)[0]
    spread = (length * odometry[:, 0] - true[:, 0]).std() / true[:, 0].mean()
    return np.array([length, turn, drift, spread, (known @ [turn, drift] - true[:, 2]).std()])


def test_measured_errors_are_those_of_real_creates_when_analysed_alike():
    """Size: means and deviations of 200 runs within 4.5 standard errors; 0.002 for rounding."""
    length, turn, drift, spread, residual = np.array([analyse(seed) for seed in range(200)]).T
    # Least squares underrates a scale whose regressor errs: turns by 1 + 0.143 squared.
    for values, mean, sd in ((length, 0.927, 0.018), (turn, 0.950 / (1 + 0.143**2), 0.021)):
        assert values.mean() == pytest.approx(mean, abs=4.5 * sd / np.sqrt(200) + 0.002)
        assert values.std() == pytest.approx(sd, rel=4.5 / np.sqrt(400))
    assert 60 * drift.mean() == pytest.approx(-0.105, abs=4.5 * 0.11 / np.sqrt(200))
    assert np.quantile(spread, [0.1, 0.9]) == pytest.approx([0.10, 0.14], abs=0.01)
    low, high = np.quantile(residual, [0.1, 0.9])
    assert 0.10 <= low < high <= 0.17
