"""The core: sessions that start again and grow, arrays that grow, packed records, and the compiler."""

import os
import subprocess
import sys
from collections import namedtuple
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.core import compilation
from ratslam.core.arrays import GrowableArray, allocate, layout_of
from ratslam.core.backend import PathMap
from ratslam.core.compilation import FLAGS, FOLDER, add_xla_flags, cache_settings, keep_kernels
from ratslam.core.session import CHUNK, Session, capacity_at
from ratslam.examples import dead_reckoning
from ratslam.methods.method_registry import Sensors
from tactile.base.errors import InputError
from tactile.base.types import Odometry, observation

ROOT = Path(__file__).parents[3]
BACKEND = dead_reckoning.ENTRY.build(dead_reckoning.Config(), Sensors((3, 6, 1)), np.dtype(np.float64))
STRAIGHT, CURVED = (observation(Odometry(0.1, 0.0, turn, 0.1)) for turn in (0.0, 0.1))


def test_float64_without_64_bit_types_is_refused():
    with jax.enable_x64(False), pytest.raises(ValueError, match="prepare_precision"):
        Session(BACKEND)


def test_a_restarted_session_repeats_itself_and_one_of_one_piece_refuses_another_and_goes_on():
    session = Session(BACKEND)
    walk = [observation(Odometry(0.1, 0.0, 0.1 * k, 0.1)) for k in range(20)]
    first = [step.pose for step in session.replay(walk)]
    session.restart()
    assert (session.steps, len(session.map.trajectory())) == (0, 0)
    assert np.array_equal(first, [step.pose for step in session.replay(walk)])
    assert session.compilations() == 1
    session.restart()
    session.step(CURVED)
    with pytest.raises(InputError, match="one piece"):
        session.begin_piece()
    assert session.step(CURVED).pose[2] == pytest.approx(0.2)


class Table(dead_reckoning.DeadReckoning):
    """A memory of rows, one more at each step, to which its map restores merged ones."""

    def __init__(self, restored):
        super().__init__(dead_reckoning.Config(), Sensors((3, 6, 1)), np.dtype(np.float64))
        self.restored, self.used, self.merged = restored, 0, []

    def init(self, key, capacity):
        return jnp.zeros(capacity)

    def rows(self, state):
        return self.used

    def grow(self, state, capacity):
        return jnp.zeros(capacity)

    def merge_rows(self, state, merged):
        self.merged.append((merged.rows, len(state)))
        self.used = merged.rows
        return state

    def kernel(self, state, observation):
        _, *results = super().kernel(jnp.zeros(3), observation)
        return state, *results

    def new_map(self):
        return RestoringMap(self.restored)


class RestoringMap(PathMap):
    def __init__(self, rows):
        super().__init__()
        self.rows = rows

    def merge(self):
        return SimpleNamespace(rows=self.rows) if len(self.trajectory()) == CHUNK else None


@pytest.mark.parametrize("rows", [3, 241, 242, 1000])
def test_the_memory_grows_before_merged_rows_are_restored(rows):
    backend = Table(rows)
    session = Session(backend)
    list(session.replay([STRAIGHT] * (3 * CHUNK)))
    capacity = capacity_at(rows + CHUNK - 1)
    assert (backend.merged, session.state.shape) == ([(rows, capacity)], (capacity,))
    assert int(session.arrays()["capacity"]) == capacity


DTYPES = [np.dtype(name) for name in ("float64", "float32", "int32", "uint32", "bool")]


Inner = namedtuple("Inner", "a b")


@st.composite
def kinds(draw):
    shape = st.lists(st.integers(0, 3), max_size=3).map(tuple)
    return draw(st.lists(st.tuples(shape, st.sampled_from(DTYPES)), min_size=2, max_size=6))


def records_of(kind, count):
    records = []
    for seed in range(count):
        stream = np.random.default_rng(seed)
        leaves = [(stream.normal(0, 9, shape) ** 2).astype(dtype) for shape, dtype in kind]
        records.append({"inner": Inner(*leaves[:2]), "rest": leaves[2:]})
    rows = allocate(layout_of(records[0]), count + 2)
    for k, each in enumerate(records):
        rows.write(k, each)
    return records, rows


@given(kinds(), st.integers(1, 5))
def test_records_read_back_equal(kind, count):
    records, rows = records_of(kind, count)
    assert len(rows.arrays) == len({dtype for _, dtype in kind})
    equal = partial(np.testing.assert_array_equal, strict=True)
    jax.tree.map(equal, records, list(rows.records(count)))


@pytest.mark.parametrize("shapes", [(3, 4), (1, (2, 2))])
def test_a_record_of_another_shape_is_refused(shapes):
    rows = allocate(layout_of(Inner(np.zeros(3), np.zeros((2, 2)))), 1)
    with pytest.raises(ValueError, match="expected"):
        rows.write(0, Inner(*map(np.zeros, shapes)))


@given(st.lists(st.integers(0, 40), max_size=12))
def test_rows_are_copies_of_those_appended(counts: list[int]) -> None:
    array, expected = GrowableArray((2,), np.float64), np.zeros((0, 2))
    for number, count in enumerate(counts):
        rows = np.full((count, 2), float(number))
        expected = np.concatenate([expected, rows])
        if count == 1:
            array.append(rows[0])
        else:
            array.extend(rows)
        rows[:] = -1
        assert np.array_equal(array.rows, expected)


@pytest.fixture
def settings():
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


REHEARSED = """
import logging, sys
import jax
from numba.core.dispatcher import Dispatcher
from ratslam.runs.build_session import build_session, open_source, resolve_config
from ratslam.runs.settings.completion import complete
from robot.sources.in_memory import NO_ODOMETRY
from robot.touch_source import observation_of, open_touch_source
from tactile.base.types import observation

def compiled():
    modules = [module for name, module in sys.modules.items() if name.startswith("ratslam.mapping")]
    values = [value for module in modules for value in vars(module).values()]
    return {str(each): len(each.signatures) for each in values if isinstance(each, Dispatcher)}

class Kernels(logging.Handler):
    found = []

    def emit(self, record):
        self.found += [record.getMessage()] if record.getMessage().startswith("Compiling") else []

logging.getLogger("jax").addHandler(Kernels())
jax.config.update("jax_log_compiles", True)
config = resolve_config("whisker_maze")
with open_source(config) as source:
    config = complete(config, source)
    source = open_touch_source(source, config.touch)
    session = build_session(config, source)
    like = observation(NO_ODOMETRY, view_shape=source.view_shape, whiskers=source.whiskers)
    session.rehearse(like, config.pose_cells.cell_size, config.session.seed)
    before, kernels = compiled(), len(Kernels.found)
    for _, sample in zip(range(230), source):
        session.step(observation_of(sample))
later = Kernels.found[kernels:]
print(len(session.map.closures()), kernels, later, compiled() == before, sum(before.values()))
"""


def test_after_a_rehearsal_the_first_closures_compile_nothing():
    """In a process of its own: others have compiled already."""
    done = subprocess.run([sys.executable, "-c", REHEARSED], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    closures, kernels, later, same, functions = done.stdout.split()
    assert int(closures) > 5
    assert int(kernels) > 0
    assert (later, same) == ("[]", "True")
    assert int(functions) > 10
