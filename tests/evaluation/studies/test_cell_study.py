"""Studies of many networks: equal bytes however they are computed, packets of the classic backend, errors."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from evaluation.studies.cell_study import (
    FOLDER,
    PARAMETERS,
    cell_study,
    run_cell_study,
)
from evaluation.studies.executor import Executor
from evaluation.studies.network_batch import CellSets, walk
from evaluation.studies.study_course import expected_poses, read_course
from ratslam.cli import main
from ratslam.runs.build_session import build_session, open_observations, read_observations
from ratslam.runs.settings.run_config import load_config

ROOT = Path(__file__).parents[3]
SMALL = ["sets=4", "steps=100", "chunk=2", "bins=5", "pose_cells.cells_xy=11", "pose_cells.cells_heading=12"]
PATIENCE = 240.0


@pytest.fixture
def box(tmp_path):
    """A configuration whose source is a trace of a random walk in a box of 1 m."""

    def write(steps: int = 200, **changed: np.ndarray | None) -> Path:
        stream = np.random.default_rng(4)
        turn, pose, truth = 0.0, np.array([0.5, 0.5, 0.0]), []
        speed = np.full(steps, 0.2)
        rate = np.zeros(steps)
        for k in range(steps):
            turn += 0.1 * (-turn / 0.2) + 3.0 * np.sqrt(0.1) * stream.standard_normal() * 0.5
            middle = np.arctan2(0.5 - pose[1], 0.5 - pose[0]) - pose[2]
            outside = np.abs(pose[:2] - 0.5).max() > 0.4
            rate[k] = 6 * np.sin(middle) if outside else turn
            if k:
                pose = pose + [0, 0, 0.1 * rate[k]]
                pose = pose + 0.02 * np.array([np.cos(pose[2]), np.sin(pose[2]), 0])
            truth.append(pose)
        columns = {
            "in_t": 0.1 * np.arange(steps), "in_v": speed, "in_w": rate,
            "in_flags": np.full(steps, 3), "in_view": stream.random((steps // 4, 18)).repeat(4, axis=0),
            "truth": np.array(truth),
        }  # fmt: skip
        columns["params_json"] = np.array('{"template_y_size": 3, "template_x_size": 6}')
        columns |= changed
        np.savez(tmp_path / "walk.npz", **{key: value for key, value in columns.items() if value is not None})
        path = tmp_path / "box.yaml"
        path.write_text("recording: {file: walk.npz}\n")
        return path

    return write


def chunks(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / FOLDER).iterdir()}


def sets_of(arguments: list[str]) -> list[str]:
    return [part for each in arguments for part in ("--set", each)]


def test_without_noise_the_packet_follows_the_truth(box, tmp_path):
    values = dict(zip(PARAMETERS, (1.0, 2.0, 2e-5, 1.0, 0.0, 0.0), strict=True))
    fixed = [f"{name}=[{value}, {value}]" for name, value in values.items()]
    study = cell_study(box(), ["steps=200", "sets=1", "precision=float64", *fixed])
    with Executor(1) as executor:
        scores = run_cell_study(study, tmp_path / "out", executor)
    assert scores["drift"][0] < 0.02  # a fifth of a cell
    assert scores["drift_heading"][0] < 0.05
    assert scores["decoding"][0] <= scores["drift"][0]
    assert not scores["reseeded"].any()
    course = study.course
    visited = np.bincount(course.bin, minlength=400).reshape(20, 20) > 0
    assert (np.isfinite(scores["maps"][0]) == visited).all()
    assert (np.nanmax(scores["maps"][0], axis=(1, 2)) > 1e-3).all()  # each cell lies on the way


def test_expected_poses_start_in_the_middle_of_the_torus_and_keep_lengths(box):
    course = read_course(load_config(box()), 200, False, 5, (), 0)
    truth = np.load(box().parent / "walk.npz")["truth"]
    assert np.allclose(course.expected[0], [10, 10, 18])
    moved = np.hypot(*np.diff(course.expected[:, :2], axis=0).T) * course.config.cell_size
    assert np.allclose(moved, np.hypot(*np.diff(truth[:, :2], axis=0).T))
    again = expected_poses(course.config, truth + [3.0, -2.0, 0.0])
    assert np.allclose(again, course.expected)


def test_every_position_lies_in_its_bin(box):
    course = read_course(load_config(box()), 200, False, 7, (), 0)
    truth = np.load(box().parent / "walk.npz")["truth"]
    row, column = np.divmod(course.bin, 7)
    for edges, at, values in ((course.x_edges, column, truth[:, 0]), (course.y_edges, row, truth[:, 1])):
        assert (values >= edges[at] - 1e-12).all()
        assert (values <= edges[at + 1] + 1e-12).all()


def test_a_larger_study_contains_a_smaller_one(box):
    few, many = (cell_study(box(), [*SMALL, f"sets={sets}"]) for sets in (5, 9))
    assert np.array_equal(many.parameters[:5], few.parameters)
    for name, column in zip(PARAMETERS, many.parameters.T, strict=True):
        low, high = getattr(many.plan, name)
        assert (column >= low).all()
        assert (column <= high).all()


@pytest.mark.soak
def test_views_give_the_packets_of_the_classic_backend():
    config = load_config("square", ["session.precision=float64"])
    course = read_course(config, 240, True, 5, (), 0)
    one = [np.array([value]) for value in (1.0, 2.0, 2e-5, 1.0, 0.0, 0.0)]
    sets = CellSets(*one)
    tracks = list(walk(course.config, sets, course.course, course.chosen))
    packets = np.concatenate([track.pose[0] for track in tracks])
    with open_observations(config.model_copy(update={"backend": "classic"})) as (whole, source):
        seen = [observation for _, observation in read_observations(source)][:240]
        rows = [
            one._replace(odometry=one.odometry._replace(dx=dx, dy=dy, dtheta=dtheta))
            for one, (dx, dy, dtheta) in zip(seen, course.course.motion, strict=True)
        ]
        steps = list(build_session(whole, source).replay(rows))
    expected = np.array([step.evidence.packet for step in steps])
    assert np.sum(course.course.energy > 0) > 10
    assert np.abs(packets - expected).max() <= 1e-9


@pytest.mark.soak
def test_bytes_do_not_depend_on_workers(box, tmp_path, monkeypatch):
    for name in ("compilation_cache_dir", "persistent_cache_min_compile_time_secs",
                 "persistent_cache_min_entry_size_bytes"):  # fmt: skip
        monkeypatch.setenv(f"JAX_{name.upper()}", str(getattr(jax.config, f"jax_{name}")))
    study = cell_study(box(), SMALL)
    with Executor(1) as executor:
        run_cell_study(study, tmp_path / "one", executor)
    with Executor(2) as executor:
        run_cell_study(study, tmp_path / "two", executor)
    assert chunks(tmp_path / "two") == chunks(tmp_path / "one")


def test_bytes_do_not_depend_on_interrupts(box, tmp_path):
    study = cell_study(box(), SMALL)
    with Executor(1) as executor:
        scores = run_cell_study(study, tmp_path / "one", executor)
    alone = chunks(tmp_path / "one")
    assert len(alone) == 2
    (tmp_path / "one" / FOLDER / sorted(alone)[0]).unlink()
    counted: list[int] = []
    with Executor(1) as executor:
        again = run_cell_study(study, tmp_path / "one", executor, counted.append)
    assert chunks(tmp_path / "one") == alone
    assert counted == [2, 2]
    for name, column in scores.items():
        assert np.array_equal(column, again[name], equal_nan=True)


def test_a_larger_study_computes_only_what_is_new(box, tmp_path):
    with Executor(1) as executor:
        run_cell_study(cell_study(box(), SMALL), tmp_path, executor)
        before = chunks(tmp_path)
        scores = run_cell_study(cell_study(box(), [*SMALL, "sets=5"]), tmp_path, executor)
    assert before.items() < chunks(tmp_path).items()
    assert len(chunks(tmp_path)) == 3
    assert scores["maps"].shape == (5, 8, 5, 5)


def test_the_program_writes_table_maps_and_pictures(box, tmp_path, capsys):
    output = tmp_path / "out"
    assert main(["study", "--preset", "cells", str(box()), *sets_of([*SMALL, "views=true"]), "--workers", "1",
                 "-o", str(output)]) == 0  # fmt: skip
    text = capsys.readouterr().out
    assert (output / "table.md").read_text().strip() in text
    with (output / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["set"]) for row in rows] == [0, 1, 2, 3]
    assert all(float(row["drift"]) > 0 for row in rows)
    with np.load(output / "maps.npz") as maps:
        assert maps["maps"].shape == (4, 8, 5, 5)
    for name in ("drift.png", "decoding.png", "maps.png"):
        assert (output / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.soak
def test_a_killed_study_continues_with_the_same_bytes(box, tmp_path):
    arguments = ["study", "--preset", "cells", str(box()), *sets_of([*SMALL, "sets=40"]), "--workers", "1"]
    program = [sys.executable, "-m", "ratslam", *arguments]
    assert subprocess.run([*program, "-o", str(tmp_path / "whole")], cwd=ROOT, check=False).returncode == 0
    process = subprocess.Popen([*program, "-o", str(tmp_path / "cut")], cwd=ROOT, start_new_session=True)
    end = time.monotonic() + PATIENCE
    while not (tmp_path / "cut" / FOLDER).exists() or not chunks(tmp_path / "cut"):
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait(PATIENCE)
    assert subprocess.run([*program, "-o", str(tmp_path / "cut")], cwd=ROOT, check=False).returncode == 0
    assert (tmp_path / "cut" / "table.csv").read_bytes() == (tmp_path / "whole" / "table.csv").read_bytes()
    whole = chunks(tmp_path / "whole")
    assert {name: data for name, data in chunks(tmp_path / "cut").items() if name in whole} == whole


def still(steps: int = 200) -> dict[str, np.ndarray]:
    return {"truth": np.zeros((steps, 3)), "in_v": np.zeros(steps), "in_w": np.zeros(steps)}


@pytest.mark.parametrize(
    ("changed", "more", "expected"),
    [
        ({}, ["sett=3"], "sett"),
        ({}, ["excite_sigma=[1.2, 0.8]"], "lower end"),
        ({}, ["excite_sigma=[0.0, 0.8]"], "greater than 0"),
        ({}, ["chosen=[15876]"], "indices below 15876"),
        ({}, ["pose_cells.cell_size=0.001"], "less than half the torus"),
        ({"truth": None}, [], "no true poses"),
        ({"in_flags": np.full(200, 2)}, ["views=true"], "no views"),
        (still(), [], "stays in one place"),
    ],
)
def test_bad_input_is_one_clear_error(box, tmp_path, capsys, changed, more, expected):
    output = tmp_path / "out"
    path = box(**changed)
    assert main(["study", "--preset", "cells", str(path), *sets_of(more), "-o", str(output)]) == 2
    assert expected in capsys.readouterr().err
    assert not output.exists()


def test_an_unknown_pose_on_the_way_is_named(box, tmp_path, capsys):
    path = box()
    with np.load(path.parent / "walk.npz") as found:
        truth = found["truth"].copy()
    truth[17] = np.nan
    assert main(["study", "--preset", "cells", str(box(truth=truth)), "-o", str(tmp_path / "out")]) == 2
    assert "17" in capsys.readouterr().err


@pytest.mark.parametrize("option", [["--search"], ["--error", "ate"]])
def test_options_of_other_studies_are_refused(box, capsys, option):
    assert main(["study", "--preset", "cells", str(box()), *option]) == 2
    assert option[0] in capsys.readouterr().err
