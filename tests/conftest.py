"""Strict numerics for every test, the option for soak tests, and the paths of data."""

import atexit
import gc
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

# One thread, so that two runs add in the same order; read when numpy and jax are first imported.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

if "PYTEST_XDIST_WORKER" not in os.environ:
    # Workers share compiled kernels and runs; every run of the suite starts without any.
    os.environ["RATSLAM_TEST_FOLDER"] = tempfile.mkdtemp(prefix="ratslam-tests-")
    atexit.register(shutil.rmtree, os.environ["RATSLAM_TEST_FOLDER"], ignore_errors=True)
os.environ.setdefault("RATSLAM_TEST_CACHE", os.environ["RATSLAM_TEST_FOLDER"])
# Programs that tests start compile the packages' modules once, and cache their kernels in this folder, apart
# from the user's.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
os.environ["XDG_CACHE_HOME"] = os.environ["RATSLAM_TEST_CACHE"]

import jax
from hypothesis import HealthCheck, settings

from ratslam.core.compilation import add_xla_flags

gc.disable()  # until all modules are imported, of which nothing is garbage: a fifth less time
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_compilation_cache_dir", f"{os.environ['XDG_CACHE_HOME']}/ratslam/jax")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

FEWER_PASSES = (
    "--xla_cpu_use_fusion_emitters=false"
    " --xla_backend_extra_options=xla_cpu_disable_loop_unrolling=true,xla_cpu_optimize_for_size=true"
)
"""Compiles a session's kernel in about 40 % of the time; its steps take a third longer. Most tests compile
more than they compute. Soak and benchmarks compile as users do."""
LONGEST = (
    "tests/ratslam/live/test_complete_session.py",
    "tests/ratslam/methods/test_conformance.py",
    "tests/test_docs.py",
    "tests/ratslam/network/test_sessions.py",
    "tests/ratslam/live/test_arm_session.py",
    "tests/ratslam/examples/test_examples.py",
    "tests/evaluation/studies/test_cell_study.py",
    "tests/ratslam/live/test_create_session.py",
    "tests/ratslam/cli/test_stopped_runs.py",
    "tests/ratslam/cli/test_run.py",
    "tests/ratslam/runs/test_recall_maps.py",
    "tests/ratslam/runs/test_touch_maps.py",
    "tests/evaluation/studies/test_study_runner.py",
    "tests/robot/drivers/ur10/test_arm.py",
    "tests/ratslam/mapping/test_closure_odds.py",
    "tests/robot/drivers/create/test_driver.py",
    "tests/robot/emulators/ur10/test_clients.py",
)
"""Modules that begin first, so that no worker is left alone with one at the end."""

for profile, examples in (("ratslam", 25), ("soak", 100)):
    settings.register_profile(
        profile,
        max_examples=examples,
        derandomize=True,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow],
    )
settings.load_profile("ratslam")

ROOT = Path(__file__).parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--soak", action="store_true", help="run the tests marked soak, and only these")
    parser.addoption("--part", default="", metavar="K/N", help="run part K of N of the soak")


def pytest_configure(config: pytest.Config) -> None:
    # JAX reads the flags when it first computes; workers and programs that tests start inherit them.
    flags = os.environ.get("XLA_FLAGS", "")
    if config.getoption("--soak"):
        settings.load_profile("soak")
    as_users_do = config.getoption("--soak") or config.getoption("--benchmark-only")
    if not as_users_do and FEWER_PASSES not in flags:
        flags = f"{flags} {FEWER_PASSES}"
    os.environ["XLA_FLAGS"] = add_xla_flags(flags)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    soak = config.getoption("--soak") or config.getoption("--benchmark-only")
    chosen = [item for item in items if bool(item.get_closest_marker("soak")) == soak]
    if config.getoption("--part"):
        modules = modules_of_part(config.getoption("--part"), {_module(item) for item in chosen})
        chosen = [item for item in chosen if _module(item) in modules]
    left = set(items) - set(chosen)
    config.hook.pytest_deselected(items=[item for item in items if item in left])
    order = {module: k for k, module in enumerate(LONGEST)}
    items[:] = sorted(chosen, key=lambda item: order.get(_module(item), len(order)))


def pytest_collection_finish() -> None:
    """Takes what lives to the end, which is most, out of the garbage collector's rounds."""
    gc.enable()
    gc.collect()
    gc.freeze()
    gc.set_threshold(5_000, 20, 50)  # fewer rounds: those of the oldest objects took 18 s of each worker


def modules_of_part(part: str, modules: set[str]) -> set[str]:
    """The test modules of part K of N ("K/N") of the soak.

    Modules go, longest first, to the part that is shortest so far. Durations are those of
    `soak_durations.json` (minutes of one worker); an unlisted module counts one minute.
    """
    number, count = (int(value) for value in part.split("/"))
    minutes = json.loads((ROOT / "tests" / "soak_durations.json").read_text(encoding="utf-8"))
    parts: list[list[str]] = [[] for _ in range(count)]
    length = [0.0] * count
    for module in sorted(modules, key=lambda name: (-minutes.get(name, 1.0), name)):
        shortest = length.index(min(length))
        parts[shortest].append(module)
        length[shortest] += minutes.get(module, 1.0)
    return set(parts[number - 1])


def _module(item: pytest.Item) -> str:
    return item.path.relative_to(ROOT).as_posix()


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
def find_trace(golden: Path, request: pytest.FixtureRequest) -> Callable[[str], Path]:
    """Finds the path of a reference trace, in the project's golden files or among the recordings."""

    def find(name: str) -> Path:
        path = golden / f"{name}.npz"
        if not path.is_file():
            path = request.getfixturevalue("reference_data") / "traces" / f"{name}.npz"
        if not path.is_file():
            pytest.skip(f"no {path}")
        return path

    return find


@pytest.fixture(scope="session")
def loopback() -> str:
    """An address of this worker's own: ports of robots are fixed."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    return f"127.0.0.{11 + int(worker)}"
