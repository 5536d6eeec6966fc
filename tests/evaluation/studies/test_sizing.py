"""Studies made from a configuration: settings for a scene, cheaper steps, presets, and growth."""

import signal
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.metrics.metric import Quantity
from evaluation.studies import recommendation
from evaluation.studies.commands import PRESETS
from evaluation.studies.growth import FILE, growth_study, measure_growth, read_rows
from evaluation.studies.presets import PARTICLES, PARTS, preset_study, variations
from evaluation.studies.run_job import RunLog, RunRecord
from evaluation.studies.scene_statistics import Scene, scene_of, short_session, shortened, with_tier
from evaluation.studies.study import with_settings
from ratslam.classic.pose_cells import LARGEST_SUBSTEP
from ratslam.grid.particles import LAYERS
from ratslam.runs.build_session import open_source
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import load, override, parse, validate
from robot.simulation.head.simulated_session import HeadSimulation
from robot.world.maze import CELL_SIDE
from tactile.base.errors import InputError
from tests.evaluation.studies.conftest import kill, preset, wait_until
from tests.helpers.commands import ROOT, refused, said, start

GOLDEN = ROOT / "tests" / "golden"
LENGTHS = st.floats(1e-3, 1e3)


@st.composite
def scenes(draw):
    usual = draw(LENGTHS)
    most = usual * draw(st.floats(1, 10))
    spans = draw(st.tuples(*[st.floats(usual, 1e3 * usual)] * 2))
    return Scene("a scene", 1000, 1.0, spans, usual, most, draw(st.floats(0, 3)))


CONFIGS = st.builds(
    lambda backend, cells, size, fidelity, side: validate(
        override(
            parse("simulation: {}\n", "a"),
            [f"backend={backend}", f"pose_cells.cells_xy={cells}", f"grid.side={side}",
             f"pose_cells.cell_size={size!r}", f"simulation.fidelity={fidelity}"],
        ),
        RunConfig,
    ),
    st.sampled_from(["recall", "classic", "grid"]),
    st.integers(7, 301),
    LENGTHS,
    st.sampled_from(["auto", "quasistatic", "dynamic"]),
    st.sampled_from([3.0, 30.0]),
)  # fmt: skip


@given(LENGTHS, st.sampled_from([-1, 0, 1]))
def test_nice_numbers_are_near_and_on_the_side_asked_for(value, side):
    found = recommendation.round_number(value, side)
    assert value / 2.5 <= found <= value * 2.5
    assert (found - value) * side >= 0
    assert recommendation.round_number(found, side) == found


@given(CONFIGS, scenes())
def test_proposals_fit_the_scene_and_are_stable(config, scene):
    found = {each.key: each.value for each in recommendation.recommend(config, scene)}
    proposed = with_settings(config, found)
    if config.backend != "grid":
        size, across = found["pose_cells.cell_size"], found["pose_cells.cells_xy"]
        assert scene.most / size <= recommendation.PARTS * LARGEST_SUBSTEP + 1e-9
        assert scene.usual / size >= recommendation.SLOW - 1e-9 or scene.most / size > 1
        assert across * size >= max(scene.span) or across == recommendation.MOST or config.backend == "recall"
        assert across >= recommendation.FEWEST
    else:
        side = int(np.ceil(proposed.grid.side / proposed.grid.cell))
        assert recommendation.PARTICLES[0] <= proposed.grid.particles <= recommendation.PARTICLES[1]
        assert proposed.grid.particles * LAYERS * side**2 * 4 <= recommendation.MEMORY * 2**20
    fixed = config.model_copy(update={"backend": proposed.backend})  # what is proposed for recall, for recall
    again = with_settings(fixed, {each.key: each.value for each in recommendation.recommend(fixed, scene)})
    assert not [each.key for each in recommendation.recommend(again, scene) if each.changed]


@given(CONFIGS, scenes())
def test_the_snippet_makes_the_configuration_the_proposed_one(config, scene):
    found = recommendation.recommend(config, scene)
    text = recommendation.changed_settings_yaml(found)
    assert bool(text) == any(each.changed for each in found)
    if text:
        document = parse(f"simulation: {{}}\n{text}" if "simulation" not in text else text, "a")
        pasted = validate(document, RunConfig)
        for each in found:
            value = pasted
            for name in each.key.split("."):
                value = getattr(value, name)
            assert not each.changed or value == each.value


@given(CONFIGS)
def test_a_cheaper_step_lowers_one_setting(config):
    for settings in recommendation.cheaper_steps(config).values():
        less = with_settings(config, settings)
        assert less != config
        again = RunConfig.model_validate(less.model_dump(exclude_unset=True))
        assert again.pose_cells.cells_xy <= max(config.pose_cells.cells_xy, recommendation.FEWEST)
        assert again.pose_cells.cells_heading <= config.pose_cells.cells_heading
        assert again.grid.particles <= config.grid.particles
        assert again.pose_cells.cell_size >= config.pose_cells.cell_size
        assert again.grid.cell >= config.grid.cell


def configuration(**content):
    return RunConfig.model_validate(content).with_absolute_paths(ROOT)


def test_a_scene_follows_from_its_odometry():
    motion = {"speed": 0.04, "jitter": {"speed": 0.0, "position": 0.0, "yaw_deg": 0.0}}
    config = configuration(simulation={"motion": motion, "path": {"circuits": "C"}})
    with open_source(with_tier(config, "kinematic")) as source:
        scene = scene_of(source)
        moves = np.array([sample.reading.odometry[:3] for sample in source])
    assert scene.cycles == source.length == len(moves)
    assert scene.usual == pytest.approx(0.04, rel=0.1)
    assert scene.usual <= scene.most <= np.hypot(*moves[:, :2].T).max()
    assert all(0.3 < side < 3 for side in scene.span)


def test_a_session_is_cut_to_about_so_many_cycles(tmp_path):
    explored = configuration(simulation={"path": {"explore": 400.0}})
    with open_source(short_session(explored, 100, tmp_path)) as found:
        assert 80 <= found.length <= 110
    with open_source(short_session(configuration(create_simulation={"reports": 500}), 60, tmp_path)) as found:
        assert found.length == 60
    for name in ("a_square3.npz", "touch_circuits.mcap"):
        (tmp_path / name).mkdir()
        config = configuration(recording={"file": str(GOLDEN / name)})
        with open_source(config) as whole, open_source(short_session(config, 37, tmp_path / name)) as part:
            assert (part.view_shape, part.whiskers) == (whole.view_shape, whole.whiskers)
            for mine, theirs in zip(part, islice(whole, 37), strict=True):
                assert mine.time == theirs.time
                assert np.array_equal(mine.truth, theirs.truth)
                for a, b in zip(mine.reading, theirs.reading, strict=True):
                    assert np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True)


@pytest.fixture
def stubbed(monkeypatch):
    configurations: list[RunConfig] = []

    def run_job(job):
        configurations.append(job.config)
        if job.config.backend == "classic":
            return RunRecord(hash="", seed=0, error="backend: cannot be had")
        em = Quantity(label="EM", value=float(job.config.pose_cells.cell_size), unit="")
        return RunRecord(hash="", seed=0, steps=9, quantities={"energy_all": em})

    monkeypatch.setattr("evaluation.studies.recommendation.run_job", run_job)
    return configurations


def test_every_step_is_tried_on_the_same_short_session(tmp_path, capsys, stubbed):
    path, cells = tmp_path / "maze.yaml", "pose_cells: {cell_size: 0.005}\nattractor: {engine: dense}\n"
    path.write_text(f"simulation: {{fidelity: dynamic}}\n{cells}")
    output = said(capsys, "size", path, "--cycles", "400")
    first, second, *others = stubbed
    assert first.pose_cells.cell_size > 0.005
    assert (second.pose_cells.cell_size, second.attractor.engine) == (0.005, "dense")
    assert second.simulation.fidelity == "dynamic"
    assert {config.simulation.path.circuits for config in stubbed} == {first.simulation.path.circuits}
    assert len(first.simulation.path.circuits) < 10
    assert {"classic", "float32"} <= {one for c in others for one in (c.backend, c.session.precision)}
    assert "backend: cannot be had" in output  # and the rest is printed
    changed = validate(parse(output.partition("For maze.yaml:")[2], "a"), RunConfig)
    cells = first.pose_cells.model_copy(update={"cells_xy": changed.pose_cells.cells_xy})
    assert (changed.pose_cells, changed.simulation.fidelity) == (cells, "kinematic")


@pytest.mark.parametrize(("content", "arguments", "named"), [
    ("simulation: {}\n", ["--cycles", "3"], "--cycles"),
    (f"recording: {{file: {GOLDEN}/a_square3.npz}}\nbackend: grid\n", [], "without whiskers"),
    ("recording: {file: still.csv, table: {pose: {}}}\n", [], "never moves"),
])  # fmt: skip
def test_unfit_input_is_one_clear_error(content, arguments, named, tmp_path, capsys):
    (tmp_path / "config.yaml").write_text(content)
    rows = "".join(f"{k},0,0,0\n" for k in range(99))
    (tmp_path / "still.csv").write_text(f"t,x,y,heading\n{rows}")
    error = refused(capsys, "size", tmp_path / "config.yaml", *arguments)
    assert named in error
    assert "\n" not in error


SQUARE, MAZE = ROOT / "configs" / "square.yaml", ROOT / "configs" / "whisker_maze.yaml"
SMALL = "simulation: {maze: {columns: 3, rows: 2, loop: 6}, path: {circuits: CA}, whisking: {rate: 0.5}}\n"


@pytest.mark.parametrize("name", sorted(set(PRESETS) - {"tiers", "growth", "cells"}))
def test_a_preset_keeps_the_seed_of_the_configuration_and_takes_overrides(name):
    study, _ = preset_study(name, SQUARE, ["session.seed=7", "recall.guard=3"])
    assert study.name == f"square-{name}"
    assert {job.seed for job in study.jobs} == ({0, 1, 2} if name == "pareto" else {7})
    guards = {job.config.recall.guard for job in study.jobs}
    assert guards == ({2, 3, 4} if name == "vary" else {3})


def test_rows_turn_parts_off_take_other_backends_or_vary_every_number_within_its_limits():
    study, _ = preset_study("ablate", SQUARE, ["copies=3"])
    assert list(dict.fromkeys(job.row for job in study.jobs)) == list(PARTS)
    assert len({job.key for job in study.jobs}) == len(study.jobs) == 3 * len(PARTS)
    for base in (MAZE, ROOT / "configs" / "create_arena.yaml"):
        study, _ = preset_study("backends", base)
        assert [job.config.backend for job in study.jobs] == ["recall", "grid"]
    study, _ = preset_study("pareto", MAZE)
    grids = [job.config for job in study.jobs if job.config.backend == "grid" and job.seed == 0]
    assert [config.grid.particles for config in grids] == list(PARTICLES)
    assert study.jobs[-1].config.simulation.fidelity == "quasistatic"
    found = variations(override(load(SQUARE), ["recall.local=0.9"]), 0.2)
    names = [name for name, _ in found]
    for name in ("recall.excite", "keyframes.min_score", "keyframes.noise.per_cell"):
        assert names.count(name) == 2
    assert names.count("recall.local") == 1  # a share: it cannot exceed 1
    assert {("recall.guard", 16), ("recall.guard", 24)} <= set(found)
    study, _ = preset_study("vary", SQUARE)
    assert len(study.jobs) == 1 + len(variations(load(SQUARE), 0.2))


def test_perturbed_copies_are_run_beside_the_session(tmp_path, capsys):
    cells = "pose_cells: {cells_xy: 11, cells_heading: 12}\nbackend: classic\n"
    (tmp_path / "c.yaml").write_text(SMALL + cells)
    command = preset("spread", tmp_path / "c.yaml", ["copies=2"], tmp_path / "out")
    lines = said(capsys, *command, "--workers", "1").splitlines()
    rows = [line.split("|")[1].strip() for line in lines[2:5]]
    assert rows == ["as recorded", "perturbed", "dead reckoning"]
    assert [each.copy_number for each in RunLog(tmp_path / "out").records.values()] == [0, 1, 2]


@pytest.mark.parametrize(("name", "path", "overrides", "options", "named"), [
    ("tiers", "recorded.yaml", [], {}, "a scene to simulate"),
    ("tiers", "recorded.yaml", [], {"seconds": 0}, "--seconds"),
    ("ablate", SQUARE, ["recall.reach=-1"], {}, "recall.reach"),
    ("spread", "none.yaml", [], {}, "none.yaml"),
    ("vary", SQUARE, [], {"by": 0}, "--by"),
    ("vary", SQUARE, [], {"by": 1.0}, "--by"),
])  # fmt: skip
def test_unfit_configurations_are_refused(tmp_path, name, path, overrides, options, named):
    (tmp_path / "recorded.yaml").write_text("recording: {file: a.npz}\n")
    with pytest.raises(InputError, match=named):
        preset_study(name, tmp_path / path, overrides, **options)


def test_sessions_are_shortened_to_whole_laps_or_to_a_time():
    def path(seconds, **given):
        config = RunConfig.model_validate({"simulation": {"path": given}})
        return shortened(config, seconds).simulation.path

    whole = "CCCAAACACA"
    some = path(700.0, circuits=whole).circuits
    assert whole.startswith(some)
    assert 3 <= len(some) <= 5
    assert path(1e9, circuits=whole).circuits == whole
    assert len(path(1.0, circuits=whole).circuits) == 2
    assert [path(100.0, explore=time).explore for time in (500.0, 50.0)] == [100, 50]


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(SMALL)
    return path


def errors(row):
    """The fields of a row that no clock decides."""
    names = "steps keyframes closures energy ate energy_odometry energy_final ate_final"
    return [getattr(row, name) for name in names.split()]


def test_lengths_double_up_to_the_greatest_and_the_course_of_a_recording_is_known_ground():
    for ground, expected in ((100_000, [*(400 * 2**k for k in range(8)), 100_000]), (100, [100])):
        _, ((_, _, lengths, _),) = growth_study(SQUARE, ["first=400", f"known_ground={ground}"])
        assert lengths == expected
    _, (task,) = growth_study(SQUARE, ["first=150", "known_ground=300", "window=40"])
    assert (task.ground, task.lengths, task.window) == ("known ground", [150, 300], 40)
    done: list[int] = []
    rows = list(measure_growth(task, lambda: done.append(1)))
    assert ([row.steps for row in rows], len(done)) == ([150, 300], 300)
    assert 0 < rows[0].closures < rows[1].closures
    assert rows[1].median <= rows[1].largest


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
    process = start(*preset("growth", config, ["first=32", "known_ground=600", "new_ground=0"], output))
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


@pytest.mark.parametrize(("settings", "named"), [
    (["known_grounds=3"], "known_grounds"),
    (["known_ground=-3"], "known_ground"),
    (["new_ground=90000"], "at most"),
    (["known_ground=0", "new_ground=0"], "no session"),
    (["recall.reach=-1"], "recall.reach"),
    (["simulation.maze.kind=tree"], "a maze without loops"),
])  # fmt: skip
def test_unfit_settings_are_refused(config, settings, named):
    with pytest.raises(InputError, match=named):
        growth_study(config, settings)


@pytest.mark.parametrize(("name", "option"), [
    ("growth", ["--workers", "2"]), ("growth", ["--search"]),
    ("cells", ["--search"]), ("cells", ["--error", "ate"]),
])  # fmt: skip
def test_options_of_other_studies_are_refused_before_anything_runs(config, tmp_path, capsys, name, option):
    assert option[0] in refused(capsys, *preset(name, config, [], tmp_path / "out"), *option)
    assert not (tmp_path / "out").exists()
