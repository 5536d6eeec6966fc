"""The program compiles its kernels otherwise than these tests do, and maps alike."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from evaluation.artifacts.closure_table import read_closure_table
from evaluation.metrics.trajectory import read_tum
from tests.conftest import FEWER_PASSES

ROOT = Path(__file__).parents[3]


def run_square(folder: Path, flags: str) -> Path:
    """The run directory of `configs/square.yaml`, compiled with these flags of XLA."""
    command = [sys.executable, "-m", "ratslam", "run", "configs/square.yaml", "-o", str(folder)]
    environment = os.environ | {"XLA_FLAGS": flags}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.soak
def test_kernels_compiled_with_fewer_passes_give_the_same_map(tmp_path: Path) -> None:
    runs = run_square(tmp_path / "users", ""), run_square(tmp_path / "tests", FEWER_PASSES)
    (_, users), (_, ours) = (read_tum(run / "trajectory.tum") for run in runs)
    assert ours == pytest.approx(users, abs=1e-6)
    pairs = [read_closure_table(run).steps for run in runs]
    assert len(pairs[0]) > 100
    assert np.array_equal(*pairs)
