"""The example backend as a package of its own, and packages that are broken."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ratslam.__main__ import main
from ratslam.examples import dead_reckoning
from ratslam.methods.method_registry import BACKENDS
from ratslam.runs.run import run
from ratslam.runs.settings.run_config import load_config
from tests.helpers.distributions import install
from tests.helpers.live import ROOT

SQUARE = str(ROOT / "configs" / "square.yaml")
MODULE = Path(dead_reckoning.__file__).read_text(encoding="utf-8")
SETTINGS = ["backend=reckoning", "backend_settings.scale=0.98"]
POINT = "ratslam.backends:reckoning"
FILES = ("steps.csv", "trajectory.tum", "online.tum", "scorecard.json", "config.yaml")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of installed packages, on the path of this process."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    return folder


def refusal(capsys: pytest.CaptureFixture[str], directory: Path, backend: str) -> str:
    """What the program prints when it refuses a run; it makes no run directory."""
    assert main(["run", SQUARE, "-o", str(directory), "--set", f"backend={backend}"]) == 2
    assert not directory.exists()
    return capsys.readouterr().err


def test_an_installed_backend_runs_and_gives_the_bits_of_a_registered_one(tmp_path: Path) -> None:
    install(tmp_path / "site", "own_reckoning", MODULE, {POINT: "own_reckoning:ENTRY"})
    command = [sys.executable, "-m", "ratslam", "run", SQUARE, "-o", "installed"]
    given = [word for setting in SETTINGS for word in ("--set", setting)]
    path = os.pathsep.join([str(tmp_path / "site"), str(ROOT)])
    done = subprocess.run(
        [*command, *given],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    BACKENDS.register("reckoning", dead_reckoning.ENTRY)
    try:
        run(load_config(SQUARE, SETTINGS), tmp_path / "registered")
    finally:
        BACKENDS.unregister("reckoning")
    for name in FILES:
        installed = (tmp_path / "installed" / name).read_text(encoding="utf-8")
        assert installed.replace('"installed"', '"registered"') == (tmp_path / "registered" / name).read_text(
            encoding="utf-8"
        ), name


BROKEN = {
    "import_error": ("import no_such_package", "module:ENTRY", "ModuleNotFoundError: No module named"),
    "its_own_error": ("1 / 0", "module:ENTRY", "ZeroDivisionError"),
    "no_such_object": ("", "module:ENTRY", "AttributeError"),
    "wrong_type": ("ENTRY = 3", "module:ENTRY", "is of type int; expected BackendEntry"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_package_is_named(kind: str, site: Path, tmp_path: Path, capsys) -> None:
    module, target, cause = BROKEN[kind]
    name = f"broken_{kind}"
    install(site, name, module, {POINT: target.replace("module", name)})
    told = refusal(capsys, tmp_path / "run", "reckoning")
    assert told.count("\n") == 1
    assert f"{name} 1.0" in told
    assert cause in told


@pytest.mark.soak
def test_a_broken_package_harms_nothing_else(site: Path, tmp_path: Path) -> None:
    install(site, "harmless", "1 / 0", {POINT: "harmless:ENTRY"})
    assert main(["run", SQUARE, "-o", str(tmp_path / "run")]) == 0


def test_a_name_of_two_packages_is_refused(site: Path, tmp_path: Path, capsys) -> None:
    for name in ("first_package", "second_package"):
        install(site, name, MODULE, {POINT: f"{name}:ENTRY"})
    told = refusal(capsys, tmp_path / "run", "reckoning")
    assert told.count("\n") == 1
    for part in ("first_package 1.0", "second_package 1.0", "defined twice"):
        assert part in told


def test_a_misspelt_name_of_an_installed_backend_is_corrected(site: Path, tmp_path: Path, capsys) -> None:
    install(site, "unloaded", "1 / 0", {POINT: "unloaded:ENTRY"})
    assert "did you mean 'reckoning'?" in refusal(capsys, tmp_path / "run", "reconing")


def test_settings_of_an_installed_backend_are_checked_with_line_and_column(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    install(site, "good_reckoning", MODULE, {POINT: "good_reckoning:ENTRY"})
    file = tmp_path / "own.yaml"
    file.write_text(f"recording: {{file: {ROOT}/tests/golden/a_square3.npz}}\nbackend: reckoning\n"
                    "backend_settings:\n  scael: 2.0\n")  # fmt: skip
    assert main(["run", str(file), "-o", str(tmp_path / "run")]) == 2
    told = capsys.readouterr().err
    assert "own.yaml:4:3: backend_settings.scael" in told
    assert "did you mean 'scale'?" in told
