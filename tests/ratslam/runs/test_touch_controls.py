"""Whisker images without information, and those of another maze, give no closures or few."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ratslam.runs.settings.packaged import PRESETS
from tactile.base.types import Observation
from tests.ratslam.runs.touch_walks import (
    WIDE,
    accepted_sequences,
    crossing,
    dead_reckoning,
    empty_session,
    follow,
    map_walk,
    shuffled,
    simulate_walk,
    unseen,
)


def blank(readings: list[Observation]) -> list[Observation]:
    return [one._replace(view=np.zeros_like(one.view)) for one in readings]


def numb(readings: list[Observation]) -> list[Observation]:
    return [one._replace(alive=np.zeros_like(one.alive)) for one in readings]


def alike(readings: list[Observation]) -> list[Observation]:
    return [one._replace(view=readings[0].view) for one in readings]


def different(readings: list[Observation]) -> list[Observation]:
    stream = np.random.default_rng(0)
    touching = np.mean([one.view > 0 for one in readings])
    shape = readings[0].view.shape
    return [one._replace(view=stream.random(shape) * (stream.random(shape) < touching)) for one in readings]


@pytest.mark.parametrize("control", [shuffled, blank, unseen, numb, alike, different])
def test_images_without_information_give_no_closures(
    control: Callable[[list[Observation]], list[Observation]],
) -> None:
    for seed in (0, 1):
        walk = simulate_walk(seed)
        found = map_walk(control(walk.readings))
        assert len(found.closures) == 0
        assert found.cuts == []
        assert np.allclose(found.path, dead_reckoning(walk.readings), atol=1e-9)


@pytest.mark.parametrize("seed", [30, 34, 37])
def test_weak_sequences_alone_are_not_accepted(seed: int) -> None:
    """Recall proposes sequences in these sessions that would do beside a strong one."""
    settings, session = PRESETS["touch"]["keyframes"], empty_session()
    found = follow(session, shuffled(simulate_walk(seed).readings))
    log = session.map.solution().log
    assert (log.scores()[log.sizes() >= settings["select_length"]] >= settings["select_score"]).any()
    assert len(found.closures) == 0
    assert accepted_sequences(session) == []


@pytest.mark.soak
def test_later_laps_in_another_maze_give_few_closures() -> None:
    """Small mazes share their outer walls, so the later images are those of another path as well."""
    together, apart = 0, 0
    for seed in range(4):
        walk, other = simulate_walk(seed, maze=WIDE), simulate_walk(seed + 100, maze=WIDE)
        half = len(walk.readings) // 2
        elsewhere = [other.readings[k % len(other.readings)].view for k in range(len(walk.readings))]
        later = [one._replace(view=view) for one, view in zip(walk.readings, elsewhere, strict=True)]
        together += crossing(map_walk(walk.readings), half)
        apart += crossing(map_walk(walk.readings[:half] + later[half:]), half)
    assert together > 500
    assert apart <= 0.1 * together


@pytest.mark.soak
def test_later_circuits_in_another_maze_give_few_closures() -> None:
    """In most mazes: two may have the same walls along the path by chance, the outer ones always."""
    shares = []
    for seed in range(6):
        walk = simulate_walk(seed, maze={}, path={})
        half = len(walk.readings) // 2
        other = simulate_walk(seed, maze={}, path={}, later_maze=0.5)
        joined = [crossing(map_walk(one.readings, 2048), half) for one in (walk, other)]
        shares.append(joined[1] / joined[0])
    assert np.median(shares) <= 0.1
