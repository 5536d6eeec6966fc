"""ATE and RPE against evo's command line, where a user has it (GPL: a program of its own, never imported)."""

from __future__ import annotations

import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from evaluation.metrics.trajectory import ate, rpe, write_tum


@pytest.fixture
def evo(tmp_path):
    """Runs one of evo's commands on the two files and returns its root mean square error."""
    if not (shutil.which("evo_ape") and shutil.which("evo_rpe")):
        pytest.skip("evo's command line is not installed")

    def run(command, *options):
        line = [command, "tum", "truth.tum", "estimate.tum", *options]
        env = {**os.environ, "HOME": str(tmp_path), "MPLBACKEND": "Agg"}
        done = subprocess.run(
            line, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120, check=True
        )
        return float(re.search(r"rmse\s+(\S+)", done.stdout)[1])

    return run


def test_ate_and_rpe_agree_with_evo(evo, tmp_path):
    random = np.random.default_rng(8)
    truth = np.cumsum(random.normal(size=(80, 3)) * [0.3, 0.3, 0.4], axis=0)
    estimate = truth + random.normal(0, 0.1, truth.shape)
    time = np.arange(80.0)
    write_tum(tmp_path / "truth.tum", time, truth)
    write_tum(tmp_path / "estimate.tum", time, estimate)
    assert evo("evo_ape", "--align") == pytest.approx(ate(estimate, truth), abs=2e-6)
    assert evo("evo_rpe") == pytest.approx(rpe(estimate, truth)[0], abs=2e-6)
    rotation = np.degrees(rpe(estimate, truth, step=5)[1])
    found = evo("evo_rpe", "--pose_relation", "angle_deg", "--delta", "5", "--all_pairs")
    assert found == pytest.approx(rotation, abs=2e-6)
