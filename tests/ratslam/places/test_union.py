"""Two maps driven by hand as one: each keeps its shape, its calibration and its closures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.optimizer import CalibrationPrior
from ratslam.places.union import Bend, renew_experiences, unite
from tactile.base.se2 import between, correct_heading, wrap
from tests.ratslam.mapping.map_cases import BIAS, CELL, LAP, drive, new_map, sequence

law = settings(derandomize=True, deadline=None, max_examples=40)
CLOSED = sequence(LAP + 2, 2, 12, 4.0)


def made(bias: float = BIAS):
    return drive(new_map(), CLOSED, bias=bias)


def shape(poses: np.ndarray) -> np.ndarray:
    return between(poses[0], poses)


@pytest.fixture(scope="module")
def united():
    return unite(made(), made(-BIAS), new_map())


def test_each_part_keeps_its_shape(united):
    for part, bias in ((slice(LAP + 60), BIAS), (slice(LAP + 60, None), -BIAS)):
        error = shape(united.trajectory()[part]) - shape(made(bias).trajectory())
        error[:, 2] = wrap(error[:, 2])
        assert np.abs(error).max() < 0.1 * CELL  # both parts say something of the calibration


def test_parts_lie_apart_until_something_joins_them(united):
    assert np.array_equal(united.pieces(), np.arange(2 * (LAP + 60)) >= LAP + 60)


def test_closures_stay_with_their_steps(united):
    alone = made().closures()
    assert len(alone)
    assert np.array_equal(united.closures(), np.concatenate([alone, alone + LAP + 60]))


def test_the_odometry_of_either_is_corrected_as_by_its_own_calibration(united):
    graph = united.kept_keyframes()
    for part, bias in ((slice(1, LAP + 60), BIAS), (slice(LAP + 61, None), -BIAS)):
        own = made(bias)
        fit, before = own.solution().fit, own.keyframes()
        assert abs(fit.bias - bias) < abs(bias) / 2  # each has found its own
        expected = correct_heading(before.motion.rows[1:], before.length.rows[1:], fit.bias, fit.turn_error)
        found = graph.correct(graph.motion.rows[part], graph.length.rows[part])
        assert np.abs(found - expected).max() < 1e-12


def test_experiences_are_formed_anew_within_pieces(united):
    renew_experiences(united)
    graph = united.graph()
    keyframe = np.array([data["keyframe"] for _, data in graph.nodes(data=True)])
    later = keyframe >= LAP + 60
    assert 0 < later.sum() < len(later)
    assert not [edge for edge in graph.edges if later[edge[0]] != later[edge[1]]]


@law
@given(st.integers(0, 2**32 - 1))
def test_bent_odometry_is_corrected_to_the_same_motion(seed):
    random = np.random.default_rng(seed)
    motion, length = random.normal(0, 0.3, (20, 3)), random.uniform(0, 1, 20)
    old, new = (CalibrationPrior(*random.normal(0, 0.05, 2), 0.0, 0.0) for _ in range(2))
    old, new = (one._replace(turn_error=float(random.normal(0, 0.05))) for one in (old, new))
    bend = Bend(old, new)
    there = correct_heading(bend.motions(motion, length), length, new.bias, new.turn_error)
    expected = correct_heading(motion, length, old.bias, old.turn_error)
    assert np.abs(there - expected).max() < 1e-12
    back = Bend(new, old).motions(bend.motions(motion, length), length)
    assert np.abs(back - motion).max() < 1e-12
