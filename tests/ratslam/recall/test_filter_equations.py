"""The recall filter equals explicit loops over its equations."""

from __future__ import annotations

import math

import jax
import numpy as np
import pytest

from ratslam.recall.filter import BASIN, FACING, SUPPORT
from tactile.base.se2 import between, compose, wrap
from tests.ratslam.recall.recall_cases import (
    ANGLE,
    CELL,
    FAN,
    FLAT,
    SEEDS,
    errors_by_loops,
    observe,
    random_case,
)


def moved_by_loops(m):
    """The motion since the newest frame without bias and turn error; half of the turn precedes it."""
    turn = float(m.bias * m.length + m.turn_error * m.motion[2])
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
