"""Calibration from free-whisking records, and records that are refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Cycle, Odometry
from tactile.calibration import (
    Calibration,
    CalibrationConfig,
    calibrate,
)

CONFIG = CalibrationConfig()


def record(
    count: int = 5, rate: float = 1000.0, sd: float = 2e-3, seed: int = 0, whiskers: int = 6
) -> list[Cycle]:
    """Cycles of one second in free air; whisker w's deflections rest at w / 100 and -w / 100."""
    random, cycles = stream(seed, "calibration"), []
    time = np.arange(int(rate)) / rate
    for k in range(count):
        swing = np.repeat((1.1 * (1 - np.cos(2 * np.pi * time)) / 2)[:, None], whiskers, axis=1)
        rest = np.arange(whiskers)[:, None] / 100 * [1, -1]
        noise = sd * random.standard_normal((len(time), whiskers, 3))
        cycles.append(Cycle(k + time, swing + noise[..., 0], rest + noise[..., 1:], Odometry(0, 0, 0, 1)))
    return cycles


def refused(cycles: list[Cycle], match: str, **options: float) -> None:
    with pytest.raises(InputError, match=match):
        calibrate(CONFIG, cycles, **options)


@given(st.integers(0, 50), st.floats(1e-4, 1e-2))
def test_mean_noise_and_amplitude_are_estimated(seed: int, sd: float) -> None:
    found = calibrate(CONFIG, record(sd=sd, seed=seed))
    np.testing.assert_allclose(found.mean, np.arange(6)[:, None] / 100 * [1, -1], atol=sd / 10)
    np.testing.assert_allclose(found.sd, sd, rtol=0.06)
    np.testing.assert_allclose(found.threshold, 20 * found.sd)
    np.testing.assert_allclose(found.free, 1.1, atol=5 * sd)
    assert found.alive.all()
    assert found.rate == pytest.approx(1000)


@pytest.mark.parametrize("size", [0.05, -0.2])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_record_with_a_contact_is_refused(size: float, axis: int) -> None:
    cycles = record()
    cycles[2].deflection[400:420, 3, axis] += size
    refused(cycles, "contacts of whisker 3")


@pytest.mark.parametrize("size", [0.05, -0.2])
def test_the_repair_leaves_the_cycle_with_the_contact_out(size: float) -> None:
    cycles = record()
    cycles[2].deflection[400:420, 3, 1] += size
    found = calibrate(CONFIG.model_copy(update={"on_dirty": "repair"}), cycles)
    clean = np.concatenate([cycle.deflection[:, 3] for k, cycle in enumerate(cycles) if k != 2])
    np.testing.assert_allclose(found.sd[3], clean.std(axis=0), rtol=1e-9)
    np.testing.assert_allclose(found.mean[3], clean.mean(axis=0), rtol=1e-9)


def test_contacts_in_most_cycles_are_not_repaired() -> None:
    cycles = record()
    for cycle in cycles[:3]:
        cycle.deflection[400:440, 3, 1] += 0.1
    with pytest.raises(InputError, match=r"whisker 3.*most of its cycles"):
        calibrate(CONFIG.model_copy(update={"on_dirty": "repair"}), cycles)


def test_each_whisker_with_a_contact_is_named_with_its_reason() -> None:
    cycles = record()
    cycles[2].deflection[400:420, 3] += 0.05
    cycles[1].deflection[:, 5] += 0.05 * np.sin(2 * np.pi * np.arange(1000) / 1000)[:, None]
    refused(cycles, "whisker 3: .*% of its samples are further than 6 robust .* whisker 5: .*%")


def test_a_whisker_in_constant_contact_is_refused() -> None:
    cycles = record()
    for cycle in cycles:
        cycle.deflection[:, 1, 1] += 0.05 * np.sin(2 * np.pi * cycle.time)
    refused(cycles, "contacts of whisker 1")


def test_one_spike_is_not_a_contact() -> None:
    cycles = record()
    cycles[0].deflection[77, 2, 0] += 0.5
    assert calibrate(CONFIG, cycles).alive.all()


def test_dead_whiskers_are_found() -> None:
    cycles = record()
    for cycle in cycles:
        cycle.deflection[:, 0] = 0.0
        cycle.angle[:, 4], cycle.deflection[:, 4] = 0.3, 0.1
    found = calibrate(CONFIG, cycles)
    assert found.alive.tolist() == [False, True, True, True, False, True]
    assert np.isinf(found.threshold[[0, 4]]).all()


def test_too_short_or_empty_records_are_refused() -> None:
    refused([], "empty")
    refused(record(count=3), "3 s.*at least 4 s")


def test_nan_samples_are_refused() -> None:
    for broken in ("angle", "deflection"):
        cycles = record()
        getattr(cycles[1], broken)[5, 2] = np.nan
        refused(cycles, "whisker 2: NaN")


@pytest.mark.parametrize("fault", ["constant", "clipped", "full scale"])
def test_saturated_channels_are_refused(fault: str) -> None:
    cycles = record()
    for cycle in cycles:
        channel = cycle.deflection[:, 5, 1]
        channel[:] = {
            "constant": channel * 0 + 0.2,
            "clipped": np.minimum(channel, -0.05),
            "full scale": channel,
        }[fault]
        if fault == "full scale":
            channel[10] = -1.5
    refused(cycles, "whisker 5 are constant or at their limits")


def test_a_record_without_noise_is_refused() -> None:
    cycles = record()
    for cycle in cycles:
        cycle.deflection[:] = 0
    refused(cycles, "no whisker has a signal")


def test_sample_rates_too_low_for_the_slope_window_are_refused() -> None:
    refused(record(rate=500.0), "500 samples per second.*at least 800")
    assert calibrate(CONFIG, record(rate=500.0), slope_window=0.016).rate == pytest.approx(500)


def test_times_that_do_not_increase_are_refused() -> None:
    cycles = record()
    cycles[0] = cycles[0]._replace(time=cycles[0].time[::-1])
    refused(cycles, "not increasing")
    cycles = record()
    keep = np.r_[:400, 450:1000]
    cut = (cycles[0].time[keep], cycles[0].angle[keep], cycles[0].deflection[keep])
    refused([cycles[0]._replace(time=cut[0], angle=cut[1], deflection=cut[2]), *cycles[1:]], "a gap of")


def test_arrays_read_back_equal() -> None:
    found = calibrate(CONFIG, record())
    again = Calibration.from_arrays(found.arrays())
    for name, value in found._asdict().items():
        assert np.array_equal(getattr(again, name), value), name


@pytest.mark.parametrize("name", Calibration._fields)
def test_missing_arrays_and_wrong_shapes_are_refused(name: str) -> None:
    arrays = calibrate(CONFIG, record()).arrays()
    with pytest.raises(InputError, match=name):
        Calibration.from_arrays({key: value for key, value in arrays.items() if key != name})
    if name != "alive":
        with pytest.raises(InputError, match=name):
            Calibration.from_arrays(arrays | {name: np.zeros(7)})
