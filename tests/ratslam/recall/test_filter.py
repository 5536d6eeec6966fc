"""Laws of the recall filter, compared with explicit loops."""

from __future__ import annotations

import math
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.backends.config import RecallBackendConfig
from ratslam.backends.recall import RecallBackend
from ratslam.core.session import Session
from ratslam.recall import observation_model
from ratslam.recall.config import RecallConfig
from ratslam.recall.filter import BASIN, FACING, recognise
from ratslam.recall.memory import (
    MapFeedback,
    accumulate_motion,
    apply_map_feedback,
    current_pose,
    init_memory,
    store_keyframe,
)
from ratslam.recall.observation_model import LABEL_TEMPER, LABELS, SAMPLES, ObservationLikelihood
from ratslam.recall.transition import SUPPORT
from tactile.base.se2 import between, compose, wrap
from tactile.base.types import Odometry, observation

CELL = 0.1
SIZE = 12
CAPACITY = 64
GUARD = 5
SEEDS = range(16)
ANGLE = 0.15
FAN = RecallConfig(sector_fov="auto", guard=GUARD)
FLAT = RecallConfig(sector_fov="none", guard=GUARD)


def filled(
    config,
    views,
    poses,
    *,
    labels=None,
    bias=0.0,
    since=0.0,
    angle=0.0,
    scale=0.1,
    dtype=float,
    capacity=CAPACITY,
):
    """A memory of frames [N, D] at poses [N, 3]; the robot is at the newest, all mass is novelty."""
    count = len(poses)
    store = np.zeros((views.shape[1], capacity))
    store[:, :count] = views.T
    ids = np.full(capacity, -1, np.int32)
    ids[:count] = -1 if labels is None else labels
    memory = init_memory(config, views.shape[1], capacity, np.dtype(dtype))._replace(
        view=jnp.asarray(store, dtype),
        label=jnp.asarray(ids),
        count=jnp.int32(count),
        distinct=jnp.int32(len(set(ids[ids >= 0].tolist()))),
    )
    return apply_map_feedback(memory, MapFeedback(poses, bias, since, angle, scale))


def with_modes(memory, frames, masses, offsets=None):
    """The memory with modes at these frames."""
    modes = len(memory.mass)
    anchor, mass, offset = np.zeros(modes, np.int32), np.zeros(modes), np.zeros((modes, 3))
    anchor[: len(frames)], mass[: len(frames)] = frames, masses
    if offsets is not None:
        offset[: len(frames)] = offsets
    dtype = memory.mass.dtype
    return memory._replace(
        anchor=jnp.asarray(anchor), mass=jnp.asarray(mass, dtype), offset=jnp.asarray(offset, dtype)
    )


@cache
def filter_of(config, cell=CELL):
    return jax.jit(
        lambda memory, view: recognise(
            config, cell, memory, observation_model.view_likelihood(config, cell, memory, view)
        )
    )


@cache
def compile_label_filter(config):
    def read(memory, label):
        weighed = observation_model.label_likelihood(config, memory, label)
        return *recognise(config, CELL, memory, weighed), weighed

    return jax.jit(read)


def observe(config, memory, view, cell=CELL):
    memory, found = filter_of(config, cell)(memory, jnp.asarray(view, memory.x.dtype))
    return jax.tree.map(np.asarray, memory), jax.tree.map(np.asarray, found)


def spaced(count, cells=4.0):
    """Poses in a row so far apart that no frame is near another."""
    return np.stack([np.arange(count) * cells * CELL, np.zeros(count), np.zeros(count)], axis=1)


def random_case(seed, config=FAN, angle=ANGLE, dtype=float):
    """A memory in mid-session, with frames so close that all shares matter, and a half-known view."""
    stream = np.random.default_rng(seed)
    count = int(stream.integers(GUARD + 2, CAPACITY))
    poses = np.cumsum(stream.normal(0, 0.6 * CELL, (count, 3)), axis=0)
    poses[:, 2] = stream.normal(0, 0.5, count)
    views = stream.random((count, SIZE))
    memory = filled(
        config, views, poses, dtype=dtype, angle=angle, bias=float(stream.normal(0, 0.2)),
        since=float(stream.uniform(0, 1)), scale=float(stream.uniform(0.05, 0.3)),
    )  # fmt: skip
    # Not at the newest frame, which is guarded, but near older frames of the map.
    pose = poses[stream.integers(0, count - GUARD)] + stream.normal(0, [CELL, CELL, 0.3])
    memory = memory._replace(pose=jnp.asarray(pose, dtype))
    masses = stream.dirichlet(np.full(config.modes + 1, 0.7))[:-1]
    frames = stream.integers(0, count - GUARD, config.modes)
    memory = with_modes(memory, frames, masses, stream.normal(0, 0.5 * CELL, (config.modes, 3)) * [1, 1, 4])
    memory = accumulate_motion(memory, jnp.asarray(stream.normal(0, [CELL, 0.2 * CELL, 0.1]), dtype))
    memory = accumulate_motion(memory, jnp.asarray(stream.normal(0, [CELL, 0.2 * CELL, 0.1]), dtype))
    near = np.roll(views[frames[int(masses.argmax())]], int(stream.choice([-2, -1, 0, 0, 0, 1, 2])))
    return memory, np.clip(0.6 * near + 0.4 * stream.random(SIZE), 0, 1)


# The loops


def errors_by_loops(config, m, view):
    shifts = [0] if config.sector_fov == "none" else range(-config.shifts, config.shifts + 1)
    errors = {}
    for k in shifts:
        for c in range(int(m.count) - config.guard):
            met = [abs(view[i + k] - m.view[i, c]) for i in range(len(view)) if 0 <= i + k < len(view)]
            errors[k, c] = sum(met) / len(met)
    return errors


def moved_by_loops(m):
    """The motion since the newest frame without its bias; half of the turn precedes it."""
    turn = float(m.bias * m.length)
    x, y, _ = compose(np.array([0, 0, turn / 2]), m.motion)
    return np.array([x, y, m.motion[2] + turn])


def kernel(deviation):
    return (1 - deviation / SUPPORT) ** 4 if deviation < SUPPORT else 0.0


def observe_by_loops(config, cell, memory, view):
    """The whole of `observe`, mode by mode and frame by frame."""
    m = jax.tree.map(np.asarray, memory)
    heading = np.arctan2(m.sine, m.cosine)
    frame = np.stack([m.x, m.y, heading], axis=1)
    old = range(int(m.count) - config.guard)
    errors = errors_by_loops(config, m, view)
    moved = moved_by_loops(m)
    here = compose(m.pose, moved)

    likelihood = {at: math.exp(-error / (config.sharpness * m.scale)) for at, error in errors.items()}
    mean = sum(likelihood.values()) / len(likelihood)
    novelty = config.common * mean + config.fresh * math.exp(-config.floor / config.sharpness)

    def landing(pose, sd, sd_heading):
        fall = {}
        for k, c in errors:
            apart = (pose[0] - m.x[c]) ** 2 + (pose[1] - m.y[c]) ** 2
            # A view shifted by k was seen by a robot turned by -k sectors against the frame.
            turned = pose[2] - heading[c] + k * m.angle
            fall[k, c] = kernel(apart / sd**2 + 2 * (1 - math.cos(turned)) / sd_heading**2)
        return fall

    belief, novel = dict.fromkeys(errors, 0.0), 0.0
    for anchor, offset, mass in zip(m.anchor, m.offset, m.mass, strict=True):
        fall = landing(
            compose(compose(frame[anchor], offset), moved), config.reach * cell, config.reach_heading
        )
        total = sum(fall.values()) + config.miss_weight
        for at in errors:
            belief[at] += mass * (1 - config.mode_decay) * fall[at] / total
        novel += mass * config.mode_decay + mass * (1 - config.mode_decay) * config.miss_weight / total
    fresh = 1 - sum(m.mass)
    way = m.since + m.length
    near = landing(
        here,
        config.local_sd * cell + config.local_rate * way,
        config.local_heading + config.local_heading_rate * way / cell,
    )
    entering = fresh * config.enter
    for at in errors:
        belief[at] += entering * (1 - config.local) / len(errors)
        belief[at] += entering * config.local * near[at] / max(sum(near.values()), 1)
    novel += fresh - entering + entering * config.local * (1 - min(sum(near.values()), 1))

    belief, novel = {at: belief[at] * likelihood[at] for at in errors}, novel * novelty
    total = sum(belief.values()) + novel
    belief, novel = {at: value / total for at, value in belief.items()}, novel / total

    shift, match = max(belief, key=belief.get)
    best = likelihood[shift, match]

    def apart(a, b):
        return math.hypot(m.x[a] - m.x[b], m.y[a] - m.y[b])

    fits = [
        likelihood[k, c]
        for k, c in errors
        if math.hypot(*(frame[c] - here)[:2]) < cell and math.cos(heading[c] - here[2]) > FACING
    ]
    robot = {
        c: sum(value * np.exp(1j * (heading[d] - k * m.angle)) for (k, d), value in belief.items() if d == c)
        for c in old
    }
    rest = {c: sum(value for (_, d), value in belief.items() if d == c) for c in old}
    modes = []
    for _ in range(config.modes):
        top = max(rest, key=rest.get)
        members = [
            c
            for c in old
            if apart(c, top) < cell
            and rest[c] > 0
            and (c == top or (robot[c] * robot[top].conjugate()).real > 0)
        ]
        weights = [rest[c] for c in members]
        if not members:
            modes.append((0, np.zeros(3), 0.0))
            continue
        at = np.average(frame[members, :2], axis=0, weights=weights)
        facing = sum(robot[c] for c in members)
        offset = between(frame[top], np.array([*at, np.angle(facing)]))
        modes.append((top, offset, sum(weights)))
        for c in members:
            rest[c] = 0.0
    shares = [mass for *_, mass in modes] + [1 - sum(mass for *_, mass in modes)]
    return {
        "match": match,
        "shift": shift,
        "posterior": sum(value for (_, c), value in belief.items() if apart(c, match) < BASIN * cell),
        "log_ratio": math.log(best / novelty),
        "novelty": novel,
        "entropy": -sum(share * math.log(share) for share in shares if share > 0),
        "second_mode": np.divide(*sorted(mass for *_, mass in modes)[-2:]),
        "view_fits": int(max(fits) >= novelty) if fits else -1,
    }, modes


@pytest.mark.parametrize(("config", "angle"), [(FAN, ANGLE), (FAN, -ANGLE), (FLAT, 0.0)])
@pytest.mark.parametrize("seed", SEEDS)
def test_recall_equals_explicit_loops(config, angle, seed):
    memory, view = random_case(seed, config, angle)
    expected, modes = observe_by_loops(config, CELL, memory, view)
    after, found = observe(config, memory, view)
    got = {name: getattr(found, name).item() for name in expected}
    assert got == pytest.approx(expected, abs=1e-9)
    for k, (anchor, offset, mass) in enumerate(modes):
        assert after.mass[k] == pytest.approx(mass, abs=1e-9)
        if mass > 1e-9:
            assert after.anchor[k] == anchor
            assert after.offset[k, :2] == pytest.approx(offset[:2], abs=1e-9)
            assert wrap(after.offset[k, 2] - offset[2]) == pytest.approx(0, abs=1e-7)


def test_the_seeds_cover_shifted_matches_and_both_kinds_of_revisit():
    # Without shifted matches and both kinds of revisit the comparison with loops would cover less.
    found = [observe(FAN, *random_case(seed))[1] for seed in SEEDS]
    assert {int(f.shift) != 0 for f in found} == {True, False}
    assert {0, 1} <= {int(f.view_fits) for f in found}
    assert max(float(f.posterior) for f in found) > 0.5 > min(float(f.posterior) for f in found)


# The posterior is a distribution


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10_000),
    kind=st.sampled_from(["known", "random", "zeros", "ones", "half"]),
    scale=st.sampled_from([0.0, 1e-9, 0.01, 0.1, 1.0]),
)
def test_mass_is_conserved(seed, kind, scale):
    memory, view = random_case(seed)
    view = {
        "known": view,
        "random": np.random.default_rng(seed).random(SIZE),
        "zeros": np.zeros(SIZE),
        "ones": np.ones(SIZE),
        "half": np.full(SIZE, 0.5),
    }[kind]
    after, found = observe(FAN, memory._replace(scale=jnp.asarray(scale)), view)
    assert (after.mass >= 0).all()
    assert 0 <= found.posterior <= 1 + 1e-12
    assert 0 <= found.novelty <= 1
    assert 0 <= found.entropy <= math.log(FAN.modes + 1) + 1e-12
    if scale:
        assert after.mass.sum() + found.novelty <= 1 + 1e-12
        assert found.posterior + found.novelty <= 1 + 1e-12


def test_modes_far_fewer_than_frames_lose_no_mass_that_has_a_frame():
    # All frames lie within a cell, so one mode holds them all and the rest is novelty.
    stream = np.random.default_rng(3)
    poses = stream.uniform(-0.3, 0.3, (30, 3)) * [CELL, CELL, 1]
    views = stream.random((30, SIZE))
    after, found = observe(FAN, filled(FAN, views, poses, angle=ANGLE), views[7])
    assert after.mass[0] + found.novelty == pytest.approx(1, abs=1e-12)
    assert not after.mass[1:].any()


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-6, 0.1])
@pytest.mark.parametrize("stored", [0.0, 0.5, 1.0, None], ids=["zeros", "halves", "ones", "random"])
def test_single_precision_has_no_nan(stored, scale):
    stream = np.random.default_rng(0)
    views = stream.random((40, SIZE)) if stored is None else np.full((40, SIZE), stored)
    poses = spaced(40, 0.5)
    memory = filled(FAN, views, poses, angle=ANGLE, scale=scale, dtype=np.float32)
    memory = with_modes(memory, [3, 20], [0.7, 0.3])
    for value in (0.0, 0.5, 1.0, None, 1.0, 0.0):
        seen = stream.random(SIZE) if value is None else np.full(SIZE, value)
        memory = accumulate_motion(memory, jnp.asarray([0.5 * CELL, 0, 0.01], jnp.float32))
        after, found = observe(FAN, memory, seen)
        result = found._replace(background=np.zeros(0))  # there NaN says none
        assert not any(np.isnan(leaf).any() for leaf in [*after, *result])
        assert {leaf.dtype for leaf in [*after, *found]} == {np.dtype(np.float32), np.dtype(np.int32)}
        assert (after.mass >= 0).all()
        assert after.mass.sum() <= 1 + 1e-6
        memory = jax.tree.map(jnp.asarray, after)


def test_the_least_scale_of_single_precision_has_no_nan():
    memory = filled(FAN, np.full((40, SIZE), 0.5), spaced(40), angle=ANGLE, scale=5e-38, dtype=np.float32)
    _, found = observe(FAN, memory, np.full(SIZE, 0.5))
    assert not np.isnan(found.posterior)


def test_novelty_that_enters_completely_gives_no_nan():
    config = FLAT.model_copy(update={"enter": 1.0, "local": 0.0})
    memory = filled(config, np.zeros((40, SIZE)), spaced(40), scale=1e-4)
    assert not np.isnan(observe(config, memory, np.ones(SIZE))[1].novelty)


# Units


@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize("seed", range(4))
def test_units_of_the_sensor_do_not_matter(factor, seed):
    memory, view = random_case(seed)
    after, found = observe(FAN, memory, view)
    scaled = memory._replace(view=memory.view * factor, scale=memory.scale * factor)
    after_scaled, found_scaled = observe(FAN, scaled, view * factor)
    assert np.array_equal(found_scaled.background, found.background * factor, equal_nan=True)
    for name in set(found._fields) - {"background"}:
        assert np.array_equal(getattr(found, name), getattr(found_scaled, name)), name
    for name in ("anchor", "offset", "mass"):
        assert np.array_equal(getattr(after, name), getattr(after_scaled, name)), name


def test_the_size_of_the_world_does_not_matter():
    for seed in range(4):
        memory, view = random_case(seed)
        larger = memory._replace(
            x=memory.x * 2, y=memory.y * 2, pose=memory.pose * jnp.asarray([2.0, 2.0, 1.0]),
            motion=memory.motion * jnp.asarray([2.0, 2.0, 1.0]), length=memory.length * 2,
            since=memory.since * 2, bias=memory.bias / 2,
            offset=memory.offset * jnp.asarray([[2.0, 2.0, 1.0]]),
        )  # fmt: skip
        found, doubled = observe(FAN, memory, view)[1], observe(FAN, larger, view, 2 * CELL)[1]
        for name in found._fields:
            assert np.array_equal(getattr(found, name), getattr(doubled, name), equal_nan=True), name


def test_the_frame_of_the_map_does_not_matter():
    elsewhere = np.array([1.7, -0.9, 2.1])
    for seed in range(4):
        memory, view = random_case(seed)
        frames = np.stack([memory.x, memory.y, np.arctan2(memory.sine, memory.cosine)], axis=1)
        poses = compose(elsewhere, frames[: int(memory.count)])
        result = (float(memory.bias), float(memory.since), float(memory.angle), float(memory.scale))
        moved = apply_map_feedback(memory, MapFeedback(poses, *result))
        moved = moved._replace(pose=jnp.asarray(compose(elsewhere, memory.pose)))
        found, there = observe(FAN, memory, view)[1], observe(FAN, moved, view)[1]
        for name in found._fields:
            same = pytest.approx(getattr(found, name), abs=1e-9, nan_ok=True)
            assert getattr(there, name) == same, name


# Shifts


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
        assert after.anchor[0] == place
        assert after.offset[0, 2] == pytest.approx(robot - heading[place], abs=1e-6)
        assert after.offset[0, 2] == pytest.approx(-found.shift * angle, abs=1e-6)
        assert after.offset[0, :2] == pytest.approx(0, abs=1e-9)


def test_a_turned_mode_moves_along_its_own_heading():
    # A robot turned by two sectors moves on: the frame that it reaches must be the one ahead.
    seen, heading = fan_world(40, ANGLE)
    poses = spaced(40)
    poses[:, 2] = heading
    robot = heading[11] + 2 * ANGLE
    poses[12] = compose(np.array([*poses[11, :2], robot]), np.array([3 * CELL, 0, 0]))
    poses[13] = compose(np.array([*poses[11, :2], robot - 4 * ANGLE]), np.array([3 * CELL, 0, 0]))
    views = np.stack([seen(p, poses[p, 2]) for p in range(40)])
    views[13] = views[12]  # both views are equal
    memory = filled(FAN, views, poses, angle=ANGLE, scale=0.02)
    after, _ = observe(FAN, memory, seen(11, robot))
    memory = accumulate_motion(jax.tree.map(jnp.asarray, after), jnp.asarray([3 * CELL, 0, 0.0]))
    _, found = observe(FAN, memory, views[12])
    assert found.match == 12
    assert found.shift == 0


def test_a_shift_needs_an_angle():
    seen, heading = fan_world(40, ANGLE)
    poses = spaced(40)
    poses[:, 2] = heading
    memory = filled(FAN, np.stack([seen(p, heading[p]) for p in range(40)]), poses, angle=ANGLE, scale=0.2)
    for turned in (-3, -2, -1, 1, 2, 3):
        view = seen(11, heading[11] + turned * ANGLE)
        assert observe(FAN, memory, view)[1].shift == -turned
        assert observe(FAN, memory._replace(angle=jnp.zeros(())), view)[1].shift == 0


def test_views_that_fit_nothing_have_no_shift_without_an_angle():
    # All likelihoods underflow to zero, so the whole posterior is a tie.
    memory = filled(FAN, np.zeros((40, SIZE)), spaced(40), scale=1e-5)
    _, found = observe(FAN, memory, np.ones(SIZE))
    assert found.posterior == 0
    assert found.shift == 0


def test_views_may_have_fewer_values_than_shifts():
    stream = np.random.default_rng(0)
    views = stream.random((40, FAN.shifts))
    memory = filled(FAN, views, spaced(40))
    assert observe(FAN, memory, views[7])[1].match == 7


def test_sectors_of_unknown_order_are_not_shifted():
    for seed in range(4):
        memory, view = random_case(seed, FAN, 0.0)
        auto, none = observe(FAN, memory, view)[1], observe(FLAT, memory, view)[1]
        for name in ("match", "shift", "posterior", "log_ratio", "novelty"):
            assert getattr(auto, name) == pytest.approx(getattr(none, name), abs=1e-9), name


# Recallable frames


def test_without_a_scale_nothing_is_recalled_but_all_is_remembered():
    stream = np.random.default_rng(0)
    views = stream.random((40, SIZE))
    memory = filled(FAN, views, spaced(40), angle=ANGLE, scale=0.0)
    after, found = observe(FAN, memory, views[7])
    assert (found.match, found.log_ratio, found.posterior, found.novelty, found.view_fits) == (
        -1,
        0,
        0,
        1,
        -1,
    )
    assert found.keyframe == 40
    assert observe(FAN, memory._replace(scale=jnp.asarray(0.1)), views[7])[1].match == 7

    memory = accumulate_motion(jax.tree.map(jnp.asarray, after), jnp.asarray([CELL, 0.0, 0.5]))
    memory = store_keyframe(memory, jnp.asarray(views[7]), jnp.int32(5), jnp.asarray([1.0, 2.0, 3.0]))
    assert int(memory.count) == 41
    assert np.array_equal(memory.view[:, 40], views[7])
    assert np.array_equal(memory.packet[40], [1, 2, 3])
    assert (int(memory.label[40]), int(memory.distinct)) == (5, 1)
    pose = [memory.x[40], memory.y[40], np.arctan2(memory.sine[40], memory.cosine[40])]
    assert np.array(pose) == pytest.approx(compose(spaced(40)[-1], np.array([CELL, 0, 0.5])))
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
            assert (after.anchor[after.mass > 0] < count - GUARD).all()
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
    memory = with_modes(filled(FAN, views, spaced(40), angle=ANGLE), [9], [before])

    def at_nine(view):
        after, _ = observe(FAN, memory, view)
        return float(after.mass[after.anchor == 9].sum())

    assert at_nine(views[9]) > 0.95
    assert at_nine(1 - np.round(views[9])) < 0.1 * before  # fits nothing at all
    assert at_nine(views[25]) < 0.1 * before  # fits another frame


def test_odometry_alone_is_never_evidence():
    # A straight path driven twice: odometry repeats the first drive exactly, without any views.
    memory = filled(FLAT, np.zeros((40, SIZE)), spaced(40, 0.5), scale=0.1)
    blank = ObservationLikelihood(
        likelihood=jnp.ones((1, CAPACITY)), novelty=jnp.ones(()), background=jnp.full(SAMPLES, jnp.nan),
        certain=jnp.bool_(True), informative=jnp.bool_(False),
    )  # fmt: skip
    blind = jax.jit(partial(recognise, FLAT, CELL))
    # A view that all frames share is no evidence either.
    same = np.full(SIZE, FLAT.floor * 0.1)
    for sure in (0.0, 0.3, 1.0):
        for seeing in (False, True):
            start = with_modes(memory, [0], [sure])
            start = start._replace(pose=jnp.asarray([0.0, 0.0, 0.0]))
            belief, limit = start, sure
            for _ in range(20):
                limit = limit * (1 - FLAT.mode_decay) + (1 - limit) * FLAT.enter
                belief = accumulate_motion(belief, jnp.asarray([0.5 * CELL, 0.0, 0.0]))
                belief, _ = filter_of(FLAT)(belief, jnp.asarray(same)) if seeing else blind(belief, blank)
                belief = belief._replace(pose=current_pose(belief), motion=jnp.zeros(3), length=jnp.zeros(()))
                assert float(belief.mass.sum()) <= limit + 1e-9
            # Nor is it evidence against: the mass is still there.
            assert seeing or float(belief.mass.sum()) > 0.5 * limit


def test_a_mode_that_reaches_no_frame_becomes_novelty():
    memory = with_modes(filled(FLAT, np.zeros((40, SIZE)), spaced(40, 1.0), scale=0.1), [9], [1.0])
    view = np.full(SIZE, FLAT.floor * 0.1)
    on_way = accumulate_motion(memory, jnp.asarray([CELL, 0.0, 0.0]))
    aside = accumulate_motion(memory, jnp.asarray([0.0, 4 * CELL, 0.0]))
    assert observe(FLAT, on_way, view)[1].novelty < 0.05
    assert observe(FLAT, aside, view)[1].novelty == pytest.approx(1, abs=1e-9)


def test_a_mode_has_the_heading_of_its_frames():
    # A path driven out and back: two frames at one place have opposite headings and equal views.
    stream = np.random.default_rng(0)
    views, poses = stream.random((40, SIZE)), spaced(40)
    views[10], poses[10] = views[9], poses[9] + [0, 0, np.pi]
    after, _ = observe(FLAT, filled(FLAT, views, poses), views[9])
    assert after.anchor[0] in (9, 10)
    assert abs(math.cos(after.offset[0, 2])) == pytest.approx(1, abs=0.1)


# Given ids


def label_likelihood(memory, label):
    return jax.tree.map(np.asarray, compile_label_filter(FLAT)(memory, jnp.int32(label)))


def test_ids_are_evidence_for_and_against_frames():
    ids = np.arange(40) // 4
    memory = with_modes(filled(FLAT, np.zeros((40, 0)), spaced(40), labels=ids), [9], [0.6])
    known = len(set(ids.tolist()))
    same, other, new = (label_likelihood(memory, label) for label in (ids[9], ids[30], 77))

    weighing = same[2]
    assert weighing.likelihood.shape == (1, CAPACITY)
    assert set(np.flatnonzero(weighing.likelihood[0] == weighing.likelihood.max())) == {8, 9, 10, 11}
    assert weighing.likelihood[0, 9] == pytest.approx(LABELS["same"] ** LABEL_TEMPER)
    assert weighing.novelty == pytest.approx((LABELS["new_known"] / known) ** LABEL_TEMPER)
    assert weighing.likelihood[0, 9] > weighing.novelty > weighing.likelihood[0, 30]
    assert new[2].likelihood[0, :40] == pytest.approx(LABELS["unknown"] ** LABEL_TEMPER)
    assert new[2].novelty > new[2].likelihood.max()
    assert np.isnan(weighing.background).all()

    mass = [float(after.mass[after.anchor == 9].sum()) for after, *_ in (same, other, new)]
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
        memory = store_keyframe(memory, jnp.zeros(0), jnp.int32(label), jnp.zeros(3))
        assert int(memory.distinct) == distinct


def test_the_newest_frames_are_not_recalled_by_id():
    ids = np.arange(40)
    memory = filled(FLAT, np.zeros((40, 0)), spaced(40), labels=ids)
    assert label_likelihood(memory, 40 - GUARD - 1)[1].match == 40 - GUARD - 1
    for label in range(40 - GUARD, 40):
        after, found, _ = label_likelihood(memory, label)
        assert found.match < 40 - GUARD
        assert (after.anchor[after.mass > 0] < 40 - GUARD).all()


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
    session = make_session(reserve=10_000)  # one capacity, one compilation
    views = np.random.default_rng(0).random((16, 1, SIZE, 1))
    still = [observation(Odometry(0, 0, 0, 0.1), view) for view in views]
    frames = sum(int(step.evidence.keyframe) >= 0 for _ in range(625) for step in session.replay(still))
    assert session.steps == 10_000
    assert frames == int(session.state.memory.count) == 1
    list(session.replay([observation(Odometry(CELL, 0, 0, 0.1), views[0])]))
    assert int(session.state.memory.count) == 2


def test_a_session_compiles_once_per_capacity():
    session = make_session()
    views = np.random.default_rng(0).random((30, 1, SIZE, 1))
    circle = Odometry(0.05, 0, 2 * np.pi / 30, 0.1)
    list(session.replay(observation(circle, views[k % 30]) for k in range(320)))
    assert int(session.state.memory.count) > 256  # so that it grew with frames in it
    assert session.compilations() == 2
