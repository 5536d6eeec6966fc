"""Reproductions of Fox et al. 2012: maps, rankings, and a small reproduction."""

from __future__ import annotations

import csv
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.papers import paper_sets
from evaluation.papers.commands import FOX2012
from evaluation.papers.fox2012.reproduction import (
    FIELDS,
    FILTERED,
    MAPPERS,
    MEASURES,
    PAPER,
    PAPERS,
    PROTOCOLS,
    RECKONED,
    TRUE,
    plan_jobs,
    rank_mappers,
    render_rankings,
    run_job,
)
from evaluation.papers.paper_sets import ResultRow, reproduce
from evaluation.papers.trial_sessions import (
    collect_marks,
    draw_map,
    observe_session,
    run_filter,
    simulate_session,
)
from ratslam.cli import main
from ratslam.grid.config import GridConfig
from ratslam.runs.run_directory import true_grid
from robot.world.arena import Arena, ArenaConfig, make_arena
from tactile.base.errors import InputError
from tests.helpers.grid_world import TIPS, create, report

TINY = ("create_simulation.reports=40", "grid.particles=20")
ROOMY = Arena("roomy", np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), (), np.zeros(3))
BRIER, EVERYWHERE = "map_brier_skill", next(iter(MEASURES))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, bool]:
    """The folder and the text of a small reproduction."""
    folder = tmp_path_factory.mktemp("fox")
    text, interrupted = reproduce(PAPER, "fox-fig4", folder, sets=2, workers=1, assignments=TINY)
    return folder, text, interrupted


@pytest.fixture(scope="module")
def rows(tiny: tuple[Path, str, bool]) -> list[dict[str, str]]:
    with (tiny[0] / "fox-fig4.csv").open() as file:
        return list(csv.DictReader(file))


def result_of(
    mapper: str, number: int, key: str, value: float, along: str = FILTERED, best: float = 0.0
) -> ResultRow:
    """A result with one metric."""
    score = SimpleNamespace(under=lambda convention: SimpleNamespace(best=best))
    result = SimpleNamespace(stop=0, score=score)
    return ResultRow(("1.25 m arena", "ours", mapper, along), number, 0, {"reports": 40, key: value}, result)


def of(
    field: str, table: dict[str, list[float]], along: str = FILTERED, best: float = 0.0
) -> list[ResultRow]:
    return [
        result_of(mapper, k, field, value, along, best)
        for mapper, values in table.items()
        for k, value in enumerate(values)
    ]


# Sessions and charts


def test_a_contact_is_drawn_at_its_place() -> None:
    reports = [report(forward=0.02), report(forward=0.02, touching=[1])]
    path = np.array([[0.4, 0.5, np.pi / 2], [0.4, 0.52, np.pi / 2]])
    grid = draw_map(GridConfig(body=0.0), create(), ROOMY, path, collect_marks(reports))
    assert grid.probability.shape == (40, 40)
    assert np.allclose(grid.origin, -0.5)
    row, column = np.unravel_index(grid.probability.argmax(), grid.probability.shape)
    there = grid.origin + grid.cell * (np.array([column, row]) + 0.5)
    assert np.abs(there - [0.4 - TIPS[1, 1], 0.52 + TIPS[1, 0]]).max() <= grid.cell / 2 + 1e-9
    # Later contacts are not drawn.
    first = draw_map(GridConfig(body=0.0), create(), ROOMY, path[:1], collect_marks(reports))
    assert first.probability.max() == pytest.approx(0.3)


def test_maps_and_truth_share_cells_in_any_arena() -> None:
    place = make_arena(ArenaConfig(seed=2), 0)
    empty = draw_map(GridConfig(), create(), place, np.zeros((0, 3)), collect_marks([report()]))
    truth = true_grid(place._replace(start=np.zeros(3)), empty)
    assert truth.inside.mean() == pytest.approx(0.25)
    assert (truth.occupied | truth.inside).all()
    assert place.side == 1.25
    moved = place._replace(outer=place.outer + 3.0, objects=tuple(p + 3.0 for p in place.objects))
    grid = draw_map(GridConfig(), create(), moved, np.zeros((0, 3)), collect_marks([report()]))
    assert np.array_equal(true_grid(moved._replace(start=np.zeros(3)), grid).occupied, truth.occupied)


def test_an_intermediate_stop_does_not_change_the_result(tiny: object) -> None:
    job = plan_jobs(PROTOCOLS["fox-fig4"], 1, 0, TINY)[0]
    config = job.variants["ours", "blob"]
    assert config.create_simulation is not None
    out = simulate_session(config.create_simulation)
    reports = observe_session(config, out, 0)
    early, late = run_filter(config, out, reports, (23, len(reports)))
    ((online, _, grid),) = run_filter(config, out, reports, (len(reports),))
    assert np.array_equal(late[0], online)
    assert np.array_equal(late[2].probability, grid.probability)
    assert np.array_equal(early[0], online[:23])
    assert len(early[1]) == 23


# Orders


def test_the_ranking_of_the_paper_holds_or_not() -> None:
    falling = {"blob": [0.5, 0.6, 0.7], "geometric": [0.4, 0.5, 0.6], "template": [0.3, 0.4, 0.5]}
    rising = dict(zip(falling, list(falling.values())[::-1], strict=True))
    mixed = falling | {"geometric": [0.4, 0.7, 0.6]}
    words = [rank_mappers(of(EVERYWHERE, table), "ours", EVERYWHERE)[0] for table in (falling, rising, mixed)]
    assert words == ["holds", "does not hold", "not decided"]
    # More skill is better, so the same numbers give the opposite ranking.
    better = [rank_mappers(of(BRIER, table), "ours", BRIER)[0] for table in (falling, rising)]
    assert better == ["does not hold", "holds"]
    assert not rank_mappers(of(EVERYWHERE, {name: [0.1] for name in PAPERS}), "ours", EVERYWHERE)[0]
    assert not rank_mappers(of(EVERYWHERE, falling), "as printed", EVERYWHERE)[0]


@given(st.lists(st.tuples(*[st.floats(0, 1)] * 3), min_size=2, max_size=6))
def test_a_ranking_and_its_reverse_do_not_both_hold(sets: list[tuple[float, float, float]]) -> None:
    columns = [list(column) for column in zip(*sets, strict=True)]
    forth, back = (
        rank_mappers(of(EVERYWHERE, dict(zip(PAPERS, each, strict=True))), "ours", EVERYWHERE)[0]
        for each in (columns, columns[::-1])
    )
    assert forth
    assert {forth, back} != {"holds"}
    if forth == "holds":
        assert back == "does not hold"


def test_a_constant_map_that_wins_is_reported() -> None:
    falling = {"blob": [0.5, 0.6], "geometric": [0.4, 0.5], "template": [0.3, 0.4]}
    beaten = [rank_mappers(of(EVERYWHERE, falling, best=b), "ours", EVERYWHERE)[2] for b in (0.2, 0.5)]
    assert beaten == [True, False]
    assert rank_mappers(of(BRIER, {name: [-0.1, -0.2] for name in PAPERS}), "ours", BRIER)[2]
    lines = render_rankings(
        "ours", of(EVERYWHERE, falling, best=0.2) + of(EVERYWHERE, falling, RECKONED, best=0.2)
    )
    assert lines[2].count("holds") == 2  # also along dead reckoning; the true path is not known here
    assert lines[2].endswith("without information is as good")
    assert lines[-1].startswith("Intervals of fewer than")


# The reproductions themselves


def test_the_program_lists_all_protocols() -> None:
    assert set(FOX2012) == set(PROTOCOLS)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_all_variants_of_a_set_share_a_session(name: str) -> None:
    jobs = plan_jobs(PROTOCOLS[name], 2, 0)
    assert len(jobs) == 2 * len(PROTOCOLS[name].worlds)
    assert all(len({config.create_simulation for config in job.variants.values()}) == 1 for job in jobs)
    sessions = {
        (job.number, config.create_simulation.seed)
        for job in jobs
        for config in job.variants.values()
        if config.create_simulation
    }
    assert len(sessions) == 2
    arenas = {
        config.create_simulation.arena.seed
        for job in jobs
        for config in job.variants.values()
        if config.create_simulation
    }
    assert len(arenas) == (1 if PROTOCOLS[name].one_arena else 2)


def test_a_tiny_reproduction_leaves_table_rows_and_figure(
    tiny: tuple[Path, str, bool], rows: list[dict[str, str]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, text, interrupted = tiny
    assert not interrupted
    assert "2 of 2 sets" in text
    assert "constant 0.3" in text
    assert "blob worse than geometric worse than template? as printed" in text
    assert len(rows) == 2 * 2 * 3 * len(MAPPERS)
    assert set(FIELDS) < set(rows[0])
    assert (folder / "fox-fig4.png").read_bytes().startswith(b"\x89PNG")
    assert main(["reproduce", "fox-fig4", "-o", str(folder)]) == 2
    assert "exists" in capsys.readouterr().err


def test_variants_share_sets_and_the_baseline_paths_have_the_expected_errors(
    rows: list[dict[str, str]],
) -> None:
    reckoned = [{row["odometry_error"] for row in rows if row["set"] == number} for number in "01"]
    assert [len(each) for each in reckoned] == [1, 1]
    assert reckoned[0] != reckoned[1]
    assert all(row["online_error"] == row["odometry_error"] for row in rows if row["along"] == RECKONED)
    assert all(float(row["online_error"]) == 0 for row in rows if row["along"] == TRUE)
    filtered = [row["online_error"] for row in rows if row["along"] == FILTERED and row["set"] == "0"]
    assert len(set(filtered)) > 2


def test_a_set_is_independent_of_earlier_sessions(rows: list[dict[str, str]]) -> None:
    again = run_job(plan_jobs(PROTOCOLS["fox-fig4"], 2, 0, TINY)[1])
    before = [row for row in rows if row["set"] == "1"]
    assert [repr(one.values["online_error"]) for one in again] == [row["online_error"] for row in before]
    assert [repr(one.values["map_auc"]) for one in again] == [row["map_auc"] for row in before]


def test_an_interrupt_keeps_the_finished_sessions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(function, tasks, workers):
        yield [
            result_of(mapper, 0, "online_error", 0.1)._replace(
                values={"reports": 40, "online_error": 0.1, "odometry_error": 0.2}
            )
            for mapper in PAPERS
        ]
        raise KeyboardInterrupt

    monkeypatch.setattr(paper_sets, "run_tasks", interrupted)
    text, stopped = reproduce(PAPER, "fox-fig4", tmp_path, sets=3, workers=1)
    assert stopped
    assert "1 of 3 sets" in text
    assert len((tmp_path / "fox-fig4.csv").read_text().splitlines()) == 4
    assert not (tmp_path / "fox-fig4.png").exists()


def test_invalid_arguments_are_refused_before_anything_is_written(tmp_path: Path, capsys) -> None:
    folder = tmp_path / "a"
    for assignment, message in (
        ("grid.cell=-1", "grid.cell"),
        ("create_simulation.arena.sides=2", "side"),
        ("touch.reports.walls=edges", "walls"),
    ):
        assert main(["reproduce", "fox-fig6", "-o", str(folder), "--set", assignment]) == 2
        assert message in capsys.readouterr().err
    assert not folder.exists()
    with pytest.raises(SystemExit) as stopped:
        main(["reproduce", "fox-fig3"])
    assert stopped.value.code == 2
    with pytest.raises(InputError, match="fox-fig3"):
        reproduce(PAPER, "fox-fig3", tmp_path)


@pytest.mark.soak
@pytest.mark.parametrize("name", PROTOCOLS)
def test_reproductions_run_to_their_end(name: str, tmp_path: Path) -> None:
    text, stopped = reproduce(PAPER, name, tmp_path, sets=2, workers=2, assignments=TINY)
    assert not stopped
    assert PROTOCOLS[name].title in text
    assert (tmp_path / f"{name}.png").exists()
