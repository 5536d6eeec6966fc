"""ATE and RPE against evo's command line, where a user has it (GPL: a program of its own, never imported)."""

import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from evaluation.metrics.trajectory import ate, rpe, write_tum


def test_ate_and_rpe_agree_with_evo(tmp_path):
    if not (shutil.which("evo_ape") and shutil.which("evo_rpe")):
        pytest.skip("evo's command line is not installed")

    def evo(command, *options):
        """The root mean square error that one of evo's commands gives."""
        line = [command, "tum", tmp_path / "truth.tum", tmp_path / "estimate.tum", *options]
        env = {**os.environ, "HOME": str(tmp_path), "MPLBACKEND": "Agg"}
        done = subprocess.run(line, env=env, capture_output=True, text=True, timeout=120, check=True)
        return float(re.search(r"rmse\s+(\S+)", done.stdout)[1])

    random = np.random.default_rng(8)
    truth = np.cumsum(random.normal(size=(80, 3)) * [0.3, 0.3, 0.4], axis=0)
    estimate = truth + random.normal(0, 0.1, truth.shape)
    write_tum(tmp_path / "truth.tum", np.arange(80.0), truth)
    write_tum(tmp_path / "estimate.tum", np.arange(80.0), estimate)
    assert evo("evo_ape", "--align") == pytest.approx(ate(estimate, truth), abs=2e-6)
    assert evo("evo_rpe") == pytest.approx(rpe(estimate, truth)[0], abs=2e-6)
    found = evo("evo_rpe", "--pose_relation", "angle_deg", "--delta", "5", "--all_pairs")
    assert found == pytest.approx(np.degrees(rpe(estimate, truth, step=5)[1]), abs=2e-6)
