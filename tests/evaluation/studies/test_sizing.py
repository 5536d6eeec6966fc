"""Settings for a scene, the cheaper steps that are tried, and presets: studies made from a configuration."""

from __future__ import annotations

import json
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.metrics.metric import Quantity
from evaluation.studies import recommendation
from evaluation.studies.commands import PRESETS
from evaluation.studies.presets import METHODS, PARTICLES, PARTS, TIERS, preset_study, variations
from evaluation.studies.run_job import RunLog, RunRecord
from evaluation.studies.scene_statistics import Scene, scene_of, short_session, shortened, with_tier
from evaluation.studies.study import with_settings
from ratslam.classic.pose_cells import LARGEST_SUBSTEP
from ratslam.cli import main
from ratslam.grid.particles import LAYERS
from ratslam.runs.build_session import open_source
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import load, override, parse, validate
from tactile.base.errors import InputError
from tests.evaluation.studies.conftest import ROOT

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
    """Replaces sessions; returns the configurations that would be run."""
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
    path = tmp_path / "maze.yaml"
    path.write_text(
        "simulation: {fidelity: dynamic}\npose_cells: {cell_size: 0.005}\nattractor: {engine: dense}\n"
    )
    assert main(["size", str(path), "--cycles", "400"]) == 0
    output = capsys.readouterr().out
    first, second, *others = stubbed
    assert first.pose_cells.cell_size > 0.005
    assert (second.pose_cells.cell_size, second.attractor.engine) == (0.005, "dense")
    assert second.simulation.fidelity == "dynamic"
    assert {config.simulation.path.circuits for config in stubbed} == {first.simulation.path.circuits}
    assert len(first.simulation.path.circuits) < 10
    assert "classic" in [config.backend for config in others]
    assert "float32" in [config.session.precision for config in others]
    assert "backend: cannot be had" in output  # and the rest is printed
    pasted = output.partition("For maze.yaml:")[2]
    changed = validate(parse(pasted, "a"), RunConfig)
    assert (changed.pose_cells, changed.simulation.fidelity) == (
        first.pose_cells.model_copy(update={"cells_xy": changed.pose_cells.cells_xy}), "kinematic",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("content", "arguments", "named"),
    [
        ("simulation: {}\n", ["--cycles", "3"], "--cycles"),
        (f"recording: {{file: {GOLDEN}/a_square3.npz}}\nbackend: grid\n", [], "without whiskers"),
        ("recording: {file: still.csv, table: {pose: {}}}\n", [], "never moves"),
    ],
)
def test_unfit_input_is_one_clear_error(content, arguments, named, tmp_path, capsys):
    (tmp_path / "config.yaml").write_text(content)
    rows = "".join(f"{k},0,0,0\n" for k in range(99))
    (tmp_path / "still.csv").write_text(f"t,x,y,heading\n{rows}")
    assert main(["size", str(tmp_path / "config.yaml"), *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ratslam: error: ")
    assert named in line


SQUARE, MAZE = ROOT / "configs" / "square.yaml", ROOT / "configs" / "whisker_maze.yaml"
CELLS = "pose_cells: {cells_xy: 11, cells_heading: 12}\n"
SMALL = (
    "simulation: {maze: {columns: 3, rows: 2, loop: 6}, path: {circuits: C}, whisking: {rate: 0.5}}\n"
    f"{CELLS}backend: classic\n"
)
TINY = "simulation: {maze: {columns: 2, rows: 2, loop: 4}, path: {circuits: CC}, raw: true}\n" + CELLS


@pytest.mark.parametrize("name", sorted(set(PRESETS) - {"tiers", "growth", "cells"}))
def test_a_preset_keeps_the_seed_of_the_configuration_and_takes_overrides(name):
    study, _ = preset_study(name, SQUARE, ["session.seed=7", "recall.guard=3"])
    assert study.name == f"square-{name}"
    assert {job.seed for job in study.jobs} == ({0, 1, 2} if name == "pareto" else {7})
    guards = {job.config.recall.guard for job in study.jobs}
    assert guards == ({2, 3, 4} if name == "vary" else {3})


def test_rows_turn_parts_off_or_take_other_backends():
    study, _ = preset_study("ablate", SQUARE, ["copies=3"])
    assert list(dict.fromkeys(job.row for job in study.jobs)) == list(PARTS)
    assert len({job.key for job in study.jobs}) == len(study.jobs) == 3 * len(PARTS)
    for base in (MAZE, ROOT / "configs" / "create_arena.yaml"):
        study, _ = preset_study("backends", base)
        assert [job.config.backend for job in study.jobs] == ["recall", "grid"]
    study, _ = preset_study("pareto", MAZE)
    grids = [
        job.config.grid.particles for job in study.jobs if job.config.backend == "grid" and job.seed == 0
    ]
    assert grids == list(PARTICLES)
    assert study.jobs[-1].config.simulation.fidelity == "quasistatic"


def test_every_number_is_varied_in_both_directions_within_its_limits():
    found = variations(override(load(SQUARE), ["recall.local=0.9"]), 0.2)
    names = [name for name, _ in found]
    for name in ("recall.excite", "keyframes.min_score", "keyframes.noise.per_cell"):
        assert names.count(name) == 2
    assert names.count("recall.local") == 1  # a share: it cannot exceed 1
    assert {("recall.guard", 16), ("recall.guard", 24)} <= set(found)
    study, _ = preset_study("vary", SQUARE)
    assert len(study.jobs) == 1 + len(variations(load(SQUARE), 0.2))


def test_perturbed_copies_are_run_beside_the_session(tmp_path, capsys):
    (tmp_path / "c.yaml").write_text(SMALL)
    command = ["study", "--preset", "spread", str(tmp_path / "c.yaml"), "--set", "copies=2"]
    assert main([*command, "-o", str(tmp_path / "out"), "--workers", "1"]) == 0
    rows = [line.split("|")[1].strip() for line in capsys.readouterr().out.splitlines()[2:5]]
    assert rows == ["as recorded", "perturbed", "dead reckoning"]
    assert [each.copy_number for each in RunLog(tmp_path / "out").records.values()] == [0, 1, 2]


@pytest.mark.soak
def test_tiers_are_compared_by_cost_and_images(tmp_path, capsys, monkeypatch):
    monkeypatch.delitem(METHODS, "recall")  # one kernel less to compile
    (tmp_path / "tiny.yaml").write_text(TINY)
    command = ["study", "--preset", "tiers", str(tmp_path / "tiny.yaml"), "--seconds", "60"]
    assert main([*command, "-o", str(tmp_path / "out"), "--workers", "1"]) == 0
    rows = json.loads((tmp_path / "out" / "table.json").read_text())["rows"]
    assert [row["row"] for row in rows] == [f"{name}, classic" for name in TIERS]
    cost, contact, height = (
        [row["spreads"][name]["median"] for row in rows]
        for name in ("simulation_time", "contact_difference", "height_difference")
    )
    assert cost[0] < min(cost[1:]) / 3
    assert contact[2] == height[2] == 0
    assert 0 < height[0] < 5
    assert contact[0] < 0.04
    assert "auto takes quasistatic" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "path", "overrides", "options", "named"),
    [
        ("tiers", "recorded.yaml", [], {}, "a scene to simulate"),
        ("tiers", "recorded.yaml", [], {"seconds": 0}, "--seconds"),
        ("ablate", SQUARE, ["recall.reach=-1"], {}, "recall.reach"),
        ("spread", "none.yaml", [], {}, "none.yaml"),
        ("vary", SQUARE, [], {"by": 0}, "--by"),
        ("vary", SQUARE, [], {"by": 1.0}, "--by"),
    ],
)
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
