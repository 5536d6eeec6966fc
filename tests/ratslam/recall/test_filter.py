"""Laws of the recall filter: its posterior, units and shifts."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.recall.filter import place_of
from ratslam.recall.memory import MapFeedback
from tactile.base.se2 import compose
from tests.ratslam.recall.recall_cases import (
    ANGLE,
    CELL,
    FAN,
    FLAT,
    SIZE,
    SMALL,
    believing,
    filled,
    holding,
    observe,
    random_case,
    spaced,
)

ROUNDING = 1e-5

# The posterior is a distribution


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10_000),
    kind=st.sampled_from(["known", "random", "zeros", "ones", "half"]),
    scale=st.sampled_from([0.0, 1e-9, 0.01, 0.1, 1.0]),
)
def test_mass_is_conserved(seed, kind, scale):
    memory, belief, view = random_case(seed)
    view = {
        "known": view,
        "random": np.random.default_rng(seed).random(SIZE),
        "zeros": np.zeros(SIZE),
        "ones": np.ones(SIZE),
        "half": np.full(SIZE, 0.5),
    }[kind]
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


def test_a_packet_and_novelty_are_all_where_all_frames_lie_within_a_cell():
    stream = np.random.default_rng(3)
    poses = stream.uniform(-0.3, 0.3, (30, 3)) * [CELL, CELL, 1]
    views = stream.random((30, SIZE))
    _, found = observe(FAN, filled(FAN, views, poses, angle=ANGLE), views[7])
    assert found.posterior + found.novelty == pytest.approx(1, abs=ROUNDING)
    assert found.second == pytest.approx(0, abs=ROUNDING)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-6, 0.1])
@pytest.mark.parametrize("stored", [0.0, 0.5, 1.0, None], ids=["zeros", "halves", "ones", "random"])
def test_single_precision_has_no_nan(stored, scale):
    stream = np.random.default_rng(0)
    views = stream.random((40, SIZE)) if stored is None else np.full((40, SIZE), stored)
    memory = filled(FAN, views, spaced(40, 0.5), angle=ANGLE, scale=scale, dtype=np.float32)
    belief = holding(FAN, memory, {3: 0.7, 20: 0.3})
    for value in (0.0, 0.5, 1.0, None, 1.0, 0.0):
        seen = stream.random(SIZE) if value is None else np.full(SIZE, value)
        memory = memory.accumulate_motion(jnp.asarray([0.5 * CELL, 0, 0.01], jnp.float32))
        belief, found = observe(FAN, memory, seen, belief)
        result = found._replace(background=np.zeros(0))  # there NaN says none
        assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves((belief, result)))
        assert {leaf.dtype for leaf in jax.tree.leaves((belief, found))} == {
            np.dtype(np.float32),
            np.dtype(np.int32),
        }
        assert (belief.activity >= 0).all()
        assert belief.activity.sum() <= 1 + ROUNDING


def test_the_least_scale_of_single_precision_has_no_nan():
    memory = filled(FAN, np.full((40, SIZE), 0.5), spaced(40), angle=ANGLE, scale=5e-38, dtype=np.float32)
    _, found = observe(FAN, memory, np.full(SIZE, 0.5))
    assert not np.isnan(found.posterior)


def test_novelty_that_enters_completely_gives_no_nan():
    config = FLAT.model_copy(update={"enter": 1.0, "local": 0.0})
    memory = filled(config, np.zeros((40, SIZE)), spaced(40), scale=1e-4)
    assert not np.isnan(observe(config, memory, np.ones(SIZE))[1].novelty)


# Units


def same_results(one, other):
    for name in one._fields:
        assert np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True), name


@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize("seed", range(4))
def test_units_of_the_sensor_do_not_matter(factor, seed):
    memory, belief, view = random_case(seed)
    after, found = observe(FAN, memory, view, belief)
    scaled = memory._replace(view=memory.view * factor, scale=memory.scale * factor)
    after_scaled, found_scaled = observe(FAN, scaled, view * factor, belief)
    same_results(found._replace(background=found.background * factor), found_scaled)
    same_results(after, after_scaled)


def test_the_size_of_the_world_does_not_matter():
    for seed in range(4):
        memory, belief, view = random_case(seed)
        larger = memory._replace(
            x=memory.x * 2, y=memory.y * 2, pose=memory.pose * jnp.asarray([2.0, 2.0, 1.0]),
            motion=memory.motion * jnp.asarray([2.0, 2.0, 1.0]), length=memory.length * 2,
            since=memory.since * 2, bias=memory.bias / 2,
        )  # fmt: skip
        after, found = observe(FAN, memory, view, belief)
        after_doubled, doubled = observe(FAN, larger, view, belief, 2 * CELL)
        same_results(found, doubled)
        same_results(after, after_doubled)


def test_the_frame_of_the_map_does_not_matter():
    """The network comes to itself by whole cells and quarter turns."""
    elsewhere = np.array([17 * CELL, -9 * CELL, -np.pi / 2])
    for seed in range(4):
        memory, belief, view = random_case(seed)
        frames = np.stack([memory.x, memory.y, memory.heading], axis=1)
        poses = compose(elsewhere, frames[: int(memory.count)])
        names = ("bias", "turn_error", "since", "angle", "scale")
        result = MapFeedback(poses, *(float(getattr(memory, name)) for name in names))
        moved = memory.apply_map_feedback(result)
        moved = moved._replace(pose=jnp.asarray(compose(elsewhere, memory.pose)))
        held = believing(FAN, moved, belief.mass, shape=SMALL)
        found, there = observe(FAN, memory, view, belief)[1], observe(FAN, moved, view, held)[1]
        for name in found._fields:
            same = pytest.approx(getattr(found, name), abs=ROUNDING, nan_ok=True)
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
        assert np.unravel_index(after.mass.argmax(), after.mass.shape) == (FAN.shifts - turned, place)
        pose = np.asarray(place_of(memory, jax.tree.map(jnp.asarray, found)))
        assert pose[:2] == pytest.approx(poses[place, :2])
        assert np.cos(pose[2] - robot) == pytest.approx(1, abs=1e-9)


def test_the_packet_of_a_turned_robot_moves_along_its_own_heading():
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
    belief, _ = observe(FAN, memory, seen(11, robot))
    memory = memory.accumulate_motion(jnp.asarray([3 * CELL, 0, 0.0]))
    _, found = observe(FAN, memory, views[12], belief)
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
        memory, belief, view = random_case(seed, FAN, 0.0)
        flat = believing(FLAT, memory, belief.mass[FAN.shifts][None], shape=SMALL)
        auto, none = observe(FAN, memory, view, belief)[1], observe(FLAT, memory, view, flat)[1]
        for name in ("match", "shift", "posterior", "log_ratio", "novelty"):
            assert getattr(auto, name) == pytest.approx(getattr(none, name), abs=ROUNDING), name
