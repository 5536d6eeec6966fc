"""The rule by which sequences join two pieces."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.keyframes.piece_ties import EVIDENCE, FACING, MARGIN, NEAR, TieClaim, ties_of_pieces

CELL = 0.2
POSE = np.array([30.0, -4.0, 1.0])


def claim(sequence, evidence, motion=(0.0, 0.0, 0.0)):
    return TieClaim(sequence, evidence, POSE, np.array(motion, float))


def test_nothing_joins_pieces_without_claims():
    assert ties_of_pieces([], CELL) == []


@pytest.mark.parametrize(("evidence", "ties"), [(EVIDENCE - 0.1, []), (EVIDENCE, [7])])
def test_a_sequence_needs_its_evidence(evidence, ties):
    assert ties_of_pieces([claim(7, evidence)], CELL) == ties


@pytest.mark.parametrize("motion", [(2 * NEAR * CELL, 0.0, 0.0), (0.0, 0.0, 2 * FACING)])
@pytest.mark.parametrize(("margin", "ties"), [(MARGIN - 0.1, []), (MARGIN, [7])])
def test_a_sequence_that_contradicts_holds_the_pieces_apart(motion, margin, ties):
    best, other = claim(7, 50.0), claim(3, 50.0 - margin, motion)
    assert ties_of_pieces([other, best], CELL) == ties


def test_a_sequence_that_agrees_does_not():
    assert ties_of_pieces([claim(3, 49.0, (0.1, 0.0, 0.001)), claim(7, 50.0)], CELL) == [7]
