"""Settings for a scene: recommendations that follow from it, and the cheaper steps that are tried."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.metrics.metric import Quantity
from evaluation.studies.recommendation import (
    FEWEST,
    MEMORY,
    MOST,
    PARTICLES,
    PARTS,
    SLOW,
    changed_settings_yaml,
    cheaper_steps,
    recommend,
    round_number,
)
from evaluation.studies.run_job import RunRecord
from evaluation.studies.scene_statistics import Scene, scene_of, short_session, with_tier
from evaluation.studies.study import with_settings
from ratslam.classic.pose_cells import LARGEST_SUBSTEP
from ratslam.cli import main
from ratslam.grid.particles import LAYERS
from ratslam.runs.build_session import open_source
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import override, parse, validate

ROOT = Path(__file__).parents[3]
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
    found = round_number(value, side)
    assert value / 2.5 <= found <= value * 2.5
    assert (found - value) * side >= 0
    assert round_number(found, side) == found


@given(CONFIGS, scenes())
def test_proposals_fit_the_scene_and_are_stable(config, scene):
    found = {each.key: each.value for each in recommend(config, scene)}
    proposed = with_settings(config, found)
    if config.backend != "grid":
        size, across = found["pose_cells.cell_size"], found["pose_cells.cells_xy"]
        assert scene.most / size <= PARTS * LARGEST_SUBSTEP + 1e-9
        assert scene.usual / size >= SLOW - 1e-9 or scene.most / size > 1
        assert across * size >= max(scene.span) or across == MOST or config.backend == "recall"
        assert across >= FEWEST
    else:
        side = int(np.ceil(proposed.grid.side / proposed.grid.cell))
        assert PARTICLES[0] <= proposed.grid.particles <= PARTICLES[1]
        assert proposed.grid.particles * LAYERS * side**2 * 4 <= MEMORY * 2**20
    fixed = config.model_copy(update={"backend": proposed.backend})  # what is proposed for recall, for recall
    again = with_settings(fixed, {each.key: each.value for each in recommend(fixed, scene)})
    assert not [each.key for each in recommend(again, scene) if each.changed]


@given(CONFIGS, scenes())
def test_the_snippet_makes_the_configuration_the_proposed_one(config, scene):
    found = recommend(config, scene)
    text = changed_settings_yaml(found)
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
    for settings in cheaper_steps(config).values():
        less = with_settings(config, settings)
        assert less != config
        again = RunConfig.model_validate(less.model_dump(exclude_unset=True))
        assert again.pose_cells.cells_xy <= max(config.pose_cells.cells_xy, FEWEST)
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
    config = configuration(simulation={"path": {"explore": 400.0}})
    with open_source(short_session(config, 100, tmp_path)) as source:
        assert 80 <= source.length <= 110
    config = configuration(create_simulation={"reports": 500})
    with open_source(short_session(config, 60, tmp_path)) as source:
        assert source.length == 60
    for name in ("a_square3.npz", "touch_circuits.mcap"):
        (tmp_path / name).mkdir()
        config = configuration(recording={"file": str(GOLDEN / name)})
        with open_source(config) as whole, open_source(short_session(config, 37, tmp_path / name)) as part:
            assert part.view_shape == whole.view_shape
            assert part.whiskers == whole.whiskers
            both = zip(part, islice(whole, 37), strict=True)
            for mine, theirs in both:
                assert mine.time == theirs.time
                assert np.array_equal(mine.truth, theirs.truth)
                for a, b in zip(mine.reading, theirs.reading, strict=True):
                    assert np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True)


@pytest.mark.soak
def test_a_small_arena_is_sized(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "evaluation.studies.recommendation.cheaper_steps",
        lambda config: dict(islice(cheaper_steps(config).items(), 1)),
    )  # less to compile
    path = tmp_path / "arena.yaml"
    path.write_text("create_simulation: {reports: 80}\nbackend: grid\nsession: {precision: float32}\n")
    assert main(["size", str(path), "--cycles", "60"]) == 0
    output = capsys.readouterr().out
    assert "60 of 80 cycles" in output
    rows = [line for line in output.splitlines() if line.startswith(("| recommended", "| 33 particles"))]
    assert len(rows) == 2
    assert "%" in rows[1]
    assert "%" not in rows[0]
    assert output.rstrip().endswith("arena.yaml has these settings already")


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
    ("content", "arguments", "expected"),
    [
        ("simulation: {}\n", ["--cycles", "3"], "--cycles"),
        ("simulation: {mase: {}}\n", [], "mase"),
        ("recording: {file: none.npz}\n", [], "none.npz"),
        ("simulation: {}\npose_cells: {cells_xy: 3}\n", [], "cells_xy"),
        (f"recording: {{file: {GOLDEN}/a_square3.npz}}\nbackend: grid\n", [], "without whiskers"),
        ("recording: {file: still.csv, table: {pose: {}}}\n", [], "never moves"),
    ],
)
def test_bad_input_is_one_clear_error(content, arguments, expected, tmp_path, capsys):
    (tmp_path / "config.yaml").write_text(content)
    rows = "".join(f"{k},0,0,0\n" for k in range(99))
    (tmp_path / "still.csv").write_text(f"t,x,y,heading\n{rows}")
    assert main(["size", str(tmp_path / "config.yaml"), *arguments]) == 2
    output = capsys.readouterr().err.splitlines()
    assert len(output) == 1
    assert output[0].startswith("ratslam: error: ")
    assert expected in output[0]
