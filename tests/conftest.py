"""Strict numerics for every test, the option that runs the soak tests, and where the data lie."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import pytest

# One thread, so that two runs add in the same order; read when numpy and jax are first imported.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"

if "RATSLAM_TEST_CACHE" not in os.environ:
    # Workers share what one of them has compiled; every run of the suite starts from nothing.
    os.environ["RATSLAM_TEST_CACHE"] = tempfile.mkdtemp(prefix="ratslam-tests-")
    atexit.register(shutil.rmtree, os.environ["RATSLAM_TEST_CACHE"], ignore_errors=True)
# Programs that tests start keep what they compile there too, away from the user's.
os.environ["XDG_CACHE_HOME"] = os.environ["RATSLAM_TEST_CACHE"]

import jax
from hypothesis import HealthCheck, settings

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_compilation_cache_dir", f"{os.environ['XDG_CACHE_HOME']}/ratslam/jax")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

settings.register_profile(
    "ratslam", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("ratslam")

ROOT = Path(__file__).parents[1]
REAL_TIME = ("live", "robot/live", "robot/ur10", "robot/head", "robot/create", "robot/emulators")
"""Rooms whose tests keep real time, which a busy machine can take from them: what fails is tried twice more,
and what is wrong fails each time."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--soak", action="store_true", help="run the tests marked soak as well")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if any(f"tests/{room}/" in item.path.as_posix() for room in REAL_TIME):
            item.add_marker(pytest.mark.flaky(reruns=2))
    if not config.getoption("--soak"):
        for item in items:
            if item.get_closest_marker("soak"):
                item.add_marker(pytest.mark.skip(reason="a soak test; run with --soak"))


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """The folder of recordings and traces that are not part of the project; skips where there is none."""
    folder = Path(os.environ.get("RATSLAM_DATA") or ROOT.parent / "shared" / "reference")
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}: set RATSLAM_DATA to the folder that holds the recordings")
    return folder


@pytest.fixture(scope="session")
def golden() -> Path:
    """The folder of the reference engine's traces that are part of the project."""
    return ROOT / "tests" / "golden"


@pytest.fixture(scope="session")
def loopback() -> str:
    """An address of this worker's own: ports of robots are fixed."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    return f"127.0.0.{11 + int(worker)}"
