"""Two emulators together: the head moves with the tool of the controller."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from robot.drivers.ur10.driver_config import BaseTransformConfig
from robot.emulators.head.emulator_config import HeadEmulatorConfig
from tests.helpers.live import until, ur_emulator
from tests.robot.emulators.head.heads import running

PLACING = BaseTransformConfig()


def test_the_head_follows_the_tool(tmp_path: Path, loopback: str) -> None:
    here, there = np.array([0.27, 0.27, 0.5]), np.array([0.63, 0.45, -2.0])
    config = HeadEmulatorConfig(host=loopback, path={"explore": 5}, arm=loopback, placing=PLACING)
    with ur_emulator(loopback, PLACING.tcp_from_pose(here, 0.1)) as arm, running(config, tmp_path) as head:

        def is_at(pose: np.ndarray, lift: float) -> bool:
            state = head(do="state")
            level = state["lift"] is not None and abs(state["lift"] - lift) < 1e-6
            return level and bool(np.allclose(state["pose"], pose, atol=1e-6))

        until(lambda: is_at(here, 0.1), "the head is at the arm's start")
        arm(do="place", tcp=PLACING.tcp_from_pose(there).tolist())
        until(lambda: is_at(there, 0.0), "the head is at the arm's new place")
