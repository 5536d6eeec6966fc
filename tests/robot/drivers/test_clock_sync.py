"""Clock synchronisation under any delays, drift and jumps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.clock_sync import JUMP, MAX_DRIFT, RESIDUAL_QUANTILE, WINDOW, ClockSync
from tactile.base.random_streams import stream

SHORTEST = 2e-4
"""Shortest transmission delay, s."""


def pairs(
    seconds: float, rate: float = 100.0, ppm: float = 50.0, offset: float = 3e4, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(device, arrival, true host) times [N], s, with long-tailed delays of up to 32 ms."""
    random = stream(seed, "delays")
    host = offset + np.arange(round(seconds * rate)) / rate
    device = 17.0 + (host - offset) * (1 + ppm * 1e-6)
    delay = SHORTEST + np.minimum(random.exponential(4e-4, len(host)), 0.032)
    spikes = random.random(len(host)) < 0.02
    delay[spikes] += random.uniform(0, 0.032, spikes.sum())
    # Messages arrive in order.
    return device, np.maximum.accumulate(host + delay), host


def fit_clock(device: np.ndarray, arrival: np.ndarray, clock: ClockSync | None = None) -> ClockSync:
    clock = clock or ClockSync()
    for one, other in zip(device, arrival, strict=True):
        clock.observe(one, other)
    return clock


@given(st.floats(-150, 150), st.integers(0, 30), st.sampled_from([100.0, 125.0, 500.0]))
def test_host_time_is_accurate_to_the_shortest_delay(ppm: float, seed: int, rate: float) -> None:
    """The line is a lower bound of all arrivals."""
    device, arrival, host = pairs(8, rate, ppm, seed=seed)
    clock = fit_clock(device, arrival)
    off = clock.to_host(device) - host - SHORTEST
    assert np.abs(off[-round(2 * rate) :]).max() < 2e-4  # while single arrivals are up to 32 ms off
    assert (arrival - clock.to_host(device)).min() > -1e-9
    assert abs(clock.scale - 1 / (1 + ppm * 1e-6)) < 6e-5
    assert clock.jumps == 0


@pytest.mark.parametrize("drift", [-0.8e-6, 0.8e-6])
def test_drift_is_tracked(drift: float) -> None:
    """Pairs older than the window have no effect."""
    device, arrival, host = pairs(4 * WINDOW, 50.0, ppm=0)
    device = device + drift * (host - host[0]) ** 2  # by 192 ppm at the end
    clock = ClockSync()
    off = []
    for one, other, real in zip(device, arrival, host, strict=True):
        clock.observe(one, other)
        off.append(clock.to_host(one) - real - SHORTEST)
    assert np.abs(off[100:]).max() < 6e-4
    assert clock.jumps == 0


def test_the_result_depends_on_the_observations_only() -> None:
    device, arrival, _ = pairs(3)
    one, other = fit_clock(device, arrival), ClockSync()
    for k in range(len(device)):
        other.observe(device[k], arrival[k])
        other.to_host(1.0), other.residual
    assert (one.to_host(50.0), one.scale, one.residual) == (other.to_host(50.0), other.scale, other.residual)


def test_the_residual_is_a_quantile_of_the_delays() -> None:
    device, arrival, host = pairs(20)
    early = np.quantile(arrival - host - SHORTEST, RESIDUAL_QUANTILE)
    assert fit_clock(device, arrival).residual == pytest.approx(early, abs=5e-5)
    assert fit_clock(device, host).residual < 1e-9
    lucky = host + np.where(np.arange(len(host)) % 50 == 0, 0.0, 0.02)
    assert fit_clock(device, lucky).residual == pytest.approx(0.02, abs=1e-3)
    assert ClockSync().residual == 0.0


@pytest.mark.parametrize("jump", [-3600.0, -1.0, -0.05, 0.15, 1.0, 4295.0])
def test_jumps_are_detected_at_once_and_restart_the_fit(jump: float) -> None:
    device, arrival, host = pairs(20)
    half = len(device) // 2
    clock = fit_clock(device[:half], arrival[:half])
    assert clock.jumps == 0
    late = int(np.argmax((arrival - host)[half:] < JUMP / 5)) + 1
    fit_clock(device[half : half + late] + jump, arrival[half : half + late], clock)
    assert clock.jumps == 1
    fit_clock(device[half + late :] + jump, arrival[half + late :], clock)
    assert clock.jumps == 1
    assert np.abs(clock.to_host(device[half + 200 :] + jump) - host[half + 200 :] - SHORTEST).max() < 2e-4


def test_a_small_step_back_is_followed_gradually() -> None:
    device, arrival, host = pairs(20 + WINDOW, rate=20.0)
    clock = fit_clock(device[:200], arrival[:200])
    fit_clock(device[200:] - 0.04, arrival[200:], clock)
    assert clock.jumps == 0
    assert abs(clock.to_host(device[-1] - 0.04) - host[-1] - SHORTEST) < 1e-3


@pytest.mark.parametrize("case", ["busy", "gap", "late at first", 0.5, 2.0, 5.0])
def test_what_delays_messages_is_not_a_jump(case: str | float) -> None:
    """A number: the host is suspended for so many s, and all delayed messages arrive at once."""
    device, arrival, host = pairs(30, offset=0.0)
    there = np.ones(len(host), bool)
    if case == "busy":
        arrival[(host > 8) & (host < 20)] += 0.04
    elif case == "gap":  # the device's clock continues without messages
        there = (host < 5) | (host > 25)
    elif isinstance(case, float):
        asleep = (host > 8) & (host < 8 + case)
        arrival[asleep] = 8 + case + 1e-4 * np.arange(asleep.sum())
    else:
        arrival[0] += 0.009
    clock = fit_clock(device[there], np.maximum.accumulate(arrival)[there])
    assert clock.jumps == 0
    assert np.abs(clock.to_host(device[-200:]) - host[-200:] - SHORTEST).max() < 2e-4


@pytest.mark.parametrize("step", [0.002, 0.05])
def test_repeated_time_stamps(step: float) -> None:
    """A coarse clock: the first arrival of a time stamp counts."""
    device, arrival, _ = pairs(5, rate=500.0)
    device = np.floor(device / step) * step
    clock = fit_clock(device, arrival)
    assert (arrival - clock.to_host(device)).min() > -1e-9
    assert clock.jumps == 0


def test_without_observations() -> None:
    with pytest.raises(ValueError, match="no observation"):
        ClockSync().to_host(1.0)
    clock = fit_clock(np.array([5.0]), np.array([105.0]))
    assert clock.to_host(6.0) == 106.0


@given(st.lists(st.tuples(st.floats(0, 0.3), st.floats(0, 0.3)), min_size=1, max_size=40))
def test_any_observations_are_accepted(steps: list[tuple[float, float]]) -> None:
    device, arrival = np.cumsum(np.array(steps), axis=0).T
    clock = fit_clock(device, arrival)
    assert np.isfinite(clock.to_host(device)).all()
    assert abs(clock.scale - 1) <= MAX_DRIFT * 1.0001
    assert clock.residual >= 0
