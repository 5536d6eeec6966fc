"""Growth studies: lengths of sessions, rows that measuring does not change, and what an interrupt leaves."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from evaluation.studies.growth import FILE, growth_study, measure_growth, read_rows
from ratslam.cli import main
from robot.simulation.head.simulated_session import HeadSimulation
from robot.world.maze import CELL_SIDE
from tactile.base.errors import InputError
from tests.evaluation.studies.conftest import ROOT, kill, start, wait_until

SQUARE = ROOT / "configs" / "square.yaml"


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(
        "simulation: {maze: {columns: 3, rows: 2, loop: 6}, path: {circuits: CA}, whisking: {rate: 0.5}}\n"
    )
    return path


def command(config: Path, output: Path, *assignments: str) -> list[str]:
    given = [part for each in assignments for part in ("--set", each)]
    return ["study", "--preset", "growth", str(config), *given, "-o", str(output)]


def errors(row):
    """The fields of a row that no clock decides."""
    names = "steps keyframes closures energy ate energy_odometry energy_final ate_final"
    return [getattr(row, name) for name in names.split()]


def test_lengths_double_up_to_the_greatest():
    _, ((_, _, lengths, _),) = growth_study(SQUARE, ["first=400", "known_ground=100000"])
    assert lengths == [400 * 2**k for k in range(8)] + [100_000]
    _, ((_, _, lengths, _),) = growth_study(SQUARE, ["first=400", "known_ground=100"])
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
    _, (task,) = growth_study(SQUARE, ["first=150", "known_ground=300", "window=40"])
    assert (task.ground, task.lengths, task.window) == ("known ground", [150, 300], 40)
    done: list[int] = []
    rows = list(measure_growth(task, lambda: done.append(1)))
    assert [row.steps for row in rows] == [150, 300]
    assert len(done) == 300
    assert 0 < rows[0].closures < rows[1].closures
    assert rows[1].median <= rows[1].largest


def test_a_measurement_on_the_way_changes_nothing(config):
    _, tasks = growth_study(config, ["first=32", "known_ground=96", "new_ground=0"])
    rows = list(measure_growth(tasks[0]))
    assert [row.steps for row in rows] == [32, 64, 96]
    for row in rows:
        assert 0 < row.keyframes <= row.steps
        assert 0 < row.median <= row.p99 <= row.largest
        assert row.mean <= row.process_mean
        assert row.memory > 50
        assert row.false_closures <= row.closures
        assert min(row.energy_odometry, row.energy, row.ate, row.energy_final, row.ate_final, row.end) > 0
    (alone,) = measure_growth(tasks[0]._replace(lengths=[96]))
    assert errors(alone) == errors(rows[-1])


@pytest.mark.soak
def test_an_interrupt_leaves_table_and_picture_of_the_rows_so_far(config, tmp_path):
    output = tmp_path / "out"
    process = start(*command(config, output, "first=32", "known_ground=600", "new_ground=0"))
    wait_until(lambda: len(read_rows(output)) >= 2, process)
    text, _ = kill(process, signal.SIGINT)
    assert process.returncode == 130
    rows = read_rows(output)
    assert [(row.ground, row.steps) for row in rows[:2]] == [("known ground", 32), ("known ground", 64)]
    assert (output / "table.md").read_text().strip() in text
    assert len((output / "table.csv").read_text().splitlines()) == len(rows) + 1
    assert (output / "growth.png").exists()
    with (output / FILE).open("a") as file:
        file.write('{"ground": "known gr')  # what a kill leaves
    assert read_rows(output) == rows


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        (["known_grounds=3"], "known_grounds"),
        (["known_ground=-3"], "known_ground"),
        (["new_ground=90000"], "at most"),
        (["known_ground=0", "new_ground=0"], "no session"),
        (["recall.reach=-1"], "recall.reach"),
        (["simulation.maze.kind=tree"], "a maze without loops"),
    ],
)
def test_unfit_settings_are_refused(config, settings, named):
    with pytest.raises(InputError, match=named):
        growth_study(config, settings)


@pytest.mark.parametrize("option", [["--workers", "2"], ["--search"]])
def test_options_of_other_studies_are_refused_before_anything_runs(config, tmp_path, capsys, option):
    assert main([*command(config, tmp_path / "out"), *option]) == 2
    assert option[0] in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
