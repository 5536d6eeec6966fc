"""The figure of drift: no noise, no drift; the packet adds less than a cell to the error of odometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.papers.cells.packet_figures import DRIFT, LEVELS, SPEED, measure_drift
from evaluation.papers.figure import Task

NAMES, TIMES = list(LEVELS), (10, 20)
CELL = np.array([0.05, np.radians(10)])


@pytest.fixture(scope="module")
def result() -> Any:
    return measure_drift(Task(41000, sessions=1), TIMES)


def test_without_noise_the_error_is_below_a_cell(result: Any) -> None:
    _, (packet, odometry, _) = result
    quiet = NAMES.index("none")
    assert (packet[:, quiet] < CELL / 2).all()
    assert (odometry[:, quiet] < 1e-9).all()


def test_the_packet_adds_less_than_half_a_cell_to_odometry(result: Any) -> None:
    _, (_, _, added) = result
    assert (added < CELL / 2).all()


def test_the_error_of_position_is_proportional_to_the_noise_of_the_speed(result: Any) -> None:
    _, (_, odometry, _) = result
    least, most = (NAMES.index(f"speed {each:g} sqrt(s)") for each in (SPEED[0], SPEED[-1]))
    ratio = odometry[:, most, :, 0] / odometry[:, least, :, 0]
    np.testing.assert_allclose(ratio, SPEED[-1] / SPEED[0])


def test_noise_of_the_heading_drifts_in_heading(result: Any) -> None:
    _, (_, odometry, _) = result
    for (_, heading), errors in zip(LEVELS.values(), odometry[0, ..., 1], strict=True):
        assert (errors <= 4 * heading * np.sqrt(TIMES) + 1e-9).all()
        assert (errors > 0).all() == (heading > 0)


def test_table_and_picture(result: Any, tmp_path: Path) -> None:
    text = "\n".join(DRIFT.table(result))
    assert all(text.count(f"| {level} |") == len(TIMES) for level in LEVELS)
    assert DRIFT.draw is not None
    DRIFT.draw(result, tmp_path / "drift.png")
    assert (tmp_path / "drift.png").read_bytes().startswith(b"\x89PNG")
