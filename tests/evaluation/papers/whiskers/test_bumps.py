"""The figure of the real Create's bumpers: on the recording, and its table without it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.whiskers import bumps
from evaluation.papers.whiskers.bumps import BumpsResult
from ratslam.core.estimates import GridDrawing
from tactile.base.errors import InputError


def some_result() -> BumpsResult:
    grid = GridDrawing(np.full((4, 4), 0.3), np.array([-0.2, -0.2]), 0.1)
    path = np.column_stack([np.linspace(0, 1, 5), np.zeros(5), np.zeros(5)])
    return BumpsResult(
        {"grid filter": np.array([0.5, 0.7, 1.2]), bumps.OTHERS: np.array([0.5])},
        {"grid filter": np.array([0.6, 0.8, 1.3]), bumps.OTHERS: np.array([0.5])},
        {"odometry": 1.08, f"odometry, {bumps.OTHERS}": 0.4},
        (0.1, 0.9), np.array([0.17, 0.18, 0.25]), path, path, path, (grid, np.zeros(3)),
        np.array([[0.0, 0, 1, 1]]),
    )  # fmt: skip


def test_the_table_names_the_rows_that_are_worse_than_their_odometry(tmp_path: Path) -> None:
    lines = list(bumps.FIGURE.table(some_result()))
    assert "| grid filter | 0.70 (1.20) | 0.80 (1.30) | 1 of 3 |" in lines
    assert f"| {bumps.OTHERS} | 0.50 (0.50) | 0.50 (0.50) | 1 of 1 |" in lines
    assert "3 contacts; the true distance to the nearest wall is 0.180 m" in lines[-1]
    assert "advances by 0.10 of its odometry, in others by 0.90" in lines[-1]
    assert bumps.FIGURE.draw is not None
    bumps.FIGURE.draw(some_result(), tmp_path / "bumps.png")
    assert (tmp_path / "bumps.png").stat().st_size > 10_000


def test_a_missing_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"create_lab_odometry\.csv"):
        bumps.FIGURE.measure(tmp_path)


@pytest.mark.soak
def test_the_filter_is_better_than_odometry_because_wheels_slip_at_walls(
    reference_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RATSLAM_DATA", str(reference_data))
    few = ("grid.particles=10", "grid.cell=0.1")
    rows = {"grid filter": few, "no slip at walls": (*few, "grid.drift.slip=0.0")}
    monkeypatch.setattr(bumps, "VARIANTS", rows)
    monkeypatch.setattr(bumps, "SEEDS", range(2))
    result = bumps.FIGURE.measure(reference_data)
    assert result.odometry["odometry"] == pytest.approx(1.08, abs=0.005)
    assert (result.final["grid filter"] < result.final["no slip at walls"].min()).all()
    assert (result.final["no slip at walls"] < 1.05 * result.odometry["odometry"]).all()
    pressed, others = result.advance
    assert pressed < 0.1
    assert others > 0.85
    assert len(result.distance) == 35
    assert np.median(result.distance) == pytest.approx(0.182, abs=0.001)
