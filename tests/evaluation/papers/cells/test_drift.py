"""The figure of drift: no noise, no drift; the packet adds less than a cell to the error of odometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.papers.cells.packet_figures import (
    DRIFT,
    LEVELS,
    SPEED,
    Noise,
    measure_drift,
    rms,
)
from evaluation.papers.figure import Task

CELL = np.array([0.05, np.radians(10)])


@pytest.fixture(scope="module")
def result() -> Any:
    return measure_drift(Task(41000, sessions=1), (10, 20))


def test_without_noise_the_error_is_below_a_cell(result: Any) -> None:
    quiet = LEVELS.index(Noise(0.0, 0.0))
    assert (result.packet[:, quiet] < CELL / 2).all()
    assert (result.odometry[:, quiet] < 1e-9).all()


def test_the_packet_adds_less_than_half_a_cell_to_odometry(result: Any) -> None:
    assert (result.added < CELL / 2).all()


def test_the_error_of_position_is_proportional_to_the_noise_of_the_speed(result: Any) -> None:
    least, most = (LEVELS.index(Noise(each, 0.0)) for each in (SPEED[0], SPEED[-1]))
    ratio = result.odometry[:, most, :, 0] / result.odometry[:, least, :, 0]
    np.testing.assert_allclose(ratio, SPEED[-1] / SPEED[0])


def test_noise_of_the_heading_drifts_in_heading(result: Any) -> None:
    for level, errors in zip(LEVELS, rms(result.odometry)[..., 1], strict=True):
        assert (errors <= 4 * level.heading * np.sqrt(result.times) + 1e-9).all()
        assert (errors > 0).all() == (level.heading > 0)


def test_table_and_picture(result: Any, tmp_path: Path) -> None:
    text = "\n".join(DRIFT.table(result))
    assert all(text.count(f"| {level} |") == len(result.times) for level in LEVELS)
    assert DRIFT.draw is not None
    DRIFT.draw(result, tmp_path / "drift.png")
    assert (tmp_path / "drift.png").read_bytes().startswith(b"\x89PNG")
