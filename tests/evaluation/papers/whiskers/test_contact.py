"""Contacts of the real reach: never in the whiskers that touch nothing, steady in those that do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.tables.recordings import REACH
from evaluation.papers.whiskers.contact import baseline_of
from robot.recordings.real_whiskers import WHISKERS, ReachConfig, read_reach
from tactile.base.samples import true_runs
from tactile.calibration import calibrate_free
from tactile.contact_stream import Touch, find_contacts, find_fixed_contacts, start_stream


@pytest.fixture(scope="module")
def signal(reference_data: Path) -> np.ndarray:
    return read_reach(reference_data / REACH).signal


def contacts(signal: np.ndarray) -> np.ndarray:
    config = ReachConfig(file=Path("reach.csv"))
    free = calibrate_free(config.free, signal[: config.free_rows])
    assert [WHISKERS[whisker] for whisker in free.dirty] == ["right5"]
    return find_contacts(*start_stream(config.contact, free, config.rate), signal)[1] == Touch.CONTACT


def test_four_whiskers_never_touch_and_the_others_touch_a_few_times(signal: np.ndarray) -> None:
    found = contacts(signal)
    counts = [len(true_runs(whisker)) for whisker in found.T]
    assert counts[4:8] == [0, 0, 0, 0]
    assert all(1 <= count <= 6 for count in counts[:4] + counts[8:])
    fixed = find_fixed_contacts(signal[:100], signal)
    assert len(true_runs(fixed[:, 0])) > 5 * counts[0]  # a whisker that rings crosses again and again
    assert not fixed[:, 13].any()  # the dirty one is silenced


def test_the_baseline_goes_straight_across_a_contact() -> None:
    signal = np.linspace(0, 20, 2000)[:, None].copy()
    contact = np.zeros(2000, bool)
    contact[800:1200] = True
    signal[800:1200] += 1000
    found = baseline_of(signal, contact)
    np.testing.assert_allclose(found[200:1800, 0], np.linspace(0, 20, 2000)[200:1800], atol=0.01)
