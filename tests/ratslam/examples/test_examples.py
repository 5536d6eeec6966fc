"""The examples run as programs and print what they say."""

from __future__ import annotations

import ast
import re
import runpy
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import matplotlib.image as plt_image
import numpy as np
import pytest

import ratslam.examples
from evaluation.metrics.metric_registry import METRICS
from ratslam.examples import own_arrays, taxel_array
from ratslam.methods.method_registry import BACKENDS
from robot.sources.source import SOURCES
from robot.touch_source import TOUCH

NAMES = ("dead_reckoning", "own_arrays", "own_loop", "own_metric", "taxel_array")
STEPS = (
    "one_packet", "path_integration", "two_packets", "view_templates", "first_loop", "places_that_look_alike",
    "whisker_images", "grid_filter", "a_bag", "sensor_live", "come_back", "cells_of_a_rat",
)  # fmt: skip
LONG = {
    "a_bag", "come_back", "grid_filter", "one_packet", "own_arrays", "own_loop", "own_metric",
    "places_that_look_alike", "sensor_live", "taxel_array", "two_packets",
}  # fmt: skip
"""Examples that take longest, on parts of the program that have tests of their own: for `make soak`."""
FOLDER = Path(ratslam.examples.__file__).parent
PICTURES = FOLDER.parents[1] / "docs" / "examples"


@pytest.fixture
def own_names() -> Iterator[None]:
    """Forgets what the examples register: each runs as in a process of its own."""
    yield
    for registry, name in ((BACKENDS, "dead_reckoning"), (SOURCES, "arrays"), (TOUCH, "taxels")):
        registry.unregister(name)
    METRICS.unregister("way_home")


@pytest.mark.usefixtures("own_names")
@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=pytest.mark.soak) if one in LONG else one for one in (*NAMES, *STEPS)]
)
def test_an_example_prints_what_its_docstring_says(name: str, capsys, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    said = re.findall(r"^    (.+)$", ast.get_docstring(ast.parse(text)) or "", re.MULTILINE)
    assert len(said) == 1
    runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
    assert capsys.readouterr().out.splitlines() == said
    if name in STEPS:
        drawn, shown = (read_image(folder / f"{name}.png") for folder in (tmp_path, PICTURES))
        assert drawn.shape == shown.shape
        assert np.abs(drawn - shown).mean() < 0.02  # fonts differ, and in one picture the times of the steps


def read_image(path: Path) -> np.ndarray:
    """[H, W, 3] values in 0..1."""
    return plt_image.imread(path)[..., :3]


@pytest.mark.parametrize("name", [*NAMES, *STEPS])
def test_an_example_is_short(name: str) -> None:
    assert len((FOLDER / f"{name}.py").read_text(encoding="utf-8").splitlines()) < 80


def test_every_step_is_in_the_readme() -> None:
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"`python -m ratslam.examples.(\w+)` \| !\[\]\(../../docs/examples/(\w+).png\)", text)
    assert named == [(name, name) for name in STEPS]


@pytest.mark.soak
@pytest.mark.usefixtures("own_names")
def test_a_loop_reads_through_an_own_front_end(tmp_path: Path) -> None:
    SOURCES.register("arrays", own_arrays.ENTRY)
    TOUCH.register("taxels", taxel_array.ENTRY)
    settings = ["simulation=null", "source.plugin=arrays", "source.settings.rate=50"]
    config = ratslam.load_config("whisker_maze", [*settings, "touch.frontend.plugin=taxels"])
    with ratslam.open_source(config) as source:
        samples = list(islice(source, 130))
    slam = ratslam.Slam(config)
    for sample in samples[:70]:
        slam.step(sample)
    assert slam.steps == 1  # of 50 frames
    slam.save(tmp_path / "half.npz")
    again = ratslam.Slam.load(tmp_path / "half.npz")
    for one in (slam, again):
        for sample in samples[70:]:
            one.step(sample)
        assert one.steps == 2
    assert (slam.estimate.pose == again.estimate.pose).all()
