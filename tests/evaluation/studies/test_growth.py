"""Growth studies: lengths of sessions, rows that measuring does not change, and what an interrupt leaves."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from evaluation.studies.growth import FILE, growth_study, measure_growth, read_rows
from ratslam.cli import main
from robot.simulation.head.simulated_session import HeadSimulation
from robot.world.maze import CELL_SIDE

ROOT = Path(__file__).parents[3]
SMALL = """
simulation: {maze: {columns: 3, rows: 2, loop: 6}, path: {circuits: CA}, whisking: {rate: 0.5}}
"""
SHORT = ["--set", "first=32", "--set", "known_ground=64", "--set", "new_ground=64"]
PATIENCE = 240.0


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(SMALL)
    return path


def errors(row):
    """The fields of a row that no clock decides."""
    names = "steps keyframes closures energy ate energy_odometry energy_final ate_final"
    return [getattr(row, name) for name in names.split()]


def test_lengths_double_up_to_the_greatest():
    square = ROOT / "configs" / "square.yaml"
    _, ((_, _, lengths, _),) = growth_study(square, ["first=400", "known_ground=100000"])
    assert lengths[:3] == [400, 800, 1600]
    assert lengths[-2:] == [51_200, 100_000]
    _, ((_, _, lengths, _),) = growth_study(square, ["first=400", "known_ground=100"])
    assert lengths == [100]


def test_known_ground_repeats_its_laps_and_new_ground_enters_no_cell_twice(config):
    _, tasks = growth_study(config, ["first=100", "known_ground=300", "new_ground=300", "simulation.seed=3"])
    known, new = (HeadSimulation(task.config.simulation) for task in tasks)
    for session in known, new:
        assert 300 <= session.length < 500  # no more than it needs
        assert session.config.seed == 3
    cells = [np.floor(session.truth[:, :2] / CELL_SIDE).astype(int) for session in (known, new)]
    assert len(np.unique(cells[0], axis=0)) == 6
    entered = cells[1][np.r_[True, (np.diff(cells[1], axis=0) != 0).any(axis=1)]]
    assert len(entered) > 60
    # a head that turns at the border of two cells may return to the first for a moment
    assert len(np.unique(entered, axis=0)) > 0.9 * len(entered)


def test_the_course_of_a_recording_is_known_ground():
    settings = ["first=150", "known_ground=300", "window=40"]
    _, (task,) = growth_study(ROOT / "configs" / "square.yaml", settings)
    assert (task.ground, task.lengths, task.window) == ("known ground", [150, 300], 40)
    rows, done = [], []
    for row in measure_growth(task, lambda: done.append(len(rows))):
        rows.append(row)
    assert [row.steps for row in rows] == [150, 300]
    assert len(done) == 300
    assert 0 < rows[0].closures < rows[1].closures
    assert rows[1].median <= rows[1].largest


@pytest.mark.soak
def test_the_program_writes_rows_table_and_picture(config, tmp_path, capsys):
    output = tmp_path / "out"
    assert main(["study", "--preset", "growth", str(config), *SHORT, "-o", str(output)]) == 0
    expected = [(ground, steps) for ground in ("known ground", "new ground") for steps in (32, 64)]
    rows = read_rows(output)
    assert [(row.ground, row.steps) for row in rows] == expected
    for row in rows:
        assert 0 < row.keyframes <= row.steps
        assert 0 < row.median <= row.p99 <= row.largest
        assert row.mean <= row.process_mean
        assert row.memory > 50
        assert row.energy_odometry > 0
        assert row.false_closures <= row.closures
        assert min(row.energy, row.ate, row.energy_final, row.ate_final, row.end) > 0
    text = capsys.readouterr().out
    assert (output / "table.md").read_text().strip() in text
    printed = [[cell.strip() for cell in line.split("|")[1:3]] for line in text.splitlines()[2:6]]
    assert printed == [[ground, str(steps)] for ground, steps in expected]
    with (output / "table.csv").open() as file:
        assert [(row["ground"], int(row["steps"])) for row in csv.DictReader(file)] == expected
    assert (output / "growth.png").read_bytes().startswith(b"\x89PNG")


def test_a_measurement_on_the_way_changes_nothing(config):
    _, tasks = growth_study(config, ["first=32", "known_ground=96", "new_ground=0"])
    steps = []
    rows = list(measure_growth(tasks[0], lambda: steps.append(1)))
    assert [row.steps for row in rows] == [32, 64, 96]
    assert len(steps) == 96
    (alone,) = measure_growth(tasks[0]._replace(lengths=[96]))
    assert errors(alone) == errors(rows[-1])


@pytest.mark.soak
def test_an_interrupt_leaves_table_and_picture_of_the_rows_so_far(config, tmp_path):
    output = tmp_path / "out"
    long = ["--set", "first=32", "--set", "known_ground=600", "--set", "new_ground=0"]
    code = (
        "import signal, sys\n"
        "from ratslam.__main__ import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background ignores it\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, "study", "--preset", "growth", str(config), *long, "-o", str(output)],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    end = time.monotonic() + PATIENCE
    while len(read_rows(output)) < 2:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    try:
        text, _ = process.communicate(timeout=PATIENCE)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130
    rows = read_rows(output)
    assert [row.steps for row in rows[:2]] == [32, 64]
    assert (output / "table.md").read_text().strip() in text
    assert len((output / "table.csv").read_text().splitlines()) == len(rows) + 1
    assert (output / "growth.png").exists()
    with (output / FILE).open("a") as file:
        file.write('{"ground": "known gr')  # what a kill leaves
    assert read_rows(output) == rows


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (["--set", "known_grounds=3"], "known_grounds"),
        (["--set", "known_ground=-3"], "known_ground"),
        (["--set", "new_ground=90000"], "at most"),
        (["--set", "known_ground=0", "--set", "new_ground=0"], "no session"),
        (["--set", "recall.reach=-1"], "recall.reach"),
        (["--set", "simulation.maze.kind=tree"], "a maze without loops"),
        (["--workers", "2"], "--workers"),
        (["--search"], "--search"),
    ],
)
def test_bad_input_is_refused_before_anything_runs(config, tmp_path, capsys, more, expected):
    output = tmp_path / "out"
    assert main(["study", "--preset", "growth", str(config), *more, "-o", str(output)]) == 2
    assert expected in capsys.readouterr().err
    assert not output.exists()


def test_a_recording_that_is_missing_is_named(tmp_path, capsys):
    path = tmp_path / "recorded.yaml"
    path.write_text("recording: {file: a.npz}\n")
    assert main(["study", "--preset", "growth", str(path), "-o", str(tmp_path / "out")]) == 2
    assert "a.npz: no such file" in capsys.readouterr().err
