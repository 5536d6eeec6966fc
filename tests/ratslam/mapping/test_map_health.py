"""Health of a map: a map with a false loop is doubted, a clean one is not, whatever the sensor."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping import map_solution as revisits
from ratslam.mapping.appearance import LabelAppearance
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.map_solution import (
    CONTROLS,
    DOUBTED,
    MapSolution,
    claimed_revisits,
    claims_cost,
    health_features,
    worse_than_odometry,
)
from tactile.base.se2 import compose
from tests.ratslam.mapping.lap_cases import (
    APPEARANCES,
    CLEAN,
    FALSE,
    GUARD,
    LAP,
    TRUTH,
    closed,
    drive,
    solution,
)


@pytest.fixture(params=APPEARANCES)
def graph(request):
    return drive(APPEARANCES[request.param]())


def test_a_map_of_true_closures_is_not_doubted(graph):
    assert worse_than_odometry(graph, solution(graph, closed(CLEAN))) < 0.2


def test_a_map_with_false_loops_is_doubted(graph):
    assert worse_than_odometry(graph, solution(graph, closed(FALSE))) > DOUBTED
    clean, false = (health_features(graph, solution(graph, closed(rows))) for rows in (CLEAN, FALSE))
    assert clean[0] > false[0]
    assert clean[2] < false[2]


def test_a_map_without_closures_is_odometry_and_not_doubted(graph):
    log = closed(FALSE)
    for sequence in range(log.sequences):
        log.judge(sequence, Verdict.OPEN)
    assert np.isnan(worse_than_odometry(graph, MapSolution.solved(graph, log)))


def test_closures_of_little_weight_are_closures(graph):
    found = solution(graph, closed(CLEAN))
    found.log.weigh(np.full(len(CLEAN), 0.1))
    assert np.isfinite(worse_than_odometry(graph, found))


def test_true_poses_claim_revisits_that_the_views_confirm(graph):
    frame, match, rank, examined = claimed_revisits(graph, TRUTH, 300)
    assert examined == len(TRUTH) - GUARD - 1
    assert len(frame) > 2 * LAP
    assert rank.mean() > 0.8
    assert np.all(frame - match > GUARD)


def test_each_pass_is_a_claim_of_its_own(graph):
    frame, *_ = claimed_revisits(graph, TRUTH, 300)
    assert np.count_nonzero(frame == 4 * LAP + 10) == 4


def test_poses_alike_by_chance_are_not_borne_out():
    """Views without information are as like here as elsewhere."""
    graph = drive(LabelAppearance(), places=1)
    assert np.all(claimed_revisits(graph, TRUTH, 300)[2] == 0.5)


TURNED_LAPS = np.stack([TRUTH[(k + 7 * (k // LAP)) % LAP] for k in range(len(TRUTH))])
"""Poses by which every lap begins seven places ahead of the one before."""


def test_right_poses_cost_less_than_wrong_ones(graph):
    right, wrong = claims_cost(graph, TRUTH), claims_cost(graph, TURNED_LAPS)
    false = claims_cost(graph, solution(graph, closed(FALSE)).fit.poses)
    assert right < 0 < wrong
    assert right < false
    assert claims_cost(graph, solution(graph, closed(CLEAN)).fit.poses) < false


def test_poses_that_claim_nothing_cost_nothing(graph):
    apart = TRUTH + np.arange(len(TRUTH))[:, None] * [1.0, 0.0, 0.0]
    assert claims_cost(graph, apart) == 0.0
    assert claims_cost(graph, TRUTH[: GUARD + 1]) == 0.0


@pytest.mark.parametrize("poses", [TRUTH, TURNED_LAPS], ids=["right", "wrong"])
@pytest.mark.parametrize("motion", [(3.0, -2.0, 0.0), (0.0, 0.0, 2.0), (-1.0, 5.0, -3.0)])
def test_a_map_moved_as_a_whole_costs_the_same(graph, poses, motion):
    moved = compose(np.array(motion), poses)
    assert claims_cost(graph, moved) == pytest.approx(claims_cost(graph, poses), rel=1e-9)


def test_the_cost_is_that_of_all_keyframes_however_many_are_examined(graph, monkeypatch):
    cost = claims_cost(graph, TRUTH)
    monkeypatch.setattr(revisits, "JUDGED", 60)
    assert claims_cost(graph, TRUTH) == pytest.approx(cost, rel=0.1)


def test_the_statistics_do_not_depend_on_where_the_map_lies(graph):
    clean = solution(graph, closed(CLEAN))
    moved = clean._replace(fit=clean.fit._replace(poses=compose(np.array([3.0, -2.0, 0.0]), clean.fit.poses)))
    assert health_features(graph, moved) == pytest.approx(health_features(graph, clean), abs=1e-6)


def test_controls_lie_among_older_keyframes():
    assert np.all((CONTROLS > 0) & (CONTROLS < 1))


def test_dead_reckoning_adds_up_raw_odometry(graph):
    graph.bias = 0.3
    assert graph.dead_reckoned() == pytest.approx(graph.pose.rows)
