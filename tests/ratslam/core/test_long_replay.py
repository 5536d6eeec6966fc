"""Long replays: all steps are written, and memory grows only by the final map's part of each step.

    python -m tests.ratslam.core.test_long_replay labels | views | blind [--steps 1000000] [--folder FOLDER]

replays laps of a small circuit with the classic backend into a run directory, as `ratslam run` does, and
prints its time and memory.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import pytest

from robot.sources.source import Sample, SourceInfo
from tactile.base.random_streams import stream
from tactile.base.se2 import integrate
from tactile.base.types import Odometry, observation

PLACES, DWELL = 60, 10
"""Places of the circuit, and steps at each: a lap is 600 steps."""
VIEW = (3, 6, 1)
KINDS = "labels", "views", "blind"
"""Kinds of observation: a given place id, a view, or none (path integration only)."""

POSE = 24
"""Bytes of a pose."""
MAP = 8 + POSE
"""Bytes per step of the final map: a node and the motion since the last."""
KEPT = 2 * (MAP + POSE)
"""Bytes per step with the true pose, in arrays that double when they are full."""
COPIED = MAP
"""Bytes per step of the copy from which a checkpoint is written."""
ALIGNED = 6 * POSE
"""Bytes per step of the alignment of the whole path for the online error."""
SLACK = 24 * 2**20
"""Bytes independent of the steps: allocator, compiled code, file buffers."""

STATUS = Path("/proc/self/status")
FORGET = Path("/proc/self/clear_refs")


class Moment(NamedTuple):
    """peak: largest resident memory since the last moment, bytes. clock, own: wall and processor time, s."""

    peak: int
    clock: float
    own: float


class Circuit:
    """A `robot.sources.source.Source` that goes round and round, and measures the memory of its process."""

    rate_hz, view_shape, whiskers, digest, info = 10.0, VIEW, 0, "", SourceInfo()

    def __init__(self, kind: str, steps: int) -> None:
        self.name, self.kind, self.length = kind, kind, steps
        self.moments: list[Moment] = []
        lap = PLACES * DWELL
        random = stream(0, "tests.long_replay")
        self._views = random.random((PLACES, *VIEW))
        # The same errors on each lap, so that the last lap equals the second.
        self._motion = np.tile([0.01, 0.0, 2 * np.pi / lap], (lap, 1)) + random.normal(0, 2e-4, (lap, 3))
        self._truth = integrate(np.tile([0.01, 0.0, 2 * np.pi / lap], (lap, 1)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __iter__(self) -> Iterator[Sample]:
        early, lap = self.length // 10, len(self._motion)
        for k in range(self.length):
            if k in (early // 2, early):
                self._look()
            place, blind = k % lap // DWELL, self.kind == "blind"
            yield Sample(
                0.1 * k,
                observation(
                    Odometry(*self._motion[k % lap], 0.1),
                    self._views[place] if self.kind == "views" else None,
                    view_shape=VIEW,
                    label=place if self.kind == "labels" else -1,
                ),
                None if blind else self._truth[k % lap],
            )
        self._look()

    def _look(self) -> None:
        self.moments.append(Moment(_peak(), time.perf_counter(), time.process_time()))
        _forget()


def process_source(kind: str, steps: int, folder: Path) -> dict[str, Any]:
    """Replays steps into a run directory; returns times and memory.

    Returns:
        steps, and lines in steps.csv; early, late: most memory resident in the second half of the first tenth
        of the replay, and in the other nine, bytes; growth from the one to the other, bytes a step;
        microseconds a step in those nine, by the clock and of this process alone; compilations; places;
        kernel: bytes of its state.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    from ratslam.methods.method_registry import BACKENDS
    from ratslam.runs.build_session import build_session
    from ratslam.runs.run import process_source
    from ratslam.runs.run_directory import RunDirectory
    from ratslam.runs.runner import Runner
    from ratslam.runs.settings.run_config import RunConfig

    source = Circuit(kind, steps)
    config = RunConfig.model_validate(
        {
            "recording": {"file": "circuit.npz"},
            "backend": "classic",
            "templates": {"source": "labels" if kind == "labels" else "views"},
            "experience": {"solver": {"name": "relaxation", "loops": 1}},
        }
    )
    session = build_session(config, source)
    with RunDirectory(folder, BACKENDS.get(config.backend, "backend").columns()) as store:
        process_source(Runner(config, source, store, {}, session, 0), source)
    (_, early, late), rest = source.moments, 0.9 * steps
    with (folder / "steps.csv").open(encoding="utf-8") as lines:
        written = sum(1 for _ in lines) - 1
    return {
        "kind": kind,
        "steps": steps,
        "written": written,
        "early": early.peak,
        "late": late.peak,
        "growth": (late.peak - early.peak) / rest,
        "clock_us": 1e6 * (late.clock - early.clock) / rest,
        "own_us": 1e6 * (late.own - early.own) / rest,
        "compilations": session.compilations(),
        "places": len(session.map.graph()),
        "kernel": sum(leaf.nbytes for leaf in jax.tree.leaves(session.state)),
    }


def replay_in_a_process(kind: str, steps: int, folder: Path) -> dict[str, Any]:
    """Runs `process_source` in a separate process, so that only the replay uses memory."""
    if not STATUS.exists() or not FORGET.exists():
        pytest.skip("this system does not tell a process its peak memory")
    command = [sys.executable, "-m", "tests.ratslam.core.test_long_replay", kind, "--steps", str(steps)]
    done = subprocess.run([*command, "--folder", str(folder)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def memory_bound(kind: str, steps: int) -> float:
    """Bytes that memory may grow by between the first tenth of a replay and its end."""
    return (KEPT + COPIED + (0 if kind == "blind" else ALIGNED)) * steps + SLACK


def check_memory(found: dict[str, Any]) -> None:
    """Checks that all steps were written, and that memory has grown by the bound at most."""
    assert found["written"] == found["steps"]
    assert found["late"] - found["early"] <= memory_bound(found["kind"], found["steps"]), found
    assert found["places"] <= 2 * PLACES, "the circuit is not known again: this measures something else"


def test_memory_per_step_is_bounded(tmp_path):
    check_memory(replay_in_a_process("labels", 10_000, tmp_path / "run"))


@pytest.mark.soak
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("kind", KINDS)
def test_a_million_steps_fit_in_memory(kind, tmp_path):
    found = replay_in_a_process(kind, 1_000_000, tmp_path / "run")
    print(json.dumps(found))
    check_memory(found)


def _peak() -> int:
    """Most memory resident since `_forget`, bytes; 0 where the system does not provide it."""
    if not STATUS.exists():
        return 0
    lines = STATUS.read_text(encoding="ascii").splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def _forget() -> None:
    if FORGET.exists():
        FORGET.write_text("5", encoding="ascii")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        print(json.dumps(process_source(given.kind, given.steps, given.folder or Path(scratch) / "run")))


if __name__ == "__main__":
    main()
