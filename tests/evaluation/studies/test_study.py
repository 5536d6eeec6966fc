"""Studies: jobs of a file, none lost or repeated, and refused files."""

from __future__ import annotations

import json
from math import prod
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.studies.study import Study, StudyPlan, read_study
from ratslam.cli import main
from ratslam.mapping.config import FULL, KeyframeMapConfig
from ratslam.runs.settings.run_config import RunConfig
from tactile.base.errors import InputError

ROOT = Path(__file__).parents[3]
MAZE = ROOT / "configs" / "whisker_maze.yaml"
SQUARE = ROOT / "configs" / "square.yaml"
AXES = {
    "keyframes.min_score": st.floats(1, 50, allow_subnormal=False),
    "recall.guard": st.integers(1, 8),
    "backend": st.sampled_from(["recall", "classic"]),
    "session.precision": st.sampled_from(["float32", "float64"]),
    "simulation.whisking.rate": st.floats(0.5, 4),
    "places": st.sampled_from([{}, {"radius": 1.0}, {"radius": 1.5}]),
}
GRIDS = st.lists(st.sampled_from(sorted(AXES)), unique=True, max_size=3).flatmap(
    lambda keys: st.fixed_dictionaries(
        {key: st.lists(AXES[key], min_size=1, max_size=3, unique_by=json.dumps) for key in keys}
    )
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


def test_equal_rows_are_one_job_and_explicit_defaults_another(folder):
    """A default that is given is another run: others are completed from the source."""
    usual = KeyframeMapConfig().min_score
    rows = {"a": None, "b": {}, "c": {"keyframes.min_score": usual}}
    a, b, c = read(folder, rows=rows).jobs
    assert [job.row for job in (a, b, c)] == list(rows)
    assert a.config == c.config
    assert a.key == b.key != c.key


@pytest.mark.parametrize(
    ("base", "section"),
    [("whisker_maze", "simulation"), ("create_arena", "create_simulation"), ("square", "session")],
)
def test_seeds_belong_to_the_simulation_or_the_session(folder, base, section):
    found = read(folder, base=ROOT / "configs" / f"{base}.yaml", seeds=[3, 8]).jobs
    assert [getattr(job.config, section).seed for job in found] == [3, 8]


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
    (live,), (compared,) = (
        read(folder, **how).jobs for how in ({"pace": "live"}, {"reference_tier": "dynamic"})
    )
    assert [job.ablation for job in (every, off)] == [FULL, FULL.model_copy(update={"verify": False})]
    assert [job.copy_number for job in (every, off, first, second)] == [0, 0, 1, 2]
    assert [job.pace for job in (every, live)] == ["replay", "live"]
    assert [job.reference_tier for job in (every, compared)] == [None, "dynamic"]
    jobs = every, off, first, second, live, compared
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


def test_a_section_is_set_before_its_keys(folder):
    written = {"keyframes.min_score": 2.0, "keyframes": {"max_distance": 9.0}}
    found = [read(folder, set=dict(items)).jobs for items in (written.items(), reversed(written.items()))]
    assert found[0] == found[1]
    assert found[0][0].config.keyframes.min_score == 2.0


GRID = {"keyframes.min_score": [3]}
TUNE = {"parameters": {"keyframes.min_score": {"low": 1.0, "high": 2.0}}, "objectives": ["exm_arr"]}


def vary(*values: object) -> dict[str, object]:
    return {"vary": {"keyframes.min_score": list(values)}}


def tune(key: str = "keyframes.min_score", **parameter: object) -> dict[str, object]:
    return {"tune": TUNE | {"parameters": {key: parameter}}}


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ({"base": "nowhere.yaml"}, "nowhere.yaml: no such file"),
        ({"vary": {"keyframes.min_scor": [1, 2]}}, r"study.yaml:1:.*keyframes.min_scor: .*'min_score'"),
        (vary(3, 4, 3), "vary.keyframes.min_score.2: 3 given twice"),
        ({"vary": GRID, "rows": {"a": {"keyframes": {}}}}, "rows.a.keyframes: .*'keyframes.min_score'"),
        ({"vary": GRID | {"keyframes": [{}]}}, "vary.keyframes: .*'keyframes.min_score' varies"),
        ({"vary": {"simulation.seed": [1, 2]}}, "simulation.seed: a seed"),
        ({"base": str(SQUARE), "rows": {"a": {"session.seed": 1}}}, "session.seed: a seed"),
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
    ],
)  # fmt: skip
def test_a_bad_study_is_refused_with_its_place(folder, content, named):
    with pytest.raises(InputError, match=named):
        read(folder, **content)


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("keyframes.min_scor=3", "--set keyframes.min_scor: unknown key"),
        ("backend=recall", "varied"),
        ("x", "not an assignment"),
    ],
)
def test_a_bad_override_is_refused(folder, override, named):
    with pytest.raises(InputError, match=named):
        read(folder, override, vary={"backend": ["recall", "classic"]})


def test_every_error_is_reported_once_and_nothing_runs(folder, capsys):
    settings = {"backend": ["recall", "classic"], "keyframes.min_scor": [1, 2]}
    with pytest.raises(InputError) as caught:
        read(folder, vary=settings, set={"recall.leak": "x"})
    lines = str(caught.value).splitlines()
    assert len(lines) == 2
    assert "recall.leak: 'x'" in str(caught.value)
    assert "keyframes.min_scor: unknown key" in str(caught.value)
    command = ["study", str(folder / "study.yaml"), "-o", str(folder / "never")]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert error.startswith("ratslam: error: ")
    assert "Traceback" not in error
    read(folder)
    assert main([*command, "--search"]) == 2
    assert "tune: missing" in capsys.readouterr().err
    assert not (folder / "never").exists()


def test_the_examples_are_studies():
    assert all(read_study(path).jobs for path in (ROOT / "configs").glob("study_*.yaml"))
