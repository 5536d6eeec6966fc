"""The commands run, score and recover: results, repeats, interrupts, kills, invalid input."""

from __future__ import annotations

import json
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from evaluation.metrics.trajectory import read_tum
from ratslam.cli import main
from ratslam.config.run_config import load_config
from ratslam.pipeline.run import process_source
from ratslam.pipeline.runner import open_runner
from ratslam.pipeline.source import open_observations
from tests.helpers.square_run import copy_square_run

ROOT = Path(__file__).parents[3]
FILES = {
    "online_error.csv", "calibration.yaml", "closures.csv", "config.yaml", "manifest.json", "map.g2o",
    "map.json", "map.npz", "map.png", "odometry.tum", "online.tum", "scorecard.json", "steps.csv",
    "trajectory.tum", "truth.tum", "health.json", "map.tum", "timing.csv", "closure_views.npz",
}  # fmt: skip
SQUARE = str(ROOT / "configs" / "square.yaml")


@pytest.fixture(scope="module")
def square(tmp_path_factory):
    """A finished run."""
    return copy_square_run(tmp_path_factory.mktemp("square") / "run")


@pytest.fixture(scope="module")
def corridor_run(tmp_path_factory):
    """A config that runs for some seconds, its uninterrupted run, and the session of this run."""
    folder = tmp_path_factory.mktemp("corridor")
    config = folder / "long.yaml"
    golden = ROOT / "tests" / "golden" / "c_corridor_wrap.npz"
    config.write_text(
        f"recording: {{file: {golden}}}\npose_cells: {{cells_xy: 11, cell_size: 0.05, engine: dense}}\n"
    )
    with (
        open_observations(load_config(config)) as (completed, source),
        open_runner(completed, source, folder / "whole") as runner,
    ):
        assert not process_source(runner, source)
        runner.finish(interrupted=False)
        return config, folder / "whole", runner.session


@pytest.fixture(scope="module")
def corridor(corridor_run):
    """The config and the run."""
    return corridor_run[:2]


def start(config, directory):
    """The program in a process of its own."""
    command = [sys.executable, "-m", "ratslam", "run", str(config), "-o", str(directory)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def refuses(capsys, arguments, *messages):
    """The command ends with code 2 and an error that contains all of `messages`, without a traceback."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert "ratslam: error: " in error
    for words in messages:
        assert words in error


def test_a_run_writes_all_its_files(square):
    assert {path.name for path in square.iterdir()} == FILES
    assert json.loads((square / "manifest.json").read_text())["status"] == "complete"
    card = json.loads((square / "scorecard.json").read_text())["quantities"]["ate_final"]
    assert card["value"] < card["odometry"] / 2


def test_the_written_configuration_gives_the_same_bytes_from_another_folder(square, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(square / "config.yaml"), "-o", "again"]) == 0
    for name in ("steps.csv", "trajectory.tum", "map.tum", "map.g2o", "health.json", "config.yaml"):
        assert (square / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


TRACES = (
    "a_square3",
    pytest.param("b_figure8_alias", marks=pytest.mark.soak),
    pytest.param("c_corridor_wrap", marks=pytest.mark.soak),
    pytest.param("d1_rotation_generic", marks=pytest.mark.soak),
    pytest.param("e_kidnap", marks=pytest.mark.soak),
    pytest.param("j_reverse_stop", marks=pytest.mark.soak),
)


def check_odometry(path):
    _, final = read_tum(path / "trajectory.tum")
    _, odometry = read_tum(path / "odometry.tum")
    assert np.abs(final[:, :2] - odometry[:, :2]).max() <= 1e-9


@pytest.mark.parametrize("trace", TRACES)
def test_without_closures_the_map_is_odometry(trace, tmp_path):
    file = ROOT / "tests" / "golden" / f"{trace}.npz"
    sets = ["--set", f"recording.file={file}", "--set", "experience.closures=false"]
    assert main(["run", SQUARE, "-o", str(tmp_path / "run"), *sets]) == 0
    check_odometry(tmp_path / "run")


@pytest.mark.soak
@pytest.mark.parametrize("config", ["intel_laser", "tuc_lecture_hall"])
def test_without_closures_real_maps_are_odometry(config, reference_data, tmp_path, monkeypatch):
    monkeypatch.setenv("RATSLAM_DATA", str(reference_data))
    path = tmp_path / "run"
    arguments = ["-o", str(path), "--set", "experience.closures=false"]
    assert main(["run", str(ROOT / "configs" / f"{config}.yaml"), *arguments]) == 0
    check_odometry(path)


@pytest.mark.soak
def test_the_lecture_hall_is_mapped(reference_data, tmp_path, monkeypatch):
    monkeypatch.setenv("RATSLAM_DATA", str(reference_data))
    assert main(["run", str(ROOT / "configs" / "tuc_lecture_hall.yaml"), "-o", str(tmp_path / "run")]) == 0
    card = json.loads((tmp_path / "run" / "scorecard.json").read_text())
    assert card["quantities"]["ate_final"]["value"] <= 1.5


def wait_for_steps(process, directory, size=400):
    """Waits until the file of steps has so many bytes (by default some lines beside the first one, of names),
    or the process has ended."""
    steps = directory / "steps.csv"
    while process.poll() is None and not (steps.exists() and steps.stat().st_size > size):
        time.sleep(0.005)


def test_an_interrupted_run_is_scored_and_continues(corridor, tmp_path):
    config, whole = corridor
    process = start(config, tmp_path / "first")
    wait_for_steps(process, tmp_path / "first")
    process.send_signal(signal.SIGINT)
    _, messages = process.communicate()
    first = tmp_path / "first"
    assert process.returncode == 130, messages
    assert json.loads((first / "manifest.json").read_text())["status"] == "interrupted"
    # No closure yet, and so no views of one.
    assert {path.name for path in first.iterdir()} == FILES - {"closure_views.npz"}
    assert len((first / "closures.csv").read_text().splitlines()) == 1
    second = tmp_path / "second"
    assert main(["run", str(config), "--continue", str(first / "map.npz"), "-o", str(second)]) == 0
    added = (second / "steps.csv").read_text().split("\n", 1)[1]
    assert (first / "steps.csv").read_text() + added == (whole / "steps.csv").read_text()
    assert (whole / "trajectory.tum").read_text().endswith((second / "trajectory.tum").read_text())


def test_a_run_of_known_length_compiles_its_kernel_once(corridor_run):
    _, _, session = corridor_run
    assert session.backend.rows(session.state) > 256, "fits into the smallest capacity"
    assert session.compilations() == 1


def check_killed_run(corridor, directory):
    """A killed run has a prefix of the lines, and can be scored from its first step on; how many."""
    _, whole = corridor
    for name in ("steps.csv", "online.tum", "odometry.tum", "truth.tum"):
        if (directory / name).exists():
            written = (directory / name).read_bytes()
            assert (whole / name).read_bytes().startswith(written)
            assert not written or written.endswith(b"\n")
    code = main(["score", str(directory)])
    rows = (directory / "steps.csv").read_text().count("\n") if (directory / "steps.csv").exists() else 0
    assert code == (0 if rows > 1 else 2)
    return rows


def test_a_killed_run_is_readable(corridor, tmp_path):
    """Also before its first step: a stopped process leaves the same files as a killed one."""
    process = start(corridor[0], tmp_path / "run")
    wait_for_steps(process, tmp_path / "run", -1)
    process.send_signal(signal.SIGSTOP)
    shutil.copytree(tmp_path / "run", tmp_path / "early")
    process.send_signal(signal.SIGCONT)
    wait_for_steps(process, tmp_path / "run", 40_000)
    process.kill()
    process.communicate()
    assert check_killed_run(corridor, tmp_path / "run") > 1
    check_killed_run(corridor, tmp_path / "early")


@pytest.mark.soak
def test_fifty_killed_runs_are_readable(corridor, tmp_path):
    began = time.monotonic()
    process = start(corridor[0], tmp_path / "timed")
    process.communicate()
    whole = time.monotonic() - began  # a busy machine takes longer
    delays = whole * np.random.default_rng(0).uniform(0.1, 1.0, 50)
    rows = []
    for k, delay in enumerate(delays):
        process = start(corridor[0], tmp_path / str(k))
        try:
            process.communicate(timeout=delay)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
        rows.append(check_killed_run(corridor, tmp_path / str(k)))
    print("rows left by each kill:", rows)
    assert sum(count > 1 for count in rows) > 10


@pytest.mark.parametrize(
    ("text", "messages"),
    [
        ("", ["config.yaml"]),
        (
            "recording: {file: a.npz}\npose_cells: {excite_sigm: 1}\n",
            ["did you mean 'excite_sigma'", "config.yaml:2:"],
        ),
        ("recording: {file: a.npz}\npose_cells: {excite_sigma: -1}\n", ["pose_cells.excite_sigma"]),
        ("recording: {file: a.npz}\npose_cells: {excite_width: 6}\n", ["odd"]),
        ("recording: {file: a.npz}\ntemplates: {threshold: high}\n", ["templates.threshold"]),
        ("recording: {file: a.npz}\nrecording: {file: b.npz}\n", ["recording"]),
        ("recording: {file: missing.npz}\n", ["missing.npz"]),
        ("recording: {file: '${RATSLAM_NOT_SET}/a.npz'}\n", ["RATSLAM_NOT_SET"]),
        ("recording: {file: a.npz\n", [":"]),
        ("pose_cells: {}\nplaces: {radius: 0}\n", ["recording", "places.radius"]),
    ],
)
def test_a_faulty_config_is_refused(capsys, tmp_path, text, messages):
    config = tmp_path / "config.yaml"
    config.write_text(text)
    refuses(capsys, ["run", config, "-o", tmp_path / "run"], *messages)
    assert not (tmp_path / "run").exists()


def changed(tmp_path, **changes):
    """A golden stream with some arrays changed."""
    with np.load(ROOT / "tests" / "golden" / "a_square3.npz") as archive:
        arrays = dict(archive)
    for name, change in changes.items():
        arrays[name] = change(arrays[name].copy())
    np.savez(tmp_path / "changed.npz", **arrays)
    return tmp_path / "changed.npz"


def put(row, value):
    def change(array):
        array[row] = value
        return array

    return change


@pytest.mark.parametrize(
    ("changes", "messages"),
    [
        ({"in_w": lambda w: w * 180 / np.pi}, "deg"),
        ({"in_v": lambda v: v * 1000}, "m"),
        ({"in_v": put(7, np.nan)}, "row 7"),
        ({"in_t": put(9, 0.0)}, "row 9"),
        ({"in_view": lambda view: view * 255}, "0..1"),
        ({"in_view": lambda view: view[:, :5]}, "in_view"),
    ],
    ids=["degrees", "millimetres", "nan", "backwards", "bytes", "shape"],
)
def test_a_faulty_recording_is_refused(capsys, tmp_path, changes, messages):
    file = changed(tmp_path, **changes)
    refuses(capsys, ["run", SQUARE, "-o", tmp_path / "run", "--set", f"recording.file={file}"], messages)
    assert not (tmp_path / "run").exists()


def test_cut_and_empty_recordings_are_refused(capsys, tmp_path):
    whole = (ROOT / "tests" / "golden" / "a_square3.npz").read_bytes()
    for name, content in (("cut.npz", whole[:5000]), ("empty.npz", b""), ("noise.mcap", b"noise" * 99)):
        (tmp_path / name).write_bytes(content)
        file = f"recording.file={tmp_path / name}"
        refuses(capsys, ["run", SQUARE, "-o", tmp_path / "run", "--set", file], name)


def test_an_existing_directory_is_not_changed(capsys, square):
    before = {path: path.read_bytes() for path in square.iterdir()}
    refuses(capsys, ["run", SQUARE, "-o", square], "exists")
    assert before == {path: path.read_bytes() for path in square.iterdir()}


def test_wrong_checkpoints_are_refused(capsys, square, tmp_path):
    again = ["run", SQUARE, "-o", tmp_path / "run", "--continue"]
    refuses(capsys, [*again, square / "map.npz"], "already")
    refuses(capsys, [*again, square / "steps.csv"], "not a map")
    refuses(capsys, [*again, tmp_path / "none.npz"], "none.npz")
    refuses(capsys, [*again, square / "map.npz", "--set", "pose_cells.cells_xy=25"], "configuration")
    assert not (tmp_path / "run").exists()


def test_score_refuses_a_folder_or_file_without_a_log(capsys, tmp_path):
    refuses(capsys, ["score", tmp_path], "online.tum")
    (tmp_path / "log.csv").write_text("t,id\n0,1\n")
    refuses(capsys, ["score", tmp_path / "log.csv"], "log.csv")
    refuses(capsys, ["score", tmp_path / "log.csv", "--base", "-1"], "--base: -1")


def test_a_scored_directory_gives_its_scorecard(capsys, square):
    capsys.readouterr()
    assert main(["score", str(square), "--json"]) == 0
    card = json.loads(capsys.readouterr().out)
    assert card["quantities"] == json.loads((square / "scorecard.json").read_text())["quantities"]


def test_a_full_disk_is_one_clear_error(capsys, square, tmp_path):
    """A limit on the file size makes writes fail as a full disk does."""
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
        refuses(capsys, ["run", SQUARE, "-o", tmp_path / "run"], "File too large", "free some space")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert main(["score", str(tmp_path / "run")]) == 0
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["status"] == "running"


def test_a_cut_recording_is_recovered_and_run(capsys, tmp_path):
    from robot.recordings.formats import RecordingConfig, open_recording
    from robot.recordings.mcap_reader import record_source

    with open_recording(RecordingConfig(file=ROOT / "tests" / "golden" / "a_square3.npz")) as source:
        record_source(source, tmp_path / "whole.mcap")
    content = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: len(content) * 6 // 10])
    assert main(["tools", "recover", str(tmp_path / "cut.mcap"), "-o", str(tmp_path / "good.mcap")]) == 0
    file = f"recording.file={tmp_path / 'good.mcap'}"
    assert main(["run", SQUARE, "-o", str(tmp_path / "run"), "--set", file]) == 0
    steps = (tmp_path / "run" / "steps.csv").read_text().count("\n") - 1
    assert 50 < steps < 349
    refuses(capsys, ["tools", "recover", ROOT / "LICENSE", "-o", tmp_path / "x.mcap"], "LICENSE")


def test_the_schema_names_every_part(capsys):
    capsys.readouterr()
    assert main(["tools", "schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert {"recording", "pose_cells", "templates", "places", "experience"} <= set(schema["properties"])


def test_a_folder_that_cannot_be_made_is_refused(capsys, tmp_path):
    (tmp_path / "file").write_text("in the way")
    refuses(capsys, ["run", SQUARE, "-o", tmp_path / "file" / "run"], "cannot be created")
