"""Free records with contacts in them: named, refused or repaired."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.calibration import DirtyRecordConfig, calibrate_free

REPAIR = DirtyRecordConfig(on_dirty="repair")


def free_record(seed: int = 0, rows: int = 400) -> np.ndarray:
    """[rows, 5, 3] white noise of 2 around whisker w's rest at 100 w."""
    return 100.0 * np.arange(5)[:, None] + 2 * stream(seed, "free").standard_normal((rows, 5, 3))


def press(record: np.ndarray, whisker: int, first: int, last: int) -> None:
    """Presses a whisker by up to 300 in rows first to last."""
    record[first:last, whisker, 1] += 300 * np.sin(np.pi * np.linspace(0, 1, last - first))


@settings(max_examples=15)
@given(st.integers(0, 500))
def test_a_clean_record_gives_mean_and_noise(seed: int) -> None:
    baseline = calibrate_free(DirtyRecordConfig(), free_record(seed))
    assert baseline.dirty == {}
    np.testing.assert_allclose(baseline.mean[:, 0], 100.0 * np.arange(5), atol=0.6)
    np.testing.assert_allclose(baseline.noise, 2.0, rtol=0.35)


def test_a_contact_is_refused_with_whisker_and_reason() -> None:
    record = free_record()
    press(record, 3, 250, 400)
    with pytest.raises(
        InputError, match=r"whisker 3: its standard deviation is [\d.]+ times its noise"
    ) as error:
        calibrate_free(DirtyRecordConfig(), record)
    assert "whisker 2" not in str(error.value)


@settings(max_examples=15)
@given(st.integers(0, 200), st.integers(0, 4), st.integers(60, 200))
def test_repair_takes_a_stretch_without_the_contact(seed: int, whisker: int, first: int) -> None:
    record = free_record(seed)
    press(record, whisker, first, first + 120)
    baseline = calibrate_free(REPAIR, record)
    assert [*baseline.dirty] == [whisker]
    np.testing.assert_allclose(baseline.mean[whisker], 100 * whisker, atol=2.0)
    np.testing.assert_allclose(baseline.noise[whisker], 2.0, rtol=0.45)


def test_a_whisker_that_never_rests_is_not_repaired() -> None:
    record = free_record()
    record[:, 1] += 300 * np.sin(np.arange(400) / 7)[:, None]
    with pytest.raises(InputError, match=r"whisker 1: its noise .* no clean stretch"):
        calibrate_free(REPAIR, record)


def test_a_whisker_without_a_signal_is_no_standard_for_the_others() -> None:
    record = free_record()
    record[:, :2] = 7.0
    assert calibrate_free(DirtyRecordConfig(), record).dirty == {}
