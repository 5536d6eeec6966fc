"""One job: the quantities of a run, independent of earlier jobs in the process; time and memory."""

from __future__ import annotations

from pathlib import Path

import jax
import pytest

from evaluation.artifacts.run_reader import read_scorecard
from evaluation.metrics.occupancy_score import GRID_METRICS
from evaluation.studies.machine import COMPILED, Stopwatch
from evaluation.studies.metrics import MEASURED, METRICS
from evaluation.studies.run_job import run_job
from evaluation.studies.study import read_study
from ratslam.mapping.config import FULL
from ratslam.runs.run import run
from robot.recordings.mcap_writer import record_source
from robot.recordings.npz_trace import read_trace

ROOT = Path(__file__).parents[3]
SMALL = {"simulation.path": {"circuits": "CC"}}


@pytest.mark.parametrize("backend", ["classic", pytest.param("recall", marks=pytest.mark.soak)])
def test_a_job_has_the_quantities_of_a_run(tiny, tmp_path, backend):
    (job,) = read_study(tiny(set=SMALL | {"backend": backend}, seeds=[3])).jobs
    result = run_job(job)
    run(job.config, tmp_path / "run")
    card = read_scorecard(tmp_path / "run")
    assert list(result.quantities)[: len(card.quantities)] == list(card.quantities)
    for name, quantity in card.quantities.items():
        ours = result.quantities[name]
        assert (ours.label, ours.unit) == (quantity.label, quantity.unit)
        # Quaternions in files round headings.
        assert ours.value == (quantity.value and pytest.approx(quantity.value, rel=1e-6, abs=1e-9))
    assert result.steps == result.quantities["steps"].value
    assert (result.row, result.seed, result.error) == ("", 3, None)


def test_pace_and_earlier_jobs_change_no_quantity_and_a_perturbed_copy_is_another_session(tiny):
    vary, before = {"session.precision": ["float32", "float64"]}, jax.config.jax_enable_x64
    single, double = read_study(tiny(set=SMALL, vary=vary)).jobs
    (live, _) = read_study(tiny(set=SMALL, vary=vary, pace="live")).jobs
    (copy, _) = read_study(tiny(set=SMALL, vary=vary, copies=1)).jobs
    first, wide, stepwise, perturbed = map(run_job, (single, double, live, copy))
    assert first.quantities == stepwise.quantities
    assert first.quantities != wide.quantities or first.source == wide.source
    assert jax.config.jax_enable_x64 == before
    assert perturbed.source == f"{first.source}+1"
    assert perturbed.quantities["ate_final"].odometry != first.quantities["ate_final"].odometry
    step, compiling = first.value("step_time"), first.value("compile_time")
    assert 0 < step <= first.value("step_time_p99")
    assert step < 1.2 * first.value("run_time")
    assert compiling > 100e-6 * step  # not hidden among the steps
    assert first.value("memory") > 100
    assert first.machine.versions["jax"] == jax.__version__
    assert all(first.value(metric.name) > 0 for metric in MEASURED)


@pytest.mark.soak
def test_the_grid_filter_is_judged_by_its_map(tmp_path):
    (tmp_path / "study.yaml").write_text(
        f"base: {ROOT}/configs/create_arena.yaml\nset: {{create_simulation.reports: 30}}\n"
    )
    (job,) = read_study(tmp_path / "study.yaml").jobs
    result = run_job(job)
    assert result.error is None
    assert 0 < result.value("map_error") < 1
    assert 0 <= result.value("map_auc") <= 1
    assert set(result.quantities) <= set(METRICS)


def test_every_quantity_of_the_scorecards_is_known(tiny, tmp_path):
    """A search needs the direction of each quantity, and a table its worst value."""
    (job,) = read_study(tiny()).jobs
    (tmp_path / "relations").write_text("2.5,4.5,0,0,0,0,0,0\n2.5,6.5,0,0,0,0,0,0\n")
    score = job.config.score.model_copy(update={"relations": tmp_path / "relations"})
    config = job.config.model_copy(update={"score": score})
    result = run_job(job._replace(config=config, reference_tier="kinematic"))
    assert result.error is None
    maps = {name for name in METRICS if name.startswith("map_")}
    pieces = {metric.name for metric in METRICS.values() if metric.section == "Pieces"}
    assert set(result.quantities) | maps | pieces | {metric.name for metric in MEASURED} == set(METRICS)
    assert maps - {"map_error", "map_doubt"} == {metric.name for metric in GRID_METRICS}


def test_input_errors_are_results_and_other_errors_are_raised(tiny, tmp_path, monkeypatch):
    (job,) = read_study(tiny(set={"simulation.maze": {"file": "nowhere.txt"}})).jobs
    result = run_job(job)
    assert "nowhere.txt" in result.error
    assert (result.quantities, result.value("energy_all")) == ({}, None)
    record_source(read_trace(ROOT / "tests" / "golden" / "a_square3.npz"), tmp_path / "a.mcap")
    (tmp_path / "base.yaml").write_text("recording: {file: a.mcap}\n")
    (tmp_path / "study.yaml").write_text("base: base.yaml\ncopies: 1\n")
    (job,) = read_study(tmp_path / "study.yaml").jobs
    assert "streamed" in run_job(job).error
    given = []

    def build_session(config, source, ablation):
        given.append(ablation)
        raise ZeroDivisionError

    monkeypatch.setattr("evaluation.studies.run_job.build_session", build_session)
    for job in read_study(tiny(rows={"plain": {}, "off": {"ablation": {"verify": False}}})).jobs:
        with pytest.raises(ZeroDivisionError):
            run_job(job)
    assert given == [FULL, FULL.model_copy(update={"verify": False})]


def test_a_stopwatch_separates_compilation_from_steps(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("evaluation.studies.machine.perf_counter", lambda: now[0])
    watch = Stopwatch()
    with watch.taking(0):
        now[0] += 3.0
    for seconds, compiles in ((10.016, True), (0.016, False), (0.016, False), (0.032, False), (5.016, True)):
        with watch.taking(16):
            now[0] += seconds
            if compiles:
                jax.monitoring.record_event_duration_secs(COMPILED, seconds)
    result = watch.times()
    assert result["step_time"] == pytest.approx(1000)
    assert result["step_time_p99"] == pytest.approx(2000, rel=0.02)
    assert result["compile_time"] == pytest.approx(18.0)
    assert result["run_time"] == pytest.approx((now[0] - 18.0) * 1e6 / 80)


def test_closures_true_and_false_are_counted(tmp_path):
    (tmp_path / "study.yaml").write_text(f"base: {ROOT}/configs/square.yaml\n")
    (job,) = read_study(tmp_path / "study.yaml").jobs
    found = run_job(job)
    assert found.value("ate_final") < 0.02 < found.quantities["ate_final"].odometry
    assert found.value("closures") > 150
    assert found.value("false_closures") == 0
    assert found.value("anytime_median") < found.quantities["ate_final"].odometry
    assert found.value("lost_share") < 0.5
