"""Long replays: all steps are written, and memory grows only by the final map's part of each step.

`python -m tests.ratslam.core.test_long_replay STEPS FOLDER` replays laps of a small circuit with the
classic backend into a run directory, as `ratslam run` does, and prints its memory.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest

from robot.sources.source import Sample, SourceInfo
from tactile.base.random_streams import stream
from tactile.base.se2 import integrate
from tactile.base.types import Odometry, observation

PLACES, DWELL = 60, 10
"""Places of the circuit, and steps at each: a lap is 600 steps."""
POSE = 24
"""Bytes of a pose."""
MAP = 8 + POSE
"""Bytes per step of the final map: a node and the motion since the last."""
KEPT, COPIED = 2 * (MAP + POSE), MAP
"""Bytes per step with the true pose, in arrays that double when they are full, and of a checkpoint's copy."""
ALIGNED = 6 * POSE
"""Bytes per step of the alignment of the whole path for the online error."""
SLACK = 24 * 2**20
"""Bytes independent of the steps: allocator, compiled code, file buffers."""
STATUS, FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Circuit:
    """A source of given places that goes round and round, and measures the memory of its process: `peaks` in
    the first twentieth, the second one, and the rest, bytes."""

    name, rate_hz, view_shape, whiskers, digest, info = "circuit", 10.0, (3, 6, 1), 0, "", SourceInfo()

    def __init__(self, steps: int) -> None:
        self.length = steps
        self.peaks: list[int] = []
        lap = PLACES * DWELL
        random = stream(0, "tests.long_replay")
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
            moved, place = Odometry(*self._motion[k % lap], 0.1), k % lap // DWELL
            reading = observation(moved, None, view_shape=self.view_shape, label=place)
            yield Sample(0.1 * k, reading, self._truth[k % lap])
        self._look()

    def _look(self) -> None:
        lines = STATUS.read_text(encoding="ascii").splitlines()
        self.peaks.append(next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM")))
        FORGET.write_text("5", encoding="ascii")


def replay(steps: int, folder: Path) -> dict[str, int]:
    """Lines in steps.csv, places, and the most memory resident in the second twentieth of the replay and in
    its last nine tenths, bytes."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from ratslam.methods.method_registry import BACKENDS
    from ratslam.runs.build_session import build_session
    from ratslam.runs.run import process_source
    from ratslam.runs.run_directory import RunDirectory
    from ratslam.runs.runner import Runner
    from ratslam.runs.settings.run_config import RunConfig

    source = Circuit(steps)
    settings: dict[str, Any] = {
        "recording": {"file": "circuit.npz"},
        "backend": "classic",
        "templates": {"source": "labels"},
        "experience": {"solver": {"name": "relaxation", "loops": 1}},
    }
    config = RunConfig.model_validate(settings)
    session = build_session(config, source)
    with RunDirectory(folder, BACKENDS.get(config.backend, "backend").columns()) as store:
        process_source(Runner(config, source, store, {}, session, 0), source)
    with (folder / "steps.csv").open(encoding="utf-8") as lines:
        written = sum(1 for _ in lines) - 1
    _, early, late = source.peaks
    return {"written": written, "places": len(session.map.graph()), "early": early, "late": late}


@pytest.mark.parametrize("steps", [10_000, pytest.param(1_000_000, marks=pytest.mark.soak)])
@pytest.mark.timeout(7200)
def test_memory_per_step_is_bounded(steps: int, tmp_path: Path) -> None:
    """In a process of its own, so that only the replay uses memory."""
    if not STATUS.exists() or not FORGET.exists():
        pytest.skip("this system does not tell a process its peak memory")
    module, folder = "tests.ratslam.core.test_long_replay", str(tmp_path / "run")
    command = [sys.executable, "-m", module, str(steps), folder]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["written"] == steps
    assert found["late"] - found["early"] <= (KEPT + COPIED + ALIGNED) * steps + SLACK, found
    assert found["places"] <= 2 * PLACES, "the circuit is not known again: this measures something else"


if __name__ == "__main__":
    print(json.dumps(replay(int(sys.argv[1]), Path(sys.argv[2]))))
