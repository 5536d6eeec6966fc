"""Reproductions of Salman & Pearson 2016: laps, controls, claims, threshold sweeps, a small reproduction."""

from __future__ import annotations

import csv

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.classic.experience_map import ExperienceMap
from ratslam.cli import main
from ratslam.cli.reproduce import SALMAN2016
from ratslam.experiments.salman2016.claims import judge_claim, render_claims
from ratslam.experiments.salman2016.direction_metrics import direction_metrics, lap_of_step
from ratslam.experiments.salman2016.protocols import PROTOCOLS, THRESHOLDS, Claim
from ratslam.experiments.salman2016.reproduction import PAPER, match_thresholds, plan_jobs, session_config
from ratslam.experiments.trials import reproduction
from ratslam.experiments.trials.controls import apply_control
from ratslam.experiments.trials.reproduction import ResultRow, column, reproduce
from ratslam.experiments.trials.threshold_sweep import sweep_steps, sweep_thresholds
from ratslam.experiments.trials.touch_trial import (
    SessionResult,
    capacity_for,
    collect_session,
    lap_ends,
    run_session,
    touch_metrics,
    truncate_log,
)
from robot.touch_source import observation_of
from tactile.base.errors import InputError
from tactile.base.se2 import compose

TINY = (
    "simulation.maze.columns=2",
    "simulation.maze.rows=2",
    "simulation.maze.loop=4",
    "simulation.path.circuits=CCA",
    "simulation.kidnaps.ahead=2.0",
)
RISES = Claim("a rises", "arr", "rises", "a", "b")


def square(word, side=12):
    """True poses of laps around a square of 0.36 m, 3 cm a step; C clockwise, A anticlockwise."""
    way = np.linspace(0, 1, side, endpoint=False)
    zero, one = np.zeros(side), np.ones(side)
    x = 0.36 * np.concatenate([way, one, 1 - way, zero])
    y = 0.36 * np.concatenate([zero, way, one, 1 - way])
    heading = np.repeat([0, np.pi / 2, np.pi, -np.pi / 2], side)
    lap = np.column_stack([x, y, heading])
    back = np.roll(lap[::-1], 1, axis=0) + [0, 0, np.pi]
    laps = [lap if letter == "A" else back for letter in word]
    return np.concatenate([*laps, laps[-1][:1]])


def session(truth, **given):
    still = {
        "truth": truth,
        "odometry": truth,
        "trajectory": truth,
        "place": np.arange(len(truth)),
        "node": truth,
        "closures": np.zeros((0, 2), int),
    }
    return SessionResult(**{**still, **given})


@pytest.fixture(scope="module")
def tiny():
    """A session of the small reproduction below, which shares its compiled kernel."""
    return collect_session(session_config(PROTOCOLS["fig6"].conditions[1], "classic", 0, TINY))


# Laps and sessions


@pytest.mark.parametrize("word", ["C", "CA", "CCCAAACACA"])
def test_laps_end_where_they_began(word):
    truth = square(word)
    ends = lap_ends(truth)
    assert ends.tolist() == [48 * (k + 1) for k in range(len(word))]
    assert np.bincount(lap_of_step(truth, len(word))).tolist() == [49, *[48] * (len(word) - 1)]


def test_a_path_that_never_returns_has_no_laps():
    assert len(lap_ends(square("C")[:40])) == 0


def test_a_perfect_map_has_no_energy_in_any_frame():
    truth = square("CC")
    moved = compose(np.array([3.0, -1.0, 2.0]), truth)
    place = np.arange(len(truth)) % 48
    perfect = session(truth, trajectory=moved, place=place, node=moved[:48])
    trial = touch_metrics(perfect)
    assert trial.em == pytest.approx(0, abs=1e-9)
    assert trial.em_experiences == pytest.approx(0, abs=1e-9)
    assert (trial.arcr, trial.arcr_chain_free) == (1, 1)
    assert trial.arr > 0.9  # the base set ends a few steps before the places begin again
    assert touch_metrics(session(truth)).arr == 0


def test_closures_are_false_from_ten_centimetres_on():
    truth = square("CC")
    closures = np.array([[48, 0], [50, 2], [60, 8], [60, 30]])
    trial = touch_metrics(session(truth, closures=closures))
    assert (trial.closures, trial.false_closures) == (4, 2)


def test_a_step_lies_where_its_experience_does():
    truth = square("CC")
    spread = session(truth, place=np.arange(len(truth)) // 4, node=truth[::4])
    trial = touch_metrics(spread)
    assert trial.em == 0 < trial.em_experiences


def test_sessions_that_share_a_compiled_kernel_are_independent(tiny):
    config, log = tiny
    once = run_session(config, log)
    run_session(config, truncate_log(log, 50))
    again = run_session(config, log)
    assert all(np.array_equal(a, b) for a, b in zip(once, again, strict=True))
    assert len(once.truth) == log.length


@given(st.integers(1, 5000))
def test_capacities_are_sufficient_powers_of_two(steps):
    capacity = capacity_for(steps)
    assert capacity >= steps
    assert capacity & (capacity - 1) == 0
    assert capacity < 2 * steps + 512


def test_a_threshold_sweep_equals_single_sessions(tiny):
    """In the current experiences, and in the map that the steps of a threshold are folded into."""
    config, log = tiny
    thresholds = np.array([0.06, config.templates.threshold])
    first, second = sweep_thresholds(config, log, thresholds)
    assert len(np.unique(first)) != len(np.unique(second))
    alone = run_session(config, log)
    assert np.array_equal(second, alone.place)
    folded = ExperienceMap(config.experience)
    columns = sweep_steps(config, log, thresholds)
    for row, sample in enumerate(log):
        estimate, evidence = jax.tree.map(lambda column, row=row: column[1, row], columns)
        folded.update(observation_of(sample), estimate, evidence)
    assert len(alone.closures) > 0
    assert np.allclose(folded.trajectory(), alone.trajectory, atol=1e-9)
    assert np.array_equal(folded.closures(), alone.closures)


def test_only_the_classic_method_has_thresholds(tiny):
    config, log = tiny
    with pytest.raises(ValueError, match="classic"):
        sweep_thresholds(config.model_copy(update={"backend": "recall"}), log, np.array([0.1]))


# Controls


@pytest.mark.parametrize("control", ["shuffled", "blank", "ideal"])
def test_controls_change_only_the_views(tiny, control):
    log = tiny[1]
    changed = apply_control(log, control, 1)
    assert changed.views.shape == log.views.shape
    assert not np.array_equal(changed.views, log.views)
    assert np.array_equal(changed.motion, log.motion)
    assert np.array_equal(changed.truth, log.truth)
    assert np.array_equal(changed.views, apply_control(log, control, 1).views)
    assert 0 <= changed.views.min() <= changed.views.max() <= 1
    assert apply_control(log, "none", 1) is log


def test_shuffled_views_are_the_same_views(tiny):
    log = tiny[1]
    views, shuffled = (np.sort(x.views.reshape(-1)) for x in (log, apply_control(log, "shuffled", 0)))
    assert np.array_equal(views, shuffled)
    assert not apply_control(log, "blank", 0).views.any()


def test_ideal_views_are_equal_exactly_at_one_spot_and_heading(tiny):
    log = tiny[1]
    views = apply_control(log, "ideal", 0).views.reshape(log.length, -1)
    x, y, heading = np.asarray(log.truth).T
    spot = np.stack([np.round(x / 0.06), np.round(y / 0.06), np.round(heading / (np.pi / 4)) % 8], axis=1)
    same = (spot[:, None] == spot[None]).all(axis=2)
    alike = (views[:, None] == views[None]).all(axis=2)
    assert np.array_equal(same, alike)
    assert same.sum() > log.length


# Quantities of single figures


def test_laps_the_other_way_round_are_associated_by_experience_or_closure():
    word, truth = "CA", square("CA")
    new = direction_metrics(session(truth), word)
    assert (new["first_anticlockwise"], new["directions_apart"]) == (0, 0)
    nearest = [int(np.argmin(np.hypot(*(truth[:49, :2] - p[:2]).T))) for p in truth]
    known = direction_metrics(session(truth, place=np.array(nearest)), word)
    assert known["first_anticlockwise"] == known["associated_correct"] == 1
    wrong = direction_metrics(session(truth, place=np.where(np.arange(len(truth)) > 48, 24, nearest)), word)
    assert wrong["first_anticlockwise"] == 1 > wrong["associated_correct"]
    closures = np.array([[k, nearest[k]] for k in range(49, 73)])
    half = direction_metrics(session(truth, closures=closures), word)
    assert half["first_anticlockwise"] == half["first_anticlockwise_correct"] == pytest.approx(0.5)
    assert half["associated_correct"] == 1
    assert wrong["first_anticlockwise_correct"] < 0.5


def test_a_step_closed_with_an_associated_step_is_associated():
    word, truth = "CAA", square("CAA")
    again = np.array([[k, k - 48] for k in range(97, 145)])
    none = direction_metrics(session(truth, closures=again), word)
    assert none["last_anticlockwise"] == 0
    first_lap = np.array([[k, 0] for k in range(49, 97)])
    all_of_it = direction_metrics(session(truth, closures=np.concatenate([first_lap, again])), word)
    assert all_of_it["last_anticlockwise"] == 1 > all_of_it["associated_correct"]


def test_the_distance_of_the_two_directions_is_measured_in_the_map():
    truth = square("CA")
    moved = truth + np.where(np.arange(len(truth)) > 48, 1, 0)[:, None] * [0.3, 0, 0]
    assert direction_metrics(session(truth, trajectory=moved), "CA")["directions_apart"] == pytest.approx(0.3)
    assert np.isnan(direction_metrics(session(truth), "CC")["directions_apart"])


def test_closures_across_the_change_are_counted():
    truth = square("CCC")
    closures = np.array([[90, 2], [100, 80], [30, 4], [44, 42]])
    assert (
        direction_metrics(session(truth, closures=closures), "CCC")["across"] == 2
    )  # 145 steps: the change is at 43


# Verdicts


def test_claims_are_confirmed_refuted_or_neither():
    low, high = np.array([0.1, 0.2, 0.3]), np.array([0.3, 0.4, 0.6])
    assert judge_claim(RISES, low, high).word == "confirmed"
    assert judge_claim(RISES, high, low).word == "refuted"
    assert judge_claim(RISES, low, low).word == "refuted"
    assert judge_claim(RISES, low, low[::-1]).word == "not decided"
    assert judge_claim(RISES, low, np.array([0.2, np.nan, np.nan])).word == "undefined"
    alike = RISES._replace(kind="alike")
    assert judge_claim(alike, low, low + 0.01).word == "confirmed"
    assert judge_claim(alike, low, high).word == "refuted"
    small = RISES._replace(kind="small")
    assert judge_claim(small, low / 10, high).word == "confirmed"
    assert judge_claim(small, high, low).word == "refuted"


@given(st.lists(st.tuples(st.floats(0.01, 10), st.floats(0.01, 10)), min_size=2, max_size=6))
def test_a_claim_and_its_opposite_are_not_both_confirmed(pairs):
    here, there = np.array(pairs).T
    for claim in (RISES, RISES._replace(quantity="em")):
        forth, back = judge_claim(claim, here, there), judge_claim(claim, there, here)
        assert {forth.word, back.word} != {"confirmed"}
        if forth.word == "confirmed":
            assert back.word == "refuted"
        slack = 1e-9 * (1 + abs(forth.estimate))
        assert forth.low - slack <= forth.estimate <= forth.high + slack


def test_energies_are_compared_by_ratio():
    em = RISES._replace(quantity="em")
    found = judge_claim(em, np.array([0.01, 1.0]), np.array([0.02, 2.0]))
    assert found.estimate == pytest.approx(2)
    assert found.word == "confirmed"


def test_sets_stay_paired_where_one_is_missing():
    rows = [ResultRow(("a", "ours", "none"), k, k, {"arr": k / 10}) for k in (0, 2)]
    assert np.array_equal(column(rows, ("a", "ours", "none"), "arr"), [0, np.nan, 0.2], equal_nan=True)


@pytest.mark.parametrize(("sets", "stated"), [(1, False), (3, True), (6, False)])
def test_a_table_states_the_significance_of_few_sets(sets, stated):
    protocol = PROTOCOLS["fig6"]
    rows = [
        ResultRow((condition.name, "ours", "none"), k, k, {"arr": 0.1 * k + number / 10})
        for k in range(sets)
        for number, condition in enumerate(protocol.conditions)
    ]
    text = render_claims(protocol, rows, sets)
    assert ("in 25% of cases" in text) == stated
    assert ("CONFIRMED: difference 0.1" in text) == (sets > 1)
    assert "0.1765" in text


def test_matched_thresholds_reach_the_arcr_that_all_conditions_reach():
    def row(name, arcr, arr):
        return ResultRow((name, "classic", "sweep"), 0, 0, {"arcr": arcr, "arr": arr, "threshold": arr})

    rows = [
        row("a", 0.9, 0.1),
        row("a", 0.8, 0.3),
        row("a", 0.5, 0.6),
        row("b", 0.7, 0.2),
        row("b", 0.6, 0.4),
    ]
    found = match_thresholds([*rows, row("c", np.nan, 0.0)])
    assert {name: r.values["arr"] for name, r in found.items()} == {"a": 0.3, "b": 0.2}
    assert match_thresholds([]) == {}


# The reproductions themselves


def test_the_program_lists_all_protocols():
    assert set(SALMAN2016) == set(PROTOCOLS)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_all_conditions_are_valid_and_run_on_the_same_sets(name):
    protocol = PROTOCOLS[name]
    jobs = plan_jobs(protocol, 2, 0)
    seeds = [{job.config.simulation.seed for job in jobs if job.number == n} for n in (0, 1)]
    assert [len(each) for each in seeds] == [1, 1]
    assert seeds[0] != seeds[1]
    names = {condition.name for condition in protocol.conditions}
    assert all({claim.here, claim.there} <= names | {""} for claim in protocol.claims)
    assert {condition for condition, _ in protocol.paper} <= names
    for job in jobs:
        if job.key[1] == "classic":
            transform = job.config.touch.image.transform
            assert job.config.templates.threshold == THRESHOLDS[transform]
            assert job.config.templates.energy == 0.05


def test_a_tiny_reproduction_leaves_table_rows_and_figure(tmp_path, capsys):
    sets = [part for assignment in TINY for part in ("--set", assignment)]
    arguments = ["reproduce", "fig6", "--sets", "1", "--workers", "1", "-o", str(tmp_path), *sets]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "0.1765" in text
    assert "0.2257" in text
    assert "claim: RCP raises ARR" in text
    with (tmp_path / "fig6.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * (2 + 3)
    ours = [row for row in rows if row["method"] == "ours" and row["control"] != "none"]
    assert all(
        row["closures"] == "0" and float(row["em_ratio"]) == pytest.approx(1, abs=0.05) for row in ours
    )
    assert (tmp_path / "fig6.png").read_bytes().startswith(b"\x89PNG")
    assert main(arguments) == 2
    assert "exists" in capsys.readouterr().err


def test_an_interrupt_keeps_the_finished_sessions(tmp_path, monkeypatch):
    def interrupted(function, tasks, workers):
        result = session(square("CCC"))
        for job in tasks[:2]:
            yield ResultRow(job.key, job.number, job.seed, {"across": 0.0}, (job.laps, result))
        raise KeyboardInterrupt

    monkeypatch.setattr(reproduction, "run_tasks", interrupted)
    text, stopped = reproduce(PAPER, "fig2", tmp_path, sets=1, workers=1, assignments=TINY)
    assert stopped
    assert "Odometry drift" in text
    assert len((tmp_path / "fig2.csv").read_text().splitlines()) == 3
    assert not (tmp_path / "fig2.png").exists()


def test_invalid_arguments_are_refused_before_anything_is_written(tmp_path, capsys):
    assert main(["reproduce", "fig6", "-o", str(tmp_path / "a"), "--set", "recall.reach=-1"]) == 2
    assert "recall.reach" in capsys.readouterr().err
    assert main(["reproduce", "fig6", "-o", str(tmp_path / "a"), "--seed", "-1"]) == 2
    assert not (tmp_path / "a").exists()
    with pytest.raises(SystemExit) as stopped:
        main(["reproduce", "fig9"])
    assert stopped.value.code == 2
    with pytest.raises(InputError, match="fig9"):
        reproduce(PAPER, "fig9", tmp_path)


@pytest.mark.soak
@pytest.mark.parametrize("name", PROTOCOLS)
def test_reproductions_run_to_their_end(name, tmp_path):
    text, stopped = reproduce(PAPER, name, tmp_path, sets=2, workers=4, assignments=TINY)
    assert not stopped
    assert PROTOCOLS[name].title in text
    assert (tmp_path / f"{name}.png").exists()
