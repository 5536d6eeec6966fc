"""The figures of boxes, of the torus and of packets: laws, short sessions, and every other figure once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.cells.recording import CellRecording
from evaluation.papers.cells import boxes, packet_figures
from evaluation.papers.cells.agreement import compare_scores
from evaluation.papers.cells.belief_lesions import measure_sizes
from evaluation.papers.cells.costs import measure_analysis, measure_networks
from evaluation.papers.cells.rat_sessions import EVERY, RatSessions, column_activity
from evaluation.papers.cells.rotation import measure_rotation, rotation_of
from evaluation.papers.cells.shuffles import check_shuffles
from evaluation.papers.cells.torus import measure_cells, measure_torus
from evaluation.papers.figure import CELLS, MAPS, REAL, Task, find_figure
from tactile.base.se2 import wrap
from tests.evaluation.papers.shown import rows_of, table_of

BINS = 21
CENTRES = np.random.default_rng(0).uniform(0, BINS, (40, 2))
"""Of the fields of 40 cells on the torus, bins."""


def fields(angle, shift, side=20):
    """Maps of a box turned by an angle and shifted on the torus, of cells with one field on it."""
    at = np.arange(side) - (side - 1) / 2
    x, y = np.meshgrid(at, at)
    u = np.cos(angle) * x - np.sin(angle) * y + (side - 1) / 2 + shift[0]
    v = np.sin(angle) * x + np.cos(angle) * y + (side - 1) / 2 + shift[1]
    off = np.stack([u, v], axis=-1) - CENTRES[:, None, None]
    off -= BINS * np.round(off / BINS)
    return np.exp(-(off**2).sum(axis=-1) / (2 * 2.0**2))


@settings(max_examples=8)
@given(st.sampled_from([0, 45, 90, 165, 270]), st.integers(0, 20), st.integers(0, 20))
def test_a_common_turn_and_shift_is_found_and_undone(degrees, x, y):
    turned = fields(np.radians(degrees), (x, y))
    angle, shift, correlation = boxes.align_maps(
        fields(0.0, (0, 0)), turned, BINS, np.radians(np.arange(0, 360, 15))
    )
    assert abs(np.degrees(angle) - degrees) <= 15
    off = (np.array(shift) - [x, y] + BINS // 2) % BINS - BINS // 2
    assert np.abs(off).max() <= 1
    assert np.nanmean(correlation) > 0.95


def test_correlations_of_shifts_are_those_of_numpy():
    rng = np.random.default_rng(1)
    first, second = rng.random((2, 3, 7, 7))
    first[:, 2, 5] = np.nan
    found = boxes.correlate_shifts(first, second)
    for y, x in ((0, 0), (3, 6)):
        moved = np.roll(second, (y, x), axis=(1, 2))
        for cell in range(3):
            known = np.isfinite(first[cell])
            expected = np.corrcoef(first[cell][known], moved[cell][known])[0, 1]
            np.testing.assert_allclose(found[cell, y, x], expected)
    assert np.isnan(boxes.correlate_shifts(np.ones((1, 7, 7)), second[:1])).all()


def test_shuffled_identities_are_far_below_the_cells_themselves():
    fits, _, _ = boxes.fit_maps(fields(0.0, (0, 0)), fields(np.radians(75), (4, 17)), BINS)
    assert np.nanmean(fits["best"]) > 0.95
    assert abs(np.nanmean(fits["still"])) < 0.25
    assert abs(np.nanmean(fits["shuffled still"])) < 0.25
    assert np.nanmean(fits["shuffled best"]) < 0.35


def test_columns_are_places_with_headings_all_the_way_round():
    config = RatSessions.of_columns(5, 0).config
    chosen = np.array(config.cells.chosen).reshape(5, -1, 3)
    assert (chosen[..., :2] == chosen[:, :1, :2]).all()
    assert len(np.unique(chosen[:, 0, :2], axis=0)) == 5
    np.testing.assert_array_equal(chosen[0, :, 2], np.arange(0, config.pose_cells.cells_heading, EVERY))
    activity = np.arange(2.0 * chosen.shape[0] * chosen.shape[1]).reshape(2, -1)
    summed, single = column_activity(activity, 5)
    assert summed.sum() == activity.sum()
    assert set(single[0]) <= set(activity[0])
    assert single.shape == (2, 5)


def ideal(size: tuple[float, float], torus: float) -> CellRecording:
    """Cells with one field of 0.1 m on a torus of a side in m, along a path without order in a box."""
    rng, steps = np.random.default_rng(0), 20_000
    place = rng.random((steps, 2)) * size
    off = place[:, None] - rng.random((6, 2)) * torus
    off -= torus * np.round(off / torus)
    activity = np.exp(-(off**2).sum(axis=-1) / (2 * 0.1**2)).astype(np.float32)
    truth = np.column_stack([place, np.zeros(steps)])
    return CellRecording(
        (36, 21, 21), torus / 21, np.arange(steps) / 10.0, truth, np.zeros((steps, 3)), np.zeros(steps),
        np.zeros(steps, np.int32), np.arange(6, dtype=np.int32), activity, None,
    )  # fmt: skip


def test_spacing_is_the_side_of_the_torus_and_a_smaller_box_holds_no_lattice():
    large, small = (3.5, 2.5), (0.4, 0.4)
    recording = ideal(large, 0.8)
    found = measure_cells(recording, recording.activity, large, 0.1, 19, 0)
    np.testing.assert_allclose(found.spacing, 0.8, rtol=0.02)
    assert (found.square.score > 0.8).all()
    assert found.square.above.all()
    assert (found.hexagonal.score < 0.3).all()
    assert (found.fields >= 4).all()
    recording = ideal(small, 1.05)
    found = measure_cells(recording, recording.activity, small, 0.05, 19, 0)
    assert (found.fields <= 1).all()
    assert np.isnan(found.spacing).all()


# In make test the same session as below, and so the same compiled kernel.


@pytest.mark.soak
@pytest.mark.parametrize(
    ("name", "measure"),
    [
        ("rotation", lambda: measure_rotation(Task(41000, 1), (16.0, 19.0, 22.0))),
        ("boxes", lambda: boxes.measure_boxes(Task(41009, 1), seconds=12.0, columns=8)),
        ("agreement", lambda: compare_scores(Task(3, 12), seconds=30.0)),
        ("torus", lambda: measure_torus(Task(41009, 1), seconds=(60.0, 45.0), columns=6, shuffles=19)),
        ("shuffles", lambda: check_shuffles(Task(3, 12), shuffles=19, seconds=60.0)),
        ("analysis_cost", lambda: measure_analysis(cells=4, shuffles=19, seconds=60.0)),
        ("networks", lambda: measure_networks(sets=1, steps=200)),
        ("scale", lambda: measure_sizes(Task(31001, 1), "clean", sides=(7, 21), sizes=())),
    ],
)
def test_other_figures_run_on_a_tiny_setting(name, measure, tmp_path):
    assert len(table_of(find_figure(CELLS[name]), measure(), tmp_path)) > 3


@pytest.mark.parametrize("place", [*CELLS.values(), *MAPS.values(), *REAL.values()])
def test_every_name_is_a_figure(place):
    figure = find_figure(place)
    assert figure.title[0].isupper()
    assert callable(figure.measure)


SHORT = TURN, _, END = 16.0, 19.0, 22.0
SHAPE, CELL_SIZE = (36, 21, 21), 0.05


def planted(turn: float) -> CellRecording:
    """A packet whose frame turns by an angle round the middle of the box, and cells tuned to its heading."""
    time = np.arange(0, END, 0.1)
    random = np.random.default_rng(3)
    truth = np.column_stack([random.uniform(0.2, 0.8, (len(time), 2)), random.uniform(-3, 3, len(time))])
    truth[0] = [0.5, 0.5, 0.0]
    angle = np.where(time >= TURN, -turn, 0.0)
    x, y = (truth[:, :2] - 0.5).T
    c, s = np.cos(angle), np.sin(angle)
    metres = np.column_stack([c * x - s * y, s * x + c * y])
    heading = truth[:, 2] + angle
    packet = np.column_stack([10 + metres / CELL_SIZE, heading * 36 / (2 * np.pi)]) % [21, 21, 36]
    cell = np.arange(36, dtype=np.int32) * 441
    activity = np.exp(4 * np.cos(heading[:, None] - 2 * np.pi * np.arange(36) / 36) - 4)
    return CellRecording(
        SHAPE, CELL_SIZE, time, truth, packet, np.zeros(len(time)), np.zeros(len(time), np.int32), cell,
        activity.astype(np.float32), None,
    )  # fmt: skip


@given(st.floats(0.0, np.pi))
def test_a_planted_rotation_is_found(turn: float) -> None:
    (heading, place, cells), _ = rotation_of(planted(turn), SHORT, turn)
    assert abs(wrap(heading - turn)) < 1e-6
    assert abs(wrap(place - turn)) < 1e-6
    assert abs(wrap(cells - turn)) < 0.2
    (heading, place, cells), _ = rotation_of(planted(0.0), SHORT, turn)  # it follows odometry
    assert max(abs(heading), abs(place)) < 1e-6
    assert abs(cells) < 0.2  # the rows before and after hold other headings


TEST, BACK, LAST = 20.0, 28.0, 34.0


def test_packets_are_anchored_by_views_and_misled_by_shuffled_ones(tmp_path: Path) -> None:
    """Sessions are equal until the test. On the walk no view is recalled within these 8 s."""
    result = packet_figures.measure_anchoring(Task(41000, sessions=1), (TEST, BACK, LAST))
    _, error, again = result
    begins, back = round(TEST * packet_figures.RATE), round(BACK * packet_figures.RATE)
    for path in packet_figures.PATHS:
        light, *others = (error[path, test] for test in packet_figures.TESTS)
        for other in others:
            assert np.array_equal(other[:, :begins], light[:, :begins])
            assert not np.array_equal(other, light)
        assert (again[path, "light"] == 0).all()
    assert all((times >= 0).all() for times in again.values())
    light, _, shuffled = (
        error["sargolini", test][:, begins:back].mean(axis=(0, 1)) for test in packet_figures.TESTS
    )
    assert (shuffled > 1.5 * light).all(), (light, shuffled)
    rows = rows_of(table_of(packet_figures.ANCHORING, result, tmp_path))
    assert [row[0] for row in rows[1:]] == [
        path for path in packet_figures.PATHS for _ in packet_figures.TESTS
    ]
    middle = np.median(error[packet_figures.PATHS[0], "dark"][:, begins:back].reshape(-1, 2), axis=0)
    assert rows[2][2] == f"{middle[0]:.3f} m, {middle[1]:.3f} rad"
    assert rows[1][-2:] == ["-", "-"]


def test_the_packet_adds_less_than_half_a_cell_to_the_drift_of_odometry(tmp_path: Path) -> None:
    names, times, cell = list(packet_figures.LEVELS), (10, 20), np.array([0.05, np.radians(10)])
    result = packet_figures.measure_drift(Task(41000, sessions=1), times)
    _, (packet, odometry, added) = result
    quiet, least, most = (
        names.index(name) for name in ("none", *(f"speed {s:g} sqrt(s)" for s in (0.05, 0.4)))
    )
    assert (packet[:, quiet] < cell / 2).all()
    assert (odometry[:, quiet] < 1e-9).all()
    assert (added < cell / 2).all()
    np.testing.assert_allclose(odometry[:, most, :, 0] / odometry[:, least, :, 0], 0.4 / 0.05)
    for (_, heading), errors in zip(packet_figures.LEVELS.values(), odometry[0, ..., 1], strict=True):
        assert (errors <= 4 * heading * np.sqrt(times) + 1e-9).all()
        assert (errors > 0).all() == (heading > 0)
    rows = rows_of(table_of(packet_figures.DRIFT, result, tmp_path))
    assert [row[:2] for row in rows[1:]] == [[name, str(time)] for name in names for time in times]
    heading = packet_figures.LEVELS[names[-1]][1]
    assert rows[-1][6] == f"{heading * np.sqrt(20):.3f}"
    assert rows[-1][2:5] == [f"{each[0, -1, -1, 0]:.3f}" for each in (packet, odometry, added)]
