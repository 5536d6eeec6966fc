"""A map that is likely wrong gives odometry as its best estimate; it doubts alike live and in replay."""

from __future__ import annotations

import json

import numpy as np
import pytest

from evaluation.artifacts.run_reader import read_run
from evaluation.metrics import run_metrics
from evaluation.metrics.scorecard import render_health, render_warnings, score_run
from evaluation.metrics.trajectory import ate
from evaluation.papers.tables.spoilt_maps import solved_anew, spoil
from ratslam.core.backend import NO_CLOSURE
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.map_solution import DOUBTED, worse_than_odometry
from tactile.base.se2 import compose, integrate, inverse
from tests.ratslam.runs.test_recall_maps import golden, golden_map, map_log, started

NAME = "b_figure8_alias"


def test_a_clean_map_is_its_own_best_estimate():
    map = golden_map(NAME)
    assert map.final_doubt() < 0.2
    assert np.array_equal(map.trajectory(), map.map_trajectory())


def test_a_map_with_false_loops_only_is_doubted():
    log, map = golden(NAME), golden_map(NAME)
    graph, final, truth = map.keyframes(), map.solution(), log.truth[map.keyframe_steps()]
    false = spoil(graph, final.log, truth, np.random.default_rng(0), kept=0.0, choices=300)
    assert worse_than_odometry(graph, solved_anew(graph, false, final, robust=False)) > DOUBTED


def test_odometry_is_the_best_estimate_of_a_doubted_map(monkeypatch):
    monkeypatch.setattr("ratslam.mapping.map.worse_than_odometry", lambda graph, solution: 0.9)
    log = golden(NAME)
    map = map_log(log)
    assert map.final_doubt() == 0.9
    odometry = integrate(log.motion[:, :3])
    assert ate(map.trajectory(), odometry) < 1e-9
    start = map.trajectory()[0]
    assert np.allclose(map.trajectory(), compose(compose(start, inverse(odometry[0])), odometry), atol=1e-9)
    assert not len(map.closures())
    assert not (map.candidates()[:, 7] == Verdict.ACCEPTED).any()
    assert len(map.solution().log.accepted_pairs())
    assert ate(map.map_trajectory(), log.truth) < ate(map.trajectory(), log.truth)


@pytest.mark.soak
def test_the_doubt_is_the_same_live_and_in_replay():
    log = golden(NAME)
    readings = [sample.reading for sample in log]
    replayed = [step.doubt for step in started(log).replay(readings)]
    session = started(log)
    assert [session.step(reading).doubt for reading in readings] == replayed
    assert len(set(replayed)) > 2


@pytest.mark.parametrize("warnings", [[], ["a wild pose"], [f"gap {k}" for k in range(13)]])
@pytest.mark.parametrize(
    ("doubt", "words"),
    [
        (0.03, "map 97% likely no worse than odometry"),
        (0.0, "map 100% likely no worse than odometry"),
        (0.8, "map_doubted, 80% likely worse than odometry, which is given instead"),
        (None, NO_CLOSURE),
    ],
)
def test_the_health_of_a_run_is_told(tmp_path, doubt, words, warnings):
    """Of its input and of its map; a warning does not change the probability."""
    pose = "0.0 0.0 0.0 0.0 0.0 0.0 1.0"
    for name in ("online.tum", "odometry.tum", "truth.tum"):
        (tmp_path / name).write_text(f"0.0 {pose}\n1.0 {pose}\n")
    (tmp_path / "steps.csv").write_text("t,place\n0.0,-1\n1.0,-1\n")
    assert render_health(score_run(read_run(tmp_path))).endswith("not judged before the end of the run")
    (tmp_path / "health.json").write_text(json.dumps({"worse_than_odometry": doubt, "reason": words}))
    manifest = {"status": "complete", "recording": {"samples": 2}, "continued": False}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest | {"input": {"warnings": warnings}}))
    card = score_run(read_run(tmp_path))
    assert card.quantities["map_doubt"].value == card.health.worse_than_odometry == doubt
    count = {0: "clean", 1: "warned (1 warning)", 13: "warned (13 warnings)"}[len(warnings)]
    assert render_health(card) == f"health: input {count}; {words}"
    assert len(render_warnings(card)) == min(len(warnings), 11)
    assert len(set(render_warnings(card))) == len(render_warnings(card))


def test_both_sides_doubt_alike():
    assert run_metrics.DOUBTED == DOUBTED
