"""Studies of many networks: equal networks one by one, equal bytes however they are computed, errors."""

import csv
import signal
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evaluation.studies.cell_study import FOLDER, PARAMETERS, cell_study, run_cell_study
from evaluation.studies.executor import Executor
from evaluation.studies.network_batch import SEGMENT, CellCourse, CellSets, walk
from evaluation.studies.study_course import expected_poses, read_course
from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig, rings, units
from ratslam.classic.excitation_inhibition import ring_difference
from ratslam.classic.levels import to_full_torus, window_levels
from ratslam.cli import main
from ratslam.runs.build_session import build_session, open_observations, read_observations
from ratslam.runs.settings.run_config import load_config
from tactile.base.errors import InputError
from tactile.base.types import Odometry
from tests.evaluation.studies.conftest import kill, preset, wait_until
from tests.helpers.commands import said, start

SMALL = ["sets=4", "steps=100", "chunk=2", "bins=5", "pose_cells.cells_xy=11", "pose_cells.cells_heading=12"]
STILL = {"truth": np.zeros((200, 3)), "in_v": np.zeros(200), "in_w": np.zeros(200)}


@pytest.fixture
def box(tmp_path):
    """A configuration whose source is a trace of loops of some 0.3 m."""

    def write(**changed: np.ndarray | None) -> Path:
        steps = np.arange(200)
        rate = 0.6 + 0.9 * np.sin(0.13 * steps)
        heading = np.cumsum(0.1 * rate) - 0.1 * rate[0]
        forward = 0.02 * np.where(steps > 0, [np.cos(heading), np.sin(heading)], 0)
        columns = {
            "in_t": 0.1 * steps, "in_v": np.full(200, 0.2), "in_w": rate, "in_flags": np.full(200, 3),
            "in_view": np.random.default_rng(4).random((50, 18)).repeat(4, axis=0),
            "truth": np.column_stack([*(0.5 + np.cumsum(forward, axis=1)), heading]),
            "params_json": np.array('{"template_y_size": 3, "template_x_size": 6}'),
        }  # fmt: skip
        columns |= changed
        np.savez(tmp_path / "walk.npz", **{key: value for key, value in columns.items() if value is not None})
        path = tmp_path / "box.yaml"
        path.write_text("recording: {file: walk.npz}\n")
        return path

    return write


def chunks(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / FOLDER).iterdir()}


def command(path: Path, assignments: list[str], output: Path) -> list[str]:
    return [*preset("cells", path, assignments, output), "--workers", "1"]


def test_without_noise_the_packet_follows_the_truth(box, tmp_path):
    values = dict(zip(PARAMETERS, (1.0, 2.0, 2e-5, 1.0, 0.0, 0.0), strict=True))
    fixed = [f"{name}=[{value}, {value}]" for name, value in values.items()]
    study = cell_study(box(), ["steps=200", "sets=1", "precision=float64", *fixed])
    with Executor(1) as executor:
        scores = run_cell_study(study, tmp_path / "out", executor)
    assert scores["decoding"][0] <= scores["drift"][0] < 0.02  # a fifth of a cell
    assert scores["drift_heading"][0] < 0.05
    assert not scores["reseeded"].any()
    visited = np.bincount(study.course.bin, study.course.seconds, 400).reshape(20, 20) > 0
    assert (np.isfinite(scores["maps"][0]) == visited).all()
    assert (np.nanmax(scores["maps"][0], axis=(1, 2)) > 1e-3).all()  # each cell lies on the way


def test_a_course_starts_in_the_middle_of_the_torus_and_every_position_lies_in_its_bin(box):
    course = read_course(load_config(box()), 200, False, 7, (), 0)
    truth = np.load(box().parent / "walk.npz")["truth"]
    assert np.allclose(course.expected[0], [10, 10, 18])
    moved = np.hypot(*np.diff(course.expected[:, :2], axis=0).T) * course.config.cell_size
    assert np.allclose(moved, np.hypot(*np.diff(truth[:, :2], axis=0).T))
    assert np.allclose(expected_poses(course.config, truth + [3.0, -2.0, 0.0]), course.expected)
    row, column = np.divmod(course.bin, 7)
    for edges, at, values in ((course.x_edges, column, truth[:, 0]), (course.y_edges, row, truth[:, 1])):
        assert (np.clip(values, edges[at] - 1e-12, edges[at + 1] + 1e-12) == values).all()


@pytest.mark.soak
def test_views_give_the_packets_of_the_classic_backend():
    config = load_config("square", ["session.precision=float64"])
    course = read_course(config, 240, True, 5, (), 0)
    sets = CellSets(*(np.array([value]) for value in (1.0, 2.0, 2e-5, 1.0, 0.0, 0.0)))
    tracks = list(walk(course.config, sets, course.course, course.chosen))
    packets = np.concatenate([track.pose[0] for track in tracks])
    with open_observations(config.model_copy(update={"backend": "classic"})) as (whole, source):
        seen = [observation for _, observation in read_observations(source)][:240]
        rows = [
            one._replace(odometry=one.odometry._replace(dx=dx, dy=dy, dtheta=dtheta))
            for one, (dx, dy, dtheta) in zip(seen, course.course.motion, strict=True)
        ]
        steps = list(build_session(whole, source).replay(rows))
    assert np.sum(course.course.energy > 0) > 10
    assert np.abs(packets - np.array([step.evidence.packet for step in steps])).max() <= 1e-9


def test_an_interrupted_or_larger_study_computes_only_what_is_missing(box, tmp_path):
    study, larger = cell_study(box(), SMALL), cell_study(box(), [*SMALL, "sets=5"])
    assert np.array_equal(larger.parameters[:4], study.parameters)
    for name, column in zip(PARAMETERS, larger.parameters.T, strict=True):
        low, high = getattr(larger.plan, name)
        assert ((column >= low) & (column <= high)).all()
    counted: list[int] = []
    with Executor(1) as executor:
        scores = run_cell_study(study, tmp_path, executor)
        before = chunks(tmp_path)
        assert len(before) == 2
        (tmp_path / FOLDER / sorted(before)[0]).unlink()
        again = run_cell_study(study, tmp_path, executor, counted.append)
        assert chunks(tmp_path) == before
        assert counted == [2, 2]
        more = run_cell_study(larger, tmp_path, executor)
    for name, column in scores.items():
        assert np.array_equal(column, again[name], equal_nan=True)
    assert before.items() < chunks(tmp_path).items()
    assert len(chunks(tmp_path)) == 3
    assert more["maps"].shape == (5, 8, 5, 5)


def test_the_program_writes_table_maps_and_pictures(box, tmp_path, capsys):
    output = tmp_path / "out"
    printed = said(capsys, *command(box(), [*SMALL, "views=true"], output))
    assert (output / "table.md").read_text().strip() in printed
    rows = list(csv.DictReader((output / "table.csv").read_text().splitlines()))
    assert [int(row["set"]) for row in rows] == [0, 1, 2, 3]
    assert all(float(row["drift"]) > 0 for row in rows)
    with np.load(output / "maps.npz") as maps:
        assert maps["maps"].shape == (4, 8, 5, 5)
    assert {path.name for path in output.glob("*.png")} >= {"drift.png", "decoding.png", "maps.png"}


@pytest.mark.soak
def test_a_killed_study_continues_with_the_same_bytes_with_another_number_of_workers(box, tmp_path):
    whole, cut = (command(box(), [*SMALL, "sets=40"], tmp_path / name) for name in ("whole", "cut"))
    whole[-1] = "2"
    assert main(whole) == 0
    process = start(*cut)
    wait_until(lambda: (tmp_path / "cut" / FOLDER).exists() and chunks(tmp_path / "cut"), process)
    kill(process, signal.SIGKILL)
    assert main(cut) == 0
    assert (tmp_path / "cut" / "table.csv").read_bytes() == (tmp_path / "whole" / "table.csv").read_bytes()
    assert chunks(tmp_path / "whole").items() <= chunks(tmp_path / "cut").items()


@pytest.mark.parametrize(("changed", "more", "named"), [
    ({}, ["sett=3"], "sett"),
    ({}, ["excite_sigma=[1.2, 0.8]"], "excite_sigma"),
    ({}, ["excite_sigma=[0.0, 0.8]"], "excite_sigma"),
    ({}, ["chosen=[15876]"], "15876"),
    ({}, ["pose_cells.cell_size=0.001"], "torus"),
    ({"truth": None}, [], "no true poses"),
    ({"truth": np.where(np.arange(200)[:, None] == 17, np.nan, np.ones(3))}, [], "17"),
    ({"in_flags": np.full(200, 2)}, ["views=true"], "no views"),
    (STILL, [], "stays in one place"),
])  # fmt: skip
def test_unfit_settings_and_sessions_are_refused(box, changed, more, named):
    with pytest.raises(InputError, match=named):
        cell_study(box(**changed), more)


CONFIG = NetworkConfig(cells_xy=21)
STEPS = SEGMENT + 70
SETS = [(0.9, 2.3, 1e-5, 1.0, 0.2, 0.1), (1.1, 1.8, 3e-5, 2.0, 0.1, 0.0), (1.0, 2.0, 2e-5, 1.0, 0.0, 0.0)]
CHOSEN = [18 * 441 + 10 * 21 + 10, 17 * 441 + 11 * 21 + 9, 0]


def sets() -> CellSets:
    return CellSets(*(np.array(column) for column in zip(*SETS, strict=True)))


def course(views: bool) -> CellCourse:
    """A random drive; with views, templates learnt and seen again farther away than the window reaches."""
    stream = np.random.default_rng(3)
    motion = stream.normal(0, 0.3, (STEPS, 3)) * units(CONFIG, np.dtype(float))
    template, novel, energy = np.zeros(STEPS, np.int32), np.zeros(STEPS, bool), np.zeros(STEPS)
    turned = np.zeros(STEPS)
    if views:
        novel[[5, 20]], template[20:90] = True, 1
        energy[[30, 31, 90, 95, 150]], turned[90] = 0.12, 9.0
        template[150:] = 1
    return CellCourse(motion, stream.standard_normal((STEPS, 2)), template, novel, turned, energy)


def alone(row: tuple[float, ...], given: CellCourse) -> tuple[np.ndarray, np.ndarray]:
    """Packets [T, 3] and activity [T, C] of one dense network, each step fed from here."""
    excite, inhibit, threshold, factor, speed, heading = row
    changed = {"excite_sigma": excite, "inhibit_sigma": inhibit, "global_inhibition": threshold}
    config = CONFIG.model_copy(update=changed | {"engine": "dense"})
    levels = window_levels(config, np.dtype(float))
    step = jax.jit(lambda cells, *row: pose_cells.step(config, levels, cells, *row)[0])
    cells, packet, poses, active = pose_cells.start(config, np.dtype(float)), {}, [], []
    for motion, noise, template, novel, turned, energy in zip(*given, strict=True):
        if novel:
            packet[int(template)] = np.asarray(cells.pose)
        recall = (packet.get(int(template), np.zeros(3)) + [0, 0, turned]) % rings(config, np.dtype(float))
        faster = 1 + speed * noise[0]
        moved = motion * [faster, faster, 1] + [0, 0, heading * noise[1]]
        odometry = Odometry(*map(jnp.asarray, moved), jnp.ones(()))
        cells = step(cells, odometry, jnp.asarray(recall), jnp.asarray(energy * factor))
        poses.append(np.asarray(cells.pose))
        active.append(np.asarray(to_full_torus(levels, cells.activity)).reshape(-1)[CHOSEN])
    return np.array(poses), np.array(active)


@pytest.mark.soak
@pytest.mark.parametrize("views", [True, False])
def test_networks_equal_those_simulated_one_by_one(views):
    given = course(views)
    segments = list(walk(CONFIG, sets(), given, CHOSEN, block=2))
    assert [segment.pose.shape[1] for segment in segments] == [SEGMENT, STEPS - SEGMENT]
    pose, activity, _, level = (np.concatenate(each, axis=1) for each in zip(*segments, strict=True))
    assert bool(level.max()) == views
    for k, row in enumerate(SETS):
        expected, active = alone(row, given)
        gap = ring_difference(pose[k] - expected, np.array([[21, 21, 36]]))
        assert np.abs(gap).max() <= 1e-9
        assert np.abs(activity[k] - active).max() <= 1e-12
    assert activity[:, :, 0].max() > 1e-3


def test_networks_that_left_the_smallest_window_go_back_to_it():
    steps = np.arange(12 * SEGMENT)
    motion = np.tile([0.02, 0.0, 0.01], (len(steps), 1))
    template = (steps == steps[-1]).astype(np.int32)  # as many as in `course`, so that nothing compiles again
    energy, still = 0.05 * (steps == 200), np.zeros(len(steps))
    given = CellCourse(motion, np.zeros((len(steps), 2)), template, steps == 0, still, energy)
    level = np.concatenate([track.level for track in walk(CONFIG, sets(), given, CHOSEN, block=2)], axis=1)
    assert level[:, 200].all()
    assert not level[:, :200].any()
    assert not level[:, -SEGMENT:].any()
