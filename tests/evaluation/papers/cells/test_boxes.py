"""Figures of cells: boxes, the torus, packets; the belief beside exact inference, and its lesions."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.cells.recording import CellRecording
from evaluation.papers.cells import belief_lesions, belief_rows, belief_world, boxes, packet_figures
from evaluation.papers.cells.agreement import compare_scores
from evaluation.papers.cells.belief_lesions import measure_sizes
from evaluation.papers.cells.costs import measure_analysis, measure_networks
from evaluation.papers.cells.rotation import measure_rotation, rotation_of
from evaluation.papers.cells.sheets import measure_sheets
from evaluation.papers.cells.shuffles import check_shuffles
from evaluation.papers.cells.torus import measure_cells, measure_torus
from evaluation.papers.figure import CELLS, MAPS, REAL, Task, find_figure
from evaluation.papers.tables import touch_table as touch
from ratslam.network.config import PoseCellConfig
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
    angles = np.radians(np.arange(0, 360, 15))
    angle, shift, correlation = boxes.align_maps(fields(0.0, (0, 0)), turned, BINS, angles)
    assert abs(np.degrees(angle) - degrees) <= 15
    off = (np.array(shift) - [x, y] + BINS // 2) % BINS - BINS // 2
    assert np.abs(off).max() <= 1
    assert np.nanmean(correlation) > 0.95


def test_correlations_of_shifts_are_those_of_numpy_and_far_below_for_shuffled_cells():
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
    fits, _, _ = boxes.fit_maps(fields(0.0, (0, 0)), fields(np.radians(75), (4, 17)), BINS)
    mean = {name: np.nanmean(fit) for name, fit in fits.items()}
    assert max(abs(mean["still"]), abs(mean["shuffled still"])) < 0.25
    assert mean["shuffled best"] < 0.35 < 0.95 < mean["best"]


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
    assert found.square.above.all()
    assert found.square.score.min() > 0.8 > 0.3 > found.hexagonal.score.max()
    assert found.fields.min() >= 4
    recording = ideal(small, 1.05)
    found = measure_cells(recording, recording.activity, small, 0.05, 19, 0)
    assert (found.fields <= 1).all()
    assert np.isnan(found.spacing).all()


@pytest.mark.soak
@pytest.mark.parametrize(("name", "measure"), [
    ("rotation", lambda: measure_rotation(Task(41000, 1), (16.0, 19.0, 22.0))),
    ("boxes", lambda: boxes.measure_boxes(Task(41009, 1), seconds=12.0, columns=8)),
    ("agreement", lambda: compare_scores(Task(3, 12), seconds=30.0)),
    ("torus", lambda: measure_torus(Task(41009, 1), seconds=(60.0, 45.0), columns=6, shuffles=19)),
    ("sheets", lambda: measure_sheets(Task(41009, 1), 6, 19, ("sargolini",), 90.0)),
    ("shuffles", lambda: check_shuffles(Task(3, 12), shuffles=19, seconds=60.0)),
    ("analysis_cost", lambda: measure_analysis(cells=4, shuffles=19, seconds=60.0)),
    ("networks", lambda: measure_networks(sets=1, steps=200)),
    ("scale", lambda: measure_sizes(Task(31001, 1), "clean", sides=(7, 21), sizes=())),
])  # fmt: skip
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
    for made in (turn, 0.0):  # without a turn it follows odometry
        (heading, place, cells), _ = rotation_of(planted(made), SHORT, turn)
        assert max(abs(wrap(heading - made)), abs(wrap(place - made))) < 1e-6
        assert abs(wrap(cells - made)) < 0.2  # the rows before and after hold other headings


def test_the_packet_adds_less_than_half_a_cell_to_the_drift_of_odometry(tmp_path: Path) -> None:
    names, times, cell = list(packet_figures.LEVELS), (10, 20), np.array([0.05, np.radians(10)])
    result = packet_figures.measure_drift(Task(41000, sessions=1), times)
    _, (packet, odometry, added) = result
    quiet, least, most = map(names.index, ("none", "speed 0.05 sqrt(s)", "speed 0.4 sqrt(s)"))
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


SMALL = Task(41000, sessions=2)


def test_on_a_lattice_the_network_is_exact_inference() -> None:
    """View cells, and where they are after each motion, are at centres of cells."""
    random = np.random.default_rng(3)
    x, y, layer = np.meshgrid(np.arange(4), np.arange(4), [0, 9, 18, 27], indexing="ij")
    cell = PoseCellConfig().cell_size
    poses = np.column_stack([x.ravel() * cell, y.ravel() * cell, layer.ravel() * 2 * np.pi / 36])
    motion = np.zeros((12, 3))
    motion[:, 0] = cell * random.integers(0, 2, 12)
    likelihood, none = random.uniform(0.1, 2, (12, len(poses))), np.zeros(len(poses))
    world = belief_world.World(poses, motion, likelihood, np.ones(12), np.zeros(12, int), none)
    np.testing.assert_allclose(belief_world.network(world), belief_world.exact(world), atol=2e-6)
    np.testing.assert_allclose(belief_world.exact(world, 0.5), belief_world.exact(world), atol=1e-12)


def test_a_uniform_guess_gains_nothing_and_its_regions_hold_what_they_say() -> None:
    world = belief_world.random_world(5, 400)
    states = len(world.poses) + 1
    guess = np.full((400, states), 1 / states)
    np.testing.assert_allclose(belief_rows.log_gain(world, guess), 0, atol=1e-12)
    belief = belief_world.exact(world)
    assert np.abs(belief_rows.inside(world, belief) - [0.5, 0.9]).max() < 0.06
    sharp = belief**3 / (belief**3).sum(axis=1, keepdims=True)
    assert belief_rows.inside(world, sharp)[1] < belief_rows.inside(world, belief)[1]


def table_rows(name: str, result: Any, folder: Path) -> list[list[str]]:
    return rows_of(table_of(find_figure(CELLS[name]), result, folder))


def test_the_network_loses_little_and_the_control_much(tmp_path: Path) -> None:
    result = belief_rows.measure_posterior(SMALL, updates=150)
    scores = {name: one[:, 0].mean() for name, one in result[0].items()}
    assert scores[belief_rows.EXACT] > scores[belief_rows.MANY] > 0.9 * scores[belief_rows.EXACT]
    assert scores[belief_rows.NETWORK] == pytest.approx(scores[belief_rows.EXACT], rel=0.03)
    assert scores[belief_rows.CONTROL] < 0.8 * scores[belief_rows.EXACT]
    rows = table_rows("posterior", result, tmp_path)
    assert [row[0] for row in rows[1:]] == list(scores)
    world = belief_world.random_world(7, 100)
    best = belief_world.exact(world)
    sizes = PoseCellConfig(), belief_rows.FINE_CELLS
    coarse, fine = (np.abs(belief_world.network(world, cells=c) - best).mean() for c in sizes)
    assert fine < 0.6 * coarse


def test_rooms_that_look_alike_share_the_belief_until_they_differ(tmp_path: Path) -> None:
    result = belief_rows.measure_rooms(SMALL, sessions=0)
    found, evident, _ = result
    share = found[belief_rows.NETWORK][:, 0]
    assert np.abs(share[~evident] - 0.5).max() < 0.1
    assert share[:, -1].min() > 0.9
    assert found[belief_rows.CONTROL][:, 0, -1].max() < 0.9
    assert any(row[0] == belief_rows.NETWORK for row in table_rows("alike_rooms", result, tmp_path))
    world = belief_rows.alike_rooms(41000)
    half = len(world.poses) // 2
    belief = belief_world.exact(world._replace(likelihood=np.tile(world.likelihood[:, :half], 2)))
    np.testing.assert_allclose(belief[:, :half].sum(axis=1), belief[:, half:-1].sum(axis=1), rtol=0.02)


def test_after_a_kidnap_the_network_finds_the_place_by_re_entry(tmp_path: Path) -> None:
    result = belief_rows.measure_kidnaps(SMALL)
    (steps, _), (without, _) = result[belief_rows.NETWORK], result[belief_rows.NO_ENTRY]
    assert np.isfinite(steps).all()
    assert (without > steps).all()
    assert any(row[0] == belief_rows.NETWORK for row in table_rows("kidnap", result, tmp_path))


def test_cues_are_weighed_by_their_reliability(tmp_path: Path) -> None:
    result = belief_rows.measure_conflicts(SMALL._replace(sessions=1))
    network, exact = belief_rows.NETWORK, belief_rows.EXACT
    strong, weak, best = (
        result[f"view {share} against odometry", 180, which][0]
        for share, which in (("0.6", network), ("0.3", network), ("0.6", exact))
    )
    assert (np.diff(strong) > 0).all()
    assert (strong > weak).all()
    assert np.abs(strong - best).max() < 0.05
    header, *rows = table_rows("cue_conflict", result, tmp_path)
    (row,) = (row for row in rows if row[:2] == ["view 0.6 against odometry", "180"])
    assert row[header.index(f"weight of the first: {network}")] == f"{strong[belief_rows.READ - 1]:.3f}"


SHORT_ROW = touch.TouchRow("short", {"path": {"explore": 420}, "maze": {"columns": 3, "rows": 3, "loop": 4}})
CHOSEN = (belief_lesions.INTACT, "cells and ties permuted together", "ties permuted alone")


def test_a_renamed_network_closes_the_same_loops_and_one_without_places_none(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("RATSLAM_DATA", raising=False)
        patch.setitem(touch.ROWS, "short", SHORT_ROW)
        lesions = belief_lesions.measure_lesions(Task(31001, sessions=1), CHOSEN, ("short",))
    ((_, _, true),), ((_, same, _),), ((figures, other, _),) = (lesions[name, "short"] for name in CHOSEN)
    assert true > 0
    assert (same, other, figures.record["closures"]) == (1, 0, 0)
    (row,) = (row for row in table_rows("lesions", lesions, tmp_path) if row[0].startswith(CHOSEN[2]))
    assert row[3:5] == ["0, 0", "0%"]
