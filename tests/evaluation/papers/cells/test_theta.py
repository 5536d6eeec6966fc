"""Theta cycles: samples of a belief have its mean, one cell fires in each, and spikes tell."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.cells.recording import CellRecording
from evaluation.cells.theta_cycles import cycle_contrast
from evaluation.papers.cells import theta
from evaluation.papers.cells.theta import CYCLES, HELD, ONE, SAMPLED, TWO, cycle_divergence, separation
from evaluation.papers.figure import Task
from ratslam.service.spikes import SpikeConfig, draw_spikes, sample_cycles
from tactile.base.errors import InputError
from tests.evaluation.papers.shown import rows_of, table_of

beliefs = st.lists(st.floats(0.01, 1), min_size=2, max_size=40)


@given(beliefs, st.floats(0.3, 1), st.integers(0, 99))
def test_the_mean_of_cycles_is_the_belief_and_the_rest_is_drawn_too(weights, certainty, seed):
    belief = certainty * np.array(weights) / np.sum(weights)
    assert cycle_divergence(belief, seed) <= 0.01
    drawn = sample_cycles(np.arange(CYCLES) / 8, np.tile(belief, (CYCLES, 1)), 8.0, seed)
    assert np.mean(drawn < 0) == pytest.approx(1 - certainty, abs=0.02)


def recording(activity, rate=32.0):
    steps, cells = activity.shape
    unknown = np.full((steps, 3), np.nan)
    return CellRecording(
        (1, 1, cells), 0.1, 5 + np.arange(steps) / rate, unknown, unknown, np.zeros(steps),
        np.zeros(steps, np.int32), np.arange(cells), activity, None,
    )  # fmt: skip


def test_one_cell_fires_in_a_cycle_at_the_peak_rate_and_counts_are_those_of_the_belief():
    belief = recording(np.tile([0.5, 0.3, 0.1], (32 * 400 + 1, 1)))
    cycles = draw_spikes(belief, 1.0, SpikeConfig(theta_hz=8.0))
    plain = draw_spikes(belief, 1.0)
    numbers = [np.floor((times - 5) * 8).astype(int) for times in cycles.times]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert not set(numbers[a]) & set(numbers[b])
    for one, other, share in zip(cycles.times, plain.times, (0.5, 0.3, 0.1), strict=True):
        assert len(one) == pytest.approx(20 * 400 * share, rel=0.15)
        assert len(other) == pytest.approx(20 * 400 * share, rel=0.15)
    filled = np.bincount(numbers[0])
    assert filled[filled > 0].mean() == pytest.approx(2.5 / (1 - np.exp(-2.5)), rel=0.1)


def test_cells_that_overlap_are_refused():
    with pytest.raises(
        InputError, match=r"theta: activity from 0.6, in sum up to 1.2; .* exclude each other"
    ):
        draw_spikes(recording(np.full((40, 2), 0.6)), 1.0, SpikeConfig(theta_hz=8.0))


def test_the_contrast_of_spikes_at_known_places():
    place = np.array([[0.0, 0.0], [1.0, 0.0]])
    same = [np.array([0.01, 0.11, 0.21]), np.array([0.05, 0.15, 0.25])]  # both fire in every cycle
    assert cycle_contrast(same, place, 0.1, 0.0) == pytest.approx(np.log(0.5))
    turns = [np.array([0.01, 0.02]), np.array([0.11, 0.12])]  # by turns: no distance within a cycle
    assert np.isnan(cycle_contrast(turns, place, 0.1, 0.0))
    assert np.isnan(cycle_contrast([np.zeros(0)] * 2, place, 0.1, 0.0))


def test_spikes_of_two_packets_tell_the_hypotheses_apart(tmp_path):
    result = theta.measure_theta(Task(43000, 6))
    contrast = result.contrast[TWO]
    assert separation(contrast[SAMPLED], contrast[HELD]) >= 0.95
    assert separation(contrast[HELD], contrast[HELD]) == 0.5
    assert result.divergence.max() <= 0.01
    table = rows_of(table_of(theta.FIGURE, result, tmp_path))
    assert [row[0] for row in table[1:]] == ["---", TWO, ONE][-len(table[1:]) :]
