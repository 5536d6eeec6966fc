"""Spikes: laws of their counts and times, and their files: NWB that pynwb accepts, NumPy, scores of cells."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evaluation.cells.analysis import analyse_cells
from evaluation.cells.recording import CellRecording, write_recording
from ratslam.classic.config import NetworkConfig
from ratslam.service.export_formats import EPOCH, export_run, write_nwb
from ratslam.service.spikes import (
    SpikeConfig,
    cell_poses,
    draw_spikes,
    expected_spikes,
    read_spikes,
    settled_peak,
    write_spikes,
)
from tactile.base.errors import InputError
from tests.helpers.commands import said

SHAPE = (8, 7, 7)


def recording(time: np.ndarray, cell: list[int], activity: np.ndarray) -> CellRecording:
    """A recording of a network of 8 x 7 x 7 cells of 0.1 m; the robot drives along x, its heading turns."""
    steps = len(time)
    truth = np.stack([0.05 * time, np.zeros(steps), 0.1 * time], axis=1)
    packet = np.stack([np.arange(steps) % 7, np.full(steps, 3.0), np.arange(steps) % 8], axis=1)
    return CellRecording(
        shape=SHAPE, cell_size=0.1, time=time, truth=truth, packet=packet, energy=np.zeros(steps),
        place=np.full(steps, -1, np.int32), cell=np.array(cell, np.int32),
        activity=activity.astype(np.float32), sums=None,
    )  # fmt: skip


def drawn_recording(seed: int, cell: list[int], steps: int = 400) -> CellRecording:
    """Unevenly spaced steps, and an activity of each cell of its own with silent stretches."""
    time = 3.0 + np.cumsum(np.random.default_rng(seed).uniform(0.0, 0.1, steps))
    activity = [
        np.maximum(np.random.default_rng([seed, index]).normal(0.01, 0.02, steps), 0) for index in cell
    ]
    return recording(time, cell, np.stack(activity, axis=1))


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


def test_a_damaged_file_of_spikes_is_refused(tmp_path):
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


# Files

CHOSEN = [5, 1, 300]
CONFIG = "recording: {file: none.bag}\npose_cells: {cells_xy: 7, cells_heading: 8}\n"
NETWORK = NetworkConfig(cells_xy=7, cells_heading=8)


@pytest.fixture(scope="module")
def pynwb():
    """The package, which takes seconds to import."""
    return importlib.import_module("pynwb")


@pytest.fixture
def three():
    """Three cells, of which the last is silent; the true pose is unknown at one step."""
    made = drawn_recording(0, CHOSEN)
    made.activity[:, 2] = 0.0
    made.truth[3] = np.nan
    return made


@pytest.fixture
def run(three, tmp_path):
    """A run directory with what an export of spikes reads."""
    directory = tmp_path / "run"
    directory.mkdir()
    (directory / "config.yaml").write_text(CONFIG)
    write_recording(directory / "cells.npz", three)
    return directory


def test_the_validator_accepts_the_file_and_it_holds_all(run, three, tmp_path, pynwb, capsys):
    for name in ("run.nwb", "again.nwb"):
        said(capsys, "export", run, "-o", tmp_path / name, "--peak-rate", "30")
    assert (tmp_path / "run.nwb").read_bytes() == (tmp_path / "again.nwb").read_bytes()
    assert pynwb.validate(path=str(tmp_path / "run.nwb")) == []
    spikes = draw_spikes(three, settled_peak(NETWORK), SpikeConfig(peak_rate=30))
    assert sum(map(len, spikes.times)) > 100
    with pynwb.NWBHDF5IO(tmp_path / "run.nwb", "r") as source:
        file = source.read()
        assert file.session_start_time == EPOCH
        assert len(file.identifier) == 64
        units = file.units
        for k, times in enumerate(spikes.times):
            np.testing.assert_array_equal(units.get_unit_spike_times(k), times)
            np.testing.assert_array_equal(units.get_unit_obs_intervals(k), [[spikes.start, spikes.stop]])
        np.testing.assert_array_equal(units["cell"][:], CHOSEN)
        poses = np.stack([units[name][:] for name in ("x", "y", "heading")], axis=1)
        np.testing.assert_array_equal(poses, cell_poses(three.shape, 0.1, np.array(CHOSEN)))
        behaviour = file.processing["behavior"]
        position, heading = behaviour["Position"]["position"], behaviour["CompassDirection"]["heading"]
        np.testing.assert_array_equal(position.data, three.truth[:, :2])
        np.testing.assert_allclose(heading.data, three.truth[:, 2], atol=1e-12)
        packet = behaviour["PacketPosition"]["packet_position"]
        np.testing.assert_allclose(packet.data, 0.1 * three.packet[:, :2])
        np.testing.assert_array_equal(packet.timestamps, three.time)
        angle = behaviour["PacketDirection"]["packet_heading"].data[:]
        np.testing.assert_allclose(np.exp(1j * angle), np.exp(2j * np.pi / 8 * three.packet[:, 2]))
        np.testing.assert_array_equal(file.acquisition["activity"].data, three.activity)
        assert len(file.acquisition["injected_energy"].data) == len(three.time)


def test_numpy_spikes_are_those_of_the_settings(run, three, tmp_path, capsys):
    said(capsys, "export", run, "-o", tmp_path / "s.npz", "--peak-rate", "5", "--spike-seed", "3")
    again = draw_spikes(three, settled_peak(NETWORK), SpikeConfig(peak_rate=5, seed=3))
    for one, other in zip(read_spikes(tmp_path / "s.npz").times, again.times, strict=True):
        np.testing.assert_array_equal(one, other)


def test_cells_without_any_spike_are_valid(three, tmp_path, pynwb):
    three.activity[:] = 0.0
    write_nwb(tmp_path / "silent.nwb", three, draw_spikes(three, 1.0), "digest")
    assert pynwb.validate(path=str(tmp_path / "silent.nwb")) == []


def test_spikes_without_chosen_cells_or_of_others_or_without_pynwb_are_refused(
    run, three, tmp_path, monkeypatch
):
    none = three._replace(cell=three.cell[:0], activity=three.activity[:, :0])
    write_recording(run / "cells.npz", none)
    with pytest.raises(InputError, match=r"no chosen cells.*add `cells: {chosen: 64}`"):
        export_run(run, tmp_path / "run.nwb")
    spikes = draw_spikes(drawn_recording(0, [1, 2]), 1.0)
    with pytest.raises(InputError, match="other cells than those of the recording"):
        write_nwb(tmp_path / "run.nwb", three, spikes, "digest")
    monkeypatch.setitem(sys.modules, "pynwb", None)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[nwb\]'"):
        write_nwb(tmp_path / "run.nwb", three, draw_spikes(three, 1.0), "digest")
    assert list(tmp_path.iterdir()) == [run]


def test_scores_are_a_line_for_each_cell_in_hz(run, three, tmp_path, capsys):
    three.truth[:] = np.random.default_rng(1).random(three.truth.shape)
    write_recording(run / "cells.npz", three)
    said(capsys, "export", run, "-o", tmp_path / "cells.csv", "--peak-rate", "30")
    table = np.genfromtxt(tmp_path / "cells.csv", delimiter=",", names=True)
    scores = analyse_cells(three, 30 / settled_peak(NETWORK))
    np.testing.assert_array_equal(table["cell"], CHOSEN)
    np.testing.assert_array_equal(table["mean_rate"], scores.mean_rate)
