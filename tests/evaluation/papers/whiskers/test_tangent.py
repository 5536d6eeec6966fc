"""The figure of tangents: its truth, its comparison of sweeps, and its numbers on one day of real sweeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.whiskers.tangent import (
    FIGURE,
    RADIUS,
    CylinderResult,
    SweepResult,
    TangentResult,
    Tangents,
    angle_between,
    circle_tangents,
    fit_centre,
    repeatability,
)
from tactile.base.errors import InputError

CENTRE = np.array([4e-3, -6e-3])


def sweep_along_circle(start_deg: float, wrong_deg: float) -> SweepResult:
    """A sweep on the circle from an angle downwards, its tangents wrong by an angle."""
    angle = np.radians(start_deg - np.arange(0.0, 80.0, 2.0))
    points = CENTRE + RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    none = np.zeros(len(angle))
    tangents = Tangents((angle + np.pi / 2 + np.radians(wrong_deg)) % np.pi, none + 0.1, none)
    return SweepResult(points, tangents, np.pi, RADIUS, points, tangents)


def test_the_truth_is_the_circle_about_the_other_days_centre() -> None:
    sweeps = [sweep_along_circle(150.0, 0.0), sweep_along_circle(130.0, 0.0)]
    centre = fit_centre([sweep.points for sweep in sweeps])
    np.testing.assert_allclose(centre, CENTRE, atol=1e-6)
    truth = circle_tangents(sweeps[0].points, centre)
    assert angle_between(sweeps[0].tangents.direction, truth).max() < 0.1
    assert angle_between(np.radians(179.0), np.radians(-179.0)) == pytest.approx(2.0)


def test_sweeps_are_compared_where_they_pass_the_same_place() -> None:
    sweeps = [sweep_along_circle(150.0, 3.0), sweep_along_circle(130.0, -4.0)]
    angles = repeatability(sweeps)
    assert 20 < len(angles) < 35
    np.testing.assert_allclose(angles, 7.0, atol=2.0)


def test_table_and_picture_hold_each_figure_beside_its_control(tmp_path: Path) -> None:
    sweeps = [sweep_along_circle(150.0, 5.0), sweep_along_circle(130.0, 5.0)]
    truth = [circle_tangents(sweep.points, CENTRE) for sweep in sweeps]
    day = CylinderResult(sweeps, CENTRE, truth, truth)
    result = TangentResult(
        {"May 03": day, "May 04": day, "May 09": day},
        {"flat": sweeps, "star 2": sweeps},
        {"flat": 0, "star 2": 1},
    )
    lines = list(FIGURE.table(result))
    row = next(line for line in lines if line.startswith("| all |"))
    assert "| 6 | 5.0° (5.0°) | 5.0° (5.0°) |" in row
    assert "| 15.0 mm (15.0-15.0) | 6 of 6 |" in row
    motion = angle_between(np.concatenate(truth), 0.0)
    assert f"{np.median(motion):.1f}°" in row
    assert any(line.startswith("| star 2 | 2 (1) |") for line in lines)
    assert FIGURE.draw is not None
    FIGURE.draw(result, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def test_a_missing_bench_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file or folder"):
        FIGURE.measure(tmp_path)


@pytest.mark.soak
def test_the_figure_meets_its_goals_on_the_real_bench(reference_data: Path) -> None:
    result = FIGURE.measure(reference_data)
    days = list(result.cylinder.values())
    sweeps = [sweep for day in days for sweep in day.sweeps]
    truth = [one for day in days for one in day.truth]
    assert len(sweeps) == 21
    pairs = list(zip(sweeps, truth, strict=True))
    error = np.concatenate([angle_between(sweep.tangents.direction, true) for sweep, true in pairs])
    motion = np.concatenate([angle_between(true, sweep.motion) for sweep, true in pairs])
    assert np.median(error) <= 6.0
    assert np.median(motion) > 15.0
    assert abs(np.median([sweep.radius for sweep in sweeps]) / RADIUS - 1) <= 0.2
    flat = np.concatenate(
        [angle_between(sweep.tangents.direction, sweep.motion) for sweep in result.others["flat"]]
    )
    assert np.median(flat) <= 1.5
