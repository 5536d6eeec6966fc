"""Help, version and schema; the commands run, score and simulate: files, repeats, repaired recordings."""

import json
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from importlib.metadata import EntryPoint, version

import numpy as np
import pytest

from evaluation.artifacts.run_reader import read_walls, read_whisker_views
from evaluation.plots.run_plots import plot_writers
from ratslam.cli import GROUPS, build_parser, main
from ratslam.cli.common import Commands
from ratslam.core.backend import NO_CLOSURE
from ratslam.runs.build_session import open_source
from ratslam.runs.run import simulate
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig, load_config
from robot.recordings.formats import open_recording
from robot.recordings.mcap_reader import Recording
from robot.recordings.mcap_writer import record_source
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_session import HeadSimulation
from robot.touch_source import open_touch_source
from tests.helpers.commands import ROOT, SQUARE, said, start

FILES = {
    "online_error.csv", "calibration.yaml", "closures.csv", "config.yaml", "manifest.json", "map.g2o",
    "map.json", "map.npz", "map.png", "odometry.tum", "online.tum", "scorecard.json", "steps.csv",
    "trajectory.tum", "truth.tum", "health.json", "map.tum", "timing.csv", "closure_views.npz",
}  # fmt: skip


def test_a_run_has_all_its_files_is_scored_and_repeated_anywhere(capsys, square, tmp_path, monkeypatch):
    assert {path.name for path in square.iterdir()} == FILES
    assert json.loads((square / "manifest.json").read_text())["status"] == "complete"
    card = json.loads((square / "scorecard.json").read_text())["quantities"]
    assert card["ate_final"]["value"] < card["ate_final"]["odometry"] / 2
    assert json.loads(said(capsys, "score", square, "--json"))["quantities"] == card
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(square / "config.yaml"), "-o", "again", "--report"]) == 0
    for name in ("steps.csv", "trajectory.tum", "map.tum", "map.g2o", "health.json", "config.yaml"):
        assert (square / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    assert (tmp_path / "again" / "report.html").read_text(encoding="utf-8").startswith("<!doctype html>")


@pytest.mark.parametrize("backend", ["recall", pytest.param("classic", marks=pytest.mark.soak)])
def test_without_closures_the_map_is_odometry(backend, tmp_path, capsys):
    sets = ["--set", "experience.closures=false", "--set", f"backend={backend}"]
    text = said(capsys, "run", SQUARE, "-o", tmp_path / "run", *sets)
    for name in ("trajectory", "map", "online"):
        path = tmp_path / "run" / f"{name}.tum"
        assert path.read_bytes() == path.with_name("odometry.tum").read_bytes(), name
    found = json.loads((tmp_path / "run" / "scorecard.json").read_text())["health"]
    assert (found["worse_than_odometry"], found["reason"]) == (None, NO_CLOSURE)
    assert not (tmp_path / "run" / "calibration.yaml").exists()
    assert re.search(r"ATE, final \(RMS\): (\S+) m, odometry \1 m", text)
    assert text.endswith(f"warnings: none\nhealth: input clean; {NO_CLOSURE}\n")


@pytest.mark.soak
def test_the_lecture_hall_is_mapped(reference_data, tmp_path, monkeypatch):
    monkeypatch.setenv("RATSLAM_DATA", str(reference_data))
    assert main(["run", str(ROOT / "configs" / "tuc_lecture_hall.yaml"), "-o", str(tmp_path / "run")]) == 0
    card = json.loads((tmp_path / "run" / "scorecard.json").read_text())
    assert card["quantities"]["ate_final"]["value"] <= 1.5


def test_a_cut_recording_is_recovered(tmp_path, capsys):
    with open_recording(RecordingConfig(file=ROOT / "tests" / "golden" / "a_square3.npz")) as source:
        record_source(source, tmp_path / "whole.mcap")
    content = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: len(content) * 6 // 10])
    text = said(capsys, "tools", "recover", tmp_path / "cut.mcap", "-o", tmp_path / "good.mcap")
    with open_recording(RecordingConfig(file=tmp_path / "good.mcap")) as source:
        steps = len(list(source))
    assert 50 < steps < 349
    assert f"good.mcap: {steps} samples; the rest is lost: " in text


CONFIG = """
simulation: {path: {explore: 150}, maze: {heights: [0.03, 0.05]}, seed: 3}
touch: {head: {dead: [4]}}
"""
SAME = ("trajectory.tum", "online.tum", "odometry.tum", "truth.tum", "steps.csv", "map.g2o", "map.json")
KEPT = ("walls.csv", "views.npz", "maze.txt")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("simulate")
    (path / "config.yaml").write_text(CONFIG)
    (path / "replay.yaml").write_text("recording: {file: session.mcap}\n")
    assert main(["simulate", str(path / "config.yaml"), "-o", str(path / "session.mcap")]) == 0
    assert main(["run", str(path / "config.yaml"), "-o", str(path / "direct")]) == 0
    assert main(["run", str(path / "replay.yaml"), "-o", str(path / "replayed")]) == 0
    return path


def test_a_run_of_the_recording_equals_that_of_the_simulation_and_names_it(folder):
    for name in (*SAME, *KEPT):
        assert (folder / "direct" / name).read_bytes() == (folder / "replayed" / name).read_bytes(), name
    assert (folder / "direct" / "steps.csv").read_text().count("\n") == 151
    config = load_config(folder / "config.yaml")
    for name in ("direct", "replayed"):
        made = json.loads((folder / name / "manifest.json").read_text())["simulation"]
        assert (made["seed"], made["tier"], bool(made["why"])) == (3, "kinematic", True)
        assert made["sha256"] == Recording(folder / "session.mcap").info.simulation.sha256
        assert made["sha256"] != HeadSimulation(config.simulation).digest  # its head has a dead whisker
        manifest = json.loads((folder / "direct" / "manifest.json").read_text())
        assert manifest["recording"]["sha256"] == made["sha256"]
    config = load_config(folder / "replayed" / "config.yaml")
    assert (config.pose_cells.cell_size, config.touch.head.dead) == (0.05, (4,))


def test_plots_are_made_again_from_the_directory_alone_which_keeps_views_and_walls(folder, tmp_path):
    run, elsewhere = folder / "direct", tmp_path / "moved"
    shutil.copytree(run, elsewhere, ignore=shutil.ignore_patterns("*.png"))
    for name, save in plot_writers(elsewhere).items():
        save(elsewhere / name)
    for name in ("map.png", "whiskers.png", "experiences.png"):
        assert (elsewhere / name).read_bytes() == (run / name).read_bytes(), name
    config = load_config(folder / "config.yaml")
    source = open_source(config)
    boxes = source.scene.surroundings.walls
    assert np.array_equal(read_walls(run), np.column_stack(boxes))
    assert len(np.unique(boxes.height)) == 2
    given = [sample.reading for sample in open_touch_source(source, config.touch)]
    images = read_whisker_views(run / "views.npz")
    assert np.abs(images.view - np.array([g.view[..., 0] for g in given])).max() <= 1 / 255
    assert np.array_equal(images.alive.reshape(-1, 18), np.array([g.alive for g in given]))
    assert not images.alive[:, 0, 4].any()
    assert images.azimuth == pytest.approx(np.radians([0, 60, 120, 180, -120, -60]))
    assert images.length == pytest.approx([0.05, 0.11, 0.16])
    assert sum((run / name).stat().st_size for name in KEPT) < 10_000
    config = RunConfig.model_validate(
        {"simulation": {"maze": {"file": run / "maze.txt"}, "path": {"explore": 5}}}
    )
    assert open_source(config).length == 5


def test_the_same_session_is_the_same_file_and_its_tier_is_printed(folder, tmp_path, capsys):
    assert main(["simulate", str(folder / "config.yaml"), "-o", str(tmp_path / "again.mcap")]) == 0
    assert "in the kinematic tier: only contact features" in capsys.readouterr().err
    assert (tmp_path / "again.mcap").read_bytes() == (folder / "session.mcap").read_bytes()
    assert (folder / "session.mcap").stat().st_size < 300_000


def test_a_recording_of_raw_samples_gives_the_observations_of_the_simulation(tmp_path):
    (tmp_path / "config.yaml").write_text("simulation: {path: {explore: 12}, fidelity: quasistatic}\n")
    path = tmp_path / "session.mcap"
    assert main(["simulate", str(tmp_path / "config.yaml"), "-o", str(path), "--raw"]) == 0
    assert path.stat().st_size > 1_000_000
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


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.soak)])
def test_an_interrupted_session_is_complete_and_a_killed_one_readable(number, tmp_path):
    config, path = tmp_path / "long.yaml", tmp_path / "long.mcap"
    config.write_text("simulation: {path: {explore: 30000}, mechanics: {poses: 2}}\n")
    process = start("simulate", config, "-o", path)
    while process.poll() is None and not (path.exists() and path.stat().st_size > 30_000):
        time.sleep(0.005)
    process.send_signal(number)
    out, messages = process.communicate()
    interrupted, source = number == signal.SIGINT, Recording(path)
    assert process.returncode == (130 if interrupted else -signal.SIGKILL), messages
    assert source.truncated == (not interrupted)
    assert 16 < source.length < 30_000
    assert not interrupted or f"{source.length} steps" in out
    assert source.info.simulation.seed == 0


def test_a_maze_file_lies_beside_its_configuration(tmp_path):
    (tmp_path / "maze.txt").write_text("o---o---o\n|       |\no   o   o\n|       |\no---o---o\n")
    loop = "path: {loop: [[0, 0], [1, 0], [1, 1], [0, 1]]}"
    (tmp_path / "config.yaml").write_text(f"simulation: {{maze: {{file: maze.txt}}, {loop}}}\n")
    count, interrupted = simulate(load_config(tmp_path / "config.yaml"), tmp_path / "a.mcap")
    assert count == Recording(tmp_path / "a.mcap").length
    assert not interrupted


COMMANDS = build_parser().commands.parsers


def test_the_help_lists_every_command_with_an_example_that_is_understood() -> None:
    lines = build_parser().format_help().splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert {parser.group for parser in COMMANDS.values()} == set(GROUPS)
    for name, parser in COMMANDS.items():
        assert any(f" {name} " in line and line.endswith(parser.help) for line in lines)
        assert parser.epilog is not None
        words = shlex.split(parser.epilog.removeprefix("Example: python -m ").split(" > ")[0])
        assert words[:2] == ["ratslam", name]
        assert callable(build_parser().parse_args(words[1:]).command)


def test_the_help_loads_no_numerics() -> None:
    code = (
        "import sys\n"
        "from ratslam.cli import build_parser\n"
        "build_parser().format_help()\n"
        "slow = {'jax', 'numpy', 'scipy', 'pydantic', 'matplotlib', 'yaml', 'tqdm'}\n"
        "print(sorted(slow & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_commands_of_packages_are_listed_and_broken_ones_harm_no_others(monkeypatch, capsys) -> None:
    broken = EntryPoint("broken", "no_such_package.commands:add_commands", "ratslam.commands")
    mine = EntryPoint("mine", f"{__name__}:add_commands", "ratslam.commands")
    monkeypatch.setattr("ratslam.cli.entry_points", lambda group: [mine, broken])
    assert "\nmine    survey " in build_parser().format_help()
    assert "the commands 'broken' (no_such_package" in capsys.readouterr().err


def add_commands(commands: Commands) -> None:
    commands.add("survey", None, "measure a field", "survey field", "mine")


def test_the_version_the_schema_and_the_completion_scripts_name_every_part(capsys) -> None:
    first, second, _ = said(capsys, "tools", "version").splitlines()
    assert first == f"ratslam {version('ratslam')}"
    assert f"jax {version('jax')}" in second
    schema = json.loads(said(capsys, "tools", "schema"))
    assert {"recording", "pose_cells", "templates", "places", "experience"} <= set(schema["properties"])
    for shell, files in (("bash", "run_pos_0_COMPGEN=_shtab_compgen_files"), ("zsh", "_files")):
        script = said(capsys, "tools", "completion", shell)
        assert all(name in script for name in COMMANDS)
        assert files in script
