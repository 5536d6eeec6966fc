"""Noise, drift and creep of whiskers: estimates from known signals, and the settings fitted to real ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.whiskers.drift import (
    CHECK,
    FIGURE,
    FIT,
    RATE,
    creep_figures,
    free_figures,
    simulate_free,
)
from robot.simulation.head.baseline import HALL_BASELINE, BaselineConfig
from tactile.base.errors import InputError
from tactile.base.random_streams import stream


@pytest.mark.parametrize("drift", [0.5, 2.0])
@pytest.mark.parametrize("time", [0.004, 0.01])
def test_colour_and_drift_of_a_signal_are_found(drift: float, time: float) -> None:
    config = BaselineConfig(colour=1.0, colour_time=time, drift=drift)
    found = free_figures(simulate_free(config, 2000).reshape(2000, -1), RATE)
    assert found.time == pytest.approx(time, rel=0.2)
    assert found.drift == pytest.approx(drift, abs=0.15)
    white = free_figures(simulate_free(BaselineConfig(), 2000).reshape(2000, -1), RATE)
    assert white.time is None
    assert white.drift < 0.15


def test_the_creep_of_a_signal_is_found() -> None:
    time = np.arange(2400) / RATE
    held = (time > 3) & (time < 5)
    since = np.maximum(time - 5, 0)
    offset = 400 * 0.05 * (1 - np.exp(-2 / 0.8)) * np.exp(-since / 0.8) * (time >= 5)
    signal = stream(0, "noise").standard_normal((2400, 3, 3))
    signal[..., 1] += np.where(held, 400.0, offset)[:, None]
    found, shares, _ = creep_figures(signal, None)
    assert np.median(shares) == pytest.approx(0.05, rel=0.1)
    assert found == pytest.approx(0.8, rel=0.15)
    signal[..., 1] = np.where(held[:, None], 400.0, stream(1, "noise").standard_normal((2400, 3)))
    assert np.abs(creep_figures(signal, 0.8)[1]).max() < 0.005


def test_the_simulator_has_the_noise_drift_and_creep_of_the_fitted_whiskers(
    reference_data: Path, tmp_path: Path
) -> None:
    found = FIGURE.measure(reference_data)
    free, crept = found
    fitted, (creep_time, creep, _) = free["fitted"], crept["fitted"]
    assert fitted.time == pytest.approx(HALL_BASELINE.colour_time, rel=0.15)
    assert fitted.drift == pytest.approx(HALL_BASELINE.drift, rel=0.1)
    assert np.median(creep) == pytest.approx(HALL_BASELINE.creep, rel=0.15)
    assert creep_time == pytest.approx(HALL_BASELINE.creep_time, rel=0.1)
    assert not set(FIT[0] + FIT[1]) & set(CHECK[0] + CHECK[1])
    assert free["checked"].drift == pytest.approx(fitted.drift, rel=0.3)
    assert free["control: white noise"].drift < 0.2 * fitted.drift
    assert free["camera"].drift < 0.2 * fitted.drift
    lines = list(FIGURE.table(found))
    assert sum(line.startswith("|") for line in lines) == 2 + len(free)
    assert FIGURE.draw is not None
    FIGURE.draw(found, tmp_path / "drift.png")
    assert (tmp_path / "drift.png").stat().st_size > 10_000


def test_a_missing_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="reaching_take20"):
        FIGURE.measure(tmp_path)
