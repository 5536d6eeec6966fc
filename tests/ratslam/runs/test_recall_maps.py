"""Whole maps by recall: sequences that classic matching distorts are mapped; ambiguous ones stay odometry."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from evaluation.metrics.trajectory import ate
from evaluation.studies.perturbation import perturb
from ratslam.core.backend import Map
from ratslam.core.session import Session, Step
from ratslam.mapping.loop_closures import Verdict
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from robot.recordings.npz_trace import read_trace
from robot.sources.in_memory import InMemorySource
from tactile.base.se2 import integrate
from tactile.base.types import Odometry, observation
from tests.helpers import scenes

GOLDEN = Path(__file__).parents[2] / "golden"


@cache
def session_of(
    view_shape: tuple[int, ...], cell_size: float | None, precision: str, **keyframes: bool
) -> Session:
    """A session with one setting for all, on pose cells small enough for a test, compiled once."""
    cells = {"pose_cells": {"cells_xy": 11, "cell_size": cell_size}}
    config = RecallBackendConfig.model_validate({**cells, "keyframes": keyframes})
    return Session(RecallBackend(config, view_shape, np.dtype(precision)), reserve=512, precision=precision)


def started(log: InMemorySource, precision: str = "float64") -> Session:
    session = session_of(log.view_shape, log.info.cell_size, precision)
    session.restart()
    return session


def map_log(log: InMemorySource, precision: str = "float64") -> Map:
    """The map of a session that has replayed the log."""
    return map_with(started(log, precision), log)


def map_carried(log: InMemorySource) -> Map:
    """The same of a robot that may be carried."""
    return map_with(started_carried(log), log)


def started_carried(log: InMemorySource) -> Session:
    session = session_of(log.view_shape, log.info.cell_size, "float64", may_be_carried=True)
    session.restart()
    return session


def map_with(session: Session, log: InMemorySource) -> Map:
    """The map of a session at its start that replays the log."""
    for _ in session.replay(sample.reading for sample in log):
        pass
    return session.map


@cache
def golden_map(name: str) -> Map:
    """The map of a stored log; tests share it and do not change it."""
    return map_log(golden(name))


@cache
def carried_steps(name: str) -> tuple[Map, list[Step]]:
    """The map of a stored log if the robot may be carried, and the steps; shared as `golden_map`."""
    session = started_carried(golden(name))
    steps = list(session.replay(sample.reading for sample in golden(name)))
    return session.map, steps


def error(map: Map, log: InMemorySource) -> float:
    return ate(map.trajectory(), log.truth)


def odometry_error(log: InMemorySource) -> float:
    return ate(integrate(log.motion[:, :3]), log.truth)


def cuts(map: Map) -> list[int]:
    """Frames before which the odometry was cut; in these scenes every row is a frame."""
    return np.flatnonzero(map.arrays()["graph/cut"] >= 0).tolist()


def golden(name: str) -> InMemorySource:
    return read_trace(GOLDEN / f"{name}.npz")


@pytest.mark.parametrize(
    ("trace", "limit", "broken"),
    [
        ("a_square3", 0.02, []),
        pytest.param("b_figure8_alias", 0.03, [], marks=pytest.mark.soak),
        ("e_kidnap", 0.08, [127]),
        pytest.param("c_corridor_wrap", None, [], marks=pytest.mark.soak),
        ("d1_rotation_generic", None, []),
        pytest.param("j_reverse_stop", None, [], marks=pytest.mark.soak),
    ],
)
def test_one_setting_maps_every_trace(trace, limit, broken):
    log = golden(trace)
    found, _ = carried_steps(trace)
    assert error(found, log) <= (limit or 1.05 * odometry_error(log) + 0.02)
    assert cuts(found) == broken


@pytest.mark.parametrize("trace", [pytest.param("a_square3", marks=pytest.mark.soak), "e_kidnap"])
def test_a_map_is_cut_only_if_the_robot_may_be_carried(trace):
    """A map that would not be cut is the same with either setting."""
    plain, carried = golden_map(trace), carried_steps(trace)[0]
    assert cuts(plain) == []
    assert len(plain.pieces()) == len(carried.pieces()) == len(golden(trace).views)
    assert not plain.pieces().any()
    assert not carried.pieces().any()  # the sequence that shows the cut joins the parts
    assert np.array_equal(plain.trajectory(), carried.trajectory()) == (not cuts(carried))


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(10))
def test_regenerated_streams_behave_as_the_published_ones(seed):
    stream = np.random.default_rng(100 + seed)
    jumps = tuple(
        (int(stream.integers(*rows)), int(stream.integers(20, 100))) for rows in ((122, 160), (210, 260))
    )
    square, eight = scenes.square(seed), scenes.figure_eight(seed)
    kidnapped = scenes.square(seed + 50, laps=4, jumps=jumps)
    assert error(map_log(square), square) <= 0.02
    assert error(map_log(eight), eight) <= 0.03
    found = map_carried(kidnapped)
    assert error(found, kidnapped) <= 0.08
    assert cuts(found) == [row for row, _ in jumps]


@pytest.mark.soak
@pytest.mark.parametrize("seed", [1, 2])
def test_a_perturbed_recording_is_mapped_as_well(seed):
    log = perturb(golden("b_figure8_alias"), seed)
    assert error(map_log(log), log) <= 0.05


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.soak)])
def test_an_unknown_corridor_stays_odometry(seed):
    log = scenes.corridor(seed)
    found = map_log(log)
    assert len(found.closures()) == 0
    assert error(found, log) == pytest.approx(odometry_error(log), abs=1e-9)


@pytest.mark.soak
def test_a_lap_in_the_opposite_direction_is_closed_where_it_turns():
    # The return path has other views (another heading), so only equal headings may close.
    there = [(0.05, 0.0)] * 30 + [(0.0, np.pi / 18)] * 18
    log = scenes.sensed(scenes.followed(there * 8), 3)
    found = map_log(log)
    assert error(found, log) <= 0.05
    pairs = found.closures()
    assert len(pairs) > 20
    assert np.hypot(*(log.truth[pairs[:, 0]] - log.truth[pairs[:, 1]])[:, :2].T).max() < 0.25


# Controls


def shuffled(log: InMemorySource) -> InMemorySource:
    return replace(log, views=np.random.default_rng(0).permutation(log.views))


def blank(log: InMemorySource) -> InMemorySource:
    return replace(log, views=np.zeros_like(log.views))


def alike(log: InMemorySource) -> InMemorySource:
    return replace(log, views=np.broadcast_to(log.views[:1], log.views.shape).copy())


def different(log: InMemorySource) -> InMemorySource:
    return replace(log, views=np.random.default_rng(0).random(log.views.shape))


@pytest.mark.parametrize("control", [shuffled, blank, alike, different])
def test_views_without_information_give_no_closures(control):
    log = control(golden("a_square3"))
    found = map_log(log)
    assert len(found.closures()) == 0
    assert error(found, log) == pytest.approx(odometry_error(log), abs=1e-9)


@pytest.mark.parametrize("factor", [pytest.param(0.5, marks=pytest.mark.soak), 2.0])
def test_the_sensors_unit_does_not_matter(factor):
    log = golden("a_square3")
    scaled = replace(log, views=log.views * factor)
    first, second = golden_map("a_square3"), map_log(scaled)
    assert np.array_equal(first.trajectory(), second.trajectory())
    assert np.array_equal(first.candidates(), second.candidates())


@pytest.mark.soak
def test_single_precision_maps_as_well():
    log = golden("b_figure8_alias")
    found = map_log(log, "float32")
    assert error(found, log) <= 0.03
    assert np.isfinite(found.trajectory()).all()
    assert np.isfinite(found.candidates()[:, 3:5]).all()


# Evidence beside the map


def test_a_kidnapped_robot_is_reported_lost_and_then_localised():
    _, steps = carried_steps("e_kidnap")
    lost = np.array([bool(step.estimate.lost) for step in steps])
    assert not lost[:127].any()
    assert lost[140:155].all()
    assert not lost[-60:].any()


def test_a_closure_sequence_can_be_undone():
    log = golden("a_square3")
    frames = started(log).map
    frames.restore(golden_map("a_square3").arrays())
    accepted = np.unique(frames.candidates()[frames.candidates()[:, 7] == Verdict.ACCEPTED, 5]).astype(int)
    before, path = frames.closures(), frames.trajectory()
    frames.undo(int(accepted[0]))
    assert len(frames.closures()) < len(before)
    assert not np.array_equal(frames.trajectory(), path)
    with pytest.raises(ValueError, match="not an accepted closure sequence"):
        frames.undo(int(accepted[0]))
    for sequence in accepted[1:]:
        frames.undo(int(sequence))
    assert len(frames.closures()) == 0
    reckoned = odometry_error(log)
    assert error(frames, log) == pytest.approx(reckoned, rel=0.05)


def test_the_spread_grows_along_the_path_and_falls_at_a_closure():
    log = golden("a_square3")
    session = started(log)
    rows, at = list(log), {}
    for start in range(0, 180, 20):
        list(session.replay(sample.reading for sample in rows[start : start + 20]))
        at[start + 20] = np.sqrt(np.linalg.eigvalsh(session.map.covariance()[:2, :2]).max())
    assert at[20] < at[60] < at[100]
    assert at[180] < at[100]  # the second lap is recognised


def test_standing_still_adds_no_keyframes():
    session = started(golden("a_square3"))
    still = observation(Odometry(0.0, 0.0, 0.0, 0.1), np.full((3, 6, 1), 0.5))
    list(session.replay(still for _ in range(300)))
    assert len(session.map.arrays()["graph/pose"]) == 1
    assert session.map.graph().number_of_nodes() == 1
