"""Reproductions of Salman & Pearson 2016: sessions, claims, threshold sweeps, a small reproduction."""

from __future__ import annotations

import csv

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.papers import paper_sets
from evaluation.papers.commands import SALMAN2016
from evaluation.papers.paper_sets import ResultRow, column, reproduce, sweep_thresholds
from evaluation.papers.salman2016.protocols import PROTOCOLS, THRESHOLDS, Claim
from evaluation.papers.salman2016.reproduction import (
    PAPER,
    judge_claim,
    match_thresholds,
    parts_of_em,
    plan_jobs,
    render_claims,
    session_config,
)
from evaluation.papers.trial_sessions import capacity_for, collect_session, run_session
from ratslam.classic.experience_map import ExperienceMap
from ratslam.cli import main
from robot.sources.in_memory import truncate_log
from robot.touch_source import observation_of
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose
from tests.helpers.laps import session, square

TINY = (
    "simulation.maze.columns=2",
    "simulation.maze.rows=2",
    "simulation.maze.loop=4",
    "simulation.path.circuits=CCA",
    "simulation.kidnaps.ahead=2.0",
)
RISES = Claim("a rises", "arr", "rises", "a", "b")


@pytest.fixture(scope="module")
def tiny():
    """A session of the small reproduction below, which shares its compiled kernel."""
    return collect_session(session_config(PROTOCOLS["fig6"].conditions[1], "classic", 0, TINY))


# Sessions


@pytest.mark.soak
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


@pytest.mark.soak
def test_a_threshold_sweep_equals_single_sessions(tiny):
    """In the current experiences, and in the map that the steps of a threshold are folded into."""
    config, log = tiny
    thresholds = np.array([0.06, config.templates.threshold])
    columns = sweep_thresholds(config, log, thresholds)
    first, second = columns[0].place
    assert len(np.unique(first)) != len(np.unique(second))
    alone = run_session(config, log)
    assert np.array_equal(second, alone.place)
    folded = ExperienceMap(config.experience)
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


# Verdicts


def test_claims_are_confirmed_refuted_or_neither():
    low, high = np.array([0.1, 0.2, 0.3]), np.array([0.3, 0.4, 0.6])
    alike, small = RISES._replace(kind="alike"), RISES._replace(kind="small")
    for claim, here, there, word in (
        (RISES, low, high, "confirmed"),
        (RISES, high, low, "refuted"),
        (RISES, low, low, "refuted"),
        (RISES, low, low[::-1], "not decided"),
        (RISES, low, np.array([0.2, np.nan, np.nan]), "undefined"),
        (alike, low, low + 0.01, "confirmed"),
        (alike, low, high, "refuted"),
        (small, low / 10, high, "confirmed"),
        (small, high, low, "refuted"),
    ):
        assert judge_claim(claim, here, there)[0] == word


@given(st.lists(st.tuples(st.floats(0.01, 10), st.floats(0.01, 10)), min_size=2, max_size=6))
def test_a_claim_and_its_opposite_are_not_both_confirmed(pairs):
    here, there = np.array(pairs).T
    for claim in (RISES, RISES._replace(quantity="em")):
        (forth, _), (back, _) = judge_claim(claim, here, there), judge_claim(claim, there, here)
        assert {forth, back} != {"confirmed"}
        if forth == "confirmed":
            assert back == "refuted"


def test_energies_are_compared_by_ratio():
    em = RISES._replace(quantity="em")
    found = judge_claim(em, np.array([0.01, 1.0]), np.array([0.02, 2.0]))
    assert found == ("confirmed", "ratio 2 [2, 2], 2 sets")


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
    assert "Each maze" in text
    near = [abs(0.1 * k - 0.1765) < 0.05 for k in range(sets)]
    assert f"of the paper's: {sum(near)} of {sets}" in text


def test_em_between_successive_experiences_needs_no_whole_map():
    """One link turned by half a turn: the mean over all pairs is large, that of successive ones small."""
    result = session(square("CCC"))
    turned = result.trajectory.copy()
    half = len(turned) // 2
    turned[half:] = compose(
        compose(turned[half - 1], [0, 0, np.pi]), between(turned[half - 1], turned[half:])
    )
    steps = np.arange(len(turned))
    broken = result._replace(trajectory=turned, node=turned, place=steps)
    parts = parts_of_em(broken)
    assert parts["em_heading"] > 0.4 * np.pi**2
    assert parts["em_successive"] == pytest.approx(np.pi**2 / (len(steps) - 1), rel=0.05)
    assert set(parts_of_em(broken)) == {"em_position", "em_heading", "em_successive"}


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
        if job.key[1] != "ours":
            transform = job.config.touch.image.transform
            assert job.config.templates.threshold == THRESHOLDS[transform]
            energy = float(job.key[1].partition("energy ")[2] or 0.03)
            assert job.config.templates.energy == energy
    compared = name in ("fig5", "fig6", "fig7")
    assert {job.key[1] for job in jobs if job.key[1] != "ours"} >= (
        {"classic", "classic, energy 0.02", "classic, energy 0.05"} if compared else {"classic"}
    )


@pytest.mark.soak
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
    assert len(rows) == 2 * (3 * 2 + 3)
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

    monkeypatch.setattr(paper_sets, "run_tasks", interrupted)
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
