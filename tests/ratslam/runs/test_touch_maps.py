"""Whole maps from whisker images of simulated sessions: closures at equal places."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping.loop_closures import Verdict
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.packaged import PRESETS
from ratslam.runs.settings.run_config import RunConfig
from robot.simulation.head.simulated_session import HeadSimulation
from tactile.base.types import Observation
from tests.ratslam.runs.touch_walks import (
    LAPS,
    accepted_sequences,
    config_of,
    crossing,
    dead_reckoning,
    empty_session,
    follow,
    map_walk,
    metric,
    shuffled,
    simulate_walk,
    true_share,
    unseen,
)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 4))])
def test_laps_are_closed_and_the_map_is_corrected(seed: int) -> None:
    walk = simulate_walk(seed)
    found = map_walk(walk.readings)
    assert len(found.closures) > 50
    assert true_share(found, walk.truth) >= 0.95
    assert found.cuts == []
    assert metric(found.path, walk.truth) < 0.3 * metric(dead_reckoning(walk.readings), walk.truth)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.soak)])
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


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 3))])
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
        first = keyframe_map.keyframe_steps()[table[table[:, 5] == sequence, :2].astype(int)]
        joined = set(map(tuple, keyframe_map.closures().tolist()))
        assert not joined & set(map(tuple, first.tolist()))
    with pytest.raises(ValueError, match="not an accepted closure sequence"):
        keyframe_map.undo(sequence)


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
@pytest.mark.parametrize("seed", range(10, 30))
def test_small_loops_are_mapped_in_every_maze(seed: int) -> None:
    walk = simulate_walk(seed)
    found = map_walk(walk.readings)
    assert len(found.closures) > 20
    assert true_share(found, walk.truth) >= 0.9
    assert metric(found.path, walk.truth) < metric(dead_reckoning(walk.readings), walk.truth)
    assert len(map_walk(shuffled(walk.readings)).closures) == 0
