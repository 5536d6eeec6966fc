"""Mazes of simulated sessions: the same one for many sessions, one that changes."""

from __future__ import annotations

import pytest

from robot.world.maze import maze_text
from tactile.base.errors import InputError
from tests.robot.simulation.head.session_cases import simulate


def test_one_maze_can_have_many_sessions() -> None:
    one, two = (simulate(seed=seed, maze={"seed": 7}) for seed in (1, 2))
    assert maze_text(one.scene.maze) == maze_text(two.scene.maze)
    assert one.scene.loop == two.scene.loop
    assert (one.odometry[:99] != two.odometry[:99]).any()


def test_a_later_maze_changes_contacts() -> None:
    base, control = simulate(), simulate(later_maze=0.5)
    half = base.length // 2
    for one, two in zip(base.features[2:], control.features[2:], strict=True):
        assert (one[:half] == two[:half]).all()
    assert (base.features.contact[half:] != control.features.contact[half:]).mean() > 0.05
    assert (base.truth == control.truth).all()
    assert (base.odometry == control.odometry).all()


def test_a_changed_maze_differs_in_the_changed_walls_alone() -> None:
    first = simulate()
    loop = first.scene.loop
    shut = (loop[0], loop[-1])
    way = [*loop, *loop[-2::-1]]
    changed = simulate(maze={"added": [shut]}, path={"cells": way})
    lines = zip(
        maze_text(first.scene.maze).splitlines(), maze_text(changed.scene.maze).splitlines(), strict=True
    )
    assert sum(a != b for one, other in lines for a, b in zip(one, other, strict=True)) in (1, 3)
    with pytest.raises(InputError, match="wall between"):
        simulate(maze={"added": [shut]})  # the circuits pass there
