"""Coloured noise, drift and creep of simulated whiskers: their laws, and what they leave unchanged."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.simulation.head.baseline import HALL_BASELINE, Baseline, BaselineConfig, make_baseline
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig, choose_tier
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Cycle

NOISE, WHISKERS = 2e-3, 3000
"""Of many whiskers, so that a variance over them and both channels is known within 1.8 % (one sd)."""
TOLERANCE = 0.08
"""4.4 standard deviations of such a variance."""
SLOW = {"path": {"explore": 6.0}, "stream": {"rate": 1000.0}, "motion": {"jitter": {"speed": 0.05}}}


def baseline(rate: float, whiskers: int = WHISKERS, seed: int = 0, **changes: float) -> Baseline:
    return Baseline(BaselineConfig.model_validate(changes), NOISE, rate, whiskers, seed)


@settings(max_examples=15)
@given(
    st.floats(0, 1),
    st.floats(1e-3, 0.1),
    st.integers(1, 20),
    st.sampled_from([200.0, 2000.0]),
    st.integers(0, 2**32),
)
def test_coloured_noise_keeps_its_sd_and_has_the_correlation_of_its_settings(
    colour: float, time: float, lag: int, rate: float, seed: int
) -> None:
    white = NOISE * stream(seed, "sensor").standard_normal((1, 21, WHISKERS, 2))
    noise = baseline(rate, seed=seed, colour=colour, colour_time=time).colour(white)[0] / NOISE
    for row in noise[0], noise[-1]:  # from the first sample on
        assert row.var() == pytest.approx(1, rel=TOLERANCE)
    expected = colour * np.exp(-lag / (rate * time))
    assert (noise[0] * noise[lag]).mean() == pytest.approx(expected, abs=TOLERANCE)


@settings(max_examples=10)
@given(st.floats(0.1, 10), st.sampled_from([20.0, 100.0]), st.integers(0, 2**32))
def test_the_variance_of_the_drift_grows_evenly_by_that_of_a_second(
    drift: float, rate: float, seed: int
) -> None:
    still = np.zeros((2, round(2 * rate), WHISKERS, 2))
    path = baseline(rate, seed=seed, drift=drift).wander(still).reshape(-1, WHISKERS, 2) / NOISE
    for seconds in (0.5, 1.0, 2.0, 4.0):
        reached = path[round(seconds * rate) - 1]
        assert reached.var() == pytest.approx(drift**2 * seconds, rel=TOLERANCE)
    later = path[-1] - path[round(2 * rate) - 1]  # steps are independent of the past
    assert np.mean(later * path[round(2 * rate) - 1]) == pytest.approx(0, abs=TOLERANCE * 2 * drift**2)


@given(st.floats(0.001, 0.5), st.floats(0.05, 3), st.sampled_from([200.0, 2000.0]), st.floats(-1, 1))
def test_creep_tends_to_its_share_of_a_deflection_and_returns_to_zero(
    share: float, time: float, rate: float, bend: float
) -> None:
    whisker = baseline(rate, 1, creep=share, creep_time=time)
    count = round(rate * time)
    bent = whisker.wander(np.full((1, count, 1, 2), bend))[0, :, 0, 0]
    grown = share * bend * (1 - np.exp(-count / (rate * time)))
    assert bent[-1] == pytest.approx(grown)
    after = whisker.wander(np.zeros((1, 12 * count, 1, 2)))[0, :, 0, 0]
    assert after[count - 1] == pytest.approx(grown * np.exp(-count / (rate * time)))
    assert (np.diff(np.abs(after)) <= 0).all()
    assert abs(after[-1]) <= 1e-5 * abs(share * bend)


@given(st.lists(st.integers(1, 119), max_size=6, unique=True))
def test_the_parts_into_which_the_samples_are_cut_make_no_difference(cuts: list[int]) -> None:
    deflection = stream(1, "bends").standard_normal((1, 120, 2, 2))

    def samples(ends: list[int]) -> np.ndarray:
        made = make_baseline(HALL_BASELINE, NOISE, 100.0, 2, 5)
        assert made is not None
        parts = [deflection[:, a:b] for a, b in itertools.pairwise([0, *sorted(ends), 120])]
        return np.concatenate([made.colour(part) + made.wander(part) for part in parts], axis=1)

    assert np.array_equal(samples(cuts), samples([]))


def simulate(baseline: dict[str, Any], **changes: Any) -> HeadSimulation:
    mechanics = {"mechanics": {"baseline": baseline}}
    return HeadSimulation(SimulationConfig.model_validate(SLOW | mechanics | changes))


def cycles(source: HeadSimulation) -> list[Cycle]:
    found = [sample.reading for sample in source]
    assert all(isinstance(cycle, Cycle) for cycle in found)
    return found  # type: ignore[return-value]


@pytest.mark.parametrize("fidelity", ["quasistatic", "dynamic"])
def test_a_baseline_reaches_the_deflections_of_a_session_and_nothing_else(fidelity: str) -> None:
    open_loop = {"fidelity": fidelity, "whisking": {"mode": "open"}}
    source, plain = simulate(HALL_BASELINE.model_dump(), **open_loop), simulate({}, **open_loop)
    one, off = cycles(source), cycles(plain)
    for with_it, without in zip(one, off, strict=True):
        assert np.array_equal(with_it.angle, without.angle)
        assert (np.abs(with_it.deflection - without.deflection).max(axis=0) > NOISE).all()
    assert np.array_equal(source.odometry, plain.odometry)
    assert np.array_equal(source.truth, plain.truth)
    for first, again in zip(one, cycles(source), strict=True):
        assert np.array_equal(first.deflection, again.deflection)
    cut = cycles(simulate(HALL_BASELINE.model_dump(), **open_loop | {"stream": {"rate": 1000.0, "batch": 2}}))
    for first, again in zip(one, cut, strict=True):
        assert np.array_equal(first.deflection, again.deflection)


def test_drift_goes_on_through_the_free_record_and_from_whisk_to_whisk() -> None:
    source = simulate({"drift": 100.0}, whisking={"mode": "open"}, calibration={"max_outlier_share": 0.9})
    still = cycles(simulate({"drift": 0.0}, raw=True, whisking={"mode": "open"}))
    drift = [a.deflection - b.deflection for a, b in zip(cycles(source), still, strict=True)]
    whisk = np.array([part[-1] - part[0] for part in drift]).std()
    between = np.array([later[0] - earlier[-1] for earlier, later in itertools.pairwise(drift)])
    assert between.std() < 0.1 * whisk
    # After 4 s of free record the drift has 2 sd of a second.
    assert drift[0][0].std() == pytest.approx(2 * 100 * NOISE, rel=0.5)


def test_a_baseline_needs_raw_samples() -> None:
    on = {"mechanics": {"baseline": {"creep": 0.01}}}
    assert choose_tier(SimulationConfig.model_validate(on))[0] == "quasistatic"
    with pytest.raises(InputError, match=r"mechanics\.baseline"):
        choose_tier(SimulationConfig.model_validate(on | {"fidelity": "kinematic"}))
    assert make_baseline(BaselineConfig(), NOISE, 2000.0, 18, 0) is None
