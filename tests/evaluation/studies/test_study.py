"""Studies: jobs of a file, none lost or repeated, and refused files."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
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


def study(folder: Path, base: Path = MAZE, **content: object) -> Path:
    """A study file. JSON is YAML."""
    path = folder / "study.yaml"
    path.write_text(json.dumps({"base": str(base), **content}))
    return path


def read(folder: Path, *overrides: str, base: Path = MAZE, **content: object) -> Study:
    return read_study(study(folder, base, **content), overrides)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("study")


@settings(max_examples=25)
@given(grid=GRIDS, rows=st.lists(st.integers(1, 99), unique=True, max_size=3), seeds=st.integers(1, 4))
def test_rows_by_combinations_by_seeds(folder, grid, rows, seeds):
    named = {f"row {n}": {"keyframes.max_distance": n + 0.5} for n in rows}
    found = read(folder, vary=grid, rows=named, seeds=seeds).jobs
    combinations = 1
    for values in grid.values():
        combinations *= len(values)
    assert len(found) == max(len(rows), 1) * combinations * seeds
    assert len({job.key for job in found}) == len(found)  # they all differ, so do their keys
    assert [job.seed for job in found[:seeds]] == list(range(seeds))
    assert list(dict.fromkeys(job.row for job in found)) == (list(named) or [""])
    for job in found:
        assert job.config.simulation.seed == job.seed
        for key, value in job.varied.items():
            assert value in grid[key]
            if key == "keyframes.min_score":
                assert job.config.keyframes.min_score == value


@settings(max_examples=25)
@given(grid=GRIDS, data=st.data())
def test_hashes_follow_from_settings_and_not_from_notation(folder, grid, data):
    first = {key: values[0] for key, values in grid.items()}
    shuffled = {key: grid[key] for key in data.draw(st.permutations(sorted(grid)))}
    expected = {job.key for job in read(folder, vary=grid, seeds=2).jobs}
    assert {job.key for job in read(folder, vary=shuffled, seeds=2).jobs} == expected
    as_row = read(folder, rows={"one": {key: first[key] for key in shuffled}}, seeds=2).jobs
    as_set = read(folder, set={key: first[key] for key in shuffled}, seeds=[1, 0]).jobs
    assert {job.key for job in as_row} == {job.key for job in as_set} <= expected


def test_a_row_that_equals_another_is_the_same_job(folder):
    found = read(folder, rows={"a": None, "b": {}, "c": {"keyframes.min_score": 3.0}}).jobs
    assert [job.row for job in found] == ["a", "b", "c"]
    assert found[0].key == found[1].key != found[2].key


def test_explicit_defaults_change_the_hash(folder):
    """Other settings may be completed from the source: touch has its own `keyframes.min_score`."""
    usual = KeyframeMapConfig().min_score
    unset, default = read(folder, rows={"unset": {}, "default": {"keyframes.min_score": usual}}).jobs
    assert unset.config == default.config
    assert unset.key != default.key


def test_seeds_are_no_part_of_the_hash_and_the_base_may_have_any(folder):
    base = folder / "seeded.yaml"
    base.write_text("simulation: {seed: 77}\n")
    plain = folder / "plain.yaml"
    plain.write_text("simulation: {}\n")
    seeded, bare = (read(folder, base=path, seeds=[5]).jobs for path in (base, plain))
    assert seeded[0].key == bare[0].key
    assert seeded[0].config.simulation.seed == 5


@pytest.mark.parametrize(
    ("base", "section"),
    [
        ("whisker_maze.yaml", "simulation"),
        ("create_arena.yaml", "create_simulation"),
        ("square.yaml", "session"),
    ],
)
def test_seeds_belong_to_the_simulation_or_the_session(folder, base, section):
    found = read(folder, base=ROOT / "configs" / base, seeds=[3, 8]).jobs
    assert [getattr(job.config, section).seed for job in found] == [3, 8]


def test_hashes_follow_from_the_content_of_files_and_not_their_path(folder):
    golden = ROOT / "tests" / "golden" / "a_square3.npz"
    keys = []
    for name, more in (("x", b""), ("y", b""), ("x", b"more")):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "run.npz").write_bytes(golden.read_bytes() + more)
        (folder / name / "base.yaml").write_text("recording: {file: run.npz}\n")
        (folder / name / "study.yaml").write_text("base: base.yaml\n")
        keys.append(read_study(folder / name / "study.yaml").jobs[0].key)
    assert keys[0] == keys[1] != keys[2]


def test_paths_of_the_base_start_at_the_base(folder):
    (job,) = read(folder, base=SQUARE).jobs
    assert job.config.recording.file.samefile(ROOT / "tests" / "golden" / "a_square3.npz")


def test_the_pace_is_part_of_the_hash(folder):
    (replay,), (live,) = (read(folder, pace=pace).jobs for pace in ("replay", "live"))
    assert (replay.pace, live.pace) == ("replay", "live")
    assert replay.key != live.key


def test_a_row_may_turn_parts_off_and_ask_for_perturbed_copies(folder):
    rows = {"all": {}, "off": {"ablation": {"verify": False}}, "copies": {"copies": 2}}
    every, off, first, second = read(folder, rows=rows).jobs
    assert every.ablation == FULL
    assert off.ablation == FULL.model_copy(update={"verify": False})
    assert (every.copy_number, first.copy_number, second.copy_number) == (0, 1, 2)
    assert every.config == off.config == first.config
    assert len({every.key, off.key, first.key, second.key}) == 4
    assert [job.copy_number for job in read(folder, "copies=3").jobs] == [1, 2, 3]


def test_a_reference_tier_is_part_of_the_run(folder):
    (plain,), (compared,) = (read(folder, **more).jobs for more in ({}, {"reference_tier": "dynamic"}))
    assert compared.reference_tier == "dynamic"
    assert plain.key != compared.key


def test_overrides_are_of_the_study_or_of_all_runs(folder):
    found = read(
        folder,
        "seeds=3",
        "keyframes.min_score=9",
        "simulation.path.circuits=CC",
        set={"keyframes.min_score": 2.0},
    )
    assert len(found.jobs) == 3
    assert {job.config.keyframes.min_score for job in found.jobs} == {9.0}
    assert {job.config.simulation.path.circuits for job in found.jobs} == {"CC"}
    whole = read(folder, "keyframes={max_distance: 9}", set={"keyframes.min_score": 2.0})
    assert whole.jobs[0].config.keyframes.model_fields_set == {"max_distance"}


def test_a_section_is_set_before_its_keys(folder):
    written = {"keyframes.min_score": 2.0, "keyframes": {"max_distance": 9.0}}
    found = [read(folder, set=dict(items)).jobs for items in (written.items(), reversed(written.items()))]
    assert found[0] == found[1]
    assert found[0][0].config.keyframes.min_score == 2.0


def test_keys_of_studies_and_runs_differ():
    assert not set(StudyPlan.model_fields) & set(RunConfig.model_fields)  # `--set` needs this


GRID = {"keyframes.min_score": [3]}


def tuning(key: str, **parameter: object) -> dict[str, object]:
    return {"tune": TUNE | {"parameters": {key: parameter}}}


def tune(**parameter: object) -> dict[str, object]:
    return tuning("keyframes.min_score", **parameter)


TUNE = {"parameters": {"keyframes.min_score": {"low": 1.0, "high": 2.0}}, "objectives": ["exm_arr"]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"base": "nowhere.yaml"}, ["nowhere.yaml: no such file", "one of building, "]),
        (
            {"vary": {"keyframes.min_scor": [1, 2]}},
            ["study.yaml:1:", "keyframes.min_scor: unknown key", "'min_score'"],
        ),
        ({"rows": {"a": {"recall.leak": "x"}}}, ["recall.leak: 'x'", "a number"]),
        ({"set": {"keyframes.min_score": [1]}}, ["keyframes.min_score: a list of 1"]),
        ({"vary": {"keyframes.min_score": []}}, ["vary.keyframes.min_score", "at least 1"]),
        ({"vary": {"keyframes.min_score": 3}}, ["vary.keyframes.min_score: 3", "a list"]),
        ({"vary": {"keyframes.min_score": [3, 4, 3]}}, ["vary.keyframes.min_score.2: 3 given twice"]),
        (
            {"vary": GRID, "rows": {"a": {"keyframes": {}}}},
            ["rows.a.keyframes", "'keyframes.min_score' varies"],
        ),
        ({"vary": GRID | {"keyframes": [{}]}}, ["vary.keyframes", "'keyframes.min_score' varies"]),
        ({"vary": {"simulation.seed": [1, 2]}}, ["simulation.seed: a seed"]),
        ({"set": {"simulation.seed": 1}}, ["simulation.seed: a seed"]),
        ({"base": str(SQUARE), "rows": {"a": {"session.seed": 1}}}, ["session.seed: a seed"]),
        ({"set": {"a..b": 3}}, ["a..b: not a key path"]),
        ({"set": {"touch.image.levels.x": 3}}, ["touch.image.levels"]),
        ({"seeds": 0}, ["seeds: 0"]),
        ({"seeds": [1, 1]}, ["seeds", "twice"]),
        ({"seeds": [-1]}, ["seeds.0: -1"]),
        ({"vary": {f"keyframes.{key}": list(range(1, 60)) for key in "abc"}}, ["205379 jobs"]),
        ({"sedes": 3}, ["sedes: unknown key", "'seeds'"]),
        ({"tune": TUNE | {"objectives": ["speed"]}}, ["objectives.0: 'speed'", "step_time"]),
        ({"tune": TUNE | {"objectives": ["steps"]}}, ["objectives.0: 'steps'", "minimise or maximise"]),
        ({"tune": TUNE | {"objectives": []}}, ["tune: no objectives"]),
        ({"tune": TUNE | {"minimise": ["exm_arr"]}}, ["tune: a quantity named twice"]),
        ({"tune": TUNE | {"parameters": {}}}, ["tune.parameters"]),
        (tuning("keyframes.x", low=1, high=2), ["keyframes.x: unknown key"]),
        (tuning("recall.leak", low=0.1, high=2.0), ["recall.leak: 2"]),
        ({"rows": {"a": {"copies": -1}}}, ["rows.a.copies: -1"]),
        ({"rows": {"a": {"ablation": {"whiskers": False}}}}, ["rows.a.ablation.whiskers: unknown key"]),
        ({"rows": {"a": {"ablation": {"verify": 0}}}}, ["rows.a.ablation.verify: 0", "true or false"]),
        ({"copies": -1}, ["copies: -1"]),
        ({"report": "medium"}, ["report"]),
        (tune(low=2, high=2), ["low 2 is not below"]),
        (tune(low=0, high=2, log=True), ["log needs"]),
        (tune(low=2), ["give low and high, or choices"]),
        (tune(low=2, high=3, choices=[1, 2]), ["give low and high, or choices"]),
    ],
)  # fmt: skip
def test_a_bad_study_is_refused_before_anything_runs(capsys, folder, content, message):
    output = folder / "never"
    assert main(["study", str(study(folder, **content)), "-o", str(output)]) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert error.startswith("ratslam: error: ")
    for words in message:
        assert words in error
    assert not output.exists()


def test_every_error_is_reported_once(folder):
    with pytest.raises(InputError) as caught:
        read(
            folder,
            vary={"backend": ["recall", "classic"], "keyframes.min_scor": [1, 2]},
            set={"recall.leak": "x"},
        )
    lines = str(caught.value).splitlines()
    assert len(lines) == 2
    assert "recall.leak: 'x'" in str(caught.value)
    assert "keyframes.min_scor: unknown key" in str(caught.value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("keyframes.min_scor=3", "--set keyframes.min_scor: unknown key"),
        ("backend=recall", "varied"),
        ("x", "not an assignment"),
    ],
)
def test_a_bad_override_is_refused(folder, override, message):
    with pytest.raises(InputError, match=message):
        read(folder, override, vary={"backend": ["recall", "classic"]})


def test_an_empty_file_and_a_missing_base_are_refused(folder):
    for text, error in (
        ("", "empty"),
        ("seeds: 2\n", "base: missing"),
        ("base: study.yaml\n", "unknown key"),
    ):
        (folder / "study.yaml").write_text(text)
        with pytest.raises(InputError, match=error):
            read_study(folder / "study.yaml")


def test_nothing_to_search_is_refused(capsys, folder):
    assert main(["study", str(study(folder)), "-o", str(folder / "never"), "--search"]) == 2
    assert "tune: missing" in capsys.readouterr().err
    assert not (folder / "never").exists()


def test_the_examples_are_studies():
    for path in (ROOT / "configs").glob("study_*.yaml"):
        assert read_study(path).jobs


def test_the_pareto_study_covers_every_axis():
    study = read_study(ROOT / "configs" / "study_pareto.yaml")
    assert study.plan.report == "pareto"
    configs = [job.config for job in study.jobs if job.seed == 0]
    for axis in (
        lambda config: config.backend,
        lambda config: config.attractor.engine,
        lambda config: config.pose_cells.cells_xy,
        lambda config: config.grid.particles,
        lambda config: config.session.precision,
        lambda config: config.simulation.fidelity,
    ):
        assert len(set(map(axis, configs))) >= 2
    assert all(a != b for a, b in pairwise(configs))
