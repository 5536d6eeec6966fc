"""Reproductions of Fox et al. 2012: maps, rankings, and a small reproduction."""

from __future__ import annotations

import csv
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from evaluation.papers import trial_sessions
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
from ratslam.cli import main
from ratslam.grid.config import GridConfig
from robot.world.arena import Arena
from tests.helpers.grid_world import TIPS, create, report

TINY = ("create_simulation.reports=40", "grid.particles=20")
ROOMY = Arena("roomy", np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), (), np.zeros(3))
BRIER, EVERYWHERE = "map_brier_skill", next(iter(MEASURES))
FALLING = {"blob": [0.5, 0.6, 0.7], "geometric": [0.4, 0.5, 0.6], "template": [0.3, 0.4, 0.5]}
RISING = dict(zip(FALLING, list(FALLING.values())[::-1], strict=True))


Table = dict[str, list[float]]


def of(field: str, table: Table, along: str = FILTERED, best: float = 0.0) -> list[ResultRow]:
    """Results with one metric, by mapper and set."""
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
    config = plan_jobs(PROTOCOLS["fox-fig4"], 1, 0, TINY)[0].variants["ours", "blob"]
    assert config.create_simulation is not None
    out = trial_sessions.simulate_session(config.create_simulation)
    reports = trial_sessions.observe_session(config, out, 0)
    early, late = trial_sessions.run_filter(config, out, reports, (23, len(reports)))
    ((online, _, grid),) = trial_sessions.run_filter(config, out, reports, (len(reports),))
    assert np.array_equal(late[0], online)
    assert np.array_equal(late[2].probability, grid.probability)
    assert np.array_equal(early[0], online[:23])
    assert len(early[1]) == 23


def test_the_ranking_of_the_paper_holds_or_not() -> None:
    def word(field: str, table: Table, ranking: str = "ours") -> str:
        return rank_mappers(of(field, table), ranking, field)[0]

    mixed = FALLING | {"geometric": [0.4, 0.7, 0.6]}
    words = [word(EVERYWHERE, table) for table in (FALLING, RISING, mixed)]
    assert words == ["holds", "does not hold", "not decided"]
    # More skill is better, so the same numbers give the opposite ranking.
    assert [word(BRIER, table) for table in (FALLING, RISING)] == ["does not hold", "holds"]
    assert not word(EVERYWHERE, {name: [0.1] for name in PAPERS})
    assert not word(EVERYWHERE, FALLING, "as printed")


def test_a_constant_map_that_wins_is_reported() -> None:
    beaten = [rank_mappers(of(EVERYWHERE, FALLING, best=b), "ours", EVERYWHERE)[2] for b in (0.2, 0.5)]
    assert beaten == [True, False]
    assert rank_mappers(of(BRIER, {name: [-0.1, -0.2] for name in PAPERS}), "ours", BRIER)[2]
    results = of(EVERYWHERE, FALLING, best=0.2) + of(EVERYWHERE, FALLING, RECKONED, best=0.2)
    line = render_rankings("ours", results)[2]
    assert line.count("holds") == 2  # also along dead reckoning; the true path is not known here
    assert "without information" in line


@pytest.mark.parametrize("name", PROTOCOLS)
def test_all_variants_of_a_set_share_a_session(name: str) -> None:
    jobs = plan_jobs(PROTOCOLS[name], 2, 0)
    assert len(jobs) == 2 * len(PROTOCOLS[name].worlds)
    sessions = [{config.create_simulation for config in job.variants.values()} for job in jobs]
    assert all(len(each) == 1 for each in sessions)
    every = [one for each in sessions for one in each if one]
    seeds = {(job.number, one.seed) for job, each in zip(jobs, sessions, strict=True) for one in each if one}
    assert len(seeds) == 2
    assert len({one.arena.seed for one in every}) == (1 if PROTOCOLS[name].one_arena else 2)


def test_a_tiny_reproduction_leaves_table_rows_and_figure(tmp_path: Path, capsys) -> None:
    text, interrupted = reproduce(PAPER, "fox-fig4", tmp_path, sets=2, workers=1, assignments=TINY)
    assert not interrupted
    assert "2 of 2 sets" in text
    assert "constant 0.3" in text
    with (tmp_path / "fox-fig4.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * 3 * len(MAPPERS)
    assert set(FIELDS) < set(rows[0])
    assert (tmp_path / "fox-fig4.png").read_bytes().startswith(b"\x89PNG")
    assert main(["reproduce", "fox-fig4", "-o", str(tmp_path)]) == 2
    assert "exists" in capsys.readouterr().err
    reckoned = [{row["odometry_error"] for row in rows if row["set"] == number} for number in "01"]
    assert [len(each) for each in reckoned] == [1, 1]
    assert reckoned[0] != reckoned[1]
    assert all(row["online_error"] == row["odometry_error"] for row in rows if row["along"] == RECKONED)
    assert all(float(row["online_error"]) == 0 for row in rows if row["along"] == TRUE)
    filtered = [row["online_error"] for row in rows if row["along"] == FILTERED and row["set"] == "0"]
    assert len(set(filtered)) > 2
    # A set is independent of the sessions before it.
    again = run_job(plan_jobs(PROTOCOLS["fox-fig4"], 2, 0, TINY)[1])
    for key in ("online_error", "map_auc"):
        assert [repr(one.values[key]) for one in again] == [row[key] for row in rows if row["set"] == "1"]
