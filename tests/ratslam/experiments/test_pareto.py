"""Speed against error: which rows are marked, what is said of them, and that nothing is run twice."""

from __future__ import annotations

import csv
import io
import json
import os
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics.metric import Quantity
from evaluation.plots.pareto_plot import ParetoPoint, draw_pareto, place_labels
from ratslam.cli import main
from ratslam.experiments.pareto import benchmark
from ratslam.experiments.pareto.cpu_affinity import one_core, others
from ratslam.experiments.pareto.error_metrics import error_named, usual_error
from ratslam.experiments.pareto.pareto_front import optimal
from ratslam.experiments.pareto.summary import lines
from ratslam.experiments.studies.recorded_runs import FOLDER
from ratslam.experiments.studies.results import Result, Timing, write_result
from ratslam.experiments.studies.run_job import machine
from ratslam.experiments.studies.study import read_study
from tactile.base.errors import InputError

ROOT = Path(__file__).parents[3]
TINY = {
    "simulation.maze": {"columns": 3, "rows": 2, "loop": 6},
    "simulation.path": {"circuits": "C"},
    "simulation.whisking.rate": 0.5,
    "pose_cells.cells_xy": 11,
    "pose_cells.cells_heading": 12,
    "backend": "classic",
}
CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
FEW = st.sampled_from([0.0, 1.0, 2.0, 3.0, np.nan])
COSTS = st.lists(st.tuples(FEW, FEW), max_size=8).map(lambda rows: np.array(rows).reshape(-1, 2))


def betters(a, b):
    return all(x <= y for x, y in zip(a, b, strict=True)) and any(x < y for x, y in zip(a, b, strict=True))


def answer(row="", seed=0, time=100.0, error=None, **values):
    """A result that nobody had to run."""
    quantities = {name: Quantity(label=name, value=value, unit="") for name, value in values.items()}
    timing = Timing(
        pace="live", median_us=time, p99_us=2 * time, compile_s=1.0, compilations=1, finish_s=0.0, total_s=3.0
    )
    return Result(
        hash=row or "none", seed=seed, row=row, steps=10, quantities=quantities, timing=timing, error=error,
        machine=machine(),
    )  # fmt: skip


def study(folder, **content):
    """A study of tiny sessions; its file."""
    (folder / "base.yaml").write_text("simulation: {}\n")
    path = folder / "study.yaml"
    path.write_text(json.dumps({"base": "base.yaml", "set": TINY, **content}))
    return path


@pytest.fixture
def stubbed(monkeypatch):
    """Rows are not run: their answers follow from the settings. The keys asked for."""
    asked: list[str] = []

    def alone(row, directory):
        for job in row:
            asked.append(job.key)
            score = job.config.keyframes.min_score
            failed = "keyframes.min_score: too much" if score > 40 else None
            found = answer(time=1000 / score, error=failed, energy_all=score + job.seed)
            if not failed or job.seed:
                write_result(
                    directory / FOLDER, found.model_copy(update={"hash": job.hash, "seed": job.seed})
                )

    monkeypatch.setattr(benchmark, "_alone", alone)
    return asked


@given(COSTS)
def test_the_optimal_ones_are_those_that_no_other_betters(costs):
    known = [row for row in costs if not np.isnan(row).any()]
    expected = [not np.isnan(row).any() and not any(betters(other, row) for other in known) for row in costs]
    assert optimal(costs).tolist() == expected
    assert optimal(costs).any() == bool(known)


@given(COSTS, st.permutations(range(8)))
def test_neither_order_nor_scale_changes_what_is_optimal(costs, order):
    best, order = optimal(costs), [k for k in order if k < len(costs)]
    assert (optimal(costs[order]) == best[order]).all()
    assert (optimal(np.exp(costs)) == best).all()
    assert (optimal(costs[best]) == True).all()  # noqa: E712


@given(
    st.lists(
        st.tuples(st.integers(10, 90), st.integers(8, 14), st.integers(0, 600), st.integers(0, 400)),
        min_size=1,
        max_size=15,
    )
)
@settings(max_examples=25)
def test_labels_lie_apart_inside_and_off_what_is_drawn(rows):
    rows = np.array(rows, float)
    area, blocked = np.array([0.0, 0.0, 600.0, 400.0]), np.array([[100.0, 100.0, 140.0, 400.0]])
    corners = place_labels(rows[:, :2], rows[:, 2:], area, blocked, blocked + 50)
    boxes = np.concatenate([np.concatenate([corners, corners + rows[:, :2]], axis=1), blocked])
    assert (boxes[:, :2] >= area[:2]).all()
    assert (boxes[:, 2:] <= area[2:]).all()
    for k, one in enumerate(boxes):
        for other in boxes[k + 1 :]:
            assert (one[2:] <= other[:2]).any() or (other[2:] <= one[:2]).any()


def test_a_label_without_room_still_gets_a_place():
    corners = place_labels(
        np.full((4, 2), 50.0), np.zeros((4, 2)), np.array([0.0, 0.0, 60.0, 60.0]), *[np.zeros((0, 4))] * 2
    )
    assert np.isfinite(corners).all()


@pytest.mark.parametrize("values", [[0.0, 0.0], [0.0, 0.2], [0.1, 0.1], [1e-9, 3e4]])
def test_any_errors_can_be_drawn_and_come_out_the_same(values):
    marks = [
        ParetoPoint(f"row {k}", (90.0, 100.0, 110.0), (v, v, 2 * v), k == 0) for k, v in enumerate(values)
    ]

    def drawn():
        told = io.BytesIO()
        figure = draw_pareto("a", "b", marks, "time", "error")
        figure.savefig(told)
        assert [text.get_text() for text in figure.axes[0].texts if text.get_text()] == ["row 0", "row 1"]
        return told.getvalue()

    assert drawn() == drawn()


def test_errors_are_small_if_good():
    result = answer(exm_arr=0.5, exm_arcr_strict=0.8, energy_all=0.1)
    assert error_named("em").of(result) == 0.1
    assert error_named("energy_all").of(result) == 0.1
    assert error_named("arcr").of(result) == pytest.approx(0.2)
    assert error_named("exm").of(result) == pytest.approx(0.6)
    assert error_named("ate").of(result) is None
    assert error_named("exm").of(answer(exm_arr=0.0)) == 1


@pytest.mark.parametrize("name", ["atee", "step_time", "experiences", ""])
def test_an_unknown_error_is_refused_before_anything_runs(name, tmp_path, capsys, stubbed):
    assert main(["frontier", str(study(tmp_path)), "-o", str(tmp_path / "out"), "--error", name or "no"]) == 2
    told = capsys.readouterr().err
    assert "--error" in told
    assert ("did you mean 'ate'" in told) == (name == "atee")
    assert not stubbed


def test_the_usual_error_is_the_first_that_all_have():
    rat, grid, none = answer(energy_all=1.0, ate_final=1.0), answer(ate_final=1.0, map_error=0.2), answer()
    assert usual_error([[rat], [rat]]).name == "em"
    assert usual_error([[rat], [grid]]).name == "ate"
    assert usual_error([[rat, none], [grid]]).name == "ate"
    assert usual_error([[none]]) is None
    assert usual_error([]) is None


def test_a_row_is_judged_by_medians_and_only_if_none_of_its_seeds_failed():
    def group(row, times, errors):
        pairs = enumerate(zip(times, errors, strict=True))
        return [
            answer(row, k, t, None if e else "failed", **({"energy_all": e} if e else {}))
            for k, (t, e) in pairs
        ]

    slow, fast = group("slow", [9, 10, 40], [3, 1, 2]), group("fast", [1, 2, 3], [5, 6, 7])
    lost, same = group("lost", [1, 1, 1], [0.5, 0.5, None]), group("same", [10, 10, 10], [2, 2, 2])
    found = {line.row: line for line in lines([slow, fast, lost, same], error_named("em"))}
    assert {row for row, line in found.items() if line.optimal} == {"slow", "fast", "same"}
    assert found["slow"].spans["step_time"][1:] == (10, 9, 40, 40)
    assert found["slow"].error[1:] == (2, 1, 3, 3)
    assert (found["lost"].seeds, found["lost"].failed) == (2, 1)
    assert not any(line.optimal for line in lines([slow], None))


def test_a_small_study_leaves_all_files_and_is_not_run_again(tmp_path, capsys, monkeypatch):
    path, output = (
        study(tmp_path, rows={"plain": {}, "float32": {"session.precision": "float32"}}, seeds=2),
        tmp_path / "out",
    )
    command = ["frontier", str(path), "-o", str(output)]
    assert main(command) == 0
    first = capsys.readouterr().out
    assert {each.name for each in output.iterdir()} == {
        FOLDER, "frontier.csv", "frontier.json", "frontier.md", "frontier.png",
    }  # fmt: skip
    told = json.loads((output / "frontier.json").read_text())
    assert [row["row"] for row in told["rows"]] == ["plain", "float32"]
    assert told["measured"]["seeds"] == "2 seeds"
    assert "jaxlib" in told["measured"]["versions"]
    for row in told["rows"]:
        spans = row["spans"]
        assert {"step_time", "step_time_p99", "compile_time", "memory", "energy_all", "ate_final"} <= set(
            spans
        )
        assert all(span["low"] <= span["median"] <= span["high"] for span in spans.values())
        assert len(spans["step_time"]["values"]) == row["seeds"] == 2
        assert spans["compile_time"]["high"] > 1e-6 * spans["step_time"]["median"] * row["cycles"]
        assert row["error"] == spans["energy_all"]
    assert any(row["optimal"] for row in told["rows"])
    with (output / "frontier.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["step_time_median"]) for row in rows] == [
        row["spans"]["step_time"]["median"] for row in told["rows"]
    ]
    table = (output / "frontier.md").read_text().split("\n\n")[0].splitlines()
    assert len({line.count("|") for line in table}) == 1
    for row, line in zip(told["rows"], table[2:], strict=True):
        assert line.startswith("| **") == row["optimal"]
    kept = {each: each.read_bytes() for each in (output / FOLDER).iterdir()}
    assert len(kept) == 4

    monkeypatch.setattr(benchmark, "_alone", lambda *_: pytest.fail("something was run again"))
    assert main(command) == 0
    again = capsys.readouterr().out
    assert again.splitlines()[:3] == first.splitlines()[:3]
    assert main([*command, "--error", "ate"]) == 0
    assert json.loads((output / "frontier.json").read_text())["error"]["name"] == "ate"
    assert {each: each.read_bytes() for each in (output / FOLDER).iterdir()} == kept


def test_what_fails_or_is_killed_is_told_and_the_rest_stands(tmp_path, capsys, stubbed):
    path = study(tmp_path, vary={"keyframes.min_score": [5, 10, 20, 41]}, seeds=2)
    command = ["frontier", str(path), "-o", str(tmp_path / "out")]
    for _ in range(2):
        assert main(command) == 2
        told = capsys.readouterr()
        assert "score=41, seed 0: its process was killed" in told.err
        assert "score=41, seed 1: keyframes.min_score: too much" in told.err
        rows = json.loads((tmp_path / "out" / "frontier.json").read_text())["rows"]
        assert [row["optimal"] for row in rows] == [True, True, True, False]
        assert "0, 2 failed" in told.out
    assert len(stubbed) == 8 + 1  # the killed one is tried again, the failed one is not


def test_twins_are_run_once_and_rows_without_an_error_are_listed(tmp_path, capsys, stubbed):
    path = study(tmp_path, rows={"a": {}, "b": {}})
    output = tmp_path / "out"
    assert main(["frontier", str(path), "-o", str(output), "--error", "relations"]) == 0
    assert len(stubbed) == 1
    rows = json.loads((output / "frontier.json").read_text())["rows"]
    assert [(row["row"], row["error"], row["optimal"]) for row in rows] == [
        ("a", None, False),
        ("b", None, False),
    ]
    assert not (output / "frontier.png").exists()
    assert main(["frontier", str(path), "-o", str(output)]) == 0
    assert (output / "frontier.png").exists()
    assert len(stubbed) == 1


def test_several_workers_are_said_to_disturb_each_other(tmp_path, capsys, stubbed, monkeypatch):
    path, output = study(tmp_path), tmp_path / "out"
    assert main(["frontier", str(path), "-o", str(output)]) == 0
    assert "disturb" not in capsys.readouterr().out
    assert main(["frontier", str(path), "-o", str(output), "--workers", "2"]) == 0
    assert "disturb each other" in capsys.readouterr().out


def test_what_disturbed_a_measurement_is_not_forgotten(tmp_path, capsys, stubbed, monkeypatch):
    busy = iter([2.5, 0.1])
    monkeypatch.setattr(benchmark, "others", lambda: nullcontext(lambda: next(busy)))
    path, output = study(tmp_path), tmp_path / "out"
    assert main(["frontier", str(path), "-o", str(output)]) == 0
    assert "kept 2.5 cores busy" in capsys.readouterr().out
    assert main(["frontier", str(path), "-o", str(output)]) == 0  # nothing is measured
    assert "kept 2.5 cores busy" in capsys.readouterr().out
    assert main(["frontier", str(path), "-o", str(output), "--set", "seeds=2"]) == 0
    assert "kept 2.5 cores busy" in capsys.readouterr().out
    assert len(stubbed) == 2


def test_measuring_keeps_to_one_core_and_lets_go_of_it():
    if not CORES:
        pytest.skip("this system does not say on which cores a process runs")
    with one_core(), others() as busy:
        assert len(os.sched_getaffinity(0)) == 1
        assert os.sched_getaffinity(0) <= CORES
    assert os.sched_getaffinity(0) == CORES
    assert busy() is None or busy() >= 0


def test_the_study_that_comes_along_covers_every_axis():
    configs = [variant.config for variant in read_study(ROOT / "configs" / "study_frontier.yaml").variants]
    for axis in (
        lambda config: config.backend,
        lambda config: config.pose_cells.engine,
        lambda config: config.pose_cells.cells_xy,
        lambda config: config.grid.particles,
        lambda config: config.session.precision,
        lambda config: config.simulation.fidelity,
    ):
        assert len(set(map(axis, configs))) >= 2
    assert all(a != b for a, b in pairwise(configs))


def test_bad_studies_are_refused(tmp_path, capsys):
    assert main(["frontier", str(tmp_path / "none.yaml")]) == 2
    assert "none.yaml" in capsys.readouterr().err
    with pytest.raises(InputError):
        read_study(study(tmp_path, rows={"a": {"no.such": 1}}))
