"""Whole maps from whisker images of simulated sessions: closures at equal places, and none without them;
merged keyframes; a robot that is found in such a map."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import jax
import numpy as np
import pytest

from ratslam.core.session import CHUNK, Session, Step
from ratslam.mapping import keyframe_merger
from ratslam.mapping.loop_closures import Verdict
from ratslam.methods.localise import LocaliseBackend
from ratslam.places.localiser import Localisation, Localiser
from ratslam.recall.memory import MapFeedback, MergedRows
from ratslam.runs.settings.packaged import PRESETS
from tactile.base.se2 import between, wrap
from tactile.base.types import Observation
from tests.golden import touch
from tests.ratslam.runs.touch_walks import (
    WIDE,
    MappedWalk,
    Walk,
    accepted_sequences,
    crossing,
    dead_reckoning,
    empty_merging_session,
    empty_session,
    follow,
    kidnap,
    map_walk,
    metric,
    same_arrays,
    shuffled,
    simulate_walk,
    true_share,
    unseen,
)


@pytest.mark.parametrize("name", [pytest.param("touch_circuits", marks=pytest.mark.soak), "touch_kidnap"])
def test_decisions_on_stored_sessions_are_those_stored(name: str) -> None:
    assert touch.decisions(name) == json.loads((touch.FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    assert (touch.FOLDER / f"{name}.mcap").stat().st_size < 300_000


def soak(*seeds: int) -> list[Any]:
    """Cases of the soak but for the first."""
    return [seeds[0], *(pytest.param(seed, marks=pytest.mark.soak) for seed in seeds[1:])]


def check_map(found: MappedWalk, walk: Walk, closures: int, share: float, error: float) -> None:
    """Checks least closures, least share of true ones, and largest error over that of odometry."""
    assert len(found.closures) > closures
    assert true_share(found, walk.truth) >= share
    assert metric(found.path, walk.truth) < error * metric(dead_reckoning(walk.readings), walk.truth)


@pytest.mark.parametrize("dead", [(), (1, 8, 15)], ids=["all", "three dead"])
@pytest.mark.parametrize("seed", soak(*range(4)))
def test_laps_are_closed_and_the_map_is_corrected(seed: int, dead: tuple[int, ...]) -> None:
    walk = simulate_walk(seed, dead)
    found = map_walk(walk.readings)
    check_map(found, walk, 50, 0.95, 0.3)
    assert found.cuts == []


@pytest.mark.parametrize("seed", soak(*range(3)))
def test_laps_in_the_opposite_direction_are_closed(seed: int) -> None:
    """The opposite whiskers touch the same walls."""
    walk = simulate_walk(seed, path={"circuits": "CCAA"})
    found = map_walk(walk.readings)
    check_map(found, walk, 20, 0.95, 0.5)
    assert crossing(found, len(walk.readings) // 2) > 20


def test_the_signals_of_dead_whiskers_do_not_change_the_map() -> None:
    walk, session = simulate_walk(0, dead=(1, 8, 15)), empty_session()
    stream = np.random.default_rng(0)

    def falsify(reading: Observation) -> Observation:
        view = reading.view.copy()
        view.reshape(-1)[[1, 8, 15]] = stream.random(3)
        return reading._replace(view=view)

    found = follow(session, walk.readings)
    level = session.map.arrays()["appearance/level"]  # the map learns from those that the kernel compares
    assert np.array_equal(np.asarray(session.state.memory.view)[:, : len(level)].T, level)
    same = map_walk([falsify(reading) for reading in walk.readings])
    assert np.array_equal(found.path, same.path)
    assert np.array_equal(found.closures, same.closures)


def test_an_undone_closure_sequence_stays_undone_and_every_one_can_be() -> None:
    walk, session = simulate_walk(2), empty_session()
    follow(session, walk.readings[:200])
    made, sequence = session.map, accepted_sequences(session)[0]
    made.undo(sequence)
    for rest in (walk.readings[200:200], walk.readings[200:240], walk.readings[240:]):
        follow(session, rest)
        table = made.candidates()
        assert (table[table[:, 5] == sequence, 7] == Verdict.UNDONE).all()
        first = made.keyframe_steps()[table[table[:, 5] == sequence, :2].astype(int)]
        assert not set(map(tuple, made.closures().tolist())) & set(map(tuple, first.tolist()))
    with pytest.raises(ValueError, match="not an accepted closure sequence"):
        made.undo(sequence)
    undone = [sequence]
    while len(sequences := accepted_sequences(session)):
        made.undo(sequences[0])
        undone.append(sequences[0])
    assert len(undone) == len(set(undone)) > 2
    assert len(made.closures()) == 0
    assert metric(made.trajectory(), dead_reckoning(walk.readings)) < 0.01


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(6))
def test_ten_circuits_are_mapped(seed: int) -> None:
    walk = simulate_walk(seed, maze={}, path={})
    check_map(map_walk(walk.readings, 2048), walk, 50, 0.95, 0.25)
    for control in (shuffled, unseen):
        assert len(map_walk(control(walk.readings), 2048).closures) == 0


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(10, 30))
def test_small_loops_are_mapped_in_every_maze(seed: int) -> None:
    walk = simulate_walk(seed)
    check_map(map_walk(walk.readings), walk, 20, 0.9, 1.0)
    assert len(map_walk(shuffled(walk.readings)).closures) == 0


def different(readings: list[Observation]) -> list[Observation]:
    stream, shape = np.random.default_rng(0), readings[0].view.shape
    touching = np.mean([one.view > 0 for one in readings])
    return [one._replace(view=stream.random(shape) * (stream.random(shape) < touching)) for one in readings]


CONTROLS: dict[str, Callable[[list[Observation]], list[Observation]]] = {
    "shuffled": shuffled,
    "blank": lambda readings: [one._replace(view=np.zeros_like(one.view)) for one in readings],
    "unseen": unseen,
    "numb": lambda readings: [one._replace(alive=np.zeros_like(one.alive)) for one in readings],
    "alike": lambda readings: [one._replace(view=readings[0].view) for one in readings],
    "different": different,
}


@pytest.mark.parametrize("seed", soak(0, 1))
@pytest.mark.parametrize("control", CONTROLS)
def test_images_without_information_give_no_closures(control: str, seed: int) -> None:
    walk = simulate_walk(seed)
    found = map_walk(CONTROLS[control](walk.readings))
    assert len(found.closures) == 0
    assert found.cuts == []
    assert np.allclose(found.path, dead_reckoning(walk.readings), atol=1e-9)


@pytest.mark.parametrize("seed", soak(30, 34, 37))
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


NEVER, BEGUN = 10**6, 300
"""Keyframes at the selection on the unmerged keyframes; it is taken up an eighth later."""


@cache
def circuits(seed: int) -> Walk:
    return simulate_walk(seed, path={"circuits": "CCCCCC"})


@pytest.fixture(params=[NEVER, BEGUN], ids=["merged", "restored"])
def first(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    if request.param == BEGUN:
        monkeypatch.setattr(keyframe_merger, "FIRST", BEGUN // 2)
    return int(request.param)


def bits(session: Session, steps: list[Step]) -> dict[str, np.ndarray]:
    """All results of steps and the whole state after them."""
    leaves = {str(k): np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(steps))}
    return leaves | session.arrays()


@cache
def replayed(seed: int, first: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """All bits of a replayed session, and its trajectory."""
    del first  # its settings are in force
    session = empty_merging_session(1)
    steps = list(session.replay(circuits(seed).readings))
    return bits(session, steps), session.map.map_trajectory()


def test_merging_live_gives_the_bits_of_the_replay_and_the_rows_of_the_map(first, monkeypatch):
    (expected, _), session = replayed(0, first), empty_merging_session(1)
    counts: list[int] = []
    restored: list[bool] = []
    real, real_merge = session.backend.apply_map_feedback, session.backend.merge_rows

    def apply(state: Any, feedback: MapFeedback) -> Any:
        state = real(state, feedback)
        memory, poses, count = state.memory, feedback.poses, len(feedback.poses)
        assert session.backend.rows(state) == count
        values = np.stack([memory.x, memory.y, memory.cosine, memory.sine])
        assert np.array_equal(values[:, :count], [*poses.T[:2], np.cos(poses[:, 2]), np.sin(poses[:, 2])])
        assert not values[:, count:].any()
        views, _ = session.map.appearance.stored(session.map.state.taken.rows)
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
    steps = [session.step(reading) for reading in circuits(0).readings]
    assert len(session.map.feedback().poses) < 0.7 * len(session.map.keyframe_steps())
    assert same_arrays(bits(session, steps), expected)
    assert session.compilations() == 1
    assert (np.diff(counts) < 0).sum() >= 2
    assert len(restored) > 4
    assert any(restored) == (first == BEGUN)


# Between two chunks, and in mid-chunk while the selection on the unmerged keyframes is in progress.
@pytest.mark.parametrize("at", [pytest.param(14 * CHUNK, marks=pytest.mark.soak), 325])
def test_a_merging_session_continues_to_the_same_bits(at: int, first: int) -> None:
    walk, session = circuits(0), empty_merging_session(1)
    before = list(session.replay(walk.readings[:at]))
    assert len(session.map.feedback().poses) < len(session.map.keyframe_steps())
    arrays = session.arrays()
    restored = empty_merging_session(1)
    restored.restore(arrays)
    after = list(restored.replay(walk.readings[at:]))
    assert same_arrays(bits(restored, before + after), replayed(0, first)[0])
    assert restored.compilations() == 1


@cache
def unmerged_error(seed: int) -> float:
    session, walk = empty_merging_session(0), circuits(seed)
    list(session.replay(walk.readings))
    assert len(session.map.feedback().poses) == len(session.map.keyframe_steps())
    return metric(session.map.map_trajectory(), walk.truth)


@pytest.mark.parametrize("seed", soak(0, 2))
def test_the_trajectory_is_as_good_as_without_merges(seed: int, first: int) -> None:
    walk, path = circuits(seed), replayed(seed, first)[1]
    assert len(path) == len(walk.readings)
    assert metric(path, walk.truth) < 1.3 * unmerged_error(seed) + 0.01
    assert metric(path, walk.truth) < 0.2 * metric(dead_reckoning(walk.readings), walk.truth)


FOUND, LOST = Localisation.FOUND, Localisation.LOST
ROOMY = WIDE | {"seed": 31003}
FAR, TURNED = 0.09, np.radians(20)
"""A pose is right if it is nearer than this, m, rad."""


@cache
def mapped() -> tuple[Walk, np.ndarray, Session]:
    """A walk of three circuits, its poses in the map, and a session that localises in it."""
    walk, mapping = simulate_walk(1, maze=ROOMY, path={"circuits": "CCA"}), empty_session()
    path = follow(mapping, walk.readings).path
    return walk, path, Session(LocaliseBackend(mapping.backend, mapping.map, 15.0))


def another_day(circuits: str = "AA") -> Walk:
    return simulate_walk(77, maze=ROOMY, path={"circuits": circuits})


def localise(readings: Sequence[Observation]) -> tuple[list[Step], Localiser]:
    session = mapped()[2]
    session.restart()
    steps = list(session.replay(readings))
    assert isinstance(session.map, Localiser)
    return steps, session.map


def is_right(steps: Sequence[Step], truth: np.ndarray) -> np.ndarray:
    """[n] whether a pose agrees with that of the nearest step of the map that faces alike."""
    walk, path, _ = mapped()
    right = []
    for step, pose in zip(steps, truth, strict=True):
        apart = np.hypot(*(walk.truth - pose)[:, :2].T) + (np.abs(wrap(walk.truth[:, 2] - pose[2])) > 0.8)
        near = int(apart.argmin())
        error = between(between(walk.truth[near], pose), between(path[near], step.pose))
        right.append(np.hypot(*error[:2]) < FAR and abs(wrap(error[2])) < TURNED)
    return np.array(right)


def test_another_session_is_found_in_a_map_and_stays_found() -> None:
    """It turns the other way round half of the time, so by half turns of the views too."""
    walk = another_day()
    steps, localiser = localise(walk.readings)
    states = localiser.states()
    first = int(np.argmax(states == FOUND))
    assert 0 < first < 120
    assert (states[first:] == FOUND).all()
    right = is_right(steps, walk.truth)
    assert right[first]
    assert right[first:].mean() > 0.9
    assert localiser.localisation().mass > 0.99


def mirrored(readings: Sequence[Observation]) -> list[Observation]:
    """The session of a robot in the mirrored maze."""
    flipped = []
    for one in readings:
        view = np.ravel(one.view)[::-1].reshape(one.view.shape)
        move = one.odometry._replace(dy=-one.odometry.dy, dtheta=-one.odometry.dtheta)
        flipped.append(one._replace(view=view, odometry=move))
    return flipped


def elsewhere(readings: Sequence[Observation]) -> list[Observation]:
    return simulate_walk(3, maze=WIDE | {"seed": 31005}, path={"circuits": "AA"}).readings


@pytest.mark.parametrize("control", [shuffled, unseen, mirrored, elsewhere])
def test_sessions_that_are_not_in_the_map_are_not_found(control: Any) -> None:
    _, localiser = localise(control(another_day().readings))
    assert FOUND not in localiser.states()


def test_a_carried_robot_is_lost_and_found_again() -> None:
    walk = another_day("AAA")  # a circuit after it is put down
    walk = kidnap(walk, 2 * len(walk.readings) // 5, 40)
    steps, localiser = localise(walk.readings)
    states = localiser.states()
    assert states[1:][np.diff(states) != 0].tolist()[:2] == [FOUND, LOST]
    assert states[-1] == FOUND
    assert is_right(steps, walk.truth)[-1]
