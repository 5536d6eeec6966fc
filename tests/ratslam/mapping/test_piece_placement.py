"""Pieces that nothing joins lie apart; joined ones where their closures claim."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.keyframe_graph import APART, number_pieces, piece_start, placed_pieces
from tactile.base.se2 import between, compose, wrap

CELL = 0.2
law = settings(derandomize=True, deadline=None, max_examples=60)


@st.composite
def maps(draw):
    """Poses [N, 3] of stretches that lie apart, and the closures between them, each true at one place."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lengths = draw(st.lists(st.integers(1, 6), min_size=1, max_size=6))
    count = sum(lengths)
    begins = np.zeros(count, bool)
    begins[np.cumsum(lengths)[:-1]] = True
    stretch = np.cumsum(begins)
    truth = random.normal(0, 2, (count, 3))
    starts = np.array([piece_start(k, CELL) for k in range(len(lengths))])
    first = np.searchsorted(stretch, stretch)
    poses = compose(starts[stretch], between(truth[first], truth))
    pairs = draw(st.lists(st.tuples(st.integers(0, count - 1), st.integers(0, count - 1)), max_size=5))
    i, j = np.array(pairs, int).reshape(-1, 2).T
    # A closure claims a position, so the two keyframes of each are put at one place of the truth.
    turn = random.uniform(-np.pi, np.pi, len(i))
    return poses, (begins, i, j, turn)


def between_first(poses, stretch):
    """Poses of keyframes in the frame of the first one of their stretch."""
    return between(poses[np.searchsorted(stretch, stretch)], poses)


@law
@given(maps())
def test_pieces_keep_their_shape_and_lie_apart_unless_they_are_joined(found):
    poses, joints = found
    placed = placed_pieces(poses, *joints, CELL)
    stretch = np.cumsum(joints[0])
    shape = between_first(placed, stretch) - between_first(poses, stretch)
    shape[:, 2] = wrap(shape[:, 2])
    assert np.abs(shape).max() < 1e-9
    piece = number_pieces(joints[0], np.column_stack([joints[2], joints[1]]))
    for number in np.unique(piece):
        at = np.flatnonzero(piece == number)[0]
        assert np.allclose(placed[at], piece_start(int(stretch[at]), CELL) if number else poses[0])
    apart = np.hypot(*(placed[:, None, :2] - placed[None, :, :2]).transpose(2, 0, 1))
    assert (apart[piece[:, None] != piece] > APART / 2 * CELL).all()


@law
@given(maps())
def test_placing_twice_changes_nothing_more(found):
    poses, joints = found
    placed = placed_pieces(poses, *joints, CELL)
    assert np.abs(placed_pieces(placed, *joints, CELL) - placed).max() < 1e-9


@law
@given(maps(), st.integers(0, 2**32 - 1))
def test_one_closure_brings_two_pieces_to_where_it_claims(found, seed):
    poses, joints = found
    stretch = np.cumsum(joints[0])
    random = np.random.default_rng(seed)
    i, j = (int(random.integers(len(stretch))) for _ in range(2))
    turn = float(random.uniform(-3, 3))
    placed = placed_pieces(poses, joints[0], np.array([i]), np.array([j]), np.array([turn]), CELL)
    if stretch[i] != stretch[j]:
        error = placed[j] - placed[i] - (0.0, 0.0, turn)
        assert np.abs([*error[:2], wrap(error[2])]).max() < 1e-9


def test_a_map_without_beginnings_is_left_as_it_is():
    poses = np.random.default_rng(0).normal(0, 1, (5, 3))
    none = np.zeros(0, int)
    assert placed_pieces(poses, np.zeros(5, bool), none, none, np.zeros(0), CELL) is poses
