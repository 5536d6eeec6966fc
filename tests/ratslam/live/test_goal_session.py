"""A live session that drives to goals on a saved map, on emulators."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from evaluation.metrics.trajectory import write_tum
from evaluation.papers.maps.scenarios import Recipe
from evaluation.papers.maps.stored_maps import store_map
from evaluation.papers.tables.touch_table import MAIN, touch_config
from ratslam.live.arm_session import plan_goals
from ratslam.runs.settings.run_config import load_config
from robot.live.arm_route import plan_path
from tactile.whisker_geometry import ur10_head
from tests.helpers.live import HEAD_FAULTS, ROOT, UR_FAULTS
from tests.ratslam.live.test_complete_session import CONFIG, PATIENT, emulated
from tests.ratslam.runs.test_map_formats import FILES

MAZE, CIRCUITS = 31002, "CCC"


def test_the_arm_begins_where_the_session_of_the_map_ended(tmp_path: Path) -> None:
    shutil.copy(FILES[-1], tmp_path / "map.npz")
    goals = ["live.plan.goal.to=[0]", f"live.plan.goal.map={tmp_path}"]
    ends = []
    for settings in (goals, [*goals, "live.plan.goal.at=[0.3, 0.1, 90]"]):
        config, _ = plan_goals(load_config("live_maze", settings))
        ends.append(plan_path(config.live, ur10_head(config.touch.head)).pose.tolist())
        write_tum(tmp_path / "truth.tum", np.arange(2.0), np.array([[0.5, 0.1, 0.0], [0.4, 0.2, 1.0]]))
    config, _ = plan_goals(load_config("live_maze", goals))
    ends.append(plan_path(config.live, ur10_head(config.touch.head)).pose.tolist())
    plain = load_config("live_maze")
    assert ends[0] == plan_path(plain.live, ur10_head(plain.touch.head)).pose[-1:].tolist()
    assert ends[1] == [[0.3, 0.1, pytest.approx(np.pi / 2)]]
    assert ends[2] == [pytest.approx([0.4, 0.2, 1.0])]


@pytest.mark.soak
@pytest.mark.timeout(1200)
def test_a_session_reaches_its_goals(loopback: str, tmp_path: Path) -> None:
    made = store_map(Recipe(touch_config(MAZE, 1, MAIN | {"path": {"circuits": CIRCUITS}})), tmp_path)
    settings = [
        *PATIENT, "live.budget=5", "live.plan.seed=1", f"live.plan.maze.seed={MAZE}",
        f"live.plan.path.circuits={CIRCUITS}", "live.plan.motion.jitter.position=0.005",
        "live.plan.motion.jitter.yaw_deg=1.5", "live.plan.motion.jitter.speed=0.05",
        f"live.plan.goal.map={made.path}", "live.plan.goal.to=[60, 0]",
    ]  # fmt: skip
    given = [word for setting in settings for word in ("--set", setting)]
    directory = tmp_path / "live"
    with emulated("ur10", UR_FAULTS, loopback, *given), emulated("head", HEAD_FAULTS, loopback, *given):
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
