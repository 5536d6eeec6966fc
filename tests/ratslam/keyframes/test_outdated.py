"""Outdated keyframes are marked by number."""

from __future__ import annotations

import numpy as np

from ratslam.keyframes.outdated import OutdatedKeyframes


def test_marks_add_up_and_later_keyframes_are_not_outdated() -> None:
    outdated = OutdatedKeyframes()
    outdated.mark(np.array([1, 4]))
    outdated.mark(np.array([2]))
    outdated.mark(np.zeros(0, int))
    assert np.flatnonzero(outdated.flags(8)).tolist() == [1, 2, 4]
    assert np.flatnonzero(outdated.flags(3)).tolist() == [1, 2]


def test_a_checkpoint_restores_the_marks_and_has_none_without_them() -> None:
    outdated, other = OutdatedKeyframes(), OutdatedKeyframes()
    assert outdated.arrays() == {}
    outdated.mark(np.array([3]))
    other.mark(np.array([0]))
    other.restore(outdated.arrays())
    assert np.flatnonzero(other.flags(9)).tolist() == [3]
    other.restore({})
    assert not other.flags(9).any()


def test_a_part_of_the_keyframes_keeps_its_marks() -> None:
    outdated = OutdatedKeyframes()
    outdated.mark(np.array([1, 4]))
    outdated.take(np.array([0, 4, 7]))
    assert outdated.flags(3).tolist() == [False, True, False]
