"""The tables of results: rows as Markdown, selection of rows, recordings that are missing, the command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.tables import batches, buildings, cycles, recordings
from evaluation.papers.tables import grid_table as grid
from evaluation.papers.tables import touch_table as touch
from evaluation.papers.tables.markdown import markdown_header, markdown_row, select_rows
from evaluation.papers.trial_sessions import ClosureClaims, closure_claims, run_recording
from evaluation.studies.metrics import TouchMetrics
from ratslam.cli import main
from ratslam.runs.settings.run_config import load_config
from tactile.base.errors import InputError
from tactile.base.se2 import between, integrate

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
    assert touch.task_config(touch.TouchTask(row, 31103)).simulation.seed == 3


def test_new_ground_enters_no_cell_twice_and_differs_by_maze():
    tasks = (touch.TouchTask("new ground", maze) for maze in (31103, 31104))
    one, other = (touch.task_config(task).simulation for task in tasks)
    cells = one.path.cells
    assert len(set(cells)) == len(cells) > 50
    assert cells != other.path.cells
    assert one.maze.seed == 31103


@pytest.mark.parametrize("row", grid.ROWS)
def test_grid_rows_are_valid_configurations(row):
    assert grid.task_config("A", row, 9003).create_simulation.seed == 9003


def test_a_touch_row_gives_medians_worst_values_and_sums(monkeypatch):
    worse = SESSION._replace(metrics=METRICS._replace(em=5.0, arcr=0.1))
    tasks = stub_sessions(monkeypatch, touch, lambda task: worse if task.maze == 31002 else SESSION)
    _, row = touch.touch_table(["clean"], first=31000, sessions=4)
    assert [(task.maze, task.seed) for task in tasks] == [(31000, 0), (31001, 1), (31002, 2), (31003, 3)]
    assert row == (
        "| clean: 2 mm / 0.5 deg | 0.010 (5.00) | 0.040 | 2.00 | 1 of 4 [5-70 %] | 1 of 4 [5-70 %] (2.50) "
        "| 0.020 | 0.500 | 0.900 (0.10), 0.950 | 0.80 | 12 / 400 |"
    )


def test_each_touch_row_has_its_number_of_sessions(monkeypatch):
    tasks = stub_sessions(monkeypatch, touch, lambda task: SESSION)
    lines = list(touch.touch_table(["main", "tree", "clean"]))
    assert [sum(task.row == row for task in tasks) for row in ("main", "tree", "clean")] == [40, 20, 12]
    assert {task.maze for task in tasks if task.row == "tree"} == set(range(31100, 31120))
    assert "0 of 40 [0-9 %]" in lines[1]


def test_touch_sessions_without_closures_have_no_arcr(monkeypatch):
    missing = METRICS._replace(arcr=np.nan, arcr_chain_free=0.0, closures=0, false_closures=0)
    none = SESSION._replace(metrics=missing)
    stub_sessions(monkeypatch, touch, lambda task: none)
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


def test_all_rows_of_the_laser_table_without_data_are_named(monkeypatch, tmp_path):
    monkeypatch.delenv(recordings.DATA, raising=False)
    stub_sessions(monkeypatch, buildings, lambda task: pytest.fail("a session without a recording"))
    monkeypatch.chdir(tmp_path)
    text = "\n".join(buildings.laser_table())
    assert all(f"Left out: {row}: " in text for row in buildings.ROWS)
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


@pytest.mark.soak
def test_a_recording_in_the_folder_of_buildings_is_a_row(tmp_path, monkeypatch):
    """Four rounds on a circle in a room, by a laser of 180 beams."""
    write_building(tmp_path / "buildings", "room")
    monkeypatch.setenv(recordings.DATA, str(tmp_path))
    rows = buildings.buildings_rows()
    assert list(rows)[:6] == ["room", "intel", "tuc", "ids lost", "ids wrong", "ids new"]
    assert buildings.choose_rows(None) == rows
    present = buildings.choose_rows(["tuc", "room"])
    assert list(present) == ["room", "tuc"]
    _, room, _, total, missing = buildings.buildings_table(present, copies=1, workers=1)
    cells = room.split(" | ")
    assert cells[0] == "| room"
    assert cells[7].endswith("of 2")
    assert int(cells[9].split(" / ")[1]) > 0
    assert "All buildings, 2 runs" in total
    assert missing.startswith("Left out: tuc: ")
    assert missing.endswith("tuc_lecture_hall_odom.csv does not exist")


def test_all_rows_of_the_buildings_table_without_data_are_named(monkeypatch):
    monkeypatch.delenv(recordings.DATA, raising=False)
    stub_sessions(monkeypatch, buildings, lambda task: pytest.fail("a session without a recording"))
    rows = buildings.buildings_rows()
    text = "\n".join(buildings.buildings_table(rows))
    assert all(f"Left out: {row}: set RATSLAM_DATA" in text for row in rows)
    assert "buildings" in rows


@pytest.mark.soak
@pytest.mark.parametrize("turned_deg", [20, -20])
def test_a_candidate_claims_the_heading_that_its_shifted_view_shows(turned_deg, tmp_path):
    """Later rounds are driven with the head turned by two sectors of ten degrees."""
    write_building(tmp_path / "buildings", "room", np.radians(turned_deg))
    file = tmp_path / "buildings" / "room_odom_gt.csv"
    settings = [f"recording.file={file}", "recall.sector_fov=3.14159"]
    _, session, run = run_recording(load_config(ROOT / "configs" / "building.yaml", settings))
    claims = closure_claims(session.map, run.truth)
    assert claims.distance.max() < 0.5
    assert claims.turn.max() < np.radians(1)
    blind = closure_claims(session.map, run.truth * [1, 1, 0])  # the claims themselves
    assert np.isclose(blind.turn, np.radians(20), atol=1e-3).sum() > 20


def write_building(folder, name, turned=0.0):
    """A recording as those of the buildings: odometry with a heading bias, truth, and scans of a room; from
    half-time on, the heading is `turned` from the direction of driving, rad."""
    folder.mkdir()
    time = np.arange(200.0)
    angle = 2 * np.pi * time / 50
    heading = angle + np.pi / 2 + turned * (time >= 100)
    truth = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), heading])
    step = between(truth[:-1], truth[1:])
    odometry = np.vstack([np.zeros(3), integrate(step + [0, 0, 0.002])])
    beam = truth[:, 2:] + np.radians(np.arange(-89.5, 90))
    reach = [
        np.where(np.cos(beam) > 0, 5 - truth[:, :1], -4 - truth[:, :1]) / np.cos(beam),
        np.where(np.sin(beam) > 0, 4 - truth[:, 1:2], -6 - truth[:, 1:2]) / np.sin(beam),
    ]
    header = "t,odo_x,odo_y,odo_th,gt_x,gt_y,gt_th"
    rows = np.column_stack([time, odometry, truth])
    np.savetxt(folder / f"{name}_odom_gt.csv", rows, delimiter=",", header=header, comments="")
    header = ",".join(["t", *(f"r{k}" for k in range(180))])
    rows = np.column_stack([time, np.min(reach, axis=0)])
    np.savetxt(folder / f"{name}_scans.csv", rows, delimiter=",", header=header, comments="")


def test_the_command_refuses_unknown_rows(capsys):
    assert main(["reproduce", "tables", "touch", "--rows", "mian"]) == 2
    assert "main; clean" in capsys.readouterr().err


def test_the_batch_table_times_networks_sets_and_sessions(monkeypatch):
    for name, value in {"BATCH_SIZES": (11,), "SINGLE": 4, "FEW": 4, "RECORDED": 2}.items():
        monkeypatch.setattr(batches, name, value)
    lines = list(batches.batch_table(sets=10, sessions=3, steps=40, rounds=1))
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[1:]]
    assert [what.split(",")[0] for what, _, _ in rows] == [
        "one network of 11 cells a side", "one network of 11 cells a side", "2 sets of 21 cells",
        "2 sets of 21 cells", "2 sets of 21 cells", "2 sessions of 40 steps", "2 sessions of 40 steps",
    ]  # fmt: skip
    assert all(device == "one core" and float(us) > 0 for _, device, us in rows)
    assert float(rows[5][0].rsplit(" ", 1)[1]) < 1e-9


def test_the_cycle_table_times_replayed_and_live_steps(monkeypatch):
    monkeypatch.setattr(cycles, "BACKENDS", ("classic",))
    _, *lines = cycles.cycle_table(["square"], rounds=1)
    for line, dtype in zip(lines, ("float64", "float32"), strict=True):
        name, backend, precision, steps, *times = [cell.strip() for cell in line.split("|")[1:-1]]
        assert (name, backend, precision, steps) == ("square", "classic", dtype, "349")
        mean, median, percentile, slowest, clock = map(float, times)
        assert 0 < median <= percentile <= 1e3 * slowest + 50
        assert slowest <= clock + 0.1
        assert mean > 0


def test_the_parts_of_a_cycle_add_up_to_its_time():
    header, *lines = cycles.profile_table(["square"])
    assert "square, recall" in header
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert [name for name, *_ in rows] == [*cycles.PARTS, "all"]
    parts = {name: float(recall) for name, recall, _ in rows}
    whole = parts.pop("all")
    assert sum(parts.values()) == pytest.approx(whole, abs=len(parts))
    assert all(parts[name] > 0 for name in ("views and belief (compiled kernel)", "closures", "solver"))
    assert parts["judge"] == 0  # of whiskers only


def test_the_time_of_library_functions_counts_for_those_that_call_them():
    own, wrapper, builtin = ("/a/ratslam/x.py", 1, "f"), ("/lib/w.py", 1, "w"), ("~", 0, "b")
    root = ("/lib/main.py", 1, "main")
    stats = {
        own: (1, 1, 2.0, 7.0, {root: (1, 1, 2.0, 7.0)}),
        wrapper: (1, 1, 1.0, 4.0, {own: (1, 1, 1.0, 4.0)}),
        builtin: (2, 2, 4.0, 4.0, {wrapper: (1, 1, 3.0, 3.0), own: (1, 1, 1.0, 1.0)}),
    }
    assert cycles.own_times(stats)[own] == pytest.approx(7.0)
