"""The tables of a study: statistics, Pareto fronts, differences, and the files."""

from __future__ import annotations

import csv
import json
import statistics

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.metrics.run_metrics import recognition_error
from evaluation.metrics.statistics import pareto_optimal
from evaluation.studies.metrics import find_error
from evaluation.studies.study import StudyPlan
from evaluation.studies.study_report import label, make_report, render, save_report, spread
from tactile.base.errors import InputError
from tests.evaluation.studies.conftest import record

FINITE = st.floats(-1e6, 1e6)
FEW = st.sampled_from([0.0, 1.0, 2.0, 3.0, np.nan])
COSTS = st.lists(st.tuples(FEW, FEW), max_size=8).map(lambda rows: np.array(rows).reshape(-1, 2))


def plan(report="means", **more):
    return StudyPlan(base="base.yaml", report=report, **more)


def dominates(a, b):
    return all(x <= y for x, y in zip(a, b, strict=True)) and any(x < y for x, y in zip(a, b, strict=True))


@given(COSTS)
def test_the_optimal_rows_are_those_that_no_other_dominates(costs):
    known = [row for row in costs if not np.isnan(row).any()]
    expected = [not np.isnan(row).any() and not any(dominates(each, row) for each in known) for row in costs]
    assert pareto_optimal(costs).tolist() == expected
    assert pareto_optimal(costs).any() == bool(known)


@given(
    st.lists(st.one_of(st.none(), FINITE), max_size=9), st.sampled_from(["energy_all", "exm_arr", "links"])
)
def test_statistics_use_the_defined_values(values, name):
    found = spread(values, name)
    known = [value for value in values if value is not None]
    if not known:
        assert found is None
        return
    assert found.values == tuple(values)
    assert found.mean == pytest.approx(sum(known) / len(known), abs=1e-6)
    assert (found.low, found.median, found.high) == (min(known), statistics.median(known), max(known))
    assert found.sd == (pytest.approx(statistics.stdev(known)) if len(known) > 1 else None)
    assert found.worst == {"energy_all": max(known), "exm_arr": min(known), "links": None}[name]


def test_recognition_is_without_error_if_all_steps_and_all_relocalisations_are():
    def error(**values):
        return recognition_error(record(**values).quantities).value

    assert error(exm_arr=0.5, exm_arcr_strict=0.8) == pytest.approx(0.6)
    assert error(exm_arr=0.0, exm_arcr_strict=None) == 1
    assert np.isnan(error(exm_arr=0.5, exm_arcr_strict=None))


def test_an_error_has_a_short_and_a_full_name_and_an_unknown_one_is_refused():
    assert find_error("em") == find_error("energy_all") == "energy_all"
    assert find_error("exm") == "recognition_error"
    for name in ("atee", "step_time", "experiences", ""):
        with pytest.raises(InputError, match="--error") as caught:
            find_error(name)
        assert ("'ate'" in str(caught.value)) == (name == "atee")


def test_the_default_error_is_the_first_that_all_rows_have():
    rat, grid, none = record(energy_all=1.0, ate_final=1.0), record(ate_final=1.0, map_error=0.2), record()

    def default(*groups):
        named = [each.model_copy(update={"row": f"{k}"}) for k, group in enumerate(groups) for each in group]
        return make_report("name", plan("pareto", pace="live"), named).error

    assert default([rat], [rat]) == "energy_all"
    assert default([rat], [grid]) == "ate_final"
    assert default([rat, none], [grid]) == "ate_final"
    assert default([none]) is None
    assert default() is None


def group(row, times, errors):
    return [
        record(row, k, time, None if error else "failed", **({"energy_all": error} if error else {}))
        for k, (time, error) in enumerate(zip(times, errors, strict=True))
    ]


PARETO = [
    *group("slow", [9, 10, 40], [3, 1, 2]),
    *group("fast", [1, 2, 3], [5, 6, 7]),
    *group("lost", [1, 1, 1], [0.5, 0.5, None]),
    *group("same", [10, 10, 10], [2, 2, 2]),
]


def test_a_row_is_judged_by_medians_and_only_if_none_of_its_runs_failed():
    found = {row.row: row for row in make_report("name", plan("pareto", pace="live"), PARETO).rows}
    assert {name for name, row in found.items() if row.optimal} == {"slow", "fast", "same"}
    time, error = (found["slow"].spreads[name] for name in ("step_time", "energy_all"))
    assert (time.median, time.low, time.high, time.worst) == (10, 9, 40, 40)
    assert (error.median, error.low, error.high, error.worst) == (2, 1, 3, 3)
    assert (found["lost"].runs, found["lost"].failed) == (2, 1)
    assert not any(row.optimal for row in make_report("name", plan("means"), PARETO).rows)


def test_a_pareto_report_marks_the_front_in_every_form(tmp_path):
    report = make_report("name", plan("pareto", pace="live"), PARETO)
    assert report.error == "energy_all"
    table = render(report).split("\n\n")[0].splitlines()
    assert len({line.count("|") for line in table}) == 1
    assert [line.startswith("| **") for line in table[2:]] == [True, True, False, True]
    paths = save_report(report, tmp_path)
    assert [path.name for path in paths] == ["table.csv", "table.json", "table.md", "pareto.png"]
    content = json.loads((tmp_path / "table.json").read_text())
    assert [row["optimal"] for row in content["rows"]] == [True, True, False, True]
    assert content["measured"]["seeds"] == "3 seeds"
    rows = list(csv.DictReader((tmp_path / "table.csv").read_text().splitlines()))
    assert [float(row["step_time_median"]) for row in rows] == [10, 2, 1, 10]


def test_without_an_error_there_is_no_picture(tmp_path):
    (tmp_path / "pareto.png").write_text("of an earlier call")
    report = make_report("name", plan("pareto"), [record("a")])
    assert report.error is None
    assert [path.name for path in save_report(report, tmp_path)] == ["table.csv", "table.json", "table.md"]
    assert not (tmp_path / "pareto.png").exists()


def test_means_have_a_line_for_each_row_in_order(tmp_path):
    report = make_report("name", plan(), [
        record("one", 0, varied={"x.k": 1}, energy_all=1.0, exm_arr=0.25, ate_online=3.0),
        record("one", 1, varied={"x.k": 1}, energy_all=3.0, exm_arr=0.75, ate_online=3.0),
        record("one", 0, varied={"x.k": 2}, energy_all=5.0),
        record("one", 1, varied={"x.k": 2}, error="no whiskers"),
    ])  # fmt: skip
    assert [(label(row.row, row.varied), row.runs, row.failed) for row in report.rows] == [
        ("one k=1", 2, 0),
        ("one k=2", 1, 1),
    ]
    head, _, first, second, *_ = render(report).splitlines()
    assert [cell.split()[0] for cell in head.split("|")[2:6]] == ["runs", "steps", "energy_all", "exm_arr"]
    assert "2 ± 1.41 (3)" in first
    assert "0.5 ± 0.354 (0.25)" in first
    assert "1, 1 failed" in second
    save_report(report, tmp_path)
    lines = list(csv.DictReader((tmp_path / "table.csv").read_text(encoding="utf-8").splitlines()))
    assert [line["x.k"] for line in lines] == ["1", "2"]
    assert float(lines[0]["energy_all_mean"]) == 2.0
    assert lines[1]["exm_arr_mean"] == ""
    content = json.loads((tmp_path / "table.json").read_text())
    assert content["rows"][0]["spreads"]["ate_online"]["worst"] == 3.0


def test_differences_are_from_the_first_row_and_odometry_comes_last():
    rows = [
        record(name, ate_final=value, odometry=9.0) for name, value in (("a", 2.0), ("b", 3.0), ("c", 2.0))
    ]
    report = make_report("name", plan("differences"), rows)
    first, second, third, last = (line.strip("| ") for line in render(report).splitlines()[2:6])
    assert first.split()[-1] == "2"
    assert second.split()[-2:] == ["3", "+50%"]
    assert third.split()[-2:] == ["2", "="]
    assert last.startswith("dead reckoning")
    assert "9" in last.split()
    assert "1 of 2 rows (50%) end at an ATE of 2.5 m or less" in report.remarks[-1]
    assert "2 of 2" in make_report("name", plan("differences", limit=3.0), rows).remarks[-1]
    blind = make_report("name", plan("differences"), [record("a"), record("b")])
    assert "without true poses" in blind.remarks[-1]


def test_disturbances_of_a_measurement_are_remarked_on():
    busy = record()
    busy = busy.model_copy(update={"machine": busy.machine.model_copy(update={"other_load": 2.5})})
    shared = busy.model_copy(update={"machine": busy.machine.model_copy(update={"workers": 2})})
    assert make_report("name", plan(), [record()]).remarks == []
    assert "2.5 cores busy" in make_report("name", plan(), [record(), busy]).remarks[0]
    assert "disturb" in make_report("name", plan(), [shared]).remarks[0]


def test_labels_are_short_and_different_values_different_rows():
    assert [label("", {}), label("a", {})] == ["as configured", "a"]
    assert label("a", {"x.k": "v", "y.l": 1.5}) == "a k=v l=1.5"
    assert label("", {"x.k": 1, "y.k": [2]}) == "x.k=1 y.k=[2]"
    assert len(make_report("name", plan(), [record(varied={"k": k}) for k in (1, "1")]).rows) == 2
