"""Imports: contracts hold, imports are light, change nothing, and name a package that hides one of ours. The
wheel holds all that a program needs, and maps as the checkout does, from any folder."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

from tests.house_figures import PACKAGES

ROOT = Path(__file__).parents[1]
COPIED = (*PACKAGES, "configs", "tests/golden")
FILES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "CITATION.cff", "constraints.txt")


def copied(folder):
    """A folder with what an installation reads."""
    for name in COPIED:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in FILES:
        shutil.copy(ROOT / name, folder)
    return folder


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built without network in a copy of what it is made of."""
    pytest.importorskip("build", reason="of the extra [dev]")
    tree = copied(tmp_path_factory.mktemp("tree"))
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", "dist", "."]
    printed(command, tree, os.environ)
    (file,) = (tree / "dist").glob("*.whl")
    return file


@pytest.fixture(scope="module")
def site(wheel, tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    with ZipFile(wheel) as archive:  # a wheel of Python files is installed by unpacking it
        archive.extractall(folder)
    return folder


def printed(command, folder, environment):
    ended = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def start(site, folder, *arguments):
    """Runs Python with the wheel's packages before all others; returns what it prints."""
    environment = os.environ | {"PYTHONPATH": str(site), "RATSLAM_DATA": "/nowhere"}
    return printed([sys.executable, *arguments], folder, environment)


def test_the_wheel_has_every_file(wheel):
    names = {name for name in ZipFile(wheel).namelist() if ".dist-info/" not in name}
    sources = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.parent.name != "__pycache__"
    }
    assert {f"{package}/py.typed" for package in PACKAGES} <= sources
    packaged = [f"configs/{path.name}" for path in (ROOT / "configs").glob("*.yaml")]
    packaged += ["tests/golden/a_square3.npz", "CITATION.cff"]
    assert names == sources | {f"ratslam/packaged/{name}" for name in packaged}


def test_an_installed_program_finds_its_configurations_and_all_commands(site, tmp_path):
    for command in ("study", "reproduce"):
        assert command in start(site, tmp_path, "-m", "ratslam", command, "--help")
    listed = start(site, tmp_path, "-m", "ratslam", "run", "--list").splitlines()
    names = sorted(path.stem for path in (ROOT / "configs").glob("*.yaml"))
    assert [line.split()[0] for line in listed] == names
    code = """
from ratslam.runs.settings.packaged import find_config
from ratslam.runs.settings.run_config import load_config
print(find_config("square"), load_config(find_config("square")).recording.file.resolve(), sep="\\n")
"""
    config, recording = start(site, tmp_path, "-c", code).splitlines()
    assert config == str(site / "ratslam" / "packaged" / "configs" / "square.yaml")
    assert Path(recording).is_relative_to(site)
    assert Path(recording).exists()


@pytest.mark.soak
@pytest.mark.parametrize("name", ["square", "whisker_maze"])
def test_an_installed_program_maps_to_the_same_bytes(name, site, tmp_path):
    for folder in ("installed", "checkout"):
        (tmp_path / folder).mkdir()
    start(site, tmp_path / "installed", "-m", "ratslam", "run", name)
    start(ROOT, tmp_path / "checkout", "-m", "ratslam", "run", str(ROOT / "configs" / f"{name}.yaml"))
    for file in ("trajectory.tum", "steps.csv", "map.g2o"):
        pair = [tmp_path / folder / "runs" / name / file for folder in ("installed", "checkout")]
        assert pair[0].read_bytes() == pair[1].read_bytes(), file


def instructions(name):
    """The arguments of the Dockerfile's instructions of a name."""
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    return [line.removeprefix(name).strip() for line in lines if line.startswith(f"{name} ")]


def execute(command, folder):
    """Executes a line as Docker does, with this Python as `python`."""
    binaries = folder / "bin"
    binaries.mkdir(exist_ok=True)
    if not (binaries / "python").exists():
        (binaries / "python").symlink_to(sys.executable)
    kept = {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "SSL_"))}
    environment = kept | {"PATH": f"{binaries}:{os.environ['PATH']}", "HOME": str(folder)}
    printed(["sh", "-c", command], folder, environment)


def test_the_image_copies_what_is_not_ignored():
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert not set(COPIED) & set(ignored)
    assert instructions("COPY") == [". ."]


@pytest.mark.soak
def test_the_steps_of_the_image_and_its_command_run(tmp_path):
    image = copied(tmp_path)
    for line in instructions("RUN"):
        execute(line, image)
    command = json.loads(instructions("CMD")[0])
    execute(f".venv/bin/{' '.join(command)}", image)
    assert (image / command[-1] / "map.png").stat().st_size > 10_000


def started(code, *path, cwd=ROOT, **environment):
    """Runs code with `path` and then our packages on Python's path."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, [*path, ROOT]))} | environment
    command = [sys.executable, "-c", code]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


def test_contracts_hold():
    code = "from importlinter.cli import lint_imports_command as check; check()"
    check = f"import sys; sys.argv[1:] = ['--no-cache', '--no-logo']; {code}"
    done = started(check, COLUMNS="200", PYTHONPATH="")
    assert done.returncode == 0, done.stdout + done.stderr
    assert " KEPT" in done.stdout


PROGRAM = """
import contextlib
import ratslam
from ratslam.__main__ import main
with contextlib.suppress(SystemExit):
    assert main(["--help"]) == 0
"""
RUN = """
from ratslam.cli.common import prepare_jax
prepare_jax()
import evaluation.metrics.scorecard
from ratslam.runs.settings.run_config import load_config
from ratslam.runs.run import open_observations
from ratslam.runs.build_session import build_session
with open_observations(load_config("configs/whisker_maze.yaml")) as (config, source):
    build_session(config, source)
    next(iter(source))
"""
HEAVY = ["jax", "matplotlib", "mcap", "scipy", "numba"]
SLOW = ["matplotlib", "networkx"] + [
    f"scipy.{name}" for name in ("signal", "stats", "interpolate", "optimize", "spatial", "ndimage")
]
"""Modules that a run needs after its first estimate, or not at all."""


@pytest.mark.parametrize(("code", "modules"), [(PROGRAM, HEAVY), (RUN, SLOW)], ids=["ratslam", "a run"])
def test_what_begins_imports_nothing_heavy(code, modules):
    done = started(f"{code}import sys\nprint([name for name in {modules} if name in sys.modules])")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


def test_importing_ratslam_changes_no_setting_of_jax():
    code = """
import importlib, json, os, pkgutil
import jax
before = dict(jax.config.values), dict(os.environ)
import ratslam
names = [module.name for module in pkgutil.walk_packages(ratslam.__path__, "ratslam.")]
for name in names:
    importlib.import_module(name)
after = dict(jax.config.values), dict(os.environ)
for _, environment in (before, after):
    environment.pop("KMP_DUPLICATE_LIB_OK", None)  # of threadpoolctl, which scipy.io loads if it is there
print(json.dumps([len(names) > 5, before == after]))
"""
    done = started(code)
    assert done.stdout.splitlines()[-1:] == ["[true, true]"], done.stderr


MAIN = "import sys; from ratslam.__main__ import main; sys.exit(main(['--help']))"


@pytest.mark.parametrize(
    ("names", "source"),
    [
        (["robot"], "__version__ = '7'"),
        (["evaluation"], "RATSLAM_PACKAGE = 'tactile'"),
        (["evaluation"], "raise RuntimeError('boom')"),
        (["robot"], "raise SystemExit(0)"),
        (["tactile", "robot"], ""),
    ],
    ids=["without a marker", "with another marker", "raising on import", "exiting on import", "two packages"],
)
def test_foreign_packages_are_named(names, source, tmp_path):
    files = [tmp_path / "elsewhere" / name / "__init__.py" for name in names]
    for file in files:
        file.parent.mkdir(parents=True)
        file.write_text(source)
    done = started(MAIN, tmp_path / "elsewhere", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    for name, file, line in zip(names, files, done.stderr.splitlines(), strict=True):
        assert f"'{name}' at {file} " in line
        assert "virtual environment of its own" in line


def test_a_missing_package_is_named_and_a_folder_without_init_hides_none(tmp_path):
    """An incomplete copy with the package `ratslam` only; a folder of data in the working directory."""
    (tmp_path / "ratslam").symlink_to(ROOT / "ratslam")
    ours_hidden = f"import sys; sys.path = [p for p in sys.path if p != {str(ROOT)!r}]\n"
    ours_hidden += "sys.meta_path = [f for f in sys.meta_path if 'editable' not in str(f)]\n"
    done = started(ours_hidden + MAIN, tmp_path, cwd=tmp_path)
    assert done.returncode == 2
    assert "'robot' is missing" in done.stderr
    (tmp_path / "ratslam").unlink()
    (tmp_path / "robot").mkdir()
    code = "from ratslam.__main__ import package_error; print(repr(package_error('robot')))"
    assert started(code, cwd=tmp_path).stdout == "''\n"
