"""The compiler: kernels are kept on disk by kind of processor, and all flags are set but a user's own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from ratslam.core import compilation
from ratslam.core.compilation import FLAGS, FOLDER, add_xla_flags, cache_settings, keep_kernels

ROOT = Path(__file__).parents[3]


@pytest.fixture
def settings():
    """JAX's settings of the cache, put back at the end."""
    before = {name: getattr(jax.config, name) for name in cache_settings()}
    yield before
    for name, value in before.items():
        jax.config.update(name, value)


def folder() -> str | int:
    return cache_settings()[FOLDER]


def test_another_processor_has_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [folder()]
    for text in ("flags : sse avx\n", "flags : sse\n", "Features : neon\n", ""):
        monkeypatch.setattr(compilation, "CPUINFO", tmp_path / f"cpuinfo{len(names)}")
        compilation.CPUINFO.write_text(f"model : one\n{text}processor : 1\n")
        names.append(folder())
        assert folder() == names[-1]
    assert len(set(names)) == len(names)
    monkeypatch.setattr(compilation, "CPUINFO", tmp_path / "none")
    assert folder() == names[-1]  # where the system does not tell


def test_kernels_are_kept_in_the_users_cache_or_in_a_programs_own_folder(settings, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    jax.config.update(FOLDER, None)
    keep_kernels()
    assert Path(getattr(jax.config, FOLDER)).parent == tmp_path / "ratslam" / "jax"
    jax.config.update(FOLDER, "/nowhere/of/the/program")
    keep_kernels()
    assert getattr(jax.config, FOLDER) == "/nowhere/of/the/program"


def test_a_loop_in_python_finds_its_kernels_again(tmp_path: Path) -> None:
    """The second process compiles none: it adds no file to the cache."""
    code = "import ratslam; ratslam.Slam('configs/square.yaml')"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    found = []
    for _ in range(2):
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")
        found.append(sorted(path.name for path in tmp_path.rglob("*-cache")))
    assert len(found[0]) > 0
    assert found[0] == found[1]


@pytest.mark.parametrize("given", ["", FLAGS[0], " ".join(FLAGS)])
def test_every_flag_is_set_once_and_a_value_of_the_user_stays(given: str) -> None:
    assert sorted(add_xla_flags(given).split()) == sorted(FLAGS)
    own = "--xla_cpu_multi_thread_eigen=true --xla_dump_to=folder"
    assert add_xla_flags(own).split() == [*own.split(), FLAGS[1]]
