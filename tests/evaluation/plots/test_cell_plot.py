"""Plots of recorded pose cells."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.cells.rate_map import arena_edges, bin_activity, rate_maps
from evaluation.cells.recording import CellRecording
from evaluation.plots.cell_plot import choose_cells, draw_cells, draw_recorded_cells, draw_spikes_on_path
from tactile.base.errors import InputError

STEPS = 3000


def recorded(cells=30):
    """A walk through a box of 1 m and cells of which every other fires, at places of a diagonal."""
    draw = np.random.default_rng(0)
    free = np.cumsum(draw.normal(0, 0.03, (STEPS, 2)), axis=0)
    place = np.abs((free + 1) % 2 - 1)
    heading = draw.uniform(-np.pi, np.pi, STEPS)
    centre = np.linspace(0.1, 0.9, cells)[:, None] * [1.0, 1.0]
    activity = np.exp(-((place[:, None] - centre) ** 2).sum(axis=2) / 0.02)
    activity[:, 1::2] = 0.0
    truth = np.column_stack([place, heading])
    return CellRecording(
        (36, 21, 21), 0.05, 0.05 * np.arange(STEPS), truth, truth, np.zeros(STEPS), np.zeros(STEPS, np.int32),
        np.arange(cells, dtype=np.int32), activity.astype(np.float32), None,
    )  # fmt: skip


def subtitle(figure):
    return figure.texts[1].get_text()


def test_twelve_of_the_more_active_cells_are_mapped():
    sums, cell = choose_cells(recorded())
    rates = rate_maps(sums)
    assert len(cell) == 12
    assert (cell % 2 == 0).all()
    assert (np.diff(cell) > 0).all()
    row, column = np.unravel_index(np.nanargmax(rates.reshape(12, -1), axis=1), rates.shape[1:])
    np.testing.assert_allclose(row, column, atol=4)  # the diagonal


def test_each_cell_is_drawn_as_a_map_and_a_dial():
    figure = draw_cells("cells", *choose_cells(recorded(5), most=3))
    assert [bool(axes.images) for axes in figure.axes] == [True, False] * 3
    assert figure.axes[0].get_title().startswith("cell 0\n")


def test_a_silent_cell_is_said_to_be_silent():
    one = recorded(2)
    silent = one._replace(cell=one.cell[1:], activity=one.activity[:, 1:])
    assert draw_recorded_cells("cells", silent).axes[0].get_title() == "cell 1\nsilent"


def test_sums_of_all_cells_are_drawn_without_chosen_ones():
    one = recorded(20)
    sums = bin_activity(one.time, one.truth, one.activity, *arena_edges(one.truth, 10))
    few, cell = choose_cells(one._replace(cell=one.cell[:0], activity=one.activity[:, :0], sums=sums), most=4)
    assert few.place.shape == (4, 10, 10)
    assert (cell % 2 == 0).all()


@pytest.mark.parametrize("case", ["no truth", "a line", "no cells", "one step"])
def test_a_recording_without_maps_gives_a_plot_with_the_reason(case):
    one = recorded(4)
    line = one.truth * [1, 0, 1]
    none = {"cell": one.cell[:0], "activity": one.activity[:, :0]}
    rows = {
        name: getattr(one, name)[:1] for name in ("time", "truth", "packet", "energy", "place", "activity")
    }
    changes = {"no truth": {"truth": np.full_like(one.truth, np.nan)}, "a line": {"truth": line},
               "no cells": none, "one step": rows}  # fmt: skip
    broken = one._replace(**changes[case])
    with pytest.raises(InputError):
        draw_cells("cells", *choose_cells(broken))
    assert subtitle(draw_recorded_cells("cells", broken)).startswith("no rate maps: ")


def test_spikes_are_drawn_at_the_pose_of_their_time():
    one = recorded(2)
    figure = draw_spikes_on_path("spikes", "", one, [one.time[[10, 20]], one.time[:0]])
    drawn = figure.axes[0].lines[1].get_xydata()
    np.testing.assert_allclose(drawn, one.truth[[10, 20], :2])
    assert [axes.get_title() for axes in figure.axes] == ["cell 0, 2 spikes", "cell 1, 0 spikes"]
