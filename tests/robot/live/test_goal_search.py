"""The search for a place on the map: ahead where there is room, and it ends."""

from __future__ import annotations

import numpy as np
import pytest

from robot.live.goal_search import STEP, TURN, GoalSearch

FREE = np.zeros((0, 2))


def test_it_moves_ahead_until_its_way_is_used_up():
    search = GoalSearch(3 * STEP - 0.001)
    moves = [search.next_move(FREE) for _ in range(4)]
    assert all(np.array_equal(move, [STEP, 0.0, 0.0]) for move in moves[:3])
    assert moves[3] is None


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_it_turns_away_from_walls_and_keeps_turning(side):
    search = GoalSearch(1.0)
    wall = np.array([[0.06, 0.02 * side], [0.06, 0.04 * side], [0.0, 0.07]])
    assert np.allclose(search.next_move(wall), [0.0, 0.0, -side * TURN])
    assert np.allclose(search.next_move(wall * (1, -1)), [0.0, 0.0, -side * TURN]), "no dithering"
    assert search.next_move(np.array([[0.0, 0.07], [0.05, -0.08]]))[0] == STEP, "walls beside leave room"


def test_a_refused_move_is_not_repeated():
    search = GoalSearch(1.0)
    search.refuse()
    assert search.next_move(FREE)[2] != 0
    assert search.next_move(FREE)[0] == STEP
