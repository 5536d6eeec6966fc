"""Touch sessions whose keyframes are merged, and restored by the selection on the unmerged ones."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from ratslam.core.session import CHUNK, Session, Step
from ratslam.mapping import archive
from ratslam.recall.memory import MapFeedback, MergedRows
from tests.ratslam.runs.touch_walks import (
    Walk,
    dead_reckoning,
    empty_merging_session,
    metric,
    simulate_walk,
)

NEVER, BEGUN = 10**6, 300
"""Keyframes at the selection on the unmerged keyframes; it is taken up an eighth later."""


@cache
def walk_of(seed: int) -> Walk:
    return simulate_walk(seed, path={"circuits": "CCCCCC"})


@pytest.fixture(params=[NEVER, BEGUN], ids=["merged", "restored"])
def first(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    if request.param == BEGUN:
        monkeypatch.setattr(archive, "FIRST", BEGUN // 2)
    return int(request.param)


def bits(session: Session, steps: list[Step]) -> list[np.ndarray]:
    """All results of steps and the whole state after them."""
    arrays = session.arrays()
    return [np.asarray(leaf) for leaf in jax.tree.leaves(steps)] + [arrays[name] for name in sorted(arrays)]


def same(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    equal = [np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in zip(one, other, strict=True)]
    return all(equal)


class Replay(NamedTuple):
    """A replayed session: all of its bits, and its trajectory."""

    bits: list[np.ndarray]
    path: np.ndarray


@cache
def replayed(seed: int, first: int) -> Replay:
    del first  # its settings are in force
    session = empty_merging_session(1)
    steps = list(session.replay(walk_of(seed).readings))
    return Replay(bits(session, steps), session.map.map_trajectory())


def test_live_gives_the_bits_of_the_replay(first: int) -> None:
    session = empty_merging_session(1)
    steps = [session.step(reading) for reading in walk_of(0).readings]
    assert len(session.map.feedback().poses) < 0.7 * len(session.map.keyframe_steps())
    assert same(bits(session, steps), replayed(0, first).bits)
    assert session.compilations() == 1


# Between two chunks, and in mid-chunk while the selection on the unmerged keyframes is in progress.
@pytest.mark.parametrize("at", [pytest.param(14 * CHUNK, marks=pytest.mark.soak), 325])
def test_a_checkpoint_continues_to_the_same_bits(at: int, first: int) -> None:
    walk, session = walk_of(0), empty_merging_session(1)
    before = list(session.replay(walk.readings[:at]))
    assert len(session.map.feedback().poses) < len(session.map.keyframe_steps())
    arrays = session.arrays()
    restored = empty_merging_session(1)
    restored.restore(arrays)
    after = list(restored.replay(walk.readings[at:]))
    assert same(bits(restored, before + after), replayed(0, first).bits)
    assert restored.compilations() == 1


def test_the_kernel_has_the_rows_of_the_map(first: int, monkeypatch: pytest.MonkeyPatch) -> None:
    session, counts, restored = empty_merging_session(1), [], []
    real, real_merge = session.backend.apply_map_feedback, session.backend.merge_rows

    def apply(state: Any, feedback: MapFeedback) -> Any:
        state = real(state, feedback)
        memory, poses, count = state.memory, feedback.poses, len(feedback.poses)
        assert session.backend.rows(state) == count
        for values, expected in (
            (memory.x, poses[:, 0]),
            (memory.y, poses[:, 1]),
            (memory.cosine, np.cos(poses[:, 2])),
            (memory.sine, np.sin(poses[:, 2])),
        ):
            assert np.array_equal(values[:count], expected)
            assert not np.asarray(values[count:]).any()
        views, _ = session.map.appearance.stored(session.map.kept_keyframes().taken.rows)
        assert np.array_equal(np.asarray(memory.view)[:, :count], views.T)
        activity, mass = (np.asarray(values) for values in state.belief)
        assert not mass[:, count:].any()
        assert mass.sum() < 1 + 1e-6
        assert activity.sum() == pytest.approx(mass.sum(), abs=1e-6)
        counts.append(count)
        return state

    def merge(state: Any, merged: MergedRows) -> Any:
        restored.append(len(np.unique(merged.source)) < len(merged.source))
        return real_merge(state, merged)

    monkeypatch.setattr(session.backend, "apply_map_feedback", apply)
    monkeypatch.setattr(session.backend, "merge_rows", merge)
    list(session.replay(walk_of(0).readings))
    assert (np.diff(counts) < 0).sum() >= 2
    assert len(restored) > 4
    assert any(restored) == (first == BEGUN)


@cache
def unmerged_error(seed: int) -> float:
    session, walk = empty_merging_session(0), walk_of(seed)
    list(session.replay(walk.readings))
    assert len(session.map.feedback().poses) == len(session.map.keyframe_steps())
    return metric(session.map.map_trajectory(), walk.truth)


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.soak)])
def test_the_trajectory_is_as_good_as_without_merges(seed: int, first: int) -> None:
    walk, path = walk_of(seed), replayed(seed, first).path
    assert len(path) == len(walk.readings)
    assert metric(path, walk.truth) < 1.3 * unmerged_error(seed) + 0.01
    assert metric(path, walk.truth) < 0.2 * metric(dead_reckoning(walk.readings), walk.truth)
