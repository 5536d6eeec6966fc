"""A live session that drives to goals on a saved map, on emulators."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from ratslam.experiments.atlas.sessions import Recipe, touch_config
from ratslam.experiments.atlas.stored_maps import store_map
from ratslam.experiments.tables.touch import MAIN
from tests.helpers.live import HEAD_FAULTS, ROOT, UR_FAULTS
from tests.ratslam.live.test_complete_session import CONFIG, PATIENT, emulated

MAZE, CIRCUITS = 31002, "CCC"


@pytest.mark.soak
@pytest.mark.timeout(1200)
def test_a_session_reaches_its_goals(loopback: str, tmp_path: Path) -> None:
    made = store_map(Recipe(touch_config(MAZE, 1, MAIN | {"path": {"circuits": CIRCUITS}}, {})), tmp_path)
    settings = [
        *PATIENT, "live.budget=5", "live.plan.seed=1", f"live.plan.maze.seed={MAZE}",
        f"live.plan.path.circuits={CIRCUITS}", "live.plan.motion.jitter.position=0.005",
        "live.plan.motion.jitter.yaw_deg=1.5", "live.plan.motion.jitter.speed=0.05",
        f"live.plan.goal.map={made.path}", "live.plan.goal.to=[60, 0]",
    ]  # fmt: skip
    given = [word for setting in settings for word in ("--set", setting)]
    directory = tmp_path / "live"
    with (
        emulated("ur10", UR_FAULTS, loopback, *given),
        emulated("head", HEAD_FAULTS, loopback, *given),
    ):
        command = [sys.executable, "-m", "ratslam", "live", CONFIG, "--ur-host", loopback, "--head", loopback]
        done = subprocess.run(
            [*command, "-o", str(directory), *given],
            cwd=ROOT, capture_output=True, text=True, timeout=900,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "reached: " in done.stderr
    report = json.loads((directory / "live.json").read_text())
    assert [goal["state"] for goal in report["goals"]] == ["reached", "reached"]
    assert (directory / "localisation.csv").exists()
