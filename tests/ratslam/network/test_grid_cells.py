"""Grid cells: lattices of their fields, what they say of a certain and of an uncertain belief, and that they
change no bit of it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ratslam
from evaluation.cells.recording import CellRecording
from evaluation.papers.cells.torus import measure_cells
from ratslam.network.config import SheetConfig
from ratslam.network.grid_cells import SIDE, sheet_activity, sheet_shape
from ratslam.network.pose_cells import ViewCells
from ratslam.runs.build_session import build_session
from ratslam.runs.settings.run_config import LoopConfig
from robot.simulation.rat.simulated_session import RatSimulation, RatSimulationConfig

SPACING = 0.3
TWISTED, SQUARE = (SheetConfig(spacing=SPACING, twisted=twisted) for twisted in (True, False))
ALL = {sheet: np.arange(np.prod(sheet_shape(sheet))) for sheet in (TWISTED, SQUARE)}
LATTICE = {
    TWISTED: SPACING * np.array([[1, 0], [0.5, np.sqrt(0.75)]]),
    SQUARE: SPACING * np.eye(2),
}
STILL = jnp.zeros(3)


def view_cells(poses):
    x, y, heading = jnp.asarray(np.reshape(poses, (-1, 3)), jnp.float32).T[:, None]
    return ViewCells(x, y, heading, jnp.cos(heading), jnp.sin(heading), jnp.ones_like(x))


def of_place(sheet, x, y):
    """The activity of a belief that is certain of a place."""
    cells, mass = view_cells([x, y, 0.7]), jnp.ones((1, 1), jnp.float32)
    return np.asarray(sheet_activity(sheet, mass, cells, STILL, STILL, ALL[sheet]))


places = st.tuples(*[st.floats(-2, 2)] * 2)


@pytest.mark.parametrize("sheet", [TWISTED, SQUARE], ids=["twisted", "square"])
@given(places, st.integers(-3, 3), st.integers(-3, 3))
def test_fields_are_on_a_lattice(sheet, place, a, b):
    moved = np.array(place) + [a, b] @ LATTICE[sheet]
    np.testing.assert_allclose(of_place(sheet, *moved), of_place(sheet, *place), atol=2e-3)


def test_a_square_period_is_none_of_a_twisted_sheet():
    one, other = of_place(TWISTED, 0.0, 0.0), of_place(TWISTED, 0.0, SPACING)
    assert np.abs(one - other).max() > 0.5


@pytest.mark.parametrize("sheet", [TWISTED, SQUARE], ids=["twisted", "square"])
def test_each_cell_prefers_its_own_place(sheet):
    _, height, width = sheet_shape(sheet)
    for cell in (0, 1, width, height * width - 1):
        y, x = np.divmod(cell, SIDE)
        active = of_place(sheet, x * SPACING / SIDE, y * SPACING / SIDE)
        assert active[cell] == pytest.approx(1, abs=1e-5)
        assert active.argmax() == cell


@given(places, places, st.floats(0, 0.5), st.floats(0, 0.5))
def test_activity_is_the_expected_tuning_and_novelty_is_where_the_map_has_the_robot(one, other, p, q):
    mass = jnp.asarray([[p, q]], jnp.float32)
    poses = [[*one, 0.0], [*other, 1.0]]
    here = jnp.asarray([0.05, 0.11, 0.0])
    found = sheet_activity(TWISTED, mass, view_cells(poses), STILL, here, ALL[TWISTED])
    parts = (of_place(TWISTED, *at) for at in (one, other, (0.05, 0.11)))
    expected = sum(share * part for share, part in zip((p, q, 1 - p - q), parts, strict=True))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_between_views_odometry_moves_the_belief_along_its_own_heading():
    motion, mass = jnp.asarray([0.1, 0.02, 0.3]), jnp.ones((1, 1), jnp.float32)
    cells = view_cells([0.2, 0.1, np.pi / 2])
    found = sheet_activity(TWISTED, mass, cells, motion, STILL, ALL[TWISTED])
    np.testing.assert_allclose(found, of_place(TWISTED, 0.18, 0.2), atol=1e-5)


def test_a_twisted_sheet_has_a_grid_score_and_a_square_one_has_none():
    """In a box of 3.33 spacings, every place visited equally."""
    rng, steps = np.random.default_rng(0), 6000
    truth = np.column_stack([rng.random((steps, 2)), np.zeros(steps)])
    nothing, medians = jnp.zeros((1, 0), jnp.float32), []
    for sheet in (TWISTED, SQUARE):
        chosen = ALL[sheet][::9]
        certain = jax.vmap(partial(sheet_activity, sheet, nothing, view_cells([]), STILL, chosen=chosen))
        active = np.asarray(certain(truth))
        recording = CellRecording(
            sheet_shape(sheet), SPACING / SIDE, np.arange(steps) / 10, truth, truth, np.zeros(steps),
            np.zeros(steps, np.int32), chosen, active, None,
        )  # fmt: skip
        found = measure_cells(recording, active, (1.0, 1.0), 0.04, 19, 0, 0.03)
        medians.append((np.nanmedian(found.hexagonal.score), np.nanmedian(found.square.score)))
    (hexagonal, low), (none, square) = medians
    assert hexagonal > 1.0 > 0.3 > none
    assert square > 1.0 > 0.3 > low


def rat(backend="recall", **cells):
    source = RatSimulation(RatSimulationConfig(seconds=12.0, rate_hz=10.0))
    config = LoopConfig.model_validate({"backend": backend, "cells": cells or None})
    return build_session(config, source), source


def test_a_sheet_changes_no_bit_of_the_session():
    outcomes = []
    for cells in ({}, {"sheet": {"spacing": 0.3}}, {"sheet": {"spacing": 0.3, "twisted": False}}):
        session, source = rat(**cells)
        steps = list(session.replay([sample.reading for sample in source]))
        outcomes.append((session.arrays() | {"path": session.map.trajectory()}, steps))
    plain = outcomes[0][0]
    for arrays, steps in outcomes[1:]:
        assert arrays.keys() == plain.keys()
        for name, value in arrays.items():
            np.testing.assert_array_equal(value, plain[name], err_msg=name)
        active = np.array([step.probed for step in steps])
        assert active.shape == (len(steps), 64)
        assert (active.max(axis=0) > 0.5).any()
        assert active.max() <= 1 + 1e-5


def test_a_sheet_needs_a_belief():
    with pytest.raises(ratslam.InputError, match=r"cells.sheet: `backend: classic`, whose cells hold no"):
        rat("classic", sheet={"spacing": 0.3})
