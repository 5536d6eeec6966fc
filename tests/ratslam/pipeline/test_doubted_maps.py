"""A map that is likely wrong gives odometry as its best estimate; it doubts alike live and in replay."""

from __future__ import annotations

import json

import numpy as np
import pytest

from evaluation.artifacts.run_directory import read_run
from evaluation.metrics import run_metrics
from evaluation.metrics.scorecard import render_health, score_run
from evaluation.metrics.trajectory import ate
from ratslam.experiments.trials.spoilt_maps import Recipe, solved_anew, spoil
from ratslam.keyframes.map_health import DOUBTED, worse_than_odometry
from tactile.base.se2 import integrate
from tests.ratslam.pipeline.test_recall_maps import golden, golden_map, map_log, started

NAME = "b_figure8_alias"


def test_a_clean_map_is_its_own_best_estimate():
    map = golden_map(NAME)
    assert map.final_doubt() < 0.2
    assert np.array_equal(map.trajectory(), map.map_trajectory())


def test_a_map_with_false_loops_only_is_doubted():
    log, map = golden(NAME), golden_map(NAME)
    graph, final, truth = map.keyframes(), map.solution(), log.truth[map.keyframe_steps()]
    recipe = Recipe("only false", kept=0.0, false=True, robust=False)
    false = spoil(graph, final.log, truth, recipe, np.random.default_rng(0))
    assert worse_than_odometry(graph, solved_anew(graph, false, final, robust=False)) > DOUBTED


def test_odometry_is_the_best_estimate_of_a_doubted_map(monkeypatch):
    monkeypatch.setattr("ratslam.keyframes.map.worse_than_odometry", lambda graph, solution: 0.9)
    log = golden(NAME)
    map = map_log(log)
    assert map.final_doubt() == 0.9
    assert ate(map.trajectory(), integrate(log.motion[:, :3])) < 1e-9  # in the frame of the map
    assert ate(map.map_trajectory(), log.truth) < ate(map.trajectory(), log.truth)


@pytest.mark.soak
def test_the_doubt_is_the_same_live_and_in_replay():
    log = golden(NAME)
    readings = [sample.reading for sample in log]
    replayed = [step.doubt for step in started(log).replay(readings)]
    session = started(log)
    assert [session.step(reading).doubt for reading in readings] == replayed
    assert len(set(replayed)) > 2


@pytest.mark.parametrize(("doubt", "words"), [(0.03, "97% likely no worse"), (0.8, "map_doubted, 80%")])
def test_the_health_of_a_run_is_told(tmp_path, doubt, words):
    pose = "0.0 0.0 0.0 0.0 0.0 0.0 1.0"
    for name in ("online.tum", "odometry.tum", "truth.tum"):
        (tmp_path / name).write_text(f"0.0 {pose}\n1.0 {pose}\n")
    (tmp_path / "steps.csv").write_text("t,place\n0.0,-1\n1.0,-1\n")
    assert render_health(score_run(read_run(tmp_path))) == ""
    (tmp_path / "health.json").write_text(json.dumps({"worse_than_odometry": doubt}))
    card = score_run(read_run(tmp_path))
    assert card.quantities["map_doubt"].value == doubt
    assert words in render_health(card)


def test_both_sides_doubt_alike():
    assert run_metrics.DOUBTED == DOUBTED
