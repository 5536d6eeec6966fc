"""Studies: jobs of a file, none lost or repeated, refused files, and the tables of their reports."""

import csv
import json
import statistics
from math import prod
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.metrics.run_metrics import recognition_error
from evaluation.metrics.statistics import pareto_optimal
from evaluation.studies.metrics import find_error
from evaluation.studies.study import Study, StudyPlan, read_study
from evaluation.studies.study_report import label, make_report, render, save_report, spread
from ratslam.mapping.config import FULL, KeyframeMapConfig
from ratslam.runs.settings.run_config import RunConfig
from tactile.base.errors import InputError
from tests.evaluation.studies.conftest import record
from tests.helpers.commands import ROOT, SQUARE, refused

MAZE = ROOT / "configs" / "whisker_maze.yaml"
AXES = {
    "keyframes.min_score": st.floats(1, 50, allow_subnormal=False),
    "recall.guard": st.integers(1, 8),
    "backend": st.sampled_from(["recall", "classic"]),
    "session.precision": st.sampled_from(["float32", "float64"]),
    "simulation.whisking.rate": st.floats(0.5, 4),
    "places": st.sampled_from([{}, {"radius": 1.0}, {"radius": 1.5}]),
}
AXIS = {key: st.lists(values, min_size=1, max_size=3, unique_by=json.dumps) for key, values in AXES.items()}
GRIDS = st.lists(st.sampled_from(sorted(AXES)), unique=True, max_size=3).flatmap(
    lambda keys: st.fixed_dictionaries({key: AXIS[key] for key in keys})
)


def read(folder: Path, *overrides: str, base: Path = MAZE, **content: object) -> Study:
    """The study of a file. JSON is YAML."""
    path = folder / "study.yaml"
    path.write_text(json.dumps({"base": str(base), **content}))
    return read_study(path, overrides)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("study")


@given(grid=GRIDS, rows=st.lists(st.integers(1, 99), unique=True, max_size=3), seeds=st.integers(1, 4))
def test_rows_by_combinations_by_seeds(folder, grid, rows, seeds):
    named = {f"row {n}": {"keyframes.max_distance": n + 0.5} for n in rows}
    found = read(folder, vary=grid, rows=named, seeds=seeds).jobs
    assert len(found) == max(len(rows), 1) * prod(map(len, grid.values())) * seeds
    assert len({job.key for job in found}) == len(found)  # they all differ, so do their keys
    assert [job.seed for job in found[:seeds]] == list(range(seeds))
    assert list(dict.fromkeys(job.row for job in found)) == (list(named) or [""])
    for job in found:
        assert job.config.simulation.seed == job.seed
        assert all(value in grid[key] for key, value in job.varied.items())
        if "keyframes.min_score" in grid:
            assert job.config.keyframes.min_score == job.varied["keyframes.min_score"]


@given(grid=GRIDS, data=st.data())
def test_hashes_follow_from_settings_and_not_from_notation(folder, grid, data):
    first = {key: values[0] for key, values in grid.items()}
    shuffled = {key: grid[key] for key in data.draw(st.permutations(sorted(grid)))}
    expected = {job.key for job in read(folder, vary=grid, seeds=2).jobs}
    assert {job.key for job in read(folder, vary=shuffled, seeds=2).jobs} == expected
    as_row = read(folder, rows={"one": {key: first[key] for key in shuffled}}, seeds=2).jobs
    as_set = read(folder, set={key: first[key] for key in shuffled}, seeds=[1, 0]).jobs
    assert {job.key for job in as_row} == {job.key for job in as_set} <= expected


def test_equal_rows_are_one_job_explicit_defaults_another_and_sections_are_set_before_keys(folder):
    usual = KeyframeMapConfig().min_score
    rows = {"a": None, "b": {}, "c": {"keyframes.min_score": usual}}
    a, b, c = read(folder, rows=rows).jobs
    assert [job.row for job in (a, b, c)] == list(rows)
    assert a.config == c.config
    assert a.key == b.key != c.key
    written = {"keyframes.min_score": 2.0, "keyframes": {"max_distance": 9.0}}
    found = [read(folder, set=dict(items)).jobs for items in (written.items(), reversed(written.items()))]
    assert found[0] == found[1]
    assert found[0][0].config.keyframes.min_score == 2.0


def test_seeds_belong_to_the_simulation_or_the_session_and_the_examples_are_studies(folder):
    sections = {"whisker_maze": "simulation", "create_arena": "create_simulation", "square": "session"}
    for base, section in sections.items():
        found = read(folder, base=ROOT / "configs" / f"{base}.yaml", seeds=[3, 8]).jobs
        assert [getattr(job.config, section).seed for job in found] == [3, 8]
    assert all(read_study(path).jobs for path in (ROOT / "configs").glob("study_*.yaml"))


def test_hashes_follow_from_the_content_of_files_and_from_no_path_or_seed_of_the_base(folder):
    golden = (ROOT / "tests" / "golden" / "a_square3.npz").read_bytes()
    (job,) = read(folder, base=SQUARE).jobs
    assert job.config.recording.file.read_bytes() == golden
    keys = []
    for name, more in (("x", b""), ("y", b""), ("x", b"more")):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "run.npz").write_bytes(golden + more)
        (folder / name / "base.yaml").write_text("recording: {file: run.npz}\n")
        (folder / name / "study.yaml").write_text("base: base.yaml\n")
        keys.append(read_study(folder / name / "study.yaml").jobs[0].key)
    assert keys[0] == keys[1] != keys[2]
    for text in ("{seed: 77}", "{}"):
        (folder / "base.yaml").write_text(f"simulation: {text}\n")
        (job,) = read(folder, base=folder / "base.yaml", seeds=[5]).jobs
        assert job.config.simulation.seed == 5
        keys.append(job.key)
    assert keys[-1] == keys[-2]


def test_how_a_job_is_run_is_part_of_its_key(folder):
    rows = {"all": {}, "off": {"ablation": {"verify": False}}, "copies": {"copies": 2}}
    every, off, first, second = read(folder, rows=rows).jobs
    ways = {"pace": "live"}, {"reference_tier": "dynamic"}
    (live,), (compared,) = (read(folder, **how).jobs for how in ways)
    assert [job.ablation for job in (every, off)] == [FULL, FULL.model_copy(update={"verify": False})]
    jobs = every, off, first, second, live, compared
    assert [job.copy_number for job in jobs] == [0, 0, 1, 2, 0, 0]
    assert [job.pace for job in jobs] == [*["replay"] * 4, "live", "replay"]
    assert [job.reference_tier for job in jobs] == [*[None] * 5, "dynamic"]
    assert all(job.config == every.config for job in jobs)
    assert len({job.key for job in jobs}) == len(jobs)
    assert [job.copy_number for job in read(folder, "copies=3").jobs] == [1, 2, 3]


def test_overrides_are_of_the_study_or_of_all_runs(folder):
    written = {"keyframes.min_score": 2.0}
    assignments = "seeds=3", "keyframes.min_score=9", "simulation.path.circuits=CC"
    found = read(folder, *assignments, set=written)
    assert len(found.jobs) == 3
    assert {job.config.keyframes.min_score for job in found.jobs} == {9.0}
    assert {job.config.simulation.path.circuits for job in found.jobs} == {"CC"}
    whole = read(folder, "keyframes={max_distance: 9}", set=written)
    assert whole.jobs[0].config.keyframes.model_fields_set == {"max_distance"}
    assert not set(StudyPlan.model_fields) & set(RunConfig.model_fields)  # `--set` needs this


GRID = {"keyframes.min_score": [3]}
TUNE = {"parameters": {"keyframes.min_score": {"low": 1.0, "high": 2.0}}, "objectives": ["exm_arr"]}


def vary(*values: object) -> dict[str, object]:
    return {"vary": {"keyframes.min_score": list(values)}}


def tune(key: str = "keyframes.min_score", **parameter: object) -> dict[str, object]:
    return {"tune": TUNE | {"parameters": {key: parameter}}}


@pytest.mark.parametrize(("content", "named"), [
    ({"base": "nowhere.yaml"}, "nowhere.yaml: no such file"),
    ({"vary": {"keyframes.min_scor": [1, 2]}}, r"study.yaml:1:.*keyframes.min_scor: .*'min_score'"),
    (vary(3, 4, 3), "vary.keyframes.min_score.2: 3 given twice"),
    ({"vary": GRID, "rows": {"a": {"keyframes": {}}}}, "rows.a.keyframes: .*'keyframes.min_score'"),
    ({"vary": GRID | {"keyframes": [{}]}}, "vary.keyframes: .*'keyframes.min_score' varies"),
    ({"vary": {"simulation.seed": [1, 2]}}, "simulation.seed: a seed"),
    ({"base": SQUARE, "rows": {"a": {"session.seed": 1}}}, "session.seed: a seed"),
    ({"set": {"a..b": 3}}, "a..b: not a key path"),
    ({"seeds": 0}, "seeds: 0"),
    ({"seeds": 10_001}, "seeds: 10001"),
    ({"seeds": [1, 1]}, "seeds.* twice"),
    ({"vary": {f"keyframes.{key}": list(range(1, 60)) for key in "abc"}}, "205379 jobs"),
    ({"sedes": 3}, "sedes: unknown key.*'seeds'"),
    ({"tune": TUNE | {"objectives": ["steps"]}}, "objectives.0: 'steps'"),
    ({"tune": TUNE | {"objectives": []}}, "tune: no objectives"),
    ({"tune": TUNE | {"minimise": ["exm_arr"]}}, "tune: .*twice"),
    (tune("keyframes.x", low=1, high=2), "keyframes.x: unknown key"),
    (tune("recall.leak", low=0.1, high=2.0), "recall.leak: 2"),
    (tune(low=2, high=2), "low 2 is not below"),
    (tune(low=0, high=2, log=True), "log needs"),
    (tune(low=2), "give low and high, or choices"),
    (tune(low=2, high=3, choices=[1, 2]), "give low and high, or choices"),
    ({"rows": {"a": {"ablation": {"whiskers": False}}}}, "rows.a.ablation.whiskers: unknown key"),
])  # fmt: skip
def test_a_bad_study_is_refused_with_its_place(folder, content, named):
    with pytest.raises(InputError, match=named):
        read(folder, **content)


@pytest.mark.parametrize(("override", "named"), [
    ("keyframes.min_scor=3", "--set keyframes.min_scor: unknown key"),
    ("backend=recall", "varied"),
    ("x", "not an assignment"),
])  # fmt: skip
def test_a_bad_override_is_refused(folder, override, named):
    with pytest.raises(InputError, match=named):
        read(folder, override, vary={"backend": ["recall", "classic"]})


def test_every_error_is_reported_once_and_nothing_runs(folder, capsys):
    settings = {"backend": ["recall", "classic"], "keyframes.min_scor": [1, 2]}
    with pytest.raises(InputError) as caught:
        read(folder, vary=settings, set={"recall.leak": "x"})
    assert str(caught.value).count("\n") == 1
    assert all(part in str(caught.value) for part in ("recall.leak: 'x'", "keyframes.min_scor: unknown key"))
    command = ["study", folder / "study.yaml", "-o", folder / "never"]
    refused(capsys, *command)
    read(folder)
    assert "tune: missing" in refused(capsys, *command, "--search")
    assert not (folder / "never").exists()


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


@given(st.lists(st.none() | FINITE, max_size=9), st.sampled_from(["energy_all", "exm_arr", "links"]))
def test_statistics_use_the_defined_values(values, name):
    found = spread(values, name)
    known = [value for value in values if value is not None]
    assert (found is None) == (not known)
    if not known:
        return
    assert found.values == tuple(values)
    assert found.mean == pytest.approx(sum(known) / len(known), abs=1e-6)
    assert (found.low, found.median, found.high) == (min(known), statistics.median(known), max(known))
    assert found.sd == (pytest.approx(statistics.stdev(known)) if len(known) > 1 else None)
    assert found.worst == {"energy_all": max(known), "exm_arr": min(known), "links": None}[name]


def test_an_error_has_a_short_and_a_full_name_and_that_of_recognition_is_known():
    assert find_error("em") == find_error("energy_all") == "energy_all"
    assert find_error("exm") == "recognition_error"
    for name in ("atee", "step_time", "experiences", ""):
        with pytest.raises(InputError, match="--error") as caught:
            find_error(name)
        assert ("'ate'" in str(caught.value)) == (name == "atee")

    def error(**values):
        return recognition_error(record(**values).quantities).value

    assert error(exm_arr=0.5, exm_arcr_strict=0.8) == pytest.approx(0.6)
    assert error(exm_arr=0.0, exm_arcr_strict=None) == 1
    assert np.isnan(error(exm_arr=0.5, exm_arcr_strict=None))


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


def test_a_pareto_report_marks_the_front_in_every_form_and_has_no_picture_without_an_error(tmp_path):
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
    rows = [(label(row.row, row.varied), row.runs, row.failed) for row in report.rows]
    assert rows == [("one k=1", 2, 0), ("one k=2", 1, 1)]
    head, _, first, second, *_ = render(report).splitlines()
    assert [cell.split()[0] for cell in head.split("|")[2:6]] == ["runs", "steps", "energy_all", "exm_arr"]
    assert all(cell in first for cell in ("2 ± 1.41 (3)", "0.5 ± 0.354 (0.25)"))
    assert "1, 1 failed" in second
    save_report(report, tmp_path)
    lines = list(csv.DictReader((tmp_path / "table.csv").read_text(encoding="utf-8").splitlines()))
    assert [line["x.k"] for line in lines] == ["1", "2"]
    assert float(lines[0]["energy_all_mean"]) == 2.0
    assert lines[1]["exm_arr_mean"] == ""
    content = json.loads((tmp_path / "table.json").read_text())
    assert content["rows"][0]["spreads"]["ate_online"]["worst"] == 3.0


def test_differences_are_from_the_first_row_and_odometry_comes_last():
    values = {"a": 2.0, "b": 3.0, "c": 2.0}
    rows = [record(row, ate_final=value, odometry=9.0) for row, value in values.items()]
    report = make_report("name", plan("differences"), rows)
    first, second, third, last = (line.strip("| ").split() for line in render(report).splitlines()[2:6])
    assert (first[-1], second[-2:], third[-2:]) == ("2", ["3", "+50%"], ["2", "="])
    assert (last[:2], "9" in last) == (["dead", "reckoning"], True)
    assert "1 of 2 rows (50%) end at an ATE of 2.5 m or less" in report.remarks[-1]
    assert "2 of 2" in make_report("name", plan("differences", limit=3.0), rows).remarks[-1]
    blind = make_report("name", plan("differences"), [record("a"), record("b")])
    assert "without true poses" in blind.remarks[-1]


def test_disturbances_are_remarked_on_and_labels_are_short():
    busy = record()
    busy = busy.model_copy(update={"machine": busy.machine.model_copy(update={"other_load": 2.5})})
    shared = busy.model_copy(update={"machine": busy.machine.model_copy(update={"workers": 2})})
    assert make_report("name", plan(), [record()]).remarks == []
    assert "2.5 cores busy" in make_report("name", plan(), [record(), busy]).remarks[0]
    assert "disturb" in make_report("name", plan(), [shared]).remarks[0]
    assert [label("", {}), label("a", {})] == ["as configured", "a"]
    assert label("a", {"x.k": "v", "y.l": 1.5}) == "a k=v l=1.5"
    assert label("", {"x.k": 1, "y.k": [2]}) == "x.k=1 y.k=[2]"
    assert len(make_report("name", plan(), [record(varied={"k": k}) for k in (1, "1")]).rows) == 2
