"""Whole maps by recall: sequences that classic matching distorts are mapped, ambiguous ones stay odometry; a
map that is likely wrong gives odometry as its best estimate."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from evaluation.artifacts.run_reader import read_run
from evaluation.metrics import run_metrics
from evaluation.metrics.scorecard import render_health, render_warnings, score_run
from evaluation.metrics.trajectory import ate
from evaluation.papers.tables.spoilt_maps import solved_anew, spoil
from ratslam.core.backend import NO_CLOSURE, Map
from ratslam.core.session import Session, Step
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.map_solution import DOUBTED, worse_than_odometry
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from robot.recordings.npz_trace import read_trace
from robot.sources.in_memory import InMemorySource
from tactile.base.se2 import compose, integrate, inverse
from tactile.base.types import Odometry, observation
from tests.helpers import scenes

ALIAS = "b_figure8_alias"


@cache
def session_of(view_shape: tuple[int, ...], cell_size: float | None, **keyframes: bool) -> Session:
    """A session with one setting for all, on pose cells small enough for a test, compiled once."""
    cells = {"pose_cells": {"cells_xy": 11, "cell_size": cell_size}}
    config = RecallBackendConfig.model_validate({**cells, "keyframes": keyframes})
    return Session(RecallBackend(config, view_shape, np.dtype("float64")), reserve=512)


def started(log: InMemorySource, **keyframes: bool) -> Session:
    session = session_of(log.view_shape, log.info.cell_size, **keyframes)
    session.restart()
    return session


@cache
def replayed(log: InMemorySource, **keyframes: bool) -> tuple[Map, list[Step]]:
    """The map of a log, and the steps; tests share it and do not change it."""
    session = started(log, **keyframes)
    steps = list(session.replay(sample.reading for sample in log))
    return session.map, steps


def map_log(log: InMemorySource, **keyframes: bool) -> Map:
    return replayed(log, **keyframes)[0]


def error(map: Map, log: InMemorySource) -> float:
    return ate(map.trajectory(), log.truth)


def odometry_error(log: InMemorySource) -> float:
    return ate(integrate(log.motion[:, :3]), log.truth)


def cuts(map: Map) -> list[int]:
    """Frames before which the odometry was cut; in these scenes every row is a frame."""
    return np.flatnonzero(map.arrays()["graph/cut"] >= 0).tolist()


@cache
def golden(name: str) -> InMemorySource:
    return read_trace(Path(__file__).parents[2] / "golden" / f"{name}.npz")


@pytest.mark.parametrize(("trace", "limit", "broken"), [
    ("a_square3", 0.02, []),
    pytest.param("b_figure8_alias", 0.03, [], marks=pytest.mark.soak),
    ("e_kidnap", 0.08, [127]),
    pytest.param("c_corridor_wrap", None, [], marks=pytest.mark.soak),
    ("d1_rotation_generic", None, []),
    pytest.param("j_reverse_stop", None, [], marks=pytest.mark.soak),
])  # fmt: skip
def test_one_setting_maps_every_trace(trace, limit, broken):
    log = golden(trace)
    found = map_log(log, may_be_carried=True)
    assert error(found, log) <= (limit or 1.05 * odometry_error(log) + 0.02)
    assert cuts(found) == broken


@pytest.mark.parametrize("trace", ["a_square3", "e_kidnap"])
def test_a_map_is_cut_only_if_the_robot_may_be_carried(trace):
    """A map that would not be cut is the same with either setting."""
    plain, carried = map_log(golden(trace)), map_log(golden(trace), may_be_carried=True)
    assert cuts(plain) == []
    assert len(plain.pieces()) == len(carried.pieces()) == len(golden(trace).views)
    assert not plain.pieces().any()
    assert not carried.pieces().any()  # the sequence that shows the cut joins the parts
    assert np.array_equal(plain.trajectory(), carried.trajectory()) == (not cuts(carried))


CONTROLS = {
    "shuffled": lambda views: np.random.default_rng(0).permutation(views),
    "blank": np.zeros_like,
    "alike": lambda views: np.broadcast_to(views[:1], views.shape).copy(),
    "different": lambda views: np.random.default_rng(0).random(views.shape),
}


@pytest.mark.parametrize("control", [*CONTROLS, "an unknown corridor"])
def test_views_without_information_give_no_closures(control):
    log = golden("a_square3")
    log = replace(log, views=CONTROLS[control](log.views)) if control in CONTROLS else scenes.corridor(1, 200)
    found = map_log(log)
    assert len(found.closures()) == 0
    assert error(found, log) == pytest.approx(odometry_error(log), abs=1e-9)


def test_the_sensors_unit_does_not_matter():
    log = golden("a_square3")
    first, second = map_log(log), map_log(replace(log, views=log.views * 2.0))
    assert np.array_equal(first.trajectory(), second.trajectory())
    assert np.array_equal(first.candidates(), second.candidates())


def test_a_kidnapped_robot_is_lost_and_then_localised_and_one_that_stands_adds_no_keyframes():
    _, steps = replayed(golden("e_kidnap"), may_be_carried=True)
    lost = np.array([bool(step.estimate.lost) for step in steps])
    assert not lost[:127].any()
    assert lost[140:155].all()
    assert not lost[-60:].any()
    session = started(golden("a_square3"))
    still = observation(Odometry(0.0, 0.0, 0.0, 0.1), np.full((3, 6, 1), 0.5))
    list(session.replay(still for _ in range(300)))
    assert (len(session.map.arrays()["graph/pose"]), session.map.graph().number_of_nodes()) == (1, 1)


def test_the_spread_grows_along_the_path_and_falls_at_a_closure():
    log = golden("a_square3")
    session = started(log)
    rows, at = list(log), {}
    for start in range(0, 180, 20):
        list(session.replay(sample.reading for sample in rows[start : start + 20]))
        at[start + 20] = np.sqrt(np.linalg.eigvalsh(session.map.covariance()[:2, :2]).max())
    assert at[20] < at[60] < at[100]
    assert at[180] < at[100]  # the second lap is recognised


CORRIDOR = ([(scenes.STEP, 0.0)] * 120 + [(-scenes.STEP, 0.0)] * 120) * 2


def symmetric(log: InMemorySource) -> InMemorySource:
    return replace(log, views=(log.views + log.views[:, :, ::-1]) / 2)


def longest(map):
    table = map.candidates()
    sequence = np.bincount(table[:, 5].astype(int)).argmax()
    row = table[table[:, 5] == sequence][0]
    return Verdict(int(row[7])), row[9]


def test_a_symmetric_loop_is_closed_with_high_odds():
    log = scenes.sensed(scenes.followed(CORRIDOR), 1)
    plain = map_log(log)
    assert longest(plain)[1] > 100
    found = map_log(symmetric(log))
    verdict, odds = longest(found)
    assert verdict == Verdict.ACCEPTED
    assert odds > 10
    assert len(found.closures()) == pytest.approx(len(plain.closures()), rel=0.05)


def test_a_clean_map_is_its_own_best_estimate_and_one_with_false_loops_only_is_doubted():
    log, map = golden(ALIAS), map_log(golden(ALIAS))
    assert map.final_doubt() < 0.2
    assert np.array_equal(map.trajectory(), map.map_trajectory())
    truth = log.truth[map.keyframe_steps()]
    false = spoil(map.solution(), truth, np.random.default_rng(0), kept=0.0, choices=300)
    assert worse_than_odometry(solved_anew(false, robust=False)) > DOUBTED
    assert run_metrics.DOUBTED == DOUBTED


def test_odometry_is_the_best_estimate_of_a_doubted_map(monkeypatch):
    monkeypatch.setattr("ratslam.mapping.map.worse_than_odometry", lambda solution: 0.9)
    log = golden(ALIAS)
    map, _ = replayed.__wrapped__(log)
    assert map.final_doubt() == 0.9
    odometry = integrate(log.motion[:, :3])
    assert ate(map.trajectory(), odometry) < 1e-9
    start = map.trajectory()[0]
    assert np.allclose(map.trajectory(), compose(compose(start, inverse(odometry[0])), odometry), atol=1e-9)
    assert not len(map.closures())
    assert not (map.candidates()[:, 7] == Verdict.ACCEPTED).any()
    assert len(map.solution().log.accepted_pairs())
    assert ate(map.map_trajectory(), log.truth) < ate(map.trajectory(), log.truth)


@pytest.mark.parametrize(("doubt", "words", "warnings", "count"), [
    (0.03, "map 97% likely no worse than odometry", [], "clean"),
    (0.0, "map 100% likely no worse than odometry", ["a wild pose"], "warned (1 warning)"),
    (0.8, "map_doubted, 80% likely worse than odometry, which is given instead", [], "clean"),
    (None, NO_CLOSURE, [f"gap {k}" for k in range(13)], "warned (13 warnings)"),
])  # fmt: skip
def test_the_health_of_a_run_is_told(tmp_path, doubt, words, warnings, count):
    """Of its input and of its map; a warning does not change the probability."""
    for name in ("online.tum", "odometry.tum", "truth.tum"):
        (tmp_path / name).write_text("".join(f"{k}.0 0.0 0.0 0.0 0.0 0.0 0.0 1.0\n" for k in range(2)))
    (tmp_path / "steps.csv").write_text("t,place\n0.0,-1\n1.0,-1\n")
    assert render_health(score_run(read_run(tmp_path))).endswith("not judged before the end of the run")
    (tmp_path / "health.json").write_text(json.dumps({"worse_than_odometry": doubt, "reason": words}))
    manifest = {"status": "complete", "recording": {"samples": 2}, "continued": False}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest | {"input": {"warnings": warnings}}))
    card = score_run(read_run(tmp_path))
    assert card.quantities["map_doubt"].value == card.health.worse_than_odometry == doubt
    assert render_health(card) == f"health: input {count}; {words}"
    assert len(set(render_warnings(card))) == len(render_warnings(card)) == min(len(warnings), 11)
