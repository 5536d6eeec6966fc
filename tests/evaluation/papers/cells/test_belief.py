"""The belief of the network beside exact inference, its figures at a small size, and its lesions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from evaluation.papers.cells import belief_lesions, belief_rows, belief_world
from evaluation.papers.figure import CELLS, Task, find_figure
from evaluation.papers.tables import touch_table as touch
from ratslam.network import pose_cells
from ratslam.network.config import Network, PoseCellConfig
from tests.evaluation.papers.shown import rows_of, table_of

SMALL = Task(41000, sessions=2)


def on_lattice() -> belief_world.World:
    """A world whose view cells, and where they are after each motion, are at centres of cells."""
    random = np.random.default_rng(3)
    x, y, layer = np.meshgrid(np.arange(4), np.arange(4), [0, 9, 18, 27], indexing="ij")
    cell = PoseCellConfig().cell_size
    poses = np.column_stack([x.ravel() * cell, y.ravel() * cell, layer.ravel() * 2 * np.pi / 36])
    motion = np.zeros((12, 3))
    motion[:, 0] = cell * random.integers(0, 2, 12)
    likelihood = random.uniform(0.1, 2, (12, len(poses)))
    return belief_world.World(poses, motion, likelihood, np.ones(12), np.zeros(12, int), np.zeros(len(poses)))


def test_on_a_lattice_the_network_is_exact_inference() -> None:
    world = on_lattice()
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
    coarse, fine = (
        np.abs(belief_world.network(world, cells=c) - best).mean()
        for c in (PoseCellConfig(), belief_rows.FINE_CELLS)
    )
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
    strong, weak, best = (
        result[f"view {share} against odometry", 180, which][0]
        for share, which in (
            ("0.6", belief_rows.NETWORK),
            ("0.3", belief_rows.NETWORK),
            ("0.6", belief_rows.EXACT),
        )
    )
    assert (np.diff(strong) > 0).all()
    assert (strong > weak).all()
    assert np.abs(strong - best).max() < 0.05
    header, *rows = table_rows("cue_conflict", result, tmp_path)
    (row,) = (row for row in rows if row[:2] == ["view 0.6 against odometry", "180"])
    assert (
        row[header.index(f"weight of the first: {belief_rows.NETWORK}")]
        == f"{strong[belief_rows.READ - 1]:.3f}"
    )


SHORT = touch.TouchRow("short", {"path": {"explore": 420}, "maze": {"columns": 3, "rows": 3, "loop": 4}})
CHOSEN = (belief_lesions.INTACT, "cells and ties permuted together", "ties permuted alone")


def test_a_renamed_network_closes_the_same_loops_and_one_without_places_none(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("RATSLAM_DATA", raising=False)
        patch.setitem(touch.ROWS, "short", SHORT)
        lesions = belief_lesions.measure_lesions(Task(31001, sessions=1), CHOSEN, ("short",))
    ((_, _, true),), ((_, same, _),), ((figures, other, _),) = (lesions[name, "short"] for name in CHOSEN)
    assert true > 0
    assert (same, other, figures.metrics.closures) == (1, 0, 0)
    (row,) = (row for row in table_rows("lesions", lesions, tmp_path) if row[0].startswith(CHOSEN[2]))
    assert row[3:5] == ["0, 0", "0%"]


def test_lesions_replace_what_cells_hold_within_alone() -> None:
    """Silent cells hold nothing; foreign activity is repeated over a larger network."""
    config = Network(PoseCellConfig(), excite=0.5, excite_heading=0.21, miss=0.002, leak=0.0)
    before = pose_cells.predict, pose_cells.anchor
    x = jnp.arange(30, dtype=jnp.float32)[None] * 0.05
    zero, mass = jnp.zeros_like(x), jnp.full_like(x, 1 / 30)
    cells = pose_cells.ViewCells(x, zero, zero, zero + 1, zero, zero + 1)
    belief = pose_cells.start(config, mass.shape)
    intact = pose_cells.anchor(config, belief, cells, mass).activity
    with belief_lesions.replaced(belief_lesions.LESIONS["ties permuted alone"](1)):
        assert pose_cells.predict is not before[0]
    with belief_lesions.replaced(belief_lesions.LESIONS["30% silent"](5)):
        left = pose_cells.anchor(config, belief, cells, mass).activity
    assert (pose_cells.predict, pose_cells.anchor) == before
    assert ((left == 0) | (left == intact)).all()
    assert 0.5 < float(left.sum()) < 0.9
    recorded = np.random.default_rng(1).random((3, 36, 21, 21)).astype(np.float32)
    with belief_lesions.replaced(belief_lesions.foreign_activity(recorded)):
        covered = pose_cells.cover(config, belief, (42, 21))
        activity = pose_cells.anchor(config, covered, cells, mass).activity
    np.testing.assert_array_equal(activity, np.tile(recorded[1], (1, 1, 2)))
