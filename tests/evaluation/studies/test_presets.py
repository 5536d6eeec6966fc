"""Presets: the studies made from a configuration."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from evaluation.studies.commands import PRESETS
from evaluation.studies.presets import METHODS, PARTS, TIERS, preset_study, variations
from evaluation.studies.run_job import RunLog
from evaluation.studies.scene_statistics import shortened
from ratslam.cli import main
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import load, override
from tactile.base.errors import InputError

ROOT = Path(__file__).parents[3]
SQUARE, MAZE = ROOT / "configs" / "square.yaml", ROOT / "configs" / "whisker_maze.yaml"
SMALL = """
simulation: {maze: {columns: 3, rows: 2, loop: 6}, path: {circuits: C}, whisking: {rate: 0.5}}
pose_cells: {cells_xy: 11, cells_heading: 12}
backend: classic
"""
CELLS = "pose_cells: {cells_xy: 11, cells_heading: 12}\n"
TINY = "simulation: {maze: {columns: 2, rows: 2, loop: 4}, path: {circuits: CC}, raw: true}\n" + CELLS


def preset(name, path=SQUARE, *overrides, **options):
    return preset_study(name, path, overrides, **options)


@pytest.mark.parametrize("name", sorted(set(PRESETS) - {"tiers", "growth", "cells"}))
def test_a_preset_keeps_the_seed_of_the_configuration_and_takes_overrides(name):
    study, _ = preset(name, SQUARE, "session.seed=7", "recall.guard=3")
    assert study.name == f"square-{name}"
    jobs = study.jobs
    assert {job.seed for job in jobs} == ({0, 1, 2} if name == "pareto" else {7})
    assert {job.config.recall.guard for job in jobs} & {3}
    if name != "vary":
        assert {job.config.recall.guard for job in jobs} == {3}


def test_every_part_is_turned_off_in_a_row_of_its_own():
    study, _ = preset("ablate", SQUARE)
    jobs = study.jobs
    assert [job.row for job in jobs] == list(PARTS)
    assert len({job.key for job in jobs}) == len(PARTS)
    assert "classic" in {job.config.backend for job in jobs}
    assert len(preset("ablate", SQUARE, "copies=3")[0].jobs) == 3 * len(PARTS)


def test_every_number_is_varied_in_both_directions_within_its_limits():
    found = variations(override(load(SQUARE), ["recall.local=0.9"]), 0.2)
    names = [name for name, _ in found]
    assert names.count("recall.excite") == names.count("keyframes.min_score") == 2
    assert names.count("keyframes.noise.per_cell") == 2
    assert names.count("recall.local") == 1  # a share: it cannot exceed 1
    assert ("recall.guard", 16) in found
    assert ("recall.guard", 24) in found
    assert len(preset("vary")[0].jobs) == 1 + len(variations(load(SQUARE), 0.2))
    with pytest.raises(InputError, match="--by"):
        preset("vary", by=1.0)


def test_backends_are_recall_or_the_configured_one_and_the_grid():
    assert [job.config.backend for job in preset("backends", MAZE)[0].jobs] == ["recall", "grid"]
    configured, _ = preset("backends", ROOT / "configs" / "create_arena.yaml")
    assert [job.config.backend for job in configured.jobs] == ["recall", "grid"]


def test_perturbed_copies_are_run_beside_the_session(tmp_path, capsys):
    output = tmp_path / "out"
    (tmp_path / "c.yaml").write_text(SMALL)
    command = ["study", "--preset", "spread", str(tmp_path / "c.yaml"), "--set", "copies=2"]
    assert main([*command, "-o", str(output), "--workers", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("|")[1].strip() for line in lines[2:5]] == [
        "as recorded",
        "perturbed",
        "dead reckoning",
    ]
    copies = [each.copy_number for each in RunLog(output).records.values()]
    assert copies == [0, 1, 2]


@pytest.mark.soak
def test_both_backends_see_the_same_session(tmp_path, capsys):
    quick = ["create_simulation.reports=20", "backend=classic", "pose_cells.cells_xy=11"]
    quick += ["pose_cells.cells_heading=12"]
    config = str(ROOT / "configs" / "create_arena.yaml")
    command = ["study", "--preset", "backends", config, *(f"--set={one}" for one in quick)]
    assert main([*command, "-o", str(tmp_path / "out"), "--workers", "1"]) == 0
    content = json.loads((tmp_path / "out" / "table.json").read_text())
    rat, grid, reckoned = content["rows"]
    assert [row["row"] for row in content["rows"]] == ["classic", "grid", "dead reckoning"]
    assert len({each.source for each in RunLog(tmp_path / "out").records.values()}) == 1
    for row in (rat, grid, reckoned):
        assert row["steps"] == 20
        assert 0 < row["spreads"]["error_final"]["median"] < 3
        assert 0 < row["spreads"]["ate_final"]["median"] < 3
    assert "step_time" not in reckoned["spreads"]


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
    assert cost[0] < cost[1] / 3
    assert cost[0] < cost[2] / 3
    assert contact[2] == height[2] == 0
    assert 0 < height[0] < 5
    assert contact[0] < 0.04
    assert "Fidelity: auto takes quasistatic: raw samples" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (["tiers", "recorded.yaml"], "a scene to simulate"),
        (["tiers", "recorded.yaml", "--seconds", "0"], "--seconds"),
        (["ablate", str(SQUARE), "--set", "recall.reach=-1"], "recall.reach"),
        (["spread", "none.yaml"], "none.yaml"),
        (["vary", str(SQUARE), "--by", "0"], "--by"),
    ],
)
def test_bad_input_is_refused_before_anything_runs(tmp_path, capsys, monkeypatch, command, expected):
    monkeypatch.chdir(tmp_path)
    Path("recorded.yaml").write_text("recording: {file: a.npz}\n")
    assert main(["study", "--preset", *command]) == 2
    assert expected in capsys.readouterr().err
    assert not Path("runs").exists()


def test_the_error_of_a_run_is_reported_unchanged(tmp_path, capsys):
    command = ["study", "--preset", "backends", str(SQUARE), "-o", str(tmp_path / "out"), "--workers", "1"]
    assert main([*command, "--set", "recording.file=nothing.npz"]) == 2
    assert "nothing.npz" in capsys.readouterr().err


def test_sessions_are_shortened_to_whole_laps_or_to_a_time():
    def path(seconds, **given):
        config = RunConfig.model_validate({"simulation": {"path": given}})
        return shortened(config, seconds).simulation.path

    whole = path(1e9, circuits="CCCAAACACA").circuits
    assert whole == "CCCAAACACA"
    some = path(700.0, circuits=whole).circuits
    assert whole.startswith(some)
    assert 3 <= len(some) <= 5
    assert len(path(1.0, circuits=whole).circuits) == 2
    assert path(100.0, explore=500.0).explore == 100
    assert path(100.0, explore=50.0).explore == 50
