"""The recall filter equals explicit loops; laws of its posterior, and what views and ids tell it."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.core.session import Session
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from ratslam.network.pose_cells import BASIN
from ratslam.recall import observation_model
from ratslam.recall.filter import FACING, SUPPORT, place_of
from ratslam.recall.observation_model import LABEL_TEMPER, LABELS, SAMPLES, ObservationLikelihood, label_gains
from tactile.base.se2 import compose
from tactile.base.types import Odometry, observation
from tests.ratslam.network.dense_network import Case, driven, predicted
from tests.ratslam.recall import recall_cases as cases
from tests.ratslam.recall.recall_cases import ANGLE, CELL, FAN, FLAT, GUARD, SIZE, filled, observe, spaced

ROUNDING = 1e-5


def moved_by_loops(m):
    """The motion since the newest frame without bias and turn error; half of the turn precedes it."""
    turn = float(m.bias * m.length + m.turn_error * m.motion[2])
    x, y, _ = compose(np.array([0, 0, turn / 2]), m.motion)
    return np.array([x, y, m.motion[2] + turn])


def entry_by_loops(config, cell, m, poses, here):
    """Shares of what enters anew at each view cell: everywhere, and around the map's pose."""
    way, near = m.since + m.length, {}
    sd = config.local_sd * cell + config.local_rate * way
    sd_heading = config.local_heading + config.local_heading_rate * way / cell
    for at, (x, y, heading) in poses.items():
        apart = (x - here[0]) ** 2 + (y - here[1]) ** 2
        deviation = apart / sd**2 + 2 * (1 - math.cos(heading - here[2])) / sd_heading**2
        near[at] = max(1 - deviation / SUPPORT, 0) ** 4
    total, everywhere = max(sum(near.values()), 1), (1 - config.local) / len(poses)
    return {at: everywhere + config.local * near[at] / total for at in poses}


def observe_by_loops(config, cell, memory, belief, view):
    """The whole of an update, view cell by view cell, and the activity thereafter."""
    m = jax.tree.map(np.asarray, memory)
    network, heading = cases.network_of(config, cell, belief.activity.shape), np.arctan2(m.sine, m.cosine)
    errors, moved = cases.errors_by_loops(config, m, view), moved_by_loops(m)
    here = compose(m.pose, moved)

    likelihood = {at: math.exp(-error / (config.sharpness * m.scale)) for at, error in errors.items()}
    mean = sum(likelihood.values()) / len(likelihood)
    novelty = config.common * mean + config.fresh * math.exp(-config.floor / config.sharpness)

    # A view shifted by k was seen by a robot turned by -k sectors against the frame.
    poses = {(k, c): np.array([m.x[c], m.y[c], heading[c] - k * m.angle]) for k, c in errors}
    reach = len(belief.mass) // 2
    every, used = np.zeros((*belief.mass.shape, 3)), np.zeros(belief.mass.shape)
    for (k, c), pose in poses.items():
        every[k + reach, c], used[k + reach, c] = pose, 1
    case = Case(network, belief.activity.shape, belief, every, used, moved)
    prior, lost = predicted(case)
    fresh = 1 - np.asarray(belief.activity, float).sum()
    entry = entry_by_loops(config, cell, m, poses, here)
    mass = {(k, c): prior[k + reach, c] + fresh * config.enter * entry[k, c] for k, c in errors}
    novel = fresh + lost - fresh * config.enter * sum(entry.values())

    total = sum(mass[at] * likelihood[at] for at in errors) + novel * novelty
    mass, every_mass = {at: mass[at] * likelihood[at] / total for at in errors}, np.zeros(used.shape)
    for (k, c), value in mass.items():
        every_mass[k + reach, c] = value

    shift, match = max(mass, key=mass.get)

    def packet_at(row, mass):
        near = {at for at in mass if math.hypot(m.x[at[1]] - m.x[row], m.y[at[1]] - m.y[row]) < BASIN * cell}
        return sum(mass[at] for at in near), {at: mass[at] for at in mass if at not in near}

    packet, others = packet_at(match, mass)
    rows = [sum(value for (_, c), value in others.items() if c == row) for row in range(len(m.x))]
    second = packet_at(int(np.argmax(rows)), others)[0]
    near = (np.hypot(m.x - here[0], m.y - here[1]) < cell) & (np.cos(heading - here[2]) > FACING)
    fits = [likelihood[k, c] for k, c in errors if near[c]]
    found = {"match": match, "shift": shift, "posterior": packet, "second": second}
    found["log_ratio"] = math.log(likelihood[shift, match] / novelty)
    found |= {"novelty": novel * novelty / total, "view_fits": int(max(fits) >= novelty) if fits else -1}
    return found, (every_mass, driven(case, every_mass))


@pytest.mark.parametrize(("config", "angle"), [(FAN, ANGLE), (FAN, -ANGLE), (FLAT, 0.0)])
def test_recall_equals_explicit_loops(config, angle):
    """Of the cases with a fan, some must have shifted matches and both kinds of revisit."""
    results = []
    for seed in cases.SEEDS:
        memory, belief, view = cases.random_case(seed, config, angle)
        expected, (mass, activity) = observe_by_loops(config, CELL, memory, belief, view)
        after, found = observe(config, memory, view, belief)
        got = {name: getattr(found, name).item() for name in expected}
        assert got == pytest.approx(expected, abs=ROUNDING, rel=ROUNDING)
        assert after.mass == pytest.approx(mass, abs=ROUNDING)
        assert after.activity == pytest.approx(activity, abs=ROUNDING)
        results.append(found)
    if config is FAN:
        assert {int(f.shift) != 0 for f in results} == {True, False}
        assert {0, 1} <= {int(f.view_fits) for f in results}
        assert max(float(f.posterior) for f in results) > 0.5 > min(float(f.posterior) for f in results)
        assert max(float(f.second) for f in results) > 0.05


KINDS = st.sampled_from(["known", "random", 0.0, 1.0, 0.5])


@settings(max_examples=40)
@given(st.integers(0, 10_000), KINDS, st.sampled_from([0.0, 1e-9, 0.01, 0.1, 1.0]))
def test_mass_is_conserved(seed, kind, scale):
    """Of a known view, a random one, and those of one value."""
    memory, belief, known = cases.random_case(seed)
    random = np.random.default_rng(seed).random(SIZE)
    view = known if kind == "known" else random if kind == "random" else np.full(SIZE, kind)
    after, found = observe(FAN, memory._replace(scale=jnp.asarray(scale)), view, belief)
    assert (after.activity >= 0).all()
    assert (after.mass >= 0).all()
    assert after.activity.sum() == pytest.approx(after.mass.sum(), abs=ROUNDING)
    assert 0 <= found.posterior <= 1 + ROUNDING
    assert 0 <= found.novelty <= 1
    assert 0 <= found.second <= 1 - found.posterior + ROUNDING
    if scale:
        assert after.activity.sum() + found.novelty == pytest.approx(1, abs=ROUNDING)
        assert found.posterior + found.novelty <= 1 + ROUNDING


@pytest.mark.parametrize("scale", [0.0, 5e-38, 0.1])
@pytest.mark.parametrize("stored", [0.5, None], ids=["halves", "random"])
def test_single_precision_has_no_nan(stored, scale):
    stream = np.random.default_rng(0)
    views = stream.random((40, SIZE)) if stored is None else np.full((40, SIZE), stored)
    memory = filled(FAN, views, spaced(40, 0.5), angle=ANGLE, scale=scale, dtype=np.float32)
    belief = cases.holding(FAN, memory, {3: 0.7, 20: 0.3})
    for value in (0.0, 0.5, 1.0, None, 1.0, 0.0):
        seen = stream.random(SIZE) if value is None else np.full(SIZE, value)
        memory = memory.accumulate_motion(jnp.asarray([0.5 * CELL, 0, 0.01], jnp.float32))
        belief, found = observe(FAN, memory, seen, belief)
        result = found._replace(background=np.zeros(0, np.float32))  # there NaN says none
        leaves = jax.tree.leaves((belief, result))
        assert not any(np.isnan(leaf).any() for leaf in leaves)
        assert {leaf.dtype.name for leaf in (*leaves, found.background)} == {"float32", "int32"}
        assert (belief.activity >= 0).all()
        assert belief.activity.sum() <= 1 + ROUNDING


def fan_world(count, angle, seed=0):
    """A function of absolute bearing for each place, seen by sectors that ascend by `angle`; headings."""
    stream = np.random.default_rng(seed)
    phase, height = stream.uniform(0, 2 * np.pi, (count, 4)), stream.uniform(0.5, 1, (count, 4))

    def seen(place, heading):
        bearing = heading + (np.arange(SIZE) - (SIZE - 1) / 2) * angle
        waves = height[place] * np.sin(np.array([2, 3, 5, 7]) * bearing[:, None] + phase[place])
        return 0.5 + 0.125 * waves.sum(axis=1)

    return seen, stream.uniform(-np.pi, np.pi, count)


@pytest.mark.parametrize("angle", [ANGLE, -ANGLE], ids=["counter-clockwise", "clockwise"])
@pytest.mark.parametrize("turned", range(-3, 4))
def test_a_turned_robot_is_found_with_its_heading(turned, angle):
    seen, heading = fan_world(40, angle)
    poses = spaced(40)
    poses[:, 2] = heading
    memory = filled(FAN, np.stack([seen(p, heading[p]) for p in range(40)]), poses, angle=angle, scale=0.02)
    for place in (0, 11, 34):
        robot = heading[place] + turned * angle
        after, found = observe(FAN, memory, seen(place, robot))
        assert found.match == place
        assert found.shift == -turned  # what was in sector i + turned is in sector i now
        assert np.unravel_index(after.mass.argmax(), after.mass.shape) == (FAN.shifts - turned, place)
        x, y, facing = np.asarray(place_of(memory, jax.tree.map(jnp.asarray, found)))
        assert [x, y, np.cos(facing - robot)] == pytest.approx([*poses[place, :2], 1], abs=1e-9)
        # A shift needs an angle.
        assert observe(FAN, memory._replace(angle=jnp.zeros(())), seen(place, robot))[1].shift == 0


def test_views_have_no_shift_without_an_angle_and_may_have_fewer_values_than_shifts():
    # All likelihoods underflow to zero, so the whole posterior is a tie.
    _, found = observe(FAN, filled(FAN, np.zeros((40, SIZE)), spaced(40), scale=1e-5), np.ones(SIZE))
    assert found.posterior == 0
    assert found.shift == 0
    views = np.random.default_rng(0).random((40, FAN.shifts))
    assert observe(FAN, filled(FAN, views, spaced(40)), views[7])[1].match == 7
    for seed in range(4):
        memory, belief, view = cases.random_case(seed, FAN, 0.0)
        flat = cases.believing(FLAT, memory, belief.mass[FAN.shifts][None], shape=cases.SMALL)
        auto, none = observe(FAN, memory, view, belief)[1], observe(FLAT, memory, view, flat)[1]
        for name in ("match", "shift", "posterior", "log_ratio", "novelty"):
            assert getattr(auto, name) == pytest.approx(getattr(none, name), abs=ROUNDING), name


def test_without_a_scale_nothing_is_recalled_but_all_is_remembered():
    views = np.random.default_rng(0).random((40, SIZE))
    memory = filled(FAN, views, spaced(40), angle=ANGLE, scale=0.0)
    _, found = observe(FAN, memory, views[7])
    nothing = found.match, found.log_ratio, found.posterior, found.novelty, found.view_fits, found.keyframe
    assert nothing == (-1, 0, 0, 1, -1, 40)
    assert observe(FAN, memory._replace(scale=jnp.asarray(0.1)), views[7])[1].match == 7

    memory = memory.accumulate_motion(jnp.asarray([CELL, 0.0, 0.5]))
    memory = memory.store_keyframe(jnp.asarray(views[7]), jnp.int32(5))
    assert int(memory.count) == 41
    assert np.array_equal(memory.view[:, 40], views[7])
    assert (int(memory.label[40]), int(memory.distinct)) == (5, 1)
    placed = [float(row[40]) for row in (memory.x, memory.y, memory.heading, memory.cosine, memory.sine)]
    pose = compose(spaced(40)[-1], np.array([CELL, 0, 0.5]))
    assert placed == pytest.approx([*pose, np.cos(0.5), np.sin(0.5)])
    assert [*memory.motion, memory.length, memory.turn] == [0] * 5
    assert float(memory.since) == pytest.approx(CELL)


def test_the_newest_frames_are_never_recalled():
    stream = np.random.default_rng(0)
    for count in (1, GUARD, GUARD + 1, cases.CAPACITY):
        views = stream.random((count, SIZE))
        memory = filled(FAN, views, spaced(count), angle=ANGLE)
        known = max(count - GUARD, 0)
        for frame in range(max(known - 4, 0), count):
            after, found = observe(FAN, memory, views[frame])
            assert found.match == frame if frame < known else found.match < known
            if frame >= known:
                assert not after.mass[:, known:].any()
                assert found.posterior < 0.1
        assert known or (found.match, found.novelty) == (-1, 1)


BLANK = ObservationLikelihood(
    likelihood=jnp.ones((1, cases.CAPACITY)), novelty=jnp.ones(()), background=jnp.full(SAMPLES, jnp.nan),
    certain=jnp.bool_(True), informative=jnp.bool_(False),
)  # fmt: skip
"""A view that says nothing."""


def test_odometry_alone_is_never_evidence_and_a_view_without_evidence_changes_no_odds():
    # A straight path driven twice: odometry repeats the first drive exactly, without any views.
    memory = filled(FLAT, np.zeros((40, SIZE)), spaced(40, 0.5), scale=0.1)
    look = jax.jit(lambda memory, belief: cases.recalled(FLAT, memory, belief, BLANK))
    # A view that all frames share is no evidence either.
    same = np.full(SIZE, FLAT.floor * 0.1)
    for sure, seeing in ((0.0, False), (0.3, True), (1.0, False)):
        robot = memory._replace(pose=jnp.asarray([0.0, 0.0, 0.0]))
        belief, limit = cases.holding(FLAT, memory, {0: sure}), sure
        for _ in range(12):
            limit = limit * (1 - FLAT.leak) + (1 - limit) * FLAT.enter
            robot = robot.accumulate_motion(jnp.asarray([0.5 * CELL, 0.0, 0.0]))
            belief, _ = observe(FLAT, robot, same, belief) if seeing else look(robot, belief)
            robot = robot._replace(pose=robot.current_pose(), motion=jnp.zeros(3), length=jnp.zeros(()))
            assert float(belief.activity.sum()) <= limit + 1e-5
        # Nor is it evidence against: the mass is still there.
        assert seeing or float(belief.activity.sum()) > 0.5 * limit
    # Every packet keeps what the motion leaves it, and only what enters anew is added.
    memory = filled(FLAT, np.zeros((40, SIZE)), spaced(40), scale=0.1)
    after, found = look(memory, cases.holding(FLAT, memory, {9: 0.5, 20: 0.1}))
    entered = 0.4 * FLAT.enter * (1 - FLAT.local) / (40 - GUARD)
    expected = np.array([0.5, 0.1]) * (1 - FLAT.leak) / (1 + FLAT.miss) + entered
    assert np.asarray(after.mass[0, [9, 20]]) == pytest.approx(expected, rel=1e-4)
    assert float(found.log_ratio) == 0
    assert float(after.mass.sum()) + float(found.novelty) == pytest.approx(1, abs=1e-5)


@jax.jit
def read_label(memory, belief, label):
    weighed = observation_model.label_likelihood(FLAT, memory, label)
    return *cases.recalled(FLAT, memory, belief, weighed), weighed


def seen(memory, label, masses=None):
    """Belief, result and likelihoods after an id."""
    belief = cases.holding(FLAT, memory, masses)
    return jax.tree.map(np.asarray, read_label(memory, belief, jnp.int32(label)))


def test_ids_are_evidence_for_and_against_frames_and_only_known_ones_about_the_maps_pose():
    ids = np.arange(40) // 4
    memory = filled(FLAT, np.zeros((40, 0)), spaced(40), labels=ids)
    known = len(set(ids.tolist()))
    same, other, new = (seen(memory, label, {9: 0.6}) for label in (ids[9], ids[30], 77))
    weighing = same[2]
    assert weighing.likelihood.shape == (1, cases.CAPACITY)
    assert set(np.flatnonzero(weighing.likelihood[0] == weighing.likelihood.max())) == {8, 9, 10, 11}
    assert weighing.likelihood[0, 9] == pytest.approx(LABELS["same"] ** LABEL_TEMPER)
    assert weighing.novelty == pytest.approx((LABELS["new_known"] / known) ** LABEL_TEMPER)
    assert weighing.likelihood[0, 9] > weighing.novelty > weighing.likelihood[0, 30]
    gains = np.log(weighing.likelihood[0, [9, 30]] / weighing.novelty)
    assert label_gains(known) == pytest.approx(gains)
    newest = seen(memory, ids[-1])  # which are never recalled
    assert newest[1].match < 40 - GUARD
    assert not newest[0].mass[:, 40 - GUARD :].any()
    for label in (99, 99, -1, 4, 98):
        memory = memory.store_keyframe(jnp.zeros(0), jnp.int32(label))  # an id is new once
        assert int(memory.distinct) == known + 1 + (label == 98)
    assert new[2].likelihood[0, :40] == pytest.approx(LABELS["unknown"] ** LABEL_TEMPER)
    assert new[2].novelty > new[2].likelihood.max()
    assert np.isnan(weighing.background).all()

    mass = [float(after.mass[0, 9]) for after, *_ in (same, other, new)]
    assert mass[0] > 0.9
    assert max(mass[1:]) < 0.6
    assert (same[1].match, same[1].shift) == (9, 0)
    assert same[1].log_ratio > 0 > new[1].log_ratio
    # The robot is at frame 20, so the map predicts its id.
    memory = filled(FLAT, np.zeros((40, 0)), spaced(40), labels=np.arange(40))
    memory = memory._replace(pose=jnp.asarray(spaced(40)[20]))
    answers = {label: seen(memory, label) for label in (20, 3, 77)}
    assert [bool(weighing.informative) for *_, weighing in answers.values()] == [True, True, False]
    assert [int(found.view_fits) for _, found, _ in answers.values()] == [1, 0, -1]


@pytest.mark.parametrize(
    ("since", "count"),
    [(0.0, GUARD), (4.0, GUARD + 1), (0.0, 20), (4.0, 30), (12.0, cases.CAPACITY), (1000.0, cases.CAPACITY)],
)
def test_background_has_each_ruled_out_frame_once(count, since):
    stream = np.random.default_rng(count)
    views, poses = stream.random((count, SIZE)), spaced(count, 1.0)
    stream.shuffle(poses)
    memory, view = filled(FAN, views, poses, angle=ANGLE, since=since), stream.random(SIZE)
    _, found = observe(FAN, memory, view)
    errors = cases.errors_by_loops(FAN, jax.tree.map(np.asarray, memory), view)
    away = max(3 * CELL, 3 * (0.5 * CELL + 0.05 * since))
    ruled_out = [
        min(errors[k, c] for k in range(-FAN.shifts, FAN.shifts + 1))
        for c in range(count - GUARD)
        if np.hypot(*(poses[c] - poses[-1])[:2]) > away
    ]
    result = found.background[~np.isnan(found.background)]
    assert (found.background.shape, len(result)) == ((SAMPLES,), min(len(ruled_out), SAMPLES))
    at = [int(np.argmin(np.abs(np.array(ruled_out) - error))) for error in result]
    assert result == pytest.approx(np.array(ruled_out)[at] if at else result, abs=1e-12)
    assert at == sorted(set(at))


def test_standing_still_makes_no_frames():
    parts = {"pose_cells": {"cells_xy": 11, "cells_heading": 12}}
    session = Session(RecallBackend(RecallBackendConfig.model_validate(parts), (1, SIZE, 1)))
    views = np.random.default_rng(0).random((16, 1, SIZE, 1))
    still = [observation(Odometry(0, 0, 0, 0.1), view) for view in views]
    frames = sum(int(step.evidence.keyframe) >= 0 for step in session.replay(still * 2))
    assert session.steps == 32
    assert frames == int(session.state.memory.count) == 1
    list(session.replay([observation(Odometry(CELL, 0, 0, 0.1), views[0])]))
    assert int(session.state.memory.count) == 2
