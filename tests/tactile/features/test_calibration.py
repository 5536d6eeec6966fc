"""Calibration from free records, records that are refused or repaired, and estimates of noise and drift."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Cycle, Odometry
from tactile.calibration import (
    Calibration,
    CalibrationConfig,
    DirtyRecordConfig,
    calibrate,
    calibrate_free,
    estimate_drift,
    estimate_noise,
)

CONFIG = CalibrationConfig()
REPAIR = CONFIG.model_copy(update={"on_dirty": "repair"})
FREE, FREE_REPAIR = DirtyRecordConfig(), DirtyRecordConfig(on_dirty="repair")
WAVE = 0.05 * np.sin(2 * np.pi * np.arange(1000) / 1000)


def record(count: int = 5, rate: float = 1000.0, sd: float = 2e-3, seed: int = 0) -> list[Cycle]:
    """Cycles of one second in free air; whisker w's deflections rest at w / 100 and -w / 100."""
    random, cycles = stream(seed, "calibration"), []
    time = np.arange(int(rate)) / rate
    for k in range(count):
        swing = np.repeat((1.1 * (1 - np.cos(2 * np.pi * time)) / 2)[:, None], 6, axis=1)
        rest = np.arange(6)[:, None] / 100 * [1, -1]
        noise = sd * random.standard_normal((len(time), 6, 3))
        cycles.append(Cycle(k + time, swing + noise[..., 0], rest + noise[..., 1:], Odometry(0, 0, 0, 1)))
    return cycles


def refused(cycles: list[Cycle], match: str, config: CalibrationConfig = CONFIG) -> None:
    with pytest.raises(InputError, match=match):
        calibrate(config, cycles)


@given(st.integers(0, 50), st.floats(1e-4, 1e-2))
def test_mean_noise_and_amplitude_are_estimated(seed: int, sd: float) -> None:
    found = calibrate(CONFIG, record(sd=sd, seed=seed))
    np.testing.assert_allclose(found.mean, np.arange(6)[:, None] / 100 * [1, -1], atol=sd / 10)
    np.testing.assert_allclose(found.sd, sd, rtol=0.06)
    np.testing.assert_allclose(found.threshold, 20 * found.sd)
    np.testing.assert_allclose(found.free, 1.1, atol=5 * sd)
    assert found.alive.all()
    assert found.rate == pytest.approx(1000)


@pytest.mark.parametrize(("axis", "size"), [(0, 0.05), (1, 0.05), (1, -0.2)])
def test_a_record_with_a_contact_is_refused_and_its_cycle_left_out_by_the_repair(
    axis: int, size: float
) -> None:
    cycles = record()
    cycles[2].deflection[400:420, 3, axis] += size
    refused(cycles, "contacts of whisker 3")
    found = calibrate(REPAIR, cycles)
    clean = np.concatenate([cycle.deflection[:, 3] for k, cycle in enumerate(cycles) if k != 2])
    np.testing.assert_allclose(found.sd[3], clean.std(axis=0), rtol=1e-9)
    np.testing.assert_allclose(found.mean[3], clean.mean(axis=0), rtol=1e-9)


def test_contacts_in_most_or_all_of_the_record_are_refused_with_their_whiskers() -> None:
    cycles = record()
    for cycle in cycles[:3]:
        cycle.deflection[400:440, 3, 1] += 0.1
    refused(cycles, r"whisker 3.*most of its cycles", REPAIR)
    cycles = record()
    cycles[2].deflection[400:420, 3] += 0.05
    cycles[1].deflection[:, 5] += WAVE[:, None]
    refused(cycles, "whisker 3: .*% of its samples are further than 6 robust .* whisker 5: .*%")
    cycles = record()
    for cycle in cycles:
        cycle.deflection[:, 1, 1] += WAVE
    refused(cycles, "contacts of whisker 1")
    cycles = record()
    cycles[0].deflection[77, 2, 0] += 0.5  # one spike is no contact
    assert calibrate(CONFIG, cycles).alive.all()


def test_dead_whiskers_are_found() -> None:
    cycles = record()
    for cycle in cycles:
        cycle.deflection[:, 0] = 0.0
        cycle.angle[:, 4], cycle.deflection[:, 4] = 0.3, 0.1
    found = calibrate(CONFIG, cycles)
    assert found.alive.tolist() == [False, True, True, True, False, True]
    assert np.isinf(found.threshold[[0, 4]]).all()


@pytest.mark.parametrize("fault", ["constant", "clipped", "full scale"])
def test_saturated_channels_are_refused(fault: str) -> None:
    cycles = record()
    for cycle in cycles:
        channel = cycle.deflection[:, 5, 1]
        if fault == "full scale":
            channel[10] = -1.5
        else:
            channel[:] = 0.2 if fault == "constant" else np.minimum(channel, -0.05)
    refused(cycles, "whisker 5 are constant or at their limits")


def test_records_that_cannot_be_used_are_refused() -> None:
    refused([], "empty")
    refused(record(count=3), "3 s.*at least 4 s")
    for broken in ("angle", "deflection"):
        cycles = record()
        getattr(cycles[1], broken)[5, 2] = np.nan
        refused(cycles, "whisker 2: NaN")
    refused(
        [cycle._replace(deflection=0 * cycle.deflection) for cycle in record()], "no whisker has a signal"
    )
    refused(record(rate=500.0), "500 samples per second.*at least 800")
    assert calibrate(CONFIG, record(rate=500.0), slope_window=0.016).rate == pytest.approx(500)
    first, *others = record()
    refused([first._replace(time=first.time[::-1]), *others], "not increasing")
    cut = [part[np.r_[:400, 450:1000]] for part in first[:3]]
    refused([Cycle(*cut, first.odometry), *others], "a gap of")


@pytest.mark.parametrize("name", Calibration._fields)
def test_arrays_read_back_equal_and_missing_ones_and_wrong_shapes_are_refused(name: str) -> None:
    found = calibrate(CONFIG, record())
    arrays = found.arrays()
    assert np.array_equal(getattr(Calibration.from_arrays(arrays), name), getattr(found, name))
    with pytest.raises(InputError, match=name):
        Calibration.from_arrays({key: value for key, value in arrays.items() if key != name})
    if name != "alive":
        with pytest.raises(InputError, match=name):
            Calibration.from_arrays(arrays | {name: np.zeros(7)})


def resting(seed: int = 0) -> np.ndarray:
    """[400, 5, 3] white noise of 2 around whisker w's rest at 100 w."""
    return 100.0 * np.arange(5)[:, None] + 2 * stream(seed, "free").standard_normal((400, 5, 3))


def press(record: np.ndarray, whisker: int, first: int, last: int) -> None:
    """Presses a whisker by up to 300 in rows first to last."""
    record[first:last, whisker, 1] += 300 * np.sin(np.pi * np.linspace(0, 1, last - first))


@settings(max_examples=15)
@given(st.integers(0, 200), st.integers(0, 4), st.integers(60, 200))
def test_a_resting_record_gives_mean_and_noise_also_when_repaired(
    seed: int, whisker: int, first: int
) -> None:
    baseline = calibrate_free(FREE, resting(seed))
    assert baseline.dirty == {}
    np.testing.assert_allclose(baseline.mean[:, 0], 100.0 * np.arange(5), atol=0.6)
    np.testing.assert_allclose(baseline.noise, 2.0, rtol=0.35)
    pressed = resting(seed)
    press(pressed, whisker, first, first + 120)
    baseline = calibrate_free(FREE_REPAIR, pressed)
    assert [*baseline.dirty] == [whisker]
    np.testing.assert_allclose(baseline.mean[whisker], 100 * whisker, atol=2.0)
    np.testing.assert_allclose(baseline.noise[whisker], 2.0, rtol=0.45)


def test_contacts_in_a_resting_record_are_refused_with_whisker_and_reason() -> None:
    pressed, moving, still = resting(), resting(), resting()
    press(pressed, 3, 250, 400)
    moving[:, 1] += 300 * np.sin(np.arange(400) / 7)[:, None]
    reason = r"^(?!.*whisker 2).*whisker 3: its standard deviation is [\d.]+ times its noise"
    for config, record, message in (
        (FREE, pressed, reason),
        (FREE_REPAIR, moving, r"whisker 1: its noise .* no clean stretch"),
    ):
        with pytest.raises(InputError, match=message):
            calibrate_free(config, record)
    still[:, :2] = 7.0  # without a signal they are no standard for the others
    assert calibrate_free(FREE, still).dirty == {}


SEEDS, LAW = st.integers(0, 10_000), settings(max_examples=15)


def coloured(seed: int, length: int, coefficient: float = 0.45, channels: int = 3) -> np.ndarray:
    """[length, channels] autoregressive noise with standard deviation 1."""
    white = stream(seed, "noise").standard_normal((length + 100, channels))
    return lfilter([np.sqrt(1 - coefficient**2)], [1, -coefficient], white, axis=0)[100:]


def push(length: int, first: int, last: int, size: float) -> np.ndarray:
    """[length, 1] a contact: rises over the first third, holds, and falls over the last."""
    rise = max((last - first) // 3, 1)
    row = np.arange(length)
    return size * np.clip(np.minimum(row - first, last - row) / rise, 0, 1)[:, None]


@LAW
@given(SEEDS, st.sampled_from([0.0, 0.45, 0.7]), st.floats(1e-6, 1e6), st.floats(-1e3, 1e3))
def test_it_is_the_marginal_sd_of_coloured_noise_at_any_scale_and_level(
    seed: int, coefficient: float, scale: float, level: float
) -> None:
    np.testing.assert_allclose(estimate_noise(coloured(seed, 4000, coefficient)), 1.0, atol=0.12)
    record = coloured(seed, 400)
    noise = estimate_noise(record)
    np.testing.assert_allclose(noise, 1.0, atol=0.34)
    np.testing.assert_allclose(estimate_noise(scale * (record + level)), scale * noise, rtol=1e-6)


@LAW
@given(SEEDS, st.floats(0.02, 0.6), st.floats(0, 0.4), st.floats(1, 1e5))
def test_one_contact_cannot_fool_it(seed: int, share: float, start: float, size: float) -> None:
    length = 2000
    contact = push(length, int(start * length), int((start + share) * length), size)
    record = coloured(seed, length) + contact
    noise = estimate_noise(record)
    assert ((noise > 0.7) & (noise < 1.5)).all()


@LAW
@given(SEEDS)
def test_a_slow_drift_adds_little(seed: int) -> None:
    record = coloured(seed, 2000)
    drift = np.linspace(0, 20, len(record))[:, None]
    np.testing.assert_allclose(estimate_noise(record + drift), estimate_noise(record), rtol=0.05)


def test_channels_are_independent_and_a_constant_one_has_no_noise() -> None:
    record = np.concatenate([coloured(1, 500), np.full((500, 1), 7.0)], axis=1)
    noise = estimate_noise(record)
    assert noise[3] == 0
    np.testing.assert_array_equal(noise[:3], estimate_noise(record[:, :3]))


@LAW
@given(SEEDS, st.floats(0.02, 0.5))
def test_drift_of_a_random_walk_beneath_noise(seed: int, rate: float) -> None:
    steps = rate * stream(seed, "walk").standard_normal((40_000, 6))
    drift = estimate_drift(coloured(seed, 40_000, channels=6) + np.cumsum(steps, axis=0))
    assert 0.75 * rate < np.median(drift) < 1.3 * rate
    still = coloured(seed, 20_000) + push(20_000, 4000, 4400, 1e4)  # a contact does not raise it
    assert (estimate_drift(still) < 0.02).all()


@pytest.mark.parametrize("estimate", [estimate_noise, estimate_drift])
def test_short_and_broken_records_are_refused(estimate) -> None:
    with pytest.raises(InputError, match="at least"):
        estimate(np.zeros((20, 3)))
    record = coloured(0, 2000)
    record[5, 1] = np.nan
    with pytest.raises(InputError, match="NaN"):
        estimate(record)
