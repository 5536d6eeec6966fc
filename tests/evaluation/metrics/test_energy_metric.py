"""The Energy Metric over every set of pairs, and against a relations file."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics.energy_metric import (
    Relations,
    energy,
    energy_all_pairs,
    read_relations,
    relation_errors,
)
from evaluation.metrics.trajectory import successive_pairs
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose

law = settings(derandomize=True, deadline=None, max_examples=60)
motions = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-np.pi, np.pi)).map(np.array)


@st.composite
def pairs_of_trajectories(draw):
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    truth = np.cumsum(random.normal(size=(draw(st.integers(2, 25)), 3)), axis=0)
    return truth + random.normal(0, draw(st.sampled_from([0.1, 3.0])), truth.shape), truth


def every_pair(count):
    return np.array(list(combinations(range(count), 2)))


def test_energy_by_hand():
    truth = np.array([[0.0, 0, 0], [1, 0, 0]])
    estimate = np.array([[0.0, 0, 0], [1, 0.5, 0.2]])
    found = energy(estimate, truth, successive_pairs(2))
    assert found == pytest.approx((0.25, 0.04, 1))
    assert found.total == pytest.approx(0.29)


@law
@given(pairs_of_trajectories(), motions, st.integers(1, 4))
def test_a_rigid_motion_of_the_truth_has_no_energy(pair, motion, step):
    truth, _ = pair
    moved = compose(motion, truth)
    assert energy_all_pairs(truth, moved)[:2] == pytest.approx((0, 0), abs=1e-10)
    if len(truth) > step:
        assert energy(truth, moved, successive_pairs(len(truth), step))[:2] == pytest.approx(
            (0, 0), abs=1e-10
        )


@law
@given(pairs_of_trajectories(), motions, motions)
def test_all_pairs_in_closed_form(pair, a, b):
    estimate, truth = pair
    direct = energy(estimate, truth, every_pair(len(truth)))
    assert energy_all_pairs(compose(a, estimate), compose(b, truth)) == pytest.approx(
        direct, rel=1e-9, abs=1e-9
    )


def test_rotation_errors_are_wrapped():
    truth = np.zeros((3, 3))
    estimate = np.array([[0, 0, np.radians(179)], [0, 0, np.radians(-179)], [0, 0, np.radians(1)]])
    expected = np.mean(np.radians([2, 178, 180]) ** 2)
    assert energy(estimate, truth, every_pair(3)).rot2 == pytest.approx(expected)
    assert energy_all_pairs(estimate, truth).rot2 == pytest.approx(expected)


def test_pairs_of_a_gap():
    assert successive_pairs(3).tolist() == [[0, 1], [1, 2]]
    assert successive_pairs(5, 3).tolist() == [[0, 3], [1, 4]]
    assert successive_pairs(2, 3).shape == (0, 2)


def test_no_pairs_have_no_energy():
    pose = np.zeros((1, 3))
    assert np.isnan(energy(pose, pose, successive_pairs(1)).total)
    assert np.isnan(energy_all_pairs(pose, pose).total)


def test_all_pairs_of_a_long_run_need_no_memory():
    random = np.random.default_rng(1)
    truth = np.cumsum(random.normal(size=(14_000, 3)), axis=0)
    found = energy_all_pairs(truth + random.normal(0, 0.01, truth.shape), truth)
    assert found.pairs == 14_000 * 13_999 // 2
    assert found.rot2 == pytest.approx(2e-4, rel=0.05)


def test_relations_are_interpolated_and_those_outside_dropped():
    time = np.array([0.0, 1, 2])
    pose = np.array([[0, 0, np.radians(170)], [1, 0, np.radians(-170)], [2, 0, np.radians(-170)]])
    true = between(np.array([0.5, 0, np.pi]), np.array([1.5, 0, np.radians(-170)]))
    off = true + np.array([0.3, 0.4, np.radians(-6)])
    relations = Relations(np.array([0.5, 0.5, 1.5]), np.array([1.5, 1.5, 2.5]), np.stack([true, off, true]))
    found = relation_errors(time, pose, relations)
    assert found == pytest.approx((0.25, 3.0, 2, 1))
    with pytest.raises(InputError, match="none inside the recording"):
        relation_errors(time + 100, pose, relations)


@pytest.mark.parametrize("head", ["", "t1,t2,x,y,z,roll,pitch,yaw\n"])
def test_relations_file_with_and_without_a_header(tmp_path, head):
    path = tmp_path / "relations"
    row = "1.5 2.5 0.1 0.2 0 0 0 -1.5\n"
    path.write_text(head + (row.replace(" ", ",") if head else row) + "3 4 5")
    found = read_relations(path)
    assert (found.start.tolist(), found.end.tolist()) == ([1.5], [2.5])
    assert found.motion.tolist() == [[0.1, 0.2, -1.5]]
