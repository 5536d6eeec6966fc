"""Results on disk, and the table over seeds."""

from __future__ import annotations

import csv
import json
import os
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.metrics.metric import Quantity
from ratslam.experiments.studies.metrics import DIRECTIONS, MAIN
from ratslam.experiments.studies.report import SHORT, label, rows, save, spread, table
from ratslam.experiments.studies.results import Memory, Result, Timing, read_result, write_result

FINITE = st.floats(-1e6, 1e6)


def result(hash="a", seed=0, row="", error=None, timing=None, varied=None, **values):
    quantities = {name: Quantity(label=name, value=value, unit="") for name, value in values.items()}
    return Result(
        hash=hash, seed=seed, row=row, varied=varied or {}, quantities=quantities, timing=timing, error=error
    )


TIMING = Timing(
    pace="live", median_us=40.0, p99_us=90.0, compile_s=2.0, compilations=3, finish_s=0.1, total_s=5.0
)
FULL = result(row="r", varied={"a.b": [1, {"c": None}]}, timing=TIMING, energy_all=0.1 + 0.2, exm_arr=None)
FULL = FULL.model_copy(update={"memory": Memory(peak=400.0, before=300.0, exact=True)})


def test_a_result_comes_back_exactly(tmp_path):
    write_result(tmp_path, FULL)
    assert read_result(tmp_path, FULL.key) == FULL
    assert [path.name for path in tmp_path.iterdir()] == ["a-0.json"]


def test_what_is_no_whole_result_is_missing(tmp_path):
    write_result(tmp_path, FULL)
    whole = (tmp_path / "a-0.json").read_bytes()
    for content in (b"", whole[: len(whole) // 2], b"{}", b"\xff\xfe", b"[1]"):
        (tmp_path / "a-0.json").write_bytes(content)
        assert read_result(tmp_path, "a-0") is None
    (tmp_path / "b-0.json").write_bytes(whole)  # another's
    assert read_result(tmp_path, "b-0") is None
    assert read_result(tmp_path, "none") is None


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    write_result(tmp_path, FULL)
    monkeypatch.setattr(
        os, "fsync", lambda file: (_ for _ in ()).throw(OSError(28, "No space left on device"))
    )
    with pytest.raises(OSError, match="No space"):
        write_result(tmp_path, FULL.model_copy(update={"steps": 7}))
    assert read_result(tmp_path, "a-0") == FULL
    assert len(list(tmp_path.iterdir())) == 1


def test_every_value_has_a_name():
    assert FULL.value("step_time") == 40.0
    assert FULL.value("step_time_p99") == 90.0
    assert FULL.value("compile_time") == 2.0
    assert FULL.value("memory") == 400.0
    assert FULL.value("energy_all") == 0.1 + 0.2
    assert FULL.value("exm_arr") is None
    assert FULL.value("map_auc") is None
    assert result().value("step_time") is None
    assert set(MAIN) == set(SHORT) <= set(DIRECTIONS)


@given(
    st.lists(st.one_of(st.none(), FINITE), max_size=9), st.sampled_from(["energy_all", "exm_arr", "links"])
)
def test_a_spread_is_of_the_values_there_are(values, name):
    found = spread(values, name)
    known = [value for value in values if value is not None]
    assert found.seeds == len(known)
    if not known:
        assert found == (0, None, None, None)
        return
    assert found.mean == pytest.approx(sum(known) / len(known), abs=1e-6)
    assert (found.sd is None) == (len(known) == 1)
    if found.sd is not None:
        assert found.sd == pytest.approx(statistics.stdev(known))
    assert found.worst == {"energy_all": max(known), "exm_arr": min(known), "links": None}[name]


def test_a_table_has_a_line_for_each_row_in_order(tmp_path):
    found = rows(
        [
            result("a", 0, "one", varied={"x.k": 1}, energy_all=1.0, exm_arr=0.25, ate_online=3.0),
            result("a", 1, "one", varied={"x.k": 1}, energy_all=3.0, exm_arr=0.75, ate_online=3.0),
            result("b", 0, "one", varied={"x.k": 2}, energy_all=5.0),
            result("b", 1, "one", varied={"x.k": 2}, error="no whiskers"),
        ]
    )
    assert [(label(row.row, row.varied), row.seeds, row.failed) for row in found] == [
        ("one k=1", 2, 0),
        ("one k=2", 1, 1),
    ]
    head, first, second = table(found).splitlines()
    assert head.split() == ["seeds", "EM", "ARR"]
    assert "2 ± 1.41 (3)" in first
    assert "0.5 ± 0.354 (0.25)" in first
    assert "1, 1 failed" in second
    assert second.split()[-2:] == ["5", "-"]
    paths = save(found, tmp_path)
    lines = list(csv.DictReader(paths[0].read_text(encoding="utf-8").splitlines()))
    assert [line["x.k"] for line in lines] == ["1", "2"]
    assert float(lines[0]["energy_all_mean"]) == 2.0
    assert lines[1]["exm_arr_mean"] == ""
    assert json.loads(paths[1].read_text())[0]["spreads"]["ate_online"]["worst"] == 3.0


def test_a_label_is_as_short_as_can_be():
    assert label("", {}) == "as configured"
    assert label("a", {}) == "a"
    assert label("a", {"x.k": "v", "y.l": 1.5}) == "a k=v l=1.5"
    assert label("", {"x.k": 1, "y.k": [2]}) == "x.k=1 y.k=[2]"


def test_two_values_that_look_alike_are_two_rows():
    found = rows(
        [result("a", varied={"k": 1}, energy_all=1.0), result("b", varied={"k": "1"}, energy_all=1.0)]
    )
    assert len(found) == 2
