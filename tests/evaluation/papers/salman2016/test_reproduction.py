"""Reproductions of Salman & Pearson 2016: claims, threshold tuning; and what those of both papers share."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from evaluation.papers import paper_sets
from evaluation.papers.commands import FOX2012, SALMAN2016
from evaluation.papers.fox2012 import reproduction as fox2012
from evaluation.papers.paper_sets import ResultRow, reproduce, sweep_thresholds
from evaluation.papers.salman2016 import threshold_tuning
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
from evaluation.papers.trial_sessions import collect_session, run_session
from evaluation.studies.metrics import ViewDifferences
from ratslam.classic import view_templates
from ratslam.classic.experience_map import ExperienceMap
from ratslam.classic.view_templates import TemplateConfig
from ratslam.cli import main
from ratslam.runs.settings.strict_yaml import parse
from robot.sources.in_memory import InMemorySource
from robot.touch_source import observation_of
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose
from tests.evaluation.papers.fox2012.test_reproduction import TINY as TINY_FOX
from tests.helpers.laps import session, square

TINY = (
    "simulation.maze.columns=2",
    "simulation.maze.rows=2",
    "simulation.maze.loop=4",
    "simulation.path.circuits=CCA",
    "simulation.kidnaps.ahead=2.0",
)
RISES = Claim("a rises", "arr", "rises", "a", "b")


@pytest.mark.soak
def test_a_threshold_sweep_equals_single_sessions():
    """In the current experiences, and in the map that the steps of a threshold are folded into."""
    config, log = collect_session(session_config(PROTOCOLS["fig6"].conditions[1], "classic", 0, TINY))
    columns = sweep_thresholds(config, log, np.array([0.06, config.templates.threshold]))
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
    energies = judge_claim(RISES._replace(quantity="em"), np.array([0.01, 1.0]), np.array([0.02, 2.0]))
    assert energies == ("confirmed", "ratio 2 [2, 2], 2 sets")


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
    near = [abs(0.1 * k - 0.1765) < 0.05 for k in range(sets)]
    assert f"of the paper's: {sum(near)} of {sets}" in text


def test_em_between_successive_experiences_needs_no_whole_map():
    """One link turned by half a turn: the mean over all pairs is large, that of successive ones small."""
    result = session(square("CCC"))
    turned = result.trajectory.copy()
    half, steps = len(turned) // 2, np.arange(len(turned))
    turned[half:] = compose(
        compose(turned[half - 1], [0, 0, np.pi]), between(turned[half - 1], turned[half:])
    )
    parts = parts_of_em(result._replace(trajectory=turned, node=turned, place=steps))
    assert parts["em_heading"] > 0.4 * np.pi**2
    assert parts["em_successive"] == pytest.approx(np.pi**2 / (len(steps) - 1), rel=0.05)
    assert set(parts) == {"em_position", "em_heading", "em_successive"}


def test_matched_thresholds_reach_the_arcr_that_all_conditions_reach():
    measured = [("a", 0.9, 0.1), ("a", 0.8, 0.3), ("a", 0.5, 0.6), ("b", 0.7, 0.2), ("b", 0.6, 0.4)]
    rows = [
        ResultRow((name, "classic", "sweep"), 0, 0, {"arcr": arcr, "arr": arr, "threshold": arr})
        for name, arcr, arr in (*measured, ("c", np.nan, 0.0))
    ]
    found = match_thresholds(rows)
    assert {name: r.values["arr"] for name, r in found.items()} == {"a": 0.3, "b": 0.2}
    assert match_thresholds([]) == {}


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
    others = [job for job in jobs if job.key[1] != "ours"]
    for job in others:
        templates = job.config.templates
        assert templates.threshold == THRESHOLDS[job.config.touch.image.transform]
        assert templates.energy == float(job.key[1].partition("energy ")[2] or 0.03)
    energies = {"classic, energy 0.02", "classic, energy 0.05"} if name in ("fig5", "fig6", "fig7") else set()
    assert {job.key[1] for job in others} >= {"classic"} | energies


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


@pytest.mark.parametrize(
    ("name", "option", "value", "named"),
    [
        ("fig6", "--seed", "-1", "--seed"),
        ("fox-fig6", "--set", "grid.cell=-1", "grid.cell"),
        ("fox-fig6", "--set", "create_simulation.arena.sides=2", "side"),
    ],
)
def test_invalid_arguments_are_refused(tmp_path, capsys, name, option, value, named):
    assert main(["reproduce", name, "-o", str(tmp_path / "a"), option, value]) == 2
    assert named in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("paper", "names", "unknown"), [(PAPER, SALMAN2016, "fig9"), (fox2012.PAPER, FOX2012, "fox-fig3")]
)
def test_the_program_lists_all_protocols_and_refuses_others(tmp_path, paper, names, unknown):
    assert set(names) == set(paper.protocols)
    with pytest.raises(InputError, match=unknown):
        reproduce(paper, unknown, tmp_path)


@pytest.mark.soak
@pytest.mark.parametrize("name", [*PROTOCOLS, *fox2012.PROTOCOLS])
def test_reproductions_run_to_their_end(name, tmp_path):
    paper, tiny = (PAPER, TINY) if name in PROTOCOLS else (fox2012.PAPER, TINY_FOX)
    text, stopped = reproduce(paper, name, tmp_path, sets=2, workers=2, assignments=tiny)
    assert not stopped
    assert (PROTOCOLS | fox2012.PROTOCOLS)[name].title in text
    assert (tmp_path / f"{name}.png").exists()


ROOT = Path(__file__).parents[4]
VIEWS = ViewDifferences(np.linspace(0, 1, 11), np.eye(10, dtype=int)[1] * 8, np.ones(10, int), 0.9)
GRID = (0.01, 0.02, 0.04, 0.08)
TUNED = """
simulation:
  maze: {columns: 3, rows: 2, loop: 6}
  path: {circuits: CCC}
  odometry: {noise: none}
pose_cells: {cells_xy: 11, cells_heading: 12}
"""


def scores(*results):
    return [
        threshold_tuning.ThresholdScore(0.01 * k, 0.5, correct, incorrect)
        for k, (correct, incorrect) in enumerate(results)
    ]


@pytest.mark.parametrize(
    "how", [{}, {"shift": 1}, {"shift": 2, "shift_step": 2}, {"panoramic": True, "shift_step": 3}]
)
@settings(max_examples=5)
@given(views=arrays.arrays(float, (3, 3, 6, 2), elements=st.floats(0, 1)))
def test_differences_equal_those_of_the_matcher(how, views):
    config = TemplateConfig(threshold=1.0, **how)
    found = threshold_tuning.view_differences(config, views, views)
    store = view_templates.start(config, (3, 6, 2), 1, np.dtype(float))
    for i in range(3):
        stored = store._replace(view=jnp.asarray(views[i].reshape(-1, 1)), count=jnp.int32(1))
        match = view_templates.match_view(config, (3, 6, 2), stored, jnp.asarray(views[i - 1]))
        assert found[i - 1, i] == pytest.approx(float(match.error), abs=1e-12)


def test_most_correct_with_none_incorrect_wins():
    found = scores((9, 0), (12, 0), (30, 0), (30, 0), (99, 1))
    winner, why = threshold_tuning.choose_threshold(found, VIEWS)
    assert winner is found[2]
    assert "3 thresholds" in why


def test_the_reason_for_no_winner_is_given():
    few, why_few = threshold_tuning.choose_threshold(scores((0, 0), (9, 0), (3, 5)), VIEWS)
    wrong, why_wrong = threshold_tuning.choose_threshold(scores((12, 4), (50, 2), (9, 0)), VIEWS)
    assert few is wrong is None
    assert "0.01 gives 9" in why_few
    assert "0.01 has the fewest, 2 beside 50" in why_wrong
    assert "0.150" in why_wrong  # the median of views of the same place
    assert "15.0%" in why_wrong  # of the views of other places lie below


def test_the_command_tunes_a_simulated_session(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("evaluation.papers.salman2016.threshold_tuning.THRESHOLDS", GRID)
    config = tmp_path / "tiny.yaml"
    config.write_text(TUNED)
    out = tmp_path / "out"
    assert main(["reproduce", "threshold", str(config), "-o", str(out)]) == 0
    text = capsys.readouterr().out
    assert len([line for line in text.splitlines() if line[:8].strip().startswith("0.")]) >= len(GRID)
    assert "AUC" in text
    assert "templates.threshold=" in text or "no threshold satisfies" in text
    assert len((out / "threshold.csv").read_text().splitlines()) == 1 + len(GRID)
    assert (out / "threshold.png").read_bytes().startswith(b"\x89PNG")


def test_parts_of_the_grid_are_run_tasks_and_put_together(monkeypatch):
    seen = []

    def run_tasks(function, tasks, workers):
        seen.append((len(tasks), workers))
        return ([threshold_tuning.ThresholdScore(float(t), 0.0, 20, 0) for t in part] for *_, part in tasks)

    monkeypatch.setattr("evaluation.papers.salman2016.threshold_tuning.run_tasks", run_tasks)
    lines = list(threshold_tuning.tune_threshold(parse(TUNED, "tiny"), ROOT, workers=3))
    assert seen == [(3, 3)]
    assert [float(line.split()[0]) for line in lines if line[2:].strip().startswith("0.")] == list(
        threshold_tuning.THRESHOLDS
    )
    assert sum(line.endswith("<- the winner") for line in lines) == 1


def test_all_steps_need_a_view(monkeypatch):
    blind = InMemorySource(
        name="made up", digest="", time=10.0 * np.arange(3), motion=np.zeros((3, 4)), moved=np.ones(3, bool),
        views=np.arange(3.0).reshape(3, 1, 1, 1), seen=np.array([True, False, True]),
        label=np.full(3, -1, np.int32), truth=np.zeros((3, 3)),
    )  # fmt: skip
    monkeypatch.setattr(
        "evaluation.papers.salman2016.threshold_tuning.collect_session", lambda config: (config, blind)
    )
    with pytest.raises(InputError, match="without a view"):
        list(threshold_tuning.tune_threshold(parse("simulation: {}\n", "here"), ROOT))
