"""The examples run as programs and print what they say; one as a package, and packages that are broken."""

import ast
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import matplotlib.image as plt_image
import numpy as np
import pytest

import ratslam.examples
from evaluation.metrics.metric_registry import METRICS
from ratslam.examples import dead_reckoning
from ratslam.methods.method_registry import BACKENDS
from ratslam.runs.run import run
from ratslam.runs.settings.run_config import load_config
from robot.sources.source import SOURCES
from robot.touch_source import TOUCH
from tests.helpers.commands import ROOT, SQUARE, refused
from tests.helpers.distributions import install

NAMES = ("dead_reckoning", "own_arrays", "own_loop", "own_metric", "taxel_array")
STEPS = (
    "one_packet", "path_integration", "two_packets", "view_templates", "first_loop", "places_that_look_alike",
    "whisker_images", "grid_filter", "a_bag", "sensor_live", "come_back", "cells_of_a_rat",
)  # fmt: skip
QUICK = {"dead_reckoning", "path_integration", "view_templates", "whisker_images"}
"""The others take longer, on parts of the program that have tests of their own: for `make soak`."""
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
    "name", [one if one in QUICK else pytest.param(one, marks=pytest.mark.soak) for one in (*NAMES, *STEPS)]
)
def test_an_example_prints_what_its_docstring_says(name: str, capsys, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    said = re.findall(r"^    (.+)$", ast.get_docstring(ast.parse(text)) or "", re.MULTILINE)
    assert len(said) == 1
    runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
    assert capsys.readouterr().out.splitlines() == said
    if name in STEPS:
        drawn, shown = (plt_image.imread(folder / f"{name}.png")[..., :3] for folder in (tmp_path, PICTURES))
        assert drawn.shape == shown.shape
        assert np.abs(drawn - shown).mean() < 0.02  # fonts differ, and in one picture the times of the steps


MODULE = Path(dead_reckoning.__file__).read_text(encoding="utf-8")
SETTINGS = ["backend=reckoning", "backend_settings.scale=0.98"]
POINT = "ratslam.backends:reckoning"
FILES = ("steps.csv", "trajectory.tum", "online.tum", "scorecard.json", "config.yaml")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (folder := tmp_path / "site").mkdir()
    monkeypatch.syspath_prepend(str(folder))
    return folder


def test_an_installed_backend_runs_and_gives_the_bits_of_a_registered_one(tmp_path: Path) -> None:
    install(tmp_path / "site", "own_reckoning", MODULE, {POINT: "own_reckoning:ENTRY"})
    command = [sys.executable, "-m", "ratslam", "run", SQUARE, "-o", "installed"]
    given = [word for setting in SETTINGS for word in ("--set", setting)]
    path = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path / "site"), str(ROOT)])}
    done = subprocess.run([*command, *given], cwd=tmp_path, env=path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    BACKENDS.register("reckoning", dead_reckoning.ENTRY)
    try:
        run(load_config(SQUARE, SETTINGS), tmp_path / "registered")
    finally:
        BACKENDS.unregister("reckoning")
    for name in FILES:
        installed = (tmp_path / "installed" / name).read_text(encoding="utf-8")
        registered = (tmp_path / "registered" / name).read_text(encoding="utf-8")
        assert installed.replace('"installed"', '"registered"') == registered, name


BROKEN = {
    "import_error": ("import no_such_package", "ModuleNotFoundError: No module named"),
    "its_own_error": ("1 / 0", "ZeroDivisionError"),
    "no_such_object": ("", "AttributeError"),
    "wrong_type": ("ENTRY = 3", "is of type int; expected BackendEntry"),
}


@pytest.mark.parametrize(("module", "cause"), BROKEN.values(), ids=BROKEN)
def test_a_broken_package_is_named(module, cause, site: Path, tmp_path: Path, request, capsys) -> None:
    name = f"broken_{request.node.callspec.id}"
    install(site, name, module, {POINT: f"{name}:ENTRY"})
    told = refused(capsys, "run", SQUARE, "-o", tmp_path / "run", "--set", "backend=reckoning")
    assert "\n" not in told
    assert f"{name} 1.0" in told
    assert cause in told
    assert not (tmp_path / "run").exists()


@pytest.mark.soak
def test_a_broken_package_harms_nothing_else(site: Path, tmp_path: Path) -> None:
    install(site, "harmless", "1 / 0", {POINT: "harmless:ENTRY"})
    run(load_config(SQUARE), tmp_path / "run")


def test_misspelt_names_wrong_settings_and_a_name_of_two_packages_are_refused(site, tmp_path, capsys) -> None:
    install(site, "first_package", MODULE, {POINT: "first_package:ENTRY"})
    assert "did you mean 'reckoning'?" in refused(capsys, "run", SQUARE, "--set", "backend=reconing")
    file = tmp_path / "own.yaml"
    file.write_text(f"recording: {{file: {ROOT}/tests/golden/a_square3.npz}}\nbackend: reckoning\n"
                    "backend_settings:\n  scael: 2.0\n")  # fmt: skip
    told = refused(capsys, "run", file)
    assert "own.yaml:4:3: backend_settings.scael" in told
    assert "did you mean 'scale'?" in told
    install(site, "second_package", MODULE, {POINT: "second_package:ENTRY"})
    told = refused(capsys, "run", SQUARE, "--set", "backend=reckoning")
    assert "\n" not in told
    assert [one for one in ("first_package 1.0", "second_package 1.0", "twice") if one not in told] == []
