"""The belief of the network beside exact inference, and the figures of it at a small size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.papers.cells.belief_rows import (
    CONTROL,
    DIFFERENCE,
    EXACT,
    FINE_CELLS,
    MANY,
    NETWORK,
    NO_ENTRY,
    alike_rooms,
    inside,
    log_gain,
    measure_conflicts,
    measure_kidnaps,
    measure_posterior,
    measure_rooms,
)
from evaluation.papers.cells.belief_world import (
    CONFIG,
    World,
    exact,
    network,
    random_world,
    room_closures,
    transition,
)
from evaluation.papers.figure import CELLS, Task, find_figure
from ratslam.network.config import PoseCellConfig

SMALL = Task(41000, sessions=2)


@pytest.fixture(scope="module")
def posterior() -> Any:
    return measure_posterior(SMALL, updates=150)


@pytest.fixture(scope="module")
def rooms() -> Any:
    return measure_rooms(SMALL, sessions=0)


@pytest.fixture(scope="module")
def kidnaps() -> Any:
    return measure_kidnaps(SMALL)


@pytest.fixture(scope="module")
def conflicts() -> Any:
    return measure_conflicts(SMALL._replace(sessions=1))


def on_lattice() -> World:
    """A world whose view cells, and where they are after each motion, are at centres of cells."""
    random = np.random.default_rng(3)
    x, y, layer = np.meshgrid(np.arange(4), np.arange(4), [0, 9, 18, 27], indexing="ij")
    cell = PoseCellConfig().cell_size
    poses = np.column_stack([x.ravel() * cell, y.ravel() * cell, layer.ravel() * 2 * np.pi / 36])
    motion = np.zeros((12, 3))
    motion[:, 0] = cell * random.integers(0, 2, 12)
    likelihood = random.uniform(0.1, 2, (12, len(poses)))
    return World(poses, motion, likelihood, np.ones(12), np.zeros(12, int), np.zeros(len(poses)))


def test_on_a_lattice_the_network_is_exact_inference() -> None:
    world = on_lattice()
    np.testing.assert_allclose(network(world), exact(world), atol=2e-6)
    np.testing.assert_allclose(exact(world, 0.5), exact(world), atol=1e-12)


def test_another_likelihood_changes_the_belief() -> None:
    world = on_lattice()
    other = world._replace(likelihood=world.likelihood[::-1])
    assert np.abs(network(other) - exact(world)).max() > 0.01


def test_a_transition_loses_the_leak_and_what_finds_no_view_cell() -> None:
    world = on_lattice()
    far = transition(world.poses, np.array([5.0, 0.0, 0.0]), 0.0)
    here = transition(world.poses, np.zeros(3), 0.0)
    assert far.sum() == 0
    assert (here.sum(axis=0) < 1 - CONFIG.leak).all()
    assert (here.sum(axis=0) > 0.99).all()


def test_a_uniform_guess_gains_nothing_and_its_regions_hold_what_they_say() -> None:
    world = random_world(5, 400)
    states = len(world.poses) + 1
    guess = np.full((400, states), 1 / states)
    np.testing.assert_allclose(log_gain(world, guess), 0, atol=1e-12)
    belief = exact(world)
    assert np.abs(inside(world, belief) - [0.5, 0.9]).max() < 0.06
    sharp = belief**3 / (belief**3).sum(axis=1, keepdims=True)
    assert inside(world, sharp)[1] < inside(world, belief)[1]


def test_the_network_loses_little_and_the_control_much(posterior: Any) -> None:
    scores = {name: one[:, 0].mean() for name, one in posterior[0].items()}
    assert scores[EXACT] > scores[MANY] > 0.9 * scores[EXACT]
    assert scores[NETWORK] == pytest.approx(scores[EXACT], rel=0.03)
    assert scores[CONTROL] < 0.8 * scores[EXACT]


def test_smaller_cells_come_closer_to_exact_inference() -> None:
    world = random_world(7, 100)
    best = exact(world)
    coarse, fine = (np.abs(network(world, cells=c) - best).mean() for c in (PoseCellConfig(), FINE_CELLS))
    assert fine < 0.6 * coarse


def test_rooms_that_look_alike_share_the_belief_until_they_differ(rooms: Any) -> None:
    found, evident, _ = rooms
    share = found[NETWORK][:, 0]
    assert np.abs(share[~evident] - 0.5).max() < 0.1
    assert share[:, -1].min() > 0.9
    assert found[CONTROL][:, 0, -1].max() < 0.9


@pytest.mark.soak
def test_the_product_closes_loops_into_the_room_of_the_robot_if_rooms_do_not_look_alike() -> None:
    early, true, false = room_closures(41000, DIFFERENCE, alike=False)
    assert early > 10
    assert true > 20
    assert false == 0


def test_rooms_that_never_differ_keep_their_shares() -> None:
    world = alike_rooms(41000)
    half = len(world.poses) // 2
    same = world._replace(likelihood=np.tile(world.likelihood[:, :half], 2))
    belief = exact(same)
    np.testing.assert_allclose(belief[:, :half].sum(axis=1), belief[:, half:-1].sum(axis=1), rtol=0.02)


def test_after_a_kidnap_the_network_finds_the_place_by_re_entry(kidnaps: Any) -> None:
    (steps, _), (without, _) = kidnaps[NETWORK], kidnaps[NO_ENTRY]
    assert np.isfinite(steps).all()
    assert (without > steps).all()


def test_cues_are_weighed_by_their_reliability(conflicts: Any) -> None:
    strong, weak = (conflicts[f"view {share} against odometry", 180, NETWORK][0] for share in ("0.6", "0.3"))
    assert (np.diff(strong) > 0).all()
    assert (strong > weak).all()
    best = conflicts["view 0.6 against odometry", 180, EXACT][0]
    assert np.abs(strong - best).max() < 0.05


@pytest.mark.parametrize("name", ["posterior", "rooms", "kidnaps", "conflicts"])
def test_tables_and_pictures(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    figure = find_figure(
        CELLS[{"rooms": "alike_rooms", "kidnaps": "kidnap", "conflicts": "cue_conflict"}.get(name, name)]
    )
    result = request.getfixturevalue(name)
    rows = [line for line in figure.table(result) if line.startswith("| ")]
    assert len({line.count("|") for line in rows}) == 1
    assert any(NETWORK in row for row in rows)
    assert figure.draw is not None
    figure.draw(result, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
