"""The errors of an odometry are found again from revisits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ratslam.runs.build_session import open_source
from ratslam.runs.settings.run_config import load_config
from ratslam.service.record_fit import fit_record, fit_revisits, fit_wheels_of
from ratslam.service.rig_fit import Quantity, Rig, fit_wheels
from robot.sources.in_memory import load_into_memory

ROOT = Path(__file__).parents[4]


@pytest.mark.soak
def test_revisits_tell_the_heading_bias_of_the_square() -> None:
    """Against its true poses: three laps of a square by a robot with a biased gyro."""
    config = load_config(ROOT / "configs" / "square.yaml")
    with open_source(config) as source:
        log = load_into_memory(source)
    assert log.truth is not None
    true, found = fit_wheels(log.time, log.motion, log.truth), fit_revisits(config)
    assert found is not None
    bias = found.quantities[-1].value
    assert abs(true.heading_bias[0]) > 0.01
    assert abs(bias - true.heading_bias[0]) < 0.5 * abs(true.heading_bias[0])
    assert np.sign(bias) == np.sign(true.heading_bias[0])


@pytest.mark.parametrize("known", [True, False])
def test_a_record_without_truth_tells_no_length_scale(known: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same record, its truth withheld; a map that closes no loops tells nothing at all."""
    config = load_config(ROOT / "configs" / "square.yaml")
    with open_source(config) as source:
        samples = [sample._replace(truth=None) for sample in source]
    turn = Quantity("turn scale", 1.0, 1.0, 0.02, "rad/rad", "recording.odometry.turn_scale")
    bias = Quantity("heading bias", 0.0, 0.03, 0.001, "rad/m", "recording.odometry.heading_bias")
    found = Rig((turn, bias)) if known else None
    monkeypatch.setattr("ratslam.service.record_fit.fit_revisits", lambda config, assumed: found)
    rig = fit_wheels_of(config, config, samples, 0)
    assert [quantity.name for quantity in rig.quantities] == (["turn scale", "heading bias"] if known else [])
    assert any("length scale" in reason for reason in rig.unknown)
    settings = {"recording": {"odometry": {"heading_bias": 0.03}}} if known else {}
    assert rig.included() == settings


def test_the_record_of_the_square_is_fitted_from_its_truth() -> None:
    names = [
        quantity.name for quantity in fit_record(load_config(ROOT / "configs" / "square.yaml")).quantities
    ]
    assert "length scale" in names
