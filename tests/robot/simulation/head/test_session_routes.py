"""Routes of simulated sessions: circuits, exploration, given cells, kidnaps, going backwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from robot.world.maze import CELL_SIDE, maze_text
from tactile.base.se2 import between
from tactile.whisker_geometry import HeadConfig, RingConfig
from tests.robot.simulation.head.session_cases import simulate


def test_reverse_tracking_senses_the_same_places() -> None:
    steady, calm = {"jitter": {"position": 0, "yaw_deg": 0}}, {"noise": "none"}
    quiet = {"noise": 0.0, "reach_noise": 0.0}
    there = simulate(path={"circuits": "C"}, motion=steady, odometry=calm, mechanics=quiet)
    backwards = steady | {"backwards": True}
    back = simulate(path={"circuits": "A"}, motion=backwards, odometry=calm, mechanics=quiet)
    assert (there.odometry[:, 0] > -1e-9).all()
    assert (back.odometry[:, 0] < 1e-9).all()
    gap = between(there.truth[:, None], back.truth[None])
    away = np.hypot(gap[..., 0], gap[..., 1]) + 0.1 * np.abs(gap[..., 2])
    nearest = away.argmin(axis=1)
    assert away.min(axis=1).max() < 0.04  # half a step, or the same for half a turn
    same = there.features.contact == back.features.contact[nearest]
    apart = there.features.contact == back.features.contact[np.roll(nearest, 40)]
    assert same.mean() > 0.9 > apart.mean()


def test_kidnaps_are_spread_and_hidden_from_odometry() -> None:
    whole = simulate(path={"circuits": "CACA"})
    session = simulate(
        path={"circuits": "CACA"}, kidnaps={"count": 3, "ahead": 30.0}, odometry={"noise": "none"}
    )
    rows = np.flatnonzero(session.kidnapped)
    assert len(rows) == 3
    assert (rows >= session.length // 4 - 1).all()
    assert abs(session.length - (whole.length - 90)) <= 1
    true = between(session.truth[:-1], session.truth[1:])
    measured = session.odometry[1:, :3]
    wrong = np.flatnonzero(np.abs(measured[:, :2] - true[:, :2]).max(axis=1) > 0.02)
    assert set(wrong) <= set(rows - 1)
    assert len(wrong) >= 2  # a kidnap may look like continued motion
    assert (measured[rows - 1] == measured[rows - 2]).all()
    assert simulate().kidnapped.sum() == 0


def test_exploration_has_the_configured_duration() -> None:
    session = simulate(path={"explore": 400.0})
    assert session.length == 400
    cells = {tuple(cell) for cell in np.floor(session.truth[:, :2] / CELL_SIDE).astype(int)}
    assert len(cells) > 12
    carried = simulate(path={"explore": 400.0}, kidnaps={"count": 2, "ahead": 60.0})
    assert carried.length == 400
    assert carried.kidnapped.sum() == 2
    assert simulate(path={"explore": 400.0}, seed=1).truth[-1].tolist() != session.truth[-1].tolist()


def test_a_maze_without_loops_is_explored() -> None:
    tree = {"kind": "tree"}
    session, other = (simulate(maze=tree, path={"explore": 300.0}, seed=seed) for seed in (0, 1))
    assert session.length == 300
    assert not session.scene.loop
    inner = np.r_[session.scene.maze.across[1:-1].ravel(), session.scene.maze.along[:, 1:-1].ravel()]
    assert (~inner).sum() == session.scene.maze.columns * session.scene.maze.rows - 1
    assert not np.array_equal(session.scene.maze.across, other.scene.maze.across)


def test_given_cells_are_visited(tmp_path: Path) -> None:
    (tmp_path / "maze.txt").write_text("o---o---o\n|       |\no   o   o\n|   |   |\no---o---o\n")
    cells = [(0, 0), (0, 1), (1, 1), (1, 0)]
    session = simulate(maze={"file": tmp_path / "maze.txt"}, path={"cells": cells})
    passed = [tuple(cell) for cell in np.floor(session.truth[:, :2] / CELL_SIDE).astype(int).tolist()]
    assert list(dict.fromkeys(passed)) == cells
    assert simulate(maze={"file": tmp_path / "maze.txt"}, path={"explore": 60}).length == 60


def test_a_low_head_may_move_where_its_whiskers_are_free(tmp_path: Path) -> None:
    """Whiskers at rest below the tops of walls are allowed where no wall is near."""
    wide = "o" + "---o" * 6 + "\n" + "\n".join(["|" + " " * 23 + "|", "o" + "   o" * 6] * 5)
    drawing = wide + "\n|" + " " * 23 + "|\no" + "---o" * 6 + "\n"
    (tmp_path / "maze.txt").write_text(drawing.replace("   o" * 6 + "\n|", "   o" * 6 + "\n|"))
    short = HeadConfig(rings=(RingConfig(length=0.04, radius=0.02, height=0.055),))
    session = simulate(short, maze={"file": tmp_path / "maze.txt"}, path={"cells": [(2, 2), (3, 2), (3, 3)]})
    assert not session.features.contact.any()


def test_circuits_start_at_a_chosen_cell_of_the_same_maze() -> None:
    first, other = simulate(), simulate(path={"circuits": "CA", "start": 7})
    assert maze_text(first.scene.maze) == maze_text(other.scene.maze)
    for session, number in ((first, 0), (other, 7)):
        cell = np.floor(session.truth[0, :2] / CELL_SIDE).astype(int)
        assert tuple(cell.tolist()) == session.scene.loop[number]
