"""Evidence of views and ids in the recall filter, and the filter in a session."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.core.session import Session
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from ratslam.recall.filter import place_of, recognise
from ratslam.recall.observation_model import LABEL_TEMPER, LABELS, SAMPLES, ObservationLikelihood, label_gains
from tactile.base.se2 import compose
from tactile.base.types import Odometry, observation
from tests.ratslam.recall.recall_cases import (
    ANGLE,
    CAPACITY,
    CELL,
    FAN,
    FLAT,
    GUARD,
    SIZE,
    compile_label_filter,
    errors_by_loops,
    filled,
    holding,
    network_of,
    observe,
    spaced,
)

# Recallable frames


def test_without_a_scale_nothing_is_recalled_but_all_is_remembered():
    stream = np.random.default_rng(0)
    views = stream.random((40, SIZE))
    memory = filled(FAN, views, spaced(40), angle=ANGLE, scale=0.0)
    _, found = observe(FAN, memory, views[7])
    assert (found.match, found.log_ratio, found.posterior, found.novelty, found.view_fits) == (
        -1,
        0,
        0,
        1,
        -1,
    )
    assert found.keyframe == 40
    assert observe(FAN, memory._replace(scale=jnp.asarray(0.1)), views[7])[1].match == 7

    memory = memory.accumulate_motion(jnp.asarray([CELL, 0.0, 0.5]))
    memory = memory.store_keyframe(jnp.asarray(views[7]), jnp.int32(5))
    assert int(memory.count) == 41
    assert np.array_equal(memory.view[:, 40], views[7])
    assert (int(memory.label[40]), int(memory.distinct)) == (5, 1)
    pose = np.array([memory.x[40], memory.y[40], memory.heading[40]])
    assert pose == pytest.approx(compose(spaced(40)[-1], np.array([CELL, 0, 0.5])))
    assert [memory.cosine[40], memory.sine[40]] == pytest.approx([np.cos(0.5), np.sin(0.5)])
    assert np.array_equal(memory.motion, np.zeros(3))
    assert (float(memory.length), float(memory.turn)) == (0, 0)
    assert float(memory.since) == pytest.approx(CELL)


def test_the_newest_frames_are_never_recalled():
    stream = np.random.default_rng(0)
    for count in (1, GUARD, GUARD + 1, 30, CAPACITY):
        views = stream.random((count, SIZE))
        memory = filled(FAN, views, spaced(count), angle=ANGLE)
        for frame in range(count):
            after, found = observe(FAN, memory, views[frame])
            if frame < count - GUARD:
                assert found.match == frame
                continue
            assert found.match < max(count - GUARD, 0)
            assert not after.mass[:, max(count - GUARD, 0) :].any()
            assert found.posterior < 0.1
        if count <= GUARD:
            assert found.match == -1
            assert found.novelty == 1


# Evidence


def test_a_view_of_more_frames_carries_less_evidence():
    stream = np.random.default_rng(0)
    old = 50
    views, common = stream.random((old + GUARD, SIZE)), stream.random(SIZE)
    gains = []
    for share in (1, 5, 25, old):
        views[:share] = common
        memory = filled(FLAT, views, spaced(old + GUARD), scale=0.05)
        gains.append(float(observe(FLAT, memory, common)[1].log_ratio))
    assert gains == sorted(gains, reverse=True)
    assert gains[0] > 3.5
    assert gains[-1] <= 0  # a view that all frames share is evidence for none of them


def test_a_view_shared_by_all_frames_counts_against_them_as_it_differs():
    views = np.zeros((40, SIZE))
    memory = filled(FLAT, views, spaced(40), scale=0.1)
    gains = [
        float(observe(FLAT, memory, np.full(SIZE, e * 0.1))[1].log_ratio) for e in (1.0, FLAT.floor, 2.0, 4.0)
    ]
    assert 0 > gains[0] > gains[1] > gains[2] > gains[3]


def test_a_contradicting_view_removes_mass():
    stream = np.random.default_rng(0)
    views = stream.random((40, SIZE))
    before = 0.6
    memory = filled(FAN, views, spaced(40), angle=ANGLE)

    def at_nine(view):
        after, _ = observe(FAN, memory, view, holding(FAN, memory, {9: before}))
        return float(after.mass[:, 9].sum())

    assert at_nine(views[9]) > 0.95
    assert at_nine(1 - np.round(views[9])) < 0.1 * before  # fits nothing at all
    assert at_nine(views[25]) < 0.1 * before  # fits another frame


BLANK = ObservationLikelihood(
    likelihood=jnp.ones((1, CAPACITY)), novelty=jnp.ones(()), background=jnp.full(SAMPLES, jnp.nan),
    certain=jnp.bool_(True), informative=jnp.bool_(False),
)  # fmt: skip
"""A view that says nothing."""


def blind(memory, belief):
    network = network_of(FLAT)
    return recognise(FLAT, network, memory, belief, memory.corrected_motion(), BLANK, FLAT.local)


def test_odometry_alone_is_never_evidence():
    # A straight path driven twice: odometry repeats the first drive exactly, without any views.
    memory = filled(FLAT, np.zeros((40, SIZE)), spaced(40, 0.5), scale=0.1)
    look = jax.jit(blind)
    # A view that all frames share is no evidence either.
    same = np.full(SIZE, FLAT.floor * 0.1)
    for sure in (0.0, 0.3, 1.0):
        for seeing in (False, True):
            robot = memory._replace(pose=jnp.asarray([0.0, 0.0, 0.0]))
            belief, limit = holding(FLAT, memory, {0: sure}), sure
            for _ in range(20):
                limit = limit * (1 - FLAT.leak) + (1 - limit) * FLAT.enter
                robot = robot.accumulate_motion(jnp.asarray([0.5 * CELL, 0.0, 0.0]))
                belief, _ = observe(FLAT, robot, same, belief) if seeing else look(robot, belief)
                robot = robot._replace(pose=robot.current_pose(), motion=jnp.zeros(3), length=jnp.zeros(()))
                assert float(belief.activity.sum()) <= limit + 1e-5
            # Nor is it evidence against: the mass is still there.
            assert seeing or float(belief.activity.sum()) > 0.5 * limit


def test_a_view_without_evidence_changes_no_odds():
    """Every packet keeps what the motion leaves it, and only what enters anew is added."""
    memory = filled(FLAT, np.zeros((40, SIZE)), spaced(40), scale=0.1)
    after, found = jax.jit(blind)(memory, holding(FLAT, memory, {9: 0.5, 20: 0.1}))
    entered = 0.4 * FLAT.enter * (1 - FLAT.local) / (40 - GUARD)
    expected = np.array([0.5, 0.1]) * (1 - FLAT.leak) / (1 + FLAT.miss) + entered
    assert np.asarray(after.mass[0, [9, 20]]) == pytest.approx(expected, rel=1e-4)
    assert float(found.log_ratio) == 0
    assert float(after.mass.sum()) + float(found.novelty) == pytest.approx(1, abs=1e-5)


def test_a_packet_that_reaches_no_frame_becomes_novelty():
    memory = filled(FLAT, np.zeros((40, SIZE)), spaced(40, 1.0), scale=0.1)
    belief = holding(FLAT, memory, {9: 1.0})
    view = np.full(SIZE, FLAT.floor * 0.1)
    on_way = memory.accumulate_motion(jnp.asarray([CELL, 0.0, 0.0]))
    aside = memory.accumulate_motion(jnp.asarray([0.0, 4 * CELL, 0.0]))
    assert observe(FLAT, on_way, view, belief)[1].novelty < 0.05
    assert observe(FLAT, aside, view, belief)[1].novelty == pytest.approx(1, abs=1e-6)


def test_a_path_driven_out_and_back_is_followed_in_the_heading_of_the_robot():
    """Two paths lie at the same places with opposite headings and equal views: motion tells them apart."""
    views = np.repeat(np.random.default_rng(0).random((20, SIZE)), 2, axis=0)
    poses = np.repeat(spaced(20, 2.0), 2, axis=0)
    poses[1::2, 2] = np.pi
    memory = filled(FLAT, views, poses)
    for begin, step in ((10, 2), (21, -2)):
        belief, robot = holding(FLAT, memory, {begin: 0.5}), memory
        robot = robot.accumulate_motion(jnp.asarray([2 * CELL, 0.0, 0.0]))
        after, found = observe(FLAT, robot, views[begin + step], belief)
        assert found.match == begin + step
        assert after.mass[0, begin + step] > 0.9
        heading = place_of(memory, jax.tree.map(jnp.asarray, found))[2]
        assert np.cos(float(heading) - poses[begin, 2]) == pytest.approx(1)


# Given ids


def label_likelihood(memory, label, masses=None):
    read = compile_label_filter(FLAT)
    return jax.tree.map(np.asarray, read(memory, holding(FLAT, memory, masses), jnp.int32(label)))


def test_ids_are_evidence_for_and_against_frames():
    ids = np.arange(40) // 4
    memory = filled(FLAT, np.zeros((40, 0)), spaced(40), labels=ids)
    known = len(set(ids.tolist()))
    same, other, new = (label_likelihood(memory, label, {9: 0.6}) for label in (ids[9], ids[30], 77))

    weighing = same[2]
    assert weighing.likelihood.shape == (1, CAPACITY)
    assert set(np.flatnonzero(weighing.likelihood[0] == weighing.likelihood.max())) == {8, 9, 10, 11}
    assert weighing.likelihood[0, 9] == pytest.approx(LABELS["same"] ** LABEL_TEMPER)
    assert weighing.novelty == pytest.approx((LABELS["new_known"] / known) ** LABEL_TEMPER)
    assert weighing.likelihood[0, 9] > weighing.novelty > weighing.likelihood[0, 30]
    gains = np.log(weighing.likelihood[0, [9, 30]] / weighing.novelty)
    assert label_gains(known) == pytest.approx(gains)
    assert new[2].likelihood[0, :40] == pytest.approx(LABELS["unknown"] ** LABEL_TEMPER)
    assert new[2].novelty > new[2].likelihood.max()
    assert np.isnan(weighing.background).all()

    mass = [float(after.mass[0, 9]) for after, *_ in (same, other, new)]
    assert mass[0] > 0.9
    assert max(mass[1:]) < 0.6
    assert (same[1].match, same[1].shift) == (9, 0)
    assert same[1].log_ratio > 0 > new[1].log_ratio


def test_only_a_known_id_is_evidence_about_the_maps_pose():
    # The robot is at frame 20, so the map predicts its id.
    ids = np.arange(40)
    memory = filled(FLAT, np.zeros((40, 0)), spaced(40), labels=ids)
    memory = memory._replace(pose=jnp.asarray(spaced(40)[20]))
    answers = {label: label_likelihood(memory, label) for label in (20, 3, 77)}
    assert [bool(weighing.informative) for *_, weighing in answers.values()] == [True, True, False]
    assert [int(found.view_fits) for _, found, _ in answers.values()] == [1, 0, -1]


def test_an_id_is_new_once():
    memory = filled(FLAT, np.zeros((2, 0)), spaced(2), labels=[4, 4])
    given_then = [(9, 2), (9, 2), (-1, 2), (4, 2), (0, 3)]
    for label, distinct in given_then:
        memory = memory.store_keyframe(jnp.zeros(0), jnp.int32(label))
        assert int(memory.distinct) == distinct


def test_the_newest_frames_are_not_recalled_by_id():
    ids = np.arange(40)
    memory = filled(FLAT, np.zeros((40, 0)), spaced(40), labels=ids)
    assert label_likelihood(memory, 40 - GUARD - 1)[1].match == 40 - GUARD - 1
    for label in range(40 - GUARD, 40):
        after, found, _ = label_likelihood(memory, label)
        assert found.match < 40 - GUARD
        assert not after.mass[:, 40 - GUARD :].any()


# Calibration


@pytest.mark.parametrize("since", [0.0, 4.0, 12.0, 1000.0])
@pytest.mark.parametrize("count", [GUARD, GUARD + 1, 20, 30, CAPACITY])
def test_background_has_each_ruled_out_frame_once(count, since):
    stream = np.random.default_rng(count)
    views, poses = stream.random((count, SIZE)), spaced(count, 1.0)
    stream.shuffle(poses)
    memory = filled(FAN, views, poses, angle=ANGLE, since=since)
    view = stream.random(SIZE)
    _, found = observe(FAN, memory, view)
    errors = errors_by_loops(FAN, jax.tree.map(np.asarray, memory), view)
    away = max(3 * CELL, 3 * (0.5 * CELL + 0.05 * since))
    ruled_out = [
        min(errors[k, c] for k in range(-FAN.shifts, FAN.shifts + 1))
        for c in range(count - GUARD)
        if np.hypot(*(poses[c] - poses[-1])[:2]) > away
    ]
    result = found.background[np.isfinite(found.background)]
    assert found.background.shape == (SAMPLES,)
    assert np.isnan(found.background).sum() == SAMPLES - len(result)
    assert len(result) == min(len(ruled_out), SAMPLES)
    at = [int(np.argmin(np.abs(np.array(ruled_out) - error))) for error in result]
    assert result == pytest.approx(np.array(ruled_out)[at] if at else result, abs=1e-12)
    assert at == sorted(set(at))


# In the session


def make_session(**settings):
    parts = {"pose_cells": {"cells_xy": 11, "cells_heading": 12}}
    return Session(RecallBackend(RecallBackendConfig.model_validate(parts), (1, SIZE, 1)), **settings)


def test_standing_still_makes_no_frames():
    session = make_session()
    views = np.random.default_rng(0).random((16, 1, SIZE, 1))
    still = [observation(Odometry(0, 0, 0, 0.1), view) for view in views]
    frames = sum(int(step.evidence.keyframe) >= 0 for _ in range(125) for step in session.replay(still))
    assert session.steps == 2_000
    assert frames == int(session.state.memory.count) == 1
    list(session.replay([observation(Odometry(CELL, 0, 0, 0.1), views[0])]))
    assert int(session.state.memory.count) == 2


@pytest.mark.soak
def test_a_session_compiles_once_per_capacity():
    session = make_session()
    views = np.random.default_rng(0).random((30, 1, SIZE, 1))
    circle = Odometry(0.05, 0, 2 * np.pi / 30, 0.1)
    list(session.replay(observation(circle, views[k % 30]) for k in range(320)))
    assert int(session.state.memory.count) > 256  # so that it grew with frames in it
    assert session.compilations() == 2
