"""The tables of results: rows as Markdown, selection of rows, missing recordings, regressions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.tables import buildings, closures, health, recordings
from evaluation.papers.tables import grid_table as grid
from evaluation.papers.tables import touch_table as touch
from evaluation.papers.tables.closures import closures_table, fit_weights
from evaluation.papers.tables.markdown import markdown_header, markdown_row, select_rows
from evaluation.papers.trial_sessions import ClosureClaims
from evaluation.studies.metrics import TouchMetrics
from ratslam.cli import main
from ratslam.mapping.closure_judge import KINDS, WEIGHTS, SequenceEvidence, shipped_weights

ROOT = Path(__file__).parents[4]

METRICS = TouchMetrics(
    em=0.01, em_experiences=0.02, em_odometry=2.0, arr=0.5, arcr=0.9, arcr_chain_free=0.95,
    relocalisations=90, closures=100, false_closures=3, experiences=50, steps=200,
)  # fmt: skip
SESSION = touch.SessionFigures(
    METRICS, revisits_closed=0.8, em_live=0.04, em_pieces=0.008, unjoined=0.1, across=40, recovery=()
)
ARENA = 0.02, 0.2, np.radians([1.0, 20.0]), 4, [0.9, 0.4, 0.3, 0.04, 0.05]


def stub_sessions(monkeypatch, module, result):
    """Replaces the sessions of a table; returns the tasks that it asks for."""
    tasks = []

    def run_tasks(function, requested, workers):
        tasks.extend(requested)
        return (result(task) for task in requested)

    monkeypatch.setattr(module, "run_tasks", run_tasks)
    return tasks


def test_rows_are_markdown_and_unknown_ones_are_refused_with_a_list(capsys):
    assert markdown_row(["a", 1]) == "| a | 1 |"
    assert markdown_header(["a", "b"]) == "| a | b |\n|---|---|"
    assert select_rows(None, {"a": 1, "b": 2}, ["b"]) == ["b"]
    assert select_rows(["a"], {"a": 1, "b": 2}, ["b"]) == ["a"]
    assert main(["reproduce", "tables", "touch", "--rows", "mian"]) == 2
    assert "main; clean" in capsys.readouterr().err


CONFIGS = [(lambda row: touch.task_config(touch.TouchTask(row, 31103)), row) for row in touch.ROWS]
CONFIGS += [(lambda row: grid.task_config("A", row, 3), row) for row in grid.ROWS]
CONFIGS += [(lambda row: health.task_config(row, 3)[0], row) for row in health.TOUCH]


@pytest.mark.parametrize(("config_of", "row"), CONFIGS)
def test_rows_are_valid_configurations(config_of, row):
    config = config_of(row)
    simulation = config.simulation or config.create_simulation
    assert simulation.seed == 3
    assert config.simulation is None or simulation.maze.seed == 31103 or row in health.TOUCH


def test_a_touch_row_gives_medians_worst_values_and_sums(monkeypatch):
    worse = SESSION._replace(metrics=METRICS._replace(em=5.0, arcr=0.1))
    tasks = stub_sessions(monkeypatch, touch, lambda task: worse if task.maze == 31002 else SESSION)
    _, row = touch.touch_table(["clean"], first=31000, sessions=4)
    assert [(task.maze, task.seed) for task in tasks] == [(31000, 0), (31001, 1), (31002, 2), (31003, 3)]
    assert row == (
        "| clean: 2 mm / 0.5 deg | 0.010 (5.00) | 0.040 | 2.00 | 1 of 4 [5-70 %] | 1 of 4 [5-70 %] (2.50) "
        "| 0.020 | 0.500 | 0.900 (0.10), 0.950 | 0.80 | 12 / 400 |"
    )
    missing = METRICS._replace(arcr=np.nan, arcr_chain_free=0.0, closures=0, false_closures=0)
    stub_sessions(monkeypatch, touch, lambda task: SESSION._replace(metrics=missing))
    _, row = touch.touch_table(["control: shuffled"], sessions=1)
    assert row.endswith("| 0.500 | - | 0.80 | 0 / 0 |")


def test_kidnaps_and_the_change_of_mazes_are_reported_below_the_touch_table(monkeypatch):
    stub_sessions(monkeypatch, touch, lambda task: SESSION._replace(recovery=(10, 20, 90)))
    text = "\n".join(touch.touch_table(["kidnaps", "control: other maze"], sessions=1))
    assert "40 of 100 closures" in text
    assert "median 20; within 45: 67%" in text
    assert "kidnaps: EM within pieces of the map, median 0.008 (0.01)" in text
    assert "outside the largest piece, median 10% (10%)" in text


def test_a_grid_row_compares_with_dead_reckoning(monkeypatch):
    tasks = stub_sessions(monkeypatch, grid, lambda task: ARENA)
    _, row = grid.grid_table([("A", "bias")], arenas=2, first=7)
    assert tasks == [("A", "bias", 7), ("A", "bias", 8)]
    assert "| 0.200 m | 0.020 | 0.10 | 2, 2 of 2 | 10.5 degrees, 50%, 50% |" in row


@pytest.mark.parametrize("table", [buildings.laser_table, buildings.buildings_table])
def test_all_rows_without_data_are_named(monkeypatch, tmp_path, table):
    monkeypatch.delenv(recordings.DATA, raising=False)
    stub_sessions(monkeypatch, buildings, lambda task: pytest.fail("a session without a recording"))
    monkeypatch.chdir(tmp_path)
    laser = table is buildings.laser_table
    rows = buildings.ROWS if laser else buildings.buildings_rows()
    text = "\n".join(table() if laser else table(rows))
    assert all(f"Left out: {row}: " in text for row in rows)
    assert "set RATSLAM_DATA" in text


def test_closures_are_false_by_distance_or_claimed_turn_and_sequences_by_their_median():
    claims = ClosureClaims(
        sequence=np.array([0, 0, 0, 2, 2, 2]),
        accepted=np.array([True] * 3 + [False] * 3),
        distance=np.array([0.0, 1.9, 2.1, 0.0, 0.0, 0.0]),
        turn=np.radians([0.0, 0.0, 0.0, 31.0, 31.0, 0.0]),
        log_odds=np.array([1.0, 1.0, 1.0, -2.0, -2.0, -2.0]),
    )
    false, sequences, odds = buildings.judge_claims(claims)
    assert false.tolist() == [0, 0, 1, 1, 1, 0]
    assert sequences.tolist() == [[True, False], [False, True]]
    assert odds.tolist() == [1.0, -2.0]
    unknown = claims._replace(distance=np.array([0.0, np.nan, 2.1, 0.0, 0.0, 0.0]))
    np.testing.assert_equal(buildings.judge_claims(unknown)[2], [np.nan, -2.0])


def test_a_row_of_buildings_counts_false_closures_and_runs_worse_than_odometry(monkeypatch):
    rows = {
        name: buildings.BuildingsRow(recordings.Recording(name, "configs/square.yaml"), section, copies)
        for name, copies, section in (("lab", "miscalibrated", "buildings"), ("ids", "ids lost", "ids"))
    }
    harmless = buildings.RunFigures(
        10.0,
        1.0,
        10.8,
        np.array([False, True]),
        np.array([[True, False], [True, True], [False, True]]),
        np.array([4.0, np.nan, -4.0]),
    )
    harmed = harmless._replace(odometry=2.0, final=2.5, live=2.0)
    tasks = stub_sessions(monkeypatch, buildings, lambda task: harmed if task[2] == 2 else harmless)
    _, lab, ids, _, total, note = buildings.buildings_table(rows, copies=2)
    assert [task[1:] for task in tasks[:3]] == [("miscalibrated", seed) for seed in range(3)]
    assert lab == (
        "| lab | 10.00 | 1.00 | 10.80 | 1.75, 2.50 | 6.40, 10.80 | 1.25 | 1, 0 of 3 | 1 / 2 | 3 / 6 | 3 / 6 |"
    )
    assert ids.startswith("| ids | 10.00 |")
    assert "3 runs: false / closures 3 / 6 (50.0%)" in total
    assert "final 33.3%, live 0.0%" in total
    assert "of the odds of 6 sequences 0.018" in total
    assert note == "ids lost: worst copy 2.50 times the ATE as is."


def test_the_create_is_mapped_at_nine_settings_without_copies(monkeypatch):
    figures = buildings.RunFigures(1.0, 0.5, 2.0, np.zeros(0, bool), np.zeros((0, 2), bool), np.zeros(0))
    tasks = stub_sessions(monkeypatch, buildings, lambda task: figures)
    monkeypatch.setattr(recordings.Recording, "missing", lambda self: "")
    monkeypatch.setenv(recordings.DATA, ".")
    rows = buildings.choose_rows(["create"])
    lines = list(buildings.buildings_table(rows, copies=2))
    configs = [task[0] for task in tasks]
    assert [task[2] for task in tasks] == [0] * 9
    assert len({config.recall.sector_fov for config in configs}) == 3
    assert {round(config.pose_cells.cell_size / config.experience.match_sd, 9) for config in configs} == {1.0}
    assert {config.pose_cells.cell_size for config in configs} == {0.15, 0.3, 0.6}
    assert lines[1].endswith("| 1.00 | 0.500 | 2.00 | - | - | 0.50 | 0, 1 of 1 | 0 / 0 | 0 / 0 | 0 / 0 |")
    assert lines[-1] == "Create, 9 settings: final median 0.500 m; above odometry: final 0, live 9."


FIT, CONTRADICT = 3, 0


def session(seed, count=60):
    """Sequences that are true where many views fit, but for some chance; contradictions go with true ones."""
    random = np.random.default_rng(seed)
    true = random.random(count) < 0.4
    counts = random.poisson(3.0, (count, 2, 2, KINDS)).astype(float)
    counts[..., FIT] += 6 * true[:, None, None]
    counts[..., CONTRADICT] += 2 * true[:, None, None]
    evidence = SequenceEvidence(random.normal(2.0 * true - 1, 2.0), counts)
    return true, random.random(count), random.random(count) < 0.5, (evidence,) * 3


def test_the_regression_finds_the_views_that_tell_and_counts_no_contradiction_for_a_place():
    weights = fit_weights([session(seed) for seed in range(5)])
    within = weights[:, 3 : 3 + KINDS]
    assert np.all(within[:, FIT] > 0.1)
    assert np.all(within.argmax(axis=1) == FIT)
    assert np.all(weights[:, [3, 4, 3 + KINDS, 4 + KINDS]] <= 0)


def test_every_session_is_tested_by_the_weights_of_the_others(monkeypatch, tmp_path):
    monkeypatch.setattr(
        closures, "run_tasks", lambda function, tasks, workers: (session(k) for k in range(len(tasks)))
    )
    _, *lines, fitted = closures_table(sessions=2, folder=tmp_path)
    assert [line.split(" | ")[0] for line in lines] == [f"| {row}" for row in (*closures.ROWS, "all")]
    assert set(closures.ROWS) <= set(touch.ROWS)
    assert float(lines[-1].split(" | ")[6]) > 0.9
    held = json.loads((tmp_path / WEIGHTS).read_text(encoding="utf-8"))
    assert held == json.loads(fitted.strip().removeprefix("```json").removesuffix("```"))
    assert np.shape(held["weights"]) == shipped_weights().shape


def test_nothing_said_is_not_counted():
    one = session(0)
    one[3][0].odometry_ratio[:10] = np.nan
    odds = one[3][0].log_odds(fit_weights([one, session(1)]))
    assert np.isnan(odds[:10]).all()
    assert np.isfinite(odds[10:]).all()


def judged(seed, count=80):
    """Maps that are bad where their first feature is low, but for some chance."""
    random = np.random.default_rng(seed)
    features = random.normal(size=(count, 5))
    bad = features[:, 0] + 0.3 * random.normal(size=count) < -0.5
    return np.column_stack([features, np.where(bad, 2.0, 0.5), bad, random.integers(1, 50, count)])


def test_the_regression_of_health_finds_the_feature_that_tells_in_any_unit():
    weights = health.fit_weights(judged(0, 400))
    assert weights[1] < -2
    assert np.all(np.abs(weights[2:]) < 0.3 * abs(weights[1]))
    maps, units = judged(0), np.array([1.0, 10.0, 0.1, 3.0, 1.0])
    scaled = health.fit_weights(maps * [*units, 1, 1, 1])
    assert scaled[1:] * units == pytest.approx(health.fit_weights(maps)[1:], rel=1e-3, abs=1e-4)


def test_every_second_session_tests_the_regression_of_health(monkeypatch):
    monkeypatch.setattr(health, "real_recordings", lambda: None)
    monkeypatch.setattr(health, "run_tasks", lambda function, tasks, workers: map(judged, range(len(tasks))))
    _, *lines, fitted = health.health_table(sessions=2)
    rows = (*health.TOUCH, "all", "even, fitted on these", "odd, fitted on even ones")
    assert [line.split(" | ")[0] for line in lines] == [f"| {row}" for row in rows]
    assert float(lines[-1].split(" | ")[3]) > 0.9
    assert len(fitted.split(": ")[1].split(", ")) == 6
