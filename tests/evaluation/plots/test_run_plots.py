"""The plots of a simulated whisker session, and what its directory keeps of views and walls."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from evaluation.artifacts.run_reader import read_walls, read_whisker_views
from evaluation.plots.run_plots import plot_writers
from ratslam.cli import main
from ratslam.runs.build_session import open_source
from ratslam.runs.settings.run_config import RunConfig, load_config
from robot.touch_source import open_touch_source
from robot.world.scene import MazeConfig

ROOT = Path(__file__).parents[3]
PICTURES = ("map.png", "whiskers.png", "experiences.png")
KEPT = ("walls.csv", "views.npz", "maze.txt")
CONFIG = """
simulation: {path: {explore: 40}, maze: {heights: [0.03, 0.05]}, seed: 3}
touch: {head: {dead: [4]}}
backend: classic
session: {reserve: 64}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A tiny whisker session: mapped directly, and from its recording."""
    path = tmp_path_factory.mktemp("pictures")
    (path / "config.yaml").write_text(CONFIG)
    (path / "replay.yaml").write_text(
        "recording: {file: session.mcap}\nbackend: classic\nsession: {reserve: 64}\n"
    )
    assert main(["simulate", str(path / "config.yaml"), "-o", str(path / "session.mcap")]) == 0
    assert main(["run", str(path / "config.yaml"), "-o", str(path / "run")]) == 0
    assert main(["run", str(path / "replay.yaml"), "-o", str(path / "replayed")]) == 0
    return path


def test_plots_are_made_again_from_the_directory_alone(folder, tmp_path):
    elsewhere = tmp_path / "moved"
    shutil.copytree(folder / "run", elsewhere, ignore=shutil.ignore_patterns("*.png"))
    for name, save in plot_writers(elsewhere).items():
        save(elsewhere / name)
    for name in PICTURES:
        assert (elsewhere / name).read_bytes() == (folder / "run" / name).read_bytes(), name


def test_a_replayed_session_has_the_same_maze_and_images(folder):
    for name in KEPT:
        assert (folder / "run" / name).read_bytes() == (folder / "replayed" / name).read_bytes(), name


def test_views_and_walls_are_those_of_the_session(folder):
    config = load_config(folder / "config.yaml")
    source = open_source(config)
    boxes = source.scene.surroundings.walls
    assert np.array_equal(read_walls(folder / "run"), np.column_stack(boxes))
    assert len(np.unique(boxes.height)) == 2
    given = [sample.reading for sample in open_touch_source(source, config.touch)]
    images = read_whisker_views(folder / "run" / "views.npz")
    assert np.abs(images.view - np.array([g.view[..., 0] for g in given])).max() <= 1 / 255
    assert np.array_equal(images.alive.reshape(-1, 18), np.array([g.alive for g in given]))
    assert not images.alive[:, 0, 4].any()
    assert images.azimuth == pytest.approx(np.radians([0, 60, 120, 180, -120, -60]))
    assert images.length == pytest.approx([0.05, 0.11, 0.16])
    assert sum((folder / "run" / name).stat().st_size for name in KEPT) < 10_000


def test_the_stored_maze_can_be_run(folder):
    kept = MazeConfig(file=folder / "run" / "maze.txt")
    config = RunConfig.model_validate({"simulation": {"maze": kept, "path": {"explore": 5}}})
    assert open_source(config).length == 5


def test_a_session_without_whiskers_has_only_its_map(tmp_path):
    sets = ["--set", "backend=classic", "--set", "session.reserve=512"]
    assert main(["run", str(ROOT / "configs" / "square.yaml"), "-o", str(tmp_path / "run"), *sets]) == 0
    assert [path.name for path in (tmp_path / "run").glob("*.png")] == ["map.png"]
    assert not {path.name for path in (tmp_path / "run").iterdir()} & set(KEPT)
