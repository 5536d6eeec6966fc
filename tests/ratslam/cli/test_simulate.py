"""The command simulate: sessions written, replayed, interrupted, killed; invalid configurations."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from ratslam.cli import main
from ratslam.runs.build_session import open_source
from ratslam.runs.run import simulate
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig, load_config
from robot.recordings.mcap_reader import Recording
from robot.simulation.head.simulated_session import HeadSimulation
from robot.touch_source import open_touch_source
from tests.ratslam.cli.run_cases import refuses

ROOT = Path(__file__).parents[3]
CONFIG = "simulation: {path: {explore: 150}, seed: 5}\ntouch: {head: {dead: [4]}}\n"
REPLAY = "recording: {file: session.mcap}\n"
SAME = ("trajectory.tum", "online.tum", "odometry.tum", "truth.tum", "steps.csv", "map.g2o", "map.json")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A configuration, its session as a file, and the runs of both."""
    path = tmp_path_factory.mktemp("simulate")
    (path / "config.yaml").write_text(CONFIG)
    (path / "replay.yaml").write_text(REPLAY)
    assert main(["simulate", str(path / "config.yaml"), "-o", str(path / "session.mcap")]) == 0
    assert main(["run", str(path / "config.yaml"), "-o", str(path / "direct")]) == 0
    assert main(["run", str(path / "replay.yaml"), "-o", str(path / "replayed")]) == 0
    return path


def test_a_run_on_the_recording_equals_a_run_on_the_simulation(folder):
    for name in SAME:
        assert (folder / "direct" / name).read_bytes() == (folder / "replayed" / name).read_bytes(), name
    assert (folder / "direct" / "steps.csv").read_text().count("\n") == 151


def test_a_manifest_names_the_simulation(folder):
    config = RunConfig.model_validate({"simulation": {"path": {"explore": 150}, "seed": 5}})
    session = HeadSimulation(config.simulation)
    for name in ("direct", "replayed"):
        made = json.loads((folder / name / "manifest.json").read_text())["simulation"]
        assert made["seed"] == 5
        assert made["tier"] == "kinematic"
        assert made["why"]
        assert made["sha256"] == Recording(folder / "session.mcap").info.simulation.sha256
        assert made["sha256"] != session.digest  # its head has a dead whisker
    assert (
        json.loads((folder / "direct" / "manifest.json").read_text())["recording"]["sha256"] == made["sha256"]
    )


def test_a_run_can_be_repeated_from_its_configuration(folder, tmp_path):
    assert main(["run", str(folder / "direct" / "config.yaml"), "-o", str(tmp_path / "again")]) == 0
    for name in SAME:
        assert (tmp_path / "again" / name).read_bytes() == (folder / "direct" / name).read_bytes()


def test_a_run_takes_the_cell_size_and_the_head_of_the_session(folder):
    config = load_config(folder / "replayed" / "config.yaml")
    assert config.pose_cells.cell_size == 0.05
    assert config.touch.head.dead == (4,)


def test_the_same_session_is_the_same_file_and_its_tier_is_printed(folder, tmp_path, capsys):
    assert main(["simulate", str(folder / "config.yaml"), "-o", str(tmp_path / "again.mcap")]) == 0
    assert "in the kinematic tier: only contact features" in capsys.readouterr().err
    assert (tmp_path / "again.mcap").read_bytes() == (folder / "session.mcap").read_bytes()
    assert (folder / "session.mcap").stat().st_size < 300_000
    other = ["--set", "simulation.seed=6"]
    assert main(["simulate", str(folder / "config.yaml"), "-o", str(tmp_path / "other.mcap"), *other]) == 0
    assert Recording(tmp_path / "other.mcap").digest != Recording(folder / "session.mcap").digest


@pytest.mark.parametrize("raw", [False, True])
def test_a_recorded_session_gives_the_observations_of_the_simulation(raw, tmp_path):
    """Both for raw samples and for contact features."""
    (tmp_path / "config.yaml").write_text("simulation: {path: {explore: 12}, fidelity: quasistatic}\n")
    path = tmp_path / "session.mcap"
    arguments = ["simulate", str(tmp_path / "config.yaml"), "-o", str(path), *(["--raw"] if raw else [])]
    assert main(arguments) == 0
    assert (path.stat().st_size > 1_000_000) == raw
    live = RunConfig.model_validate({"simulation": {"path": {"explore": 12}, "fidelity": "quasistatic"}})
    replay = RunConfig.model_validate({"recording": {"file": path}})
    given = []
    for config in (live, replay):
        source = open_source(config)
        given.append([sample.reading for sample in open_touch_source(source, complete(config, source).touch)])
    assert len(given[0]) == len(given[1]) == 12
    for one, other in zip(*given, strict=True):
        assert one.odometry == other.odometry
        assert all(np.array_equal(part, same) for part, same in zip(one[1:], other[1:], strict=True))


def test_a_configuration_without_a_simulation_is_refused(capsys, folder, tmp_path):
    refuses(capsys, ["simulate", folder / "replay.yaml", "-o", tmp_path / "a.mcap"], "simulation: missing")
    assert not (tmp_path / "a.mcap").exists()


LONG = "simulation: {path: {explore: 30000}, mechanics: {poses: 2}}\n"


def started(tmp_path):
    """The program, writing a session that takes long, in a process of its own; it has begun."""
    (tmp_path / "long.yaml").write_text(LONG)
    path = tmp_path / "long.mcap"
    command = [sys.executable, "-m", "ratslam", "simulate", str(tmp_path / "long.yaml"), "-o", str(path)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not (path.exists() and path.stat().st_size > 30_000):
        time.sleep(0.005)
    return process, path


def test_an_interrupted_session_is_a_complete_file(tmp_path):
    process, path = started(tmp_path)
    process.send_signal(signal.SIGINT)
    out, messages = process.communicate()
    assert process.returncode == 130, messages
    source = Recording(path)
    assert not source.truncated
    assert 16 < source.length < 30_000
    assert f"{source.length} steps" in out
    assert source.info.simulation.seed == 0


@pytest.mark.soak
def test_a_killed_session_is_readable(tmp_path):
    process, path = started(tmp_path)
    process.kill()
    process.communicate()
    source = Recording(path)
    assert source.truncated
    assert source.length > 16
    assert source.info.simulation.seed == 0


def test_a_maze_file_lies_beside_its_configuration(tmp_path):
    (tmp_path / "maze.txt").write_text("o---o---o\n|       |\no   o   o\n|       |\no---o---o\n")
    (tmp_path / "config.yaml").write_text(
        "simulation: {maze: {file: maze.txt}, path: {loop: [[0, 0], [1, 0], [1, 1], [0, 1]]}}\n"
    )
    count, interrupted = simulate(load_config(tmp_path / "config.yaml"), tmp_path / "a.mcap")
    assert count == Recording(tmp_path / "a.mcap").length
    assert not interrupted
