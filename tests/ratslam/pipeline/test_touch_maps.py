"""Whole maps from whisker images of simulated sessions: closures at equal places, and only there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest

from evaluation.metrics.energy_metric import energy_all_pairs
from ratslam.config.completion import complete
from ratslam.config.presets import PRESETS
from ratslam.config.run_config import RunConfig
from ratslam.core.session import Session
from ratslam.keyframes.loop_closures import Verdict
from ratslam.pipeline.runner import build_session
from ratslam.pipeline.source import read_observations
from robot.simulation.head.session import HeadSimulation
from robot.touch_source import open_touch_source
from tactile.base.se2 import integrate
from tactile.base.types import Observation

SMALL = {"columns": 3, "rows": 3, "loop": 8}
WIDE = {"columns": 5, "rows": 5, "loop": 12}
LAPS = {"maze": SMALL, "path": {"circuits": "CCCC"}}
REACH = 0.1
"""Distance within which a closure is true, m: two pose cells."""


class Walk(NamedTuple):
    """Observations [N] and true poses [N, 3]."""

    readings: list[Observation]
    truth: np.ndarray


class MappedWalk(NamedTuple):
    """The result of mapping a walk."""

    path: np.ndarray
    closures: np.ndarray
    cuts: list[int]
    """Steps before which the odometry is cut."""


def config_of(**parts: Any) -> RunConfig:
    """A small session: few pose cells, and room for all of it from the start, so that it compiles once."""
    session = {"reserve": 512} | parts.pop("session", {})
    return RunConfig.model_validate({"pose_cells": {"cells_xy": 11}, "session": session, **parts})


@cache
def _compiled(reserve: int, **keyframes: Any) -> tuple[Session, dict[str, np.ndarray]]:
    config = config_of(simulation=LAPS, session={"reserve": reserve}, keyframes=keyframes)
    assert config.simulation is not None
    source = HeadSimulation(config.simulation)
    config = complete(config, source)
    session = build_session(config, open_touch_source(source, config.touch))
    return session, session.arrays()


def empty_session(reserve: int = 512) -> Session:
    """The shared compiled session, empty: all mazes, heads and controls have the same kernel."""
    session, empty = _compiled(reserve)
    session.restore(empty)
    return session


def empty_carried_session() -> Session:
    """The shared compiled session of a robot that may be carried, empty."""
    session, empty = _compiled(512, may_be_carried=True)
    session.restore(empty)
    return session


def simulate_walk(seed: int, dead: Sequence[int] = (), **simulation: Any) -> Walk:
    """A simulated session."""
    config = config_of(simulation={"seed": seed} | LAPS | simulation, touch={"head": {"dead": tuple(dead)}})
    assert config.simulation is not None
    source = HeadSimulation(config.simulation, config.touch.head)
    readings = [
        reading for _, reading in read_observations(open_touch_source(source, complete(config, source).touch))
    ]
    return Walk(readings, source.truth)


def follow(session: Session, readings: Sequence[Observation]) -> MappedWalk:
    for _ in session.replay(readings):
        pass
    settled = session.map.solution()
    first = np.searchsorted(session.map.arrays()["step_frame"], np.arange(len(settled.cut.rows)))
    cuts = first[settled.cut.rows >= 0].tolist()
    return MappedWalk(session.map.trajectory(), session.map.closures(), cuts)


def map_walk(readings: Sequence[Observation], reserve: int = 512) -> MappedWalk:
    return follow(empty_session(reserve), readings)


def dead_reckoning(readings: Sequence[Observation]) -> np.ndarray:
    return integrate(np.array([[o.odometry.dx, o.odometry.dy, o.odometry.dtheta] for o in readings]))


def metric(path: np.ndarray, truth: np.ndarray) -> float:
    return energy_all_pairs(path, truth).total


def true_share(found: MappedWalk, truth: np.ndarray) -> float:
    apart = truth[found.closures[:, 0]] - truth[found.closures[:, 1]]
    return float((np.hypot(*apart[:, :2].T) < REACH).mean())


def crossing(found: MappedWalk, step: int) -> int:
    """The number of closures between poses before a step and poses after it."""
    return int(((found.closures[:, 0] >= step) & (found.closures[:, 1] < step)).sum())


def kidnap(walk: Walk, row: int, ahead: int) -> Walk:
    """The same walk without some whisks: the robot is carried ahead, without odometry."""
    rows = np.r_[:row, row + ahead : len(walk.readings)]
    return Walk([walk.readings[k] for k in rows], walk.truth[rows])


# Laps


@pytest.mark.parametrize("seed", range(4))
def test_laps_are_closed_and_the_map_is_corrected(seed: int) -> None:
    walk = simulate_walk(seed)
    found = map_walk(walk.readings)
    assert len(found.closures) > 50
    assert true_share(found, walk.truth) >= 0.95
    assert found.cuts == []
    assert metric(found.path, walk.truth) < 0.3 * metric(dead_reckoning(walk.readings), walk.truth)


@pytest.mark.parametrize("seed", range(2))
def test_three_whiskers_may_be_dead(seed: int) -> None:
    walk = simulate_walk(seed, dead=(1, 8, 15))
    found = map_walk(walk.readings)
    assert len(found.closures) > 50
    assert true_share(found, walk.truth) >= 0.95
    assert metric(found.path, walk.truth) < 0.3 * metric(dead_reckoning(walk.readings), walk.truth)


def test_the_signals_of_dead_whiskers_do_not_change_the_map() -> None:
    walk = simulate_walk(0, dead=(1, 8, 15))
    stream = np.random.default_rng(0)

    def falsify(reading: Observation) -> Observation:
        view = reading.view.copy()
        view.reshape(-1)[[1, 8, 15]] = stream.random(3)
        return reading._replace(view=view)

    found, same = map_walk(walk.readings), map_walk([falsify(reading) for reading in walk.readings])
    assert np.array_equal(found.path, same.path)
    assert np.array_equal(found.closures, same.closures)


@pytest.mark.parametrize("seed", range(3))
def test_laps_in_the_opposite_direction_are_closed(seed: int) -> None:
    """The opposite whiskers touch the same walls."""
    walk = simulate_walk(seed, path={"circuits": "CCAA"})
    found = map_walk(walk.readings)
    assert true_share(found, walk.truth) >= 0.95
    assert crossing(found, len(walk.readings) // 2) > 20
    assert metric(found.path, walk.truth) < 0.5 * metric(dead_reckoning(walk.readings), walk.truth)


def test_the_map_compares_the_levels_in_the_memory_of_the_kernel() -> None:
    """The map learns from the same levels that the kernel compares."""
    walk, session = simulate_walk(1, dead=(4,)), empty_session()
    follow(session, walk.readings)
    level = session.map.arrays()["appearance/level"]
    assert np.array_equal(np.asarray(session.state.memory.view)[:, : len(level)].T, level)


# Controls


def shuffled(readings: list[Observation]) -> list[Observation]:
    order = np.random.default_rng(0).permutation(len(readings))
    return [one._replace(view=readings[k].view) for one, k in zip(readings, order.tolist(), strict=True)]


def blank(readings: list[Observation]) -> list[Observation]:
    return [one._replace(view=np.zeros_like(one.view)) for one in readings]


def unseen(readings: list[Observation]) -> list[Observation]:
    return [one._replace(view_seen=np.bool_(False)) for one in readings]


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


@pytest.mark.parametrize("seed", [4, 8, 22])
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


# A kidnapped robot


def test_the_odometry_is_cut_where_the_robot_was_kidnapped() -> None:
    found = []
    for seed in range(8):
        walk = kidnap(simulate_walk(seed, maze=WIDE), 240, 45)
        found_map = follow(empty_carried_session(), walk.readings)
        assert true_share(found_map, walk.truth) >= 0.95
        near = len(found_map.cuts) == 1 and abs(found_map.cuts[0] - 240) <= 5
        right = metric(found_map.path, walk.truth) < 0.25 * metric(dead_reckoning(walk.readings), walk.truth)
        found.append([near, right])
    assert (np.sum(found, axis=0) >= [5, 7]).all()


def test_the_odometry_of_a_robot_that_is_never_carried_is_not_cut() -> None:
    for seed in range(2):
        session = empty_session()
        walk = kidnap(simulate_walk(seed, maze=WIDE), 240, 45)
        for start in range(0, len(walk.readings), 50):
            assert follow(session, walk.readings[start : start + 50]).cuts == []
            assert (session.map.arrays()["graph/cut"] == -1).all()
            assert not session.map.pieces().any()


# The map while it grows


def kidnapped_session() -> tuple[Walk, Session]:
    walk = kidnap(simulate_walk(4, maze=WIDE), 240, 45)
    return walk, empty_carried_session()


@pytest.mark.parametrize("every", [7, 100])
def test_reading_the_map_does_not_change_it(every: int) -> None:
    walk, session = kidnapped_session()
    expected = follow(session, walk.readings)
    saved = session.arrays()
    session = empty_carried_session()
    for start in range(0, len(walk.readings), every):
        list(session.replay(walk.readings[start : start + every]))
        session.map.trajectory()
        session.map.closures()
        session.map.graph()
        session.map.edges()
    found = follow(session, [])
    assert np.array_equal(found.path, expected.path)
    assert np.array_equal(found.closures, expected.closures)
    again = session.arrays()
    assert again.keys() == saved.keys()
    assert all(np.array_equal(again[name], saved[name], equal_nan=True) for name in saved)


@pytest.mark.parametrize("stop", [250, 300, 320, 330])
def test_a_restored_map_with_cuts_continues_as_the_uninterrupted_one(stop: int) -> None:
    walk, session = kidnapped_session()
    expected = follow(session, walk.readings)
    assert expected.cuts
    whole = session.arrays()
    session = empty_carried_session()
    follow(session, walk.readings[:stop])
    saved = session.arrays()
    assert (saved["map/graph/cut"] >= 0).any() == (stop >= 320)
    session = empty_carried_session()
    follow(session, walk.readings[:50])
    session.restore(saved)
    found = follow(session, walk.readings[stop:])
    assert np.array_equal(found.path, expected.path)
    assert found.cuts == expected.cuts
    again = session.arrays()
    assert all(np.array_equal(again[name], whole[name], equal_nan=True) for name in whole)


def test_an_undone_closure_sequence_stays_undone() -> None:
    walk, session = simulate_walk(2), empty_session()
    follow(session, walk.readings[:200])
    keyframe_map = session.map
    before = keyframe_map.candidates()
    sequences = np.unique(before[before[:, 7] == Verdict.ACCEPTED, 5]).astype(int)
    sequence = int(sequences[0])
    keyframe_map.undo(sequence)
    for rest in (walk.readings[200:200], walk.readings[200:240], walk.readings[240:]):
        follow(session, rest)
        table = keyframe_map.candidates()
        assert (table[table[:, 5] == sequence, 7] == Verdict.UNDONE).all()
        first = np.searchsorted(keyframe_map.arrays()["step_frame"], table[table[:, 5] == sequence, :2])
        joined = set(map(tuple, keyframe_map.closures().tolist()))
        assert not joined & set(map(tuple, first.tolist()))
    with pytest.raises(ValueError, match="not an accepted closure sequence"):
        keyframe_map.undo(sequence)


def accepted_sequences(session: Session) -> list[int]:
    """The closure sequences of the map; each decides anew which of the others fit."""
    table = session.map.candidates()
    return np.unique(table[table[:, 7] == Verdict.ACCEPTED, 5]).astype(int).tolist()


def test_every_accepted_closure_sequence_can_be_undone() -> None:
    walk, session = simulate_walk(0), empty_session()
    follow(session, walk.readings)
    undone = []
    while len(sequences := accepted_sequences(session)):
        session.map.undo(sequences[0])
        assert sequences[0] not in accepted_sequences(session)
        undone.append(sequences[0])
    assert len(undone) == len(set(undone)) > 1
    assert len(session.map.closures()) == 0


# Settings


def test_the_preset_for_touch_is_used_with_whiskers() -> None:
    config = config_of(simulation=LAPS)
    assert config.simulation is not None
    completed = complete(config, HeadSimulation(config.simulation))
    assert completed.recall.sector_fov == "whiskers"
    for name, value in PRESETS["touch"]["keyframes"].items():
        if name != "noise":
            assert getattr(completed.keyframes, name) == value
    assert completed.keyframes.noise.per_cell == PRESETS["touch"]["keyframes"]["noise"]["per_cell"]
    assert completed.pose_cells.cells_xy == 11  # explicit settings are kept
    again = RunConfig.model_validate(completed.model_dump(mode="json"))
    assert (
        complete(again, HeadSimulation(config.simulation)) == completed
    )  # the written configuration gives the same session


def test_settings_go_before_the_preset_for_touch() -> None:
    config = config_of(simulation=LAPS, keyframes={"min_score": 7.0, "noise": {"per_cell": 0.5}})
    assert config.simulation is not None
    settings = complete(config, HeadSimulation(config.simulation)).keyframes
    assert (settings.min_score, settings.noise.per_cell) == (7.0, 0.5)
    assert settings.select_every == PRESETS["touch"]["keyframes"]["select_every"]
    assert settings.noise.heading_per_cell == PRESETS["touch"]["keyframes"]["noise"]["heading_per_cell"]


def test_an_explicit_sector_fov_of_whiskers_changes_nothing() -> None:
    plain, given = config_of(simulation=LAPS), config_of(simulation=LAPS, recall={"sector_fov": "whiskers"})
    assert plain.simulation is not None
    source = HeadSimulation(plain.simulation)
    assert complete(given, source) == complete(plain, source)


# Large


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(6))
def test_ten_circuits_are_mapped(seed: int) -> None:
    walk = simulate_walk(seed, maze={}, path={})
    found = map_walk(walk.readings, 2048)
    assert true_share(found, walk.truth) >= 0.95
    assert metric(found.path, walk.truth) < 0.25 * metric(dead_reckoning(walk.readings), walk.truth)
    for control in (shuffled, unseen):
        assert len(map_walk(control(walk.readings), 2048).closures) == 0


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


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(10, 30))
def test_small_loops_are_mapped_in_every_maze(seed: int) -> None:
    walk = simulate_walk(seed)
    found = map_walk(walk.readings)
    assert len(found.closures) > 20
    assert true_share(found, walk.truth) >= 0.9
    assert metric(found.path, walk.truth) < metric(dead_reckoning(walk.readings), walk.truth)
    assert len(map_walk(shuffled(walk.readings)).closures) == 0
