"""Long replays: all steps are written, and memory grows only by the final map's part of each step.

`python -m tests.ratslam.core.test_long_replay STEPS FOLDER` replays laps of a small circuit with the
classic backend into a run directory, as `ratslam run` does, and prints its memory.
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from robot.sources.in_memory import InMemorySource
from robot.sources.source import Sample
from tactile.base.random_streams import stream
from tactile.base.se2 import integrate

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
SETTINGS = {
    "backend": "classic", "templates": {"source": "labels"},
    "experience": {"solver": {"name": "relaxation", "loops": 1}},
}  # fmt: skip


class Circuit(InMemorySource):
    """Measures the memory of its process: `peaks` in the first twentieth, the second one, and the rest,
    bytes."""

    peaks: ClassVar[list[int]] = []

    def __iter__(self) -> Iterator[Sample]:
        for k, sample in enumerate(super().__iter__()):
            if k in (self.length // 20, self.length // 10):
                self.look()
            yield sample
        self.look()

    def look(self) -> None:
        lines = STATUS.read_text(encoding="ascii").splitlines()
        self.peaks.append(next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM")))
        FORGET.write_text("5", encoding="ascii")


def circuit(steps: int) -> Circuit:
    """Given places, round and round, with the same errors on each lap."""
    lap = PLACES * DWELL
    exact = np.tile([0.01, 0.0, 2 * np.pi / lap], (lap, 1))
    moved = exact + stream(0, "tests.long_replay").normal(0, 2e-4, exact.shape)
    motion = np.column_stack([np.resize(moved, (steps, 3)), np.full(steps, 0.1)])
    return Circuit(
        name="circuit", digest="", time=0.1 * np.arange(steps), motion=motion, moved=np.ones(steps, bool),
        views=np.broadcast_to(0.0, (steps, 3, 6, 1)), seen=np.zeros(steps, bool),
        label=np.arange(steps, dtype=np.int32) % lap // DWELL, truth=np.resize(integrate(exact), (steps, 3)),
    )  # fmt: skip


def replay(steps: int, folder: Path) -> dict[str, int]:
    """Lines in steps.csv, places, and the most memory resident in the second twentieth of the replay and in
    its last nine tenths, bytes."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from ratslam.runs.run import process_source
    from ratslam.runs.runner import open_runner
    from ratslam.runs.settings.run_config import LoopConfig

    source = circuit(steps)
    with open_runner(LoopConfig.model_validate(SETTINGS), source, folder) as runner:
        process_source(runner, source)
        places = len(runner.session.map.graph())
    _, early, late = source.peaks
    written = (folder / "steps.csv").read_text(encoding="utf-8").count("\n") - 1
    return {"written": written, "places": places, "early": early, "late": late}


@pytest.mark.parametrize("steps", [10_000, pytest.param(1_000_000, marks=pytest.mark.soak)])
@pytest.mark.timeout(7200)
def test_memory_per_step_is_bounded(steps: int, tmp_path: Path) -> None:
    """In a process of its own, so that only the replay uses memory."""
    if not STATUS.exists() or not FORGET.exists():
        pytest.skip("this system does not tell a process its peak memory")
    command = [sys.executable, "-m", "tests.ratslam.core.test_long_replay", str(steps), str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["written"] == steps
    assert found["late"] - found["early"] <= (KEPT + COPIED + ALIGNED) * steps + SLACK, found
    assert found["places"] <= 2 * PLACES, "the circuit is not known again: this measures something else"


if __name__ == "__main__":
    print(json.dumps(replay(int(sys.argv[1]), Path(sys.argv[2]))))
