"""Laws of the spikes: their counts are Poisson with the integral of the rate, and each cell stands alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from ratslam.classic.config import NetworkConfig
from ratslam.service.spikes import (
    SpikeConfig,
    draw_spikes,
    expected_spikes,
    read_spikes,
    settled_peak,
    write_spikes,
)
from tactile.base.errors import InputError
from tests.ratslam.service.rats.recordings import drawn_recording, recording

REFERENCE = 0.04
SEEDS = range(400)
CELLS = st.lists(st.integers(0, 391), min_size=1, max_size=6, unique=True)


def test_counts_are_poisson_in_every_part_of_the_recording():
    """At fixed seeds: chi-squared of the dispersion, and of the mean, of counts in five parts."""
    given_recording = drawn_recording(1, [7])
    expected = expected_spikes(given_recording, REFERENCE, 20.0)[:, 0]
    parts = np.array_split(np.arange(len(expected)), 5)
    edges = given_recording.time[[part[0] for part in parts] + [len(expected)]]
    counts = np.array([
        np.histogram(draw_spikes(given_recording, REFERENCE, SpikeConfig(seed=seed)).times[0], edges)[0]
        for seed in SEEDS
    ])  # fmt: skip
    mean = np.array([expected[part].sum() for part in parts])
    assert mean.min() > 5
    dispersion = ((counts - mean) ** 2 / mean).sum()
    assert 0.005 < stats.chi2(counts.size).cdf(dispersion) < 0.995
    total = stats.poisson(mean * len(SEEDS))
    assert np.all((total.cdf(counts.sum(axis=0)) > 0.001) & (total.cdf(counts.sum(axis=0)) < 0.999))
    assert np.abs(np.corrcoef(counts.T) - np.eye(5)).max() < 4 / np.sqrt(len(SEEDS))  # independent parts


def test_times_are_uniform_within_a_step_and_gaps_exponential():
    """The p-values of many cells are uniform, as they are for a true hypothesis."""
    cells = list(range(100))
    steady = recording(np.array([0.0, 100.0]), cells, np.full((2, 100), REFERENCE))
    times = draw_spikes(steady, REFERENCE).times
    uniform = [stats.kstest(train / 100.0, "uniform").pvalue for train in times]
    exponential = [stats.kstest(20 * np.diff(train), "expon").pvalue for train in times]
    assert stats.kstest(uniform, "uniform").pvalue > 0.01
    assert stats.kstest(exponential, "uniform").pvalue > 0.01


def test_a_silent_cell_does_not_spike_and_no_spike_falls_into_a_silent_step():
    activity = np.zeros((11, 2))
    activity[3, 1] = REFERENCE
    spikes = draw_spikes(recording(np.arange(11.0), [0, 5], activity), REFERENCE)
    assert len(spikes.times[0]) == 0
    assert len(spikes.times[1]) > 0
    assert np.all((spikes.times[1] >= 3) & (spikes.times[1] <= 4))


@settings(max_examples=20)
@given(st.integers(0, 5), CELLS, st.data())
def test_other_cells_do_not_matter(seed, cell, data):
    chosen = data.draw(st.sampled_from(cell))
    together = draw_spikes(drawn_recording(seed, cell), REFERENCE)
    alone = draw_spikes(drawn_recording(seed, [chosen]), REFERENCE)
    np.testing.assert_array_equal(together.times[cell.index(chosen)], alone.times[0])


@settings(max_examples=20)
@given(st.integers(0, 5), CELLS, st.integers(2, 400))
def test_a_longer_recording_begins_with_the_same_spikes(seed, cell, steps):
    whole = drawn_recording(seed, cell)
    part = whole._replace(time=whole.time[:steps], activity=whole.activity[:steps])
    for longer, shorter in zip(
        draw_spikes(whole, REFERENCE).times, draw_spikes(part, REFERENCE).times, strict=True
    ):
        np.testing.assert_array_equal(longer[: len(shorter)], shorter)
        assert np.all(longer[len(shorter) :] >= part.time[-1])
        assert np.all(np.diff(longer) >= 0)


def test_spikes_of_two_cells_and_of_two_seeds_differ():
    both = recording(np.array([0.0, 100.0]), [3, 4], np.full((2, 2), REFERENCE))
    first, second = draw_spikes(both, REFERENCE).times
    other = draw_spikes(both, REFERENCE, SpikeConfig(seed=1)).times[0]
    assert not np.isin(first, second).any()
    assert not np.isin(first, other).any()


def test_files_hold_all_and_equal_spikes_give_equal_bytes(tmp_path):
    spikes = draw_spikes(drawn_recording(2, [9, 4, 200]), REFERENCE)
    again = draw_spikes(drawn_recording(2, [9, 4, 200]), REFERENCE)
    write_spikes(tmp_path / "a.npz", spikes)
    write_spikes(tmp_path / "b.npz", again)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    read = read_spikes(tmp_path / "a.npz")
    np.testing.assert_array_equal(read.cell, [9, 4, 200])
    assert (read.start, read.stop) == (spikes.start, spikes.stop)
    for one, other in zip(read.times, spikes.times, strict=True):
        np.testing.assert_array_equal(one, other)


def test_other_files_are_no_spikes(tmp_path):
    with pytest.raises(InputError, match="no such file; expected a file of spikes"):
        read_spikes(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", cell=np.zeros(2), count=np.zeros(3), times=[], interval=[0.0, 1.0])
    with pytest.raises(InputError, match="do not fit each other"):
        read_spikes(tmp_path / "other.npz")


GOOD = drawn_recording(0, [1, 2], 5)


@pytest.mark.parametrize(
    ("change", "reference", "message"),
    [
        ({"activity": GOOD.activity * np.nan}, 1.0, "a negative or not finite activity"),
        ({"activity": GOOD.activity - 1}, 1.0, "a negative or not finite activity"),
        ({"activity": GOOD.activity[:3]}, 1.0, "5 times and activity of shape"),
        ({"time": GOOD.time[::-1]}, 1.0, "a time before the previous one"),
        ({"time": GOOD.time[:1], "activity": GOOD.activity[:1]}, 1.0, "T at least 2"),
        ({"cell": np.array([0, 392])}, 1.0, "the index 392; expected indices of the 392 cells, 0 to 391"),
        ({"cell": np.array([0.0, 1.0])}, 1.0, "type float64"),
        ({}, 0.0, "an activity above 0"),
        ({}, np.nan, "an activity above 0"),
    ],
)
def test_bad_input_gets_one_clear_error(change, reference, message):
    with pytest.raises(InputError, match=message):
        draw_spikes(GOOD._replace(**change), reference)


def test_the_reference_is_the_peak_of_a_packet_at_rest():
    assert settled_peak(NetworkConfig()) == pytest.approx(0.042770, abs=1e-6)
