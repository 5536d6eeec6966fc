"""The program compiles its kernels otherwise than these tests do, and maps alike."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from evaluation.artifacts.closure_table import read_closure_table
from evaluation.metrics.trajectory import read_tum
from tests.helpers.environment import as_users_do
from tests.helpers.square_run import copy_square_run

ROOT = Path(__file__).parents[3]


@pytest.mark.soak
def test_the_program_as_users_compile_it_gives_the_same_map(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ratslam", "run", "configs/square.yaml", "-o", str(tmp_path / "users")]
    done = subprocess.run(command, cwd=ROOT, env=as_users_do(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    runs = tmp_path / "users", copy_square_run(tmp_path / "ours")
    (_, users), (_, ours) = (read_tum(run / "trajectory.tum") for run in runs)
    assert ours == pytest.approx(users, abs=1e-6)
    pairs = [read_closure_table(run).steps for run in runs]
    assert len(pairs[0]) > 100
    assert np.array_equal(*pairs)
