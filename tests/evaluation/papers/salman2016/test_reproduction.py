"""Reproductions of Fox et al. 2012 and Salman & Pearson 2016: claims, rankings, maps, threshold tuning."""

import csv
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from evaluation.papers import paper_sets, trial_sessions
from evaluation.papers.commands import FOX2012, SALMAN2016
from evaluation.papers.fox2012 import reproduction as fox2012
from evaluation.papers.fox2012.reproduction import FILTERED, PAPERS, RECKONED, rank_mappers
from evaluation.papers.paper_sets import ResultRow, reproduce, sweep_thresholds
from evaluation.papers.salman2016 import reproduction, threshold_tuning
from evaluation.papers.salman2016.protocols import PROTOCOLS, THRESHOLDS, Claim
from evaluation.papers.salman2016.reproduction import PAPER, judge_claim, match_thresholds, plan_jobs
from evaluation.papers.trial_sessions import collect_session, run_session
from evaluation.studies.metrics import ViewDifferences
from ratslam.classic import view_templates
from ratslam.classic.experience_map import ExperienceMap
from ratslam.classic.view_templates import TemplateConfig
from ratslam.grid.config import GridConfig
from ratslam.runs.settings.strict_yaml import parse
from robot.sources.in_memory import InMemorySource
from robot.touch_source import observation_of
from robot.world.arena import Arena
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose
from tests.helpers.commands import ROOT, refused, said
from tests.helpers.grid_world import TIPS, create, report
from tests.helpers.laps import session, square

SMALL = "maze.columns=2", "maze.rows=2", "maze.loop=4", "path.circuits=CCA", "kidnaps.ahead=2.0"
TINY = tuple(f"simulation.{one}" for one in SMALL)
RISES = Claim("a rises", "arr", "rises", "a", "b")


@pytest.mark.soak
def test_a_threshold_sweep_equals_single_sessions():
    """In the current experiences, and in the map that the steps of a threshold are folded into."""
    condition = PROTOCOLS["fig6"].conditions[1]
    config, log = collect_session(reproduction.session_config(condition, "classic", 0, TINY))
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


def test_em_has_parts_and_matched_thresholds_reach_the_arcr_that_all_conditions_reach():
    """One link turned by half a turn: the mean over all pairs is large, that of successive ones small."""
    result = session(square("CCC"))
    turned = result.trajectory.copy()
    half, steps = len(turned) // 2, np.arange(len(turned))
    rest = between(turned[half - 1], turned[half:])
    turned[half:] = compose(compose(turned[half - 1], [0, 0, np.pi]), rest)
    parts = reproduction.parts_of_em(result._replace(trajectory=turned, node=turned, place=steps))
    assert parts["em_heading"] > 0.4 * np.pi**2
    assert parts["em_successive"] == pytest.approx(np.pi**2 / (len(steps) - 1), rel=0.05)
    assert set(parts) == {"em_position", "em_heading", "em_successive"}
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


@pytest.mark.parametrize(("name", "option", "value", "named"), [
    ("fig6", "--seed", "-1", "--seed"),
    ("fox-fig6", "--set", "grid.cell=-1", "grid.cell"),
    ("fox-fig6", "--set", "create_simulation.arena.sides=2", "side"),
])  # fmt: skip
def test_invalid_arguments_are_refused(tmp_path, capsys, name, option, value, named):
    assert named in refused(capsys, "reproduce", name, "-o", tmp_path / "a", option, value)
    assert not (tmp_path / "a").exists()


def test_the_program_lists_all_protocols_and_refuses_others(tmp_path):
    for paper, names, unknown in ((PAPER, SALMAN2016, "fig9"), (fox2012.PAPER, FOX2012, "fox-fig3")):
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


VIEWS = ViewDifferences(np.linspace(0, 1, 11), np.eye(10, dtype=int)[1] * 8, np.ones(10, int), 0.9)
GRID = (0.01, 0.02, 0.04, 0.08)
TUNED = """
simulation: {maze: {columns: 3, rows: 2, loop: 6}, path: {circuits: CCC}, odometry: {noise: none}}
pose_cells: {cells_xy: 11, cells_heading: 12}
"""


def scores(*results):
    return [threshold_tuning.ThresholdScore(0.01 * k, 0.5, *counts) for k, counts in enumerate(results)]


@pytest.mark.parametrize("how", [{}, {"shift": 2, "shift_step": 2}, {"panoramic": True, "shift_step": 3}])
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


def test_most_correct_with_none_incorrect_wins_or_the_reason_for_no_winner_is_given():
    found = scores((9, 0), (12, 0), (30, 0), (30, 0), (99, 1))
    winner, why = threshold_tuning.choose_threshold(found, VIEWS)
    assert winner is found[2]
    assert "3 thresholds" in why
    few, why_few = threshold_tuning.choose_threshold(scores((0, 0), (9, 0), (3, 5)), VIEWS)
    wrong, why_wrong = threshold_tuning.choose_threshold(scores((12, 4), (50, 2), (9, 0)), VIEWS)
    assert few is wrong is None
    assert "0.01 gives 9" in why_few
    # the median of views of the same place, and the share of those of other places that lie below
    assert all(part in why_wrong for part in ("0.01 has the fewest, 2 beside 50", "0.150", "15.0%"))


def test_the_command_tunes_a_simulated_session(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(threshold_tuning, "THRESHOLDS", GRID)
    config, out = tmp_path / "tiny.yaml", tmp_path / "out"
    config.write_text(TUNED)
    text = said(capsys, "reproduce", "threshold", config, "-o", out)
    assert len([line for line in text.splitlines() if line[:8].strip().startswith("0.")]) >= len(GRID)
    assert "AUC" in text
    assert "templates.threshold=" in text or "no threshold satisfies" in text
    assert len((out / "threshold.csv").read_text().splitlines()) == 1 + len(GRID)
    assert (out / "threshold.png").read_bytes().startswith(b"\x89PNG")


def test_all_steps_need_a_view(monkeypatch):
    blind = InMemorySource(
        name="made up", digest="", time=10.0 * np.arange(3), motion=np.zeros((3, 4)), moved=np.ones(3, bool),
        views=np.arange(3.0).reshape(3, 1, 1, 1), seen=np.array([True, False, True]),
        label=np.full(3, -1, np.int32), truth=np.zeros((3, 3)),
    )  # fmt: skip
    monkeypatch.setattr(threshold_tuning, "collect_session", lambda config: (config, blind))
    with pytest.raises(InputError, match="without a view"):
        list(threshold_tuning.tune_threshold(parse("simulation: {}\n", "here"), ROOT))


TINY_FOX = ("create_simulation.reports=40", "grid.particles=20")
ROOMY = Arena("roomy", np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), (), np.zeros(3))
BRIER, EVERYWHERE = "map_brier_skill", next(iter(fox2012.MEASURES))
FALLING = {"blob": [0.5, 0.6, 0.7], "geometric": [0.4, 0.5, 0.6], "template": [0.3, 0.4, 0.5]}
RISING = dict(zip(FALLING, list(FALLING.values())[::-1], strict=True))


def of(field, table, along=FILTERED, best=0.0) -> list[ResultRow]:
    score = SimpleNamespace(under=lambda convention: SimpleNamespace(best=best))
    result = SimpleNamespace(stop=0, score=score)
    return [
        ResultRow(("1.25 m arena", "ours", mapper, along), k, 0, {"reports": 40, field: value}, result)
        for mapper, values in table.items()
        for k, value in enumerate(values)
    ]


def test_a_contact_is_drawn_at_its_place() -> None:
    marks = trial_sessions.collect_marks([report(forward=0.02), report(forward=0.02, touching=[1])])
    path = np.array([[0.4, 0.5, np.pi / 2], [0.4, 0.52, np.pi / 2]])
    grid = trial_sessions.draw_map(GridConfig(body=0.0), create(), ROOMY, path, marks)
    assert grid.probability.shape == (40, 40)
    assert np.allclose(grid.origin, -0.5)
    row, column = np.unravel_index(grid.probability.argmax(), grid.probability.shape)
    there = grid.origin + grid.cell * (np.array([column, row]) + 0.5)
    assert np.abs(there - [0.4 - TIPS[1, 1], 0.52 + TIPS[1, 0]]).max() <= grid.cell / 2 + 1e-9
    # Later contacts are not drawn.
    first = trial_sessions.draw_map(GridConfig(body=0.0), create(), ROOMY, path[:1], marks)
    assert first.probability.max() == pytest.approx(0.3)


def test_an_intermediate_stop_does_not_change_the_result() -> None:
    config = fox2012.plan_jobs(fox2012.PROTOCOLS["fox-fig4"], 1, 0, TINY_FOX)[0].variants["ours", "blob"]
    out = trial_sessions.simulate_session(config.create_simulation)
    reports = trial_sessions.observe_session(config, out, 0)
    early, late = trial_sessions.run_filter(config, out, reports, (23, len(reports)))
    ((online, _, grid),) = trial_sessions.run_filter(config, out, reports, (len(reports),))
    assert len(early[1]) == 23
    pairs = (late[0], online), (late[2].probability, grid.probability), (early[0], online[:23])
    assert all(np.array_equal(*pair) for pair in pairs)


def test_the_ranking_of_the_paper_holds_or_not_and_a_constant_map_that_wins_is_reported() -> None:
    def word(field, table, ranking="ours") -> str:
        return rank_mappers(of(field, table), ranking, field)[0]

    mixed = FALLING | {"geometric": [0.4, 0.7, 0.6]}
    words = [word(EVERYWHERE, table) for table in (FALLING, RISING, mixed)]
    assert words == ["holds", "does not hold", "not decided"]
    # More skill is better, so the same numbers give the opposite ranking.
    assert [word(BRIER, table) for table in (FALLING, RISING)] == ["does not hold", "holds"]
    assert not word(EVERYWHERE, {name: [0.1] for name in PAPERS})
    assert not word(EVERYWHERE, FALLING, "as printed")
    beaten = [rank_mappers(of(EVERYWHERE, FALLING, best=b), "ours", EVERYWHERE)[2] for b in (0.2, 0.5)]
    assert beaten == [True, False]
    assert rank_mappers(of(BRIER, {name: [-0.1, -0.2] for name in PAPERS}), "ours", BRIER)[2]
    results = of(EVERYWHERE, FALLING, best=0.2) + of(EVERYWHERE, FALLING, RECKONED, best=0.2)
    line = fox2012.render_rankings("ours", results)[2]
    assert line.count("holds") == 2  # also along dead reckoning; the true path is not known here
    assert "without information" in line


@pytest.mark.parametrize("name", fox2012.PROTOCOLS)
def test_all_variants_of_a_set_share_a_session(name: str) -> None:
    jobs = fox2012.plan_jobs(fox2012.PROTOCOLS[name], 2, 0)
    assert len(jobs) == 2 * len(fox2012.PROTOCOLS[name].worlds)
    sessions = [{config.create_simulation for config in job.variants.values()} for job in jobs]
    assert all(len(each) == 1 for each in sessions)
    every = [one for each in sessions for one in each if one]
    seeds = {(job.number, one.seed) for job, each in zip(jobs, sessions, strict=True) for one in each if one}
    assert len(seeds) == 2
    assert len({one.arena.seed for one in every}) == (1 if fox2012.PROTOCOLS[name].one_arena else 2)


def test_a_tiny_reproduction_leaves_table_rows_and_figure(tmp_path: Path, capsys) -> None:
    given = {"sets": 2, "workers": 1, "assignments": TINY_FOX}
    text, interrupted = reproduce(fox2012.PAPER, "fox-fig4", tmp_path, **given)
    assert not interrupted
    assert all(said in text for said in ("2 of 2 sets", "constant 0.3"))
    rows = list(csv.DictReader((tmp_path / "fox-fig4.csv").read_text().splitlines()))
    assert len(rows) == 2 * 2 * 3 * len(fox2012.MAPPERS)
    assert set(fox2012.FIELDS) < set(rows[0])
    assert (tmp_path / "fox-fig4.png").read_bytes().startswith(b"\x89PNG")
    assert "exists" in refused(capsys, "reproduce", "fox-fig4", "-o", tmp_path)
    reckoned = [{row["odometry_error"] for row in rows if row["set"] == number} for number in "01"]
    assert [len(each) for each in reckoned] == [1, 1]
    assert reckoned[0] != reckoned[1]
    assert all(row["online_error"] == row["odometry_error"] for row in rows if row["along"] == RECKONED)
    assert all(float(row["online_error"]) == 0 for row in rows if row["along"] == fox2012.TRUE)
    filtered = [row["online_error"] for row in rows if row["along"] == FILTERED and row["set"] == "0"]
    assert len(set(filtered)) > 2
    # A set is independent of the sessions before it.
    again = fox2012.run_job(fox2012.plan_jobs(fox2012.PROTOCOLS["fox-fig4"], 2, 0, TINY_FOX)[1])
    for key in ("online_error", "map_auc"):
        assert [repr(one.values[key]) for one in again] == [row[key] for row in rows if row["set"] == "1"]
