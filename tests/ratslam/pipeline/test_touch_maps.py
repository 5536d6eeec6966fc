"""Whole maps by whisker, from simulated sessions: what is known again closes, what is not is left alone."""

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
"""Metres within which a closure is true: two pose cells."""


class Way(NamedTuple):
    """What was felt [N] and where it truly was [N, 3]."""

    felt: list[Observation]
    truth: np.ndarray


class Mapped(NamedTuple):
    """What a session makes of a way."""

    path: np.ndarray
    closures: np.ndarray
    cuts: list[int]
    """Steps before which the odometry is cut."""


def config_of(**parts: Any) -> RunConfig:
    """A small session: few pose cells, and room for all of it from the start, so that it compiles once."""
    session = {"reserve": 512} | parts.pop("session", {})
    return RunConfig.model_validate({"pose_cells": {"cells_xy": 11}, "session": session, **parts})


@cache
def _compiled(reserve: int) -> tuple[Session, dict[str, np.ndarray]]:
    config = config_of(simulation=LAPS, session={"reserve": reserve})
    assert config.simulation is not None
    source = HeadSimulation(config.simulation)
    config = complete(config, source)
    session = build_session(config, open_touch_source(source, config.touch))
    return session, session.arrays()


def fresh(reserve: int = 512) -> Session:
    """The one compiled session, with nothing in it: all mazes, heads and controls have the same kernel."""
    session, empty = _compiled(reserve)
    session.restore(empty)
    return session


def way(seed: int, dead: Sequence[int] = (), **simulation: Any) -> Way:
    """A session simulated and sensed."""
    config = config_of(simulation={"seed": seed} | LAPS | simulation, touch={"head": {"dead": tuple(dead)}})
    assert config.simulation is not None
    source = HeadSimulation(config.simulation, config.touch.head)
    felt = [
        reading for _, reading in read_observations(open_touch_source(source, complete(config, source).touch))
    ]
    return Way(felt, source.truth)


def follow(session: Session, felt: Sequence[Observation]) -> Mapped:
    for _ in session.replay(felt):
        pass
    settled = session.map.solution()
    first = np.searchsorted(session.map.arrays()["step_frame"], np.arange(len(settled.cut.rows)))
    cuts = first[settled.cut.rows >= 0].tolist()
    return Mapped(session.map.trajectory(), session.map.closures(), cuts)


def mapped(felt: Sequence[Observation], reserve: int = 512) -> Mapped:
    return follow(fresh(reserve), felt)


def reckoned(felt: Sequence[Observation]) -> np.ndarray:
    return integrate(np.array([[o.odometry.dx, o.odometry.dy, o.odometry.dtheta] for o in felt]))


def metric(path: np.ndarray, truth: np.ndarray) -> float:
    return energy_all_pairs(path, truth).total


def true_share(found: Mapped, truth: np.ndarray) -> float:
    apart = truth[found.closures[:, 0]] - truth[found.closures[:, 1]]
    return float((np.hypot(*apart[:, :2].T) < REACH).mean())


def crossing(found: Mapped, step: int) -> int:
    """Closures that join what lies before a step with what comes after."""
    return int(((found.closures[:, 0] >= step) & (found.closures[:, 1] < step)).sum())


def carried(made: Way, row: int, ahead: int) -> Way:
    """The same way with whisks left out: the robot is carried ahead, and its odometry does not know."""
    kept = np.r_[:row, row + ahead : len(made.felt)]
    return Way([made.felt[k] for k in kept], made.truth[kept])


# Laps


@pytest.mark.parametrize("seed", range(4))
def test_laps_close_and_the_map_comes_right(seed: int) -> None:
    made = way(seed)
    found = mapped(made.felt)
    assert len(found.closures) > 50
    assert true_share(found, made.truth) >= 0.95
    assert found.cuts == []
    assert metric(found.path, made.truth) < 0.3 * metric(reckoned(made.felt), made.truth)


@pytest.mark.parametrize("seed", range(2))
def test_three_whiskers_may_be_dead(seed: int) -> None:
    made = way(seed, dead=(1, 8, 15))
    found = mapped(made.felt)
    assert len(found.closures) > 50
    assert true_share(found, made.truth) >= 0.95
    assert metric(found.path, made.truth) < 0.3 * metric(reckoned(made.felt), made.truth)


def test_whatever_dead_whiskers_say_the_map_is_the_same() -> None:
    made = way(0, dead=(1, 8, 15))
    stream = np.random.default_rng(0)

    def lying(felt: Observation) -> Observation:
        view = felt.view.copy()
        view.reshape(-1)[[1, 8, 15]] = stream.random(3)
        return felt._replace(view=view)

    found, same = mapped(made.felt), mapped([lying(felt) for felt in made.felt])
    assert np.array_equal(found.path, same.path)
    assert np.array_equal(found.closures, same.closures)


@pytest.mark.parametrize("seed", range(3))
def test_a_lap_the_other_way_round_is_joined(seed: int) -> None:
    """The head feels the same walls with the whiskers opposite."""
    made = way(seed, path={"circuits": "CCAA"})
    found = mapped(made.felt)
    assert true_share(found, made.truth) >= 0.95
    assert crossing(found, len(made.felt) // 2) > 20
    assert metric(found.path, made.truth) < 0.5 * metric(reckoned(made.felt), made.truth)


def test_a_session_that_feels_as_recall_remembers() -> None:
    """What the map learns from are the very levels that the kernel compares."""
    made, session = way(1, dead=(4,)), fresh()
    follow(session, made.felt)
    level = session.map.arrays()["appearance/level"]
    assert np.array_equal(np.asarray(session.state.memory.view)[:, : len(level)].T, level)


# Controls


def shuffled(felt: list[Observation]) -> list[Observation]:
    order = np.random.default_rng(0).permutation(len(felt))
    return [one._replace(view=felt[k].view) for one, k in zip(felt, order.tolist(), strict=True)]


def blank(felt: list[Observation]) -> list[Observation]:
    return [one._replace(view=np.zeros_like(one.view)) for one in felt]


def unseen(felt: list[Observation]) -> list[Observation]:
    return [one._replace(view_seen=np.bool_(False)) for one in felt]


def numb(felt: list[Observation]) -> list[Observation]:
    return [one._replace(alive=np.zeros_like(one.alive)) for one in felt]


def alike(felt: list[Observation]) -> list[Observation]:
    return [one._replace(view=felt[0].view) for one in felt]


def different(felt: list[Observation]) -> list[Observation]:
    stream = np.random.default_rng(0)
    touching = np.mean([one.view > 0 for one in felt])
    shape = felt[0].view.shape
    return [one._replace(view=stream.random(shape) * (stream.random(shape) < touching)) for one in felt]


@pytest.mark.parametrize("control", [shuffled, blank, unseen, numb, alike, different])
def test_images_that_tell_nothing_close_nothing(
    control: Callable[[list[Observation]], list[Observation]],
) -> None:
    for seed in (0, 1):
        made = way(seed)
        found = mapped(control(made.felt))
        assert len(found.closures) == 0
        assert found.cuts == []
        assert np.allclose(found.path, reckoned(made.felt), atol=1e-9)


@pytest.mark.soak
def test_later_laps_in_another_maze_are_hardly_joined() -> None:
    """Small mazes share their outer walls, so the later images are those of another way as well."""
    together, apart = 0, 0
    for seed in range(4):
        made, other = way(seed, maze=WIDE), way(seed + 100, maze=WIDE)
        half = len(made.felt) // 2
        elsewhere = [other.felt[k % len(other.felt)].view for k in range(len(made.felt))]
        later = [one._replace(view=view) for one, view in zip(made.felt, elsewhere, strict=True)]
        together += crossing(mapped(made.felt), half)
        apart += crossing(mapped(made.felt[:half] + later[half:]), half)
    assert together > 500
    assert apart <= 0.1 * together


# A robot that is carried


def test_a_robot_that_is_carried_is_cut_where_it_was() -> None:
    found = []
    for seed in range(8):
        made = carried(way(seed, maze=WIDE), 240, 45)
        told = mapped(made.felt)
        assert true_share(told, made.truth) >= 0.95
        near = len(told.cuts) == 1 and abs(told.cuts[0] - 240) <= 5
        right = metric(told.path, made.truth) < 0.25 * metric(reckoned(made.felt), made.truth)
        found.append([near, right])
    assert (np.sum(found, axis=0) >= [5, 7]).all()


# The map while it grows


def carried_session() -> tuple[Way, Session]:
    made = carried(way(4, maze=WIDE), 240, 45)
    return made, fresh()


@pytest.mark.parametrize("every", [7, 100])
def test_asking_for_the_map_changes_nothing(every: int) -> None:
    made, session = carried_session()
    expected = follow(session, made.felt)
    kept = session.arrays()
    session = fresh()
    for start in range(0, len(made.felt), every):
        list(session.replay(made.felt[start : start + every]))
        session.map.trajectory()
        session.map.closures()
        session.map.graph()
        session.map.edges()
    found = follow(session, [])
    assert np.array_equal(found.path, expected.path)
    assert np.array_equal(found.closures, expected.closures)
    again = session.arrays()
    assert again.keys() == kept.keys()
    assert all(np.array_equal(again[name], kept[name], equal_nan=True) for name in kept)


@pytest.mark.parametrize("stop", [250, 300, 320, 330])
def test_a_map_with_cuts_goes_on_as_if_never_stopped(stop: int) -> None:
    made, session = carried_session()
    expected = follow(session, made.felt)
    assert expected.cuts
    whole = session.arrays()
    session = fresh()
    follow(session, made.felt[:stop])
    kept = session.arrays()
    assert (kept["map/cut"] >= 0).any() == (stop >= 320)
    session = fresh()
    follow(session, made.felt[:50])
    session.restore(kept)
    found = follow(session, made.felt[stop:])
    assert np.array_equal(found.path, expected.path)
    assert found.cuts == expected.cuts
    again = session.arrays()
    assert all(np.array_equal(again[name], whole[name], equal_nan=True) for name in whole)


def test_an_undone_closure_sequence_stays_undone() -> None:
    made, session = way(2), fresh()
    follow(session, made.felt[:200])
    frames = session.map
    before = frames.candidates()
    runs = np.unique(before[before[:, 7] == Verdict.ACCEPTED, 5]).astype(int)
    run = int(runs[0])
    frames.undo(run)
    for rest in (made.felt[200:200], made.felt[200:240], made.felt[240:]):
        follow(session, rest)
        table = frames.candidates()
        assert (table[table[:, 5] == run, 7] == Verdict.UNDONE).all()
        first = np.searchsorted(frames.arrays()["step_frame"], table[table[:, 5] == run, :2])
        joined = set(map(tuple, frames.closures().tolist()))
        assert not joined & set(map(tuple, first.tolist()))
    with pytest.raises(ValueError, match="not an accepted closure sequence"):
        frames.undo(run)


def test_every_run_that_is_told_as_accepted_can_be_undone() -> None:
    made, session = way(0), fresh()
    follow(session, made.felt)
    table = session.map.candidates()
    runs = np.unique(table[table[:, 7] == Verdict.ACCEPTED, 5]).astype(int)
    assert len(runs) > 1
    for run in runs.tolist():
        session.map.undo(run)


# Settings


def test_whiskers_bring_their_own_settings() -> None:
    config = config_of(simulation=LAPS)
    assert config.simulation is not None
    completed = complete(config, HeadSimulation(config.simulation))
    assert completed.recall.sector_fov == "whiskers"
    for name, value in PRESETS["touch"]["keyframes"].items():
        if name != "noise":
            assert getattr(completed.keyframes, name) == value
    assert completed.keyframes.noise.per_cell == PRESETS["touch"]["keyframes"]["noise"]["per_cell"]
    assert completed.pose_cells.cells_xy == 11  # what was asked for stays
    again = RunConfig.model_validate(completed.model_dump(mode="json"))
    assert (
        complete(again, HeadSimulation(config.simulation)) == completed
    )  # a written configuration is the same run


def test_what_is_set_goes_before_what_whiskers_bring() -> None:
    config = config_of(simulation=LAPS, keyframes={"min_score": 7.0, "noise": {"per_cell": 0.5}})
    assert config.simulation is not None
    frames = complete(config, HeadSimulation(config.simulation)).keyframes
    assert (frames.min_score, frames.noise.per_cell) == (7.0, 0.5)
    assert frames.select_every == PRESETS["touch"]["keyframes"]["select_every"]
    assert frames.noise.heading_per_cell == PRESETS["touch"]["keyframes"]["noise"]["heading_per_cell"]


def test_saying_that_there_are_whiskers_changes_nothing() -> None:
    plain, said = config_of(simulation=LAPS), config_of(simulation=LAPS, recall={"sector_fov": "whiskers"})
    assert plain.simulation is not None
    source = HeadSimulation(plain.simulation)
    assert complete(said, source) == complete(plain, source)


# Large


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(6))
def test_ten_circuits_are_mapped(seed: int) -> None:
    made = way(seed, maze={}, path={})
    found = mapped(made.felt, 2048)
    assert true_share(found, made.truth) >= 0.95
    assert metric(found.path, made.truth) < 0.25 * metric(reckoned(made.felt), made.truth)
    for control in (shuffled, unseen):
        assert len(mapped(control(made.felt), 2048).closures) == 0


@pytest.mark.soak
def test_later_circuits_in_another_maze_are_hardly_joined() -> None:
    """In most mazes: two may have the same walls along the way by chance, the outer ones always."""
    shares = []
    for seed in range(6):
        made = way(seed, maze={}, path={})
        half = len(made.felt) // 2
        other = way(seed, maze={}, path={}, later_maze=0.5)
        joined = [crossing(mapped(one.felt, 2048), half) for one in (made, other)]
        shares.append(joined[1] / joined[0])
    assert np.median(shares) <= 0.1


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(10, 30))
def test_small_loops_are_mapped_whatever_the_maze(seed: int) -> None:
    made = way(seed)
    found = mapped(made.felt)
    assert len(found.closures) > 20
    assert true_share(found, made.truth) >= 0.9
    assert metric(found.path, made.truth) < metric(reckoned(made.felt), made.truth)
    assert len(mapped(shuffled(made.felt)).closures) == 0
