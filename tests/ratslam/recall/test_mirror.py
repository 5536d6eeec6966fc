"""Laws of the control of recall: a path in the mirror is to the control what the path itself is to recall."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.backends.config import RecallBackendConfig
from ratslam.backends.recall import RecallBackend
from ratslam.recall.config import RecallConfig
from ratslam.recall.memory import MapFeedback, init_memory
from ratslam.recall.mirror import (
    MIRROR,
    NEVER_GIVEN,
    Look,
    both_looks,
    mirror_view,
    permuted_label,
)
from tactile.base.se2 import correct_heading
from tactile.base.types import Odometry, observation
from tests.ratslam.recall.recall_cases import random_case

CELL = 0.1
SHAPE = (3, 6, 1)
WIDE_SHAPE = (2, 5, 3)
COUNT = 30
"""Keyframes of one pass."""
BIAS, TURN_ERROR = 0.3, 0.2

# Views in the mirror

shapes = st.sampled_from([(1, 1, 1), (3, 6, 1), (2, 5, 3)])


@settings(max_examples=20)
@given(shapes, st.sampled_from([0.0, 0.2]), st.integers(0, 99))
def test_mirroring_twice_is_the_identity(shape, angle, seed):
    view = np.random.default_rng(seed).random(np.prod(shape))
    once = mirror_view(view, shape, angle)
    assert np.array_equal(mirror_view(once, shape, angle), view)


@settings(max_examples=10)
@given(shapes, st.integers(0, 99))
def test_columns_or_ordered_sectors_are_reversed(shape, seed):
    view = np.random.default_rng(seed).random(shape)
    flat = view.reshape(-1)
    assert np.array_equal(mirror_view(flat, shape, 0.0).reshape(shape), view[:, ::-1])
    assert np.array_equal(mirror_view(flat, shape, 0.1), flat[::-1])
    assert np.array_equal(mirror_view(flat, shape, -0.1), flat[::-1])


# Permuted ids


def remembering(labels):
    """A memory of keyframes with these ids."""
    memory, ids = init_memory(RecallConfig(), 0, 64, np.dtype(float)), np.full(64, -1, np.int32)
    ids[: len(labels)] = labels
    return memory._replace(label=jnp.asarray(ids), count=jnp.int32(len(labels)))


@cache
def permutation():
    return jax.jit(permuted_label)


def permuted(labels, label):
    return int(permutation()(remembering(labels), jnp.int32(label)))


ids = st.lists(st.integers(-1, 40), min_size=1, max_size=64)


@given(ids, st.integers(0, 2**31 - 2))
def test_a_permuted_id_is_another_one_of_the_memory(labels, label):
    other = permuted(labels, label)
    assert other != label
    assert other == NEVER_GIVEN or other in set(labels) - {-1}


@given(ids)
def test_no_id_and_an_only_id_have_no_other(labels):
    assert permuted(labels, -1) == NEVER_GIVEN
    assert permuted([7] * len(labels), 7) == NEVER_GIVEN
    assert permuted([], 7) == NEVER_GIVEN


@given(ids, st.integers(0, 60))
def test_a_permuted_id_stays_until_the_number_of_keyframes_doubles(labels, label):
    known = 1 << (len(labels).bit_length() - 1)
    assert permuted(labels, label) == permuted(labels[:known], label)


def test_most_ids_have_another_one_and_few_share_it():
    labels = list(range(64))
    others = [permuted(labels, label) for label in labels]
    assert np.mean(np.array(others) != NEVER_GIVEN) > 0.9
    assert len(set(others)) > 30


# The two filters in one loop


def test_the_control_looks_for_the_mirror_image_and_nowhere_near_the_map():
    """In the mirror the motion changes sides, and so do its bias and the error of its turns."""
    memory, belief, view = random_case(3)
    memory = memory._replace(label=jnp.arange(64, dtype=jnp.int32), count=jnp.int32(64))
    motion, local = jnp.asarray([0.3, 0.1, -0.2]), jnp.asarray(0.4)
    control = jax.tree.map(lambda value: value / 2, belief)
    own = Look(belief, motion, jnp.asarray(view), jnp.int32(7), local)
    both = jax.tree.map(np.asarray, both_looks(memory, own, control, jnp.asarray(view[::-1])))
    assert both.local.tolist() == [0.4, 0.0]
    assert both.motion == pytest.approx(np.stack([motion, motion * MIRROR]), abs=0)
    assert np.array_equal(both.view, [view, view[::-1]])
    assert both.label.tolist() == [7, int(permutation()(memory, jnp.int32(7)))]
    for found, *pair in zip(both.belief, belief, control, strict=True):
        assert np.array_equal(found, np.stack(pair))
    straight = correct_heading(memory.motion, memory.length, BIAS, TURN_ERROR)
    mirrored = correct_heading(memory.motion * MIRROR, memory.length, -BIAS, TURN_ERROR)
    assert np.asarray(mirrored) == pytest.approx(np.asarray(straight) * MIRROR, abs=1e-12)


# The two filters change places


def backend_of(kind):
    fov = 1.2 if kind == "ordered sectors" else "none"
    recall = {"guard": COUNT - 1, "local": 0.0, "sector_fov": fov}
    cells = {"pose_cells": {"cells_xy": 11, "cell_size": CELL}}
    shape = WIDE_SHAPE if kind == "columns" else SHAPE
    return RecallBackend(RecallBackendConfig.model_validate({**cells, "recall": recall}), shape)


@cache
def engine(kind):
    backend = backend_of(kind)
    # Low optimisation, because compilation dominates.
    return backend, jax.jit(backend.kernel, compiler_options={"xla_backend_optimization_level": 0})


def reflected(kind, view):
    """The image of a view [R, C, K] that this sensor gives in the mirror."""
    return view.reshape(-1)[::-1].reshape(view.shape) if kind == "ordered sectors" else view[:, ::-1]


def second_pass(kind, seed, mirrored):
    """The evidence of every keyframe of a path driven once more, or once more in the mirror."""
    backend, kernel = engine(kind)
    stream = np.random.default_rng(seed)
    shape = backend.view_shape
    views = stream.random((COUNT, *shape))
    moves = stream.normal([0.6 * CELL, 0, 0], [0.1 * CELL, 0.1 * CELL, 0.3], (COUNT, 3))
    moves[:, 0] = np.maximum(moves[:, 0], 0.4 * CELL)  # each step gives a keyframe
    angle = 0.2 if kind == "ordered sectors" else 0.0
    feedback = MapFeedback(np.zeros((1, 3)), BIAS, TURN_ERROR, 0.0, angle, 0.3)
    state = backend.apply_map_feedback(backend.init(jax.random.key(0), 64), feedback)
    found = []
    for k in range(2 * COUNT):
        view, (dx, dy, turn) = views[k % COUNT], moves[k % COUNT]
        if k == COUNT and mirrored:
            memory = state.memory
            state = state._replace(memory=memory._replace(bias=-memory.bias))
        if k >= COUNT:
            view = np.clip(
                view + 0.05 * np.random.default_rng([seed, k]).normal(0, 1, shape) * (view > 0), 0, 1
            )
        if k >= COUNT and mirrored:
            view, dy, turn = reflected(kind, view), -dy, -turn
        state, _, evidence = kernel(state, observation(Odometry(dx, dy, turn, 0.1), view, whiskers=18))
        assert int(evidence.keyframe) == k
        if k >= COUNT:
            found.append(evidence)
    names = ("match", "shift", "posterior", "log_ratio")
    return [
        np.array([[getattr(e, f"{of}{name}") for name in names] for e in found]) for of in ("", "mirror_")
    ]


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.soak)])
@pytest.mark.parametrize(
    "kind",
    ["ordered sectors", pytest.param("columns", marks=pytest.mark.soak)],
)
def test_a_path_in_the_mirror_swaps_recall_and_its_control(kind, seed):
    recalled, control = second_pass(kind, seed, False)
    in_mirror, control_in_mirror = second_pass(kind, seed, True)
    assert control_in_mirror == pytest.approx(recalled, rel=1e-9, abs=1e-9)
    assert in_mirror == pytest.approx(control, rel=1e-9, abs=1e-9)
    # Each recognises the path that it looks for, and the other one does not.
    assert np.mean(recalled[3:, 0] == np.arange(3, COUNT)) > 0.9
    assert recalled[:, 3].sum() > 10
    assert recalled[:, 3].sum() > 2 * control[:, 3].sum()
