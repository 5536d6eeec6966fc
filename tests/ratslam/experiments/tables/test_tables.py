"""The tables of results: rows as Markdown, selection of rows, recordings that are missing, the command."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.metrics.session_metrics import TouchMetrics
from ratslam.cli import main
from ratslam.experiments.tables import grid, laser, touch
from ratslam.experiments.tables.markdown import markdown_header, markdown_row, select_rows
from tactile.base.errors import InputError

METRICS = TouchMetrics(
    em=0.01, em_experiences=0.02, em_odometry=2.0, arr=0.5, arcr=0.9, arcr_chain_free=0.95,
    relocalisations=90, closures=100, false_closures=3, experiences=50, steps=200,
)  # fmt: skip
SESSION = touch.SessionFigures(METRICS, revisits_closed=0.8, across=40, recovery=())
ARENA = grid.GridFigures(0.02, 0.2, np.radians([1.0, 20.0]), 4, (0.9, 0.4, 0.3, 0.04, 0.05))


def stub_sessions(monkeypatch, module, result):
    """Replaces the sessions of a table; returns the tasks that it asks for."""
    tasks = []

    def run_tasks(function, requested, workers):
        tasks.extend(requested)
        return (result(task) for task in requested)

    monkeypatch.setattr(module, "run_tasks", run_tasks)
    return tasks


def test_rows_are_markdown():
    assert markdown_row(["a", 1]) == "| a | 1 |"
    assert markdown_header(["a", "b"]) == "| a | b |\n|---|---|"


def test_unknown_rows_are_refused_with_a_list():
    assert select_rows(None, {"a": 1, "b": 2}, ["b"]) == ["b"]
    assert select_rows(["a"], {"a": 1, "b": 2}, ["b"]) == ["a"]
    with pytest.raises(InputError, match="one of: a; b"):
        select_rows(["c"], {"a": 1, "b": 2}, ["b"])


@pytest.mark.parametrize("row", touch.ROWS)
def test_touch_rows_are_valid_configurations(row):
    assert touch.task_config(touch.TouchTask(row, 9000, 3)).simulation.seed == 3


@pytest.mark.parametrize("row", grid.ROWS)
def test_grid_rows_are_valid_configurations(row):
    assert grid.task_config(grid.GridTask("A", row, 9003)).create_simulation.seed == 9003


def test_a_touch_row_gives_medians_worst_values_and_sums(monkeypatch):
    worse = SESSION._replace(metrics=METRICS._replace(em=0.5, arcr=0.1))
    tasks = stub_sessions(monkeypatch, touch, lambda task: worse if task.seed == 101 else SESSION)
    _, row = touch.touch_table(["clean"], mazes=2, seeds=2)
    assert [(task.maze, task.seed) for task in tasks] == [(9000, 0), (9000, 1), (9001, 100), (9001, 101)]
    assert row == (
        "| clean: 2 mm / 0.5 deg | 0.010 (0.50) | 3 of 4 | 0.020 | 2.00 | 0.500 | 0.900 (0.10), 0.950 | 0.80 "
        "| 12 / 400 |"
    )


def test_touch_sessions_without_closures_have_no_arcr(monkeypatch):
    missing = METRICS._replace(arcr=np.nan, arcr_chain_free=0.0, closures=0, false_closures=0)
    none = SESSION._replace(metrics=missing)
    stub_sessions(monkeypatch, touch, lambda task: none)
    _, row = touch.touch_table(["control: shuffled"], mazes=1, seeds=1)
    assert row.endswith("| 0.500 | - | 0.80 | 0 / 0 |")


def test_kidnaps_and_the_change_of_mazes_are_reported_below_the_touch_table(monkeypatch):
    stub_sessions(monkeypatch, touch, lambda task: SESSION._replace(recovery=(10, 20, 90)))
    *_, other, kidnaps = touch.touch_table(["kidnaps", "control: other maze"], mazes=1, seeds=1)
    text = "\n".join((other, kidnaps))
    assert "40 of 100 closures" in text
    assert "median 20; within 45: 67%" in text


def test_a_grid_row_compares_with_dead_reckoning(monkeypatch):
    tasks = stub_sessions(monkeypatch, grid, lambda task: ARENA)
    _, row = grid.grid_table([("A", "bias")], arenas=2, first=7)
    assert [task.arena for task in tasks] == [7, 8]
    assert "| 0.200 m | 0.020 | 0.10 | 2, 2 of 2 | 10.5 degrees, 50%, 50% |" in row


def test_all_rows_of_the_laser_table_without_data_are_named(monkeypatch, tmp_path):
    monkeypatch.delenv(laser.DATA, raising=False)
    stub_sessions(monkeypatch, laser, lambda task: pytest.fail("a session without a recording"))
    text = "\n".join(laser.laser_table(folder=tmp_path))
    assert all(f"Left out: {row}: " in text for row in laser.ROWS)
    assert "set RATSLAM_DATA" in text


def test_the_command_refuses_unknown_rows(capsys):
    assert main(["reproduce", "tables", "touch", "--rows", "mian"]) == 2
    assert "main; clean" in capsys.readouterr().err
