"""Whether closures and maps are believed, on laps with true and false closures, whatever the sensor."""

import numpy as np
import pytest

from ratslam.core.arrays import GrowableArray
from ratslam.mapping import closure_judge, map_solution
from ratslam.mapping.acceptance import AcceptByEvidence
from ratslam.mapping.appearance import Appearance, LabelAppearance, ViewAppearance
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.loop_closures import UNLIKELY, Candidate, ClosureLog, Verdict
from ratslam.mapping.map_solution import DOUBTED, claimed_revisits, claims_cost, worse_than_odometry
from ratslam.mapping.map_state import NO_ROBUST_SCALE, MapState
from ratslam.mapping.optimizer import solve
from tactile.base.se2 import between, compose
from tactile.base.types import Odometry, observation
from tests.helpers.laps import square
from tests.ratslam.mapping.map_cases import add, at_fit, new_graph, with_log

CELL, GUARD, LAP, SIZE, LAPS = 0.05, 20, 48, 12, 5
TRUTH = square("A" * LAPS)
DRIFT = 0.004  # heading error of the odometry, rad a step
APPEARANCES = {"ids": LabelAppearance, "views": lambda: ViewAppearance(SIZE, None)}


def drive_laps(appearance: Appearance, places: int = LAP) -> MapState:
    """Keyframes on laps around a square of so many places that look different, by odometry that turns."""
    graph, looks = new_graph(CELL, GUARD, appearance), np.random.default_rng(0).random((LAP, SIZE))
    for k in range(len(TRUTH)):
        motion = between(TRUTH[k - 1], TRUTH[k]) + [0, 0, DRIFT] if k else np.zeros(3)
        add(graph, motion, None if k else TRUTH[0])
        reading = observation(Odometry(*motion, 0.1), looks[k % places, None, :, None], label=k % places)
        appearance.append(reading, motion[2], float(np.hypot(*motion[:2])))
    return graph


def closed(sequences: list[tuple[int, int, int]]) -> ClosureLog:
    """A log of accepted sequences: first keyframe, first match, number of closures."""
    log = ClosureLog()
    for frame, match, count in sequences:
        log.add_accepted(Candidate(frame + k, match + k, 0, 0.9, 3.0) for k in range(count))
    return log


def solution(graph: MapState, log: ClosureLog) -> MapState:
    """The map with these closures, none of which loses weight."""
    problem = with_log(graph, log, graph.cut).problem()
    scale = np.full_like(problem.closures.scale, NO_ROBUST_SCALE)
    problem = problem._replace(closures=problem.closures._replace(scale=scale))
    return at_fit(graph, solve(graph.fit(), problem, 60), log, graph.cut)


CLEAN = [(LAP * lap + 5, LAP * (lap - 1) + 5, 20) for lap in range(1, LAPS)]
FIRST, EVERY = np.array([0]), np.arange(len(CLEAN))
FALSE = [(LAP * 2, 12, 30), (LAP * 3 + 5, 30, 30)]
TURNED_LAPS = np.stack([TRUTH[(k + 7 * (k // LAP)) % LAP] for k in range(len(TRUTH))])
"""Poses by which every lap begins seven places ahead of the one before."""


class JudgedLabels(LabelAppearance):
    """Ids that count as views with weights."""

    JUDGED = True


@pytest.fixture(params=APPEARANCES)
def graph(request):
    return drive_laps(APPEARANCES[request.param]())


@pytest.fixture
def judged():
    """Laps that are judged, and their clean map."""
    graph = drive_laps(JudgedLabels())
    found = solution(graph, closed(CLEAN))
    graph.pose.rows[:] = found.pose.rows
    return graph, found.log


def evidence(graph, log, sequences, cut=(), after=closure_judge.BEYOND):
    """The evidence on sequences where the odometry breaks before keyframes `cut`."""
    breaks = GrowableArray((), np.int64)
    breaks.replace(np.where(np.isin(np.arange(graph.count), cut), 0, -1))
    found = at_fit(graph, solution(graph, log).fit(), log, breaks)
    return closure_judge.sequence_evidence(found, sequences, after)


def log_odds(*case):
    return evidence(*case).log_odds(closure_judge.shipped_weights())


def judged_odds(graph, log, sequences=FIRST):
    return closure_judge.judge_sequences(at_fit(graph, graph.fit(), log, graph.cut), sequences)


def test_a_true_sequence_has_higher_log_odds_than_a_false_one_and_none_across_a_break_of_the_odometry(graph):
    odds = log_odds(graph, closed([*CLEAN, FALSE[1]]), np.arange(len(CLEAN) + 1))
    assert odds[:-1].min() > odds[-1]
    broken = np.isnan(log_odds(graph, closed(CLEAN), EVERY, [2 * LAP + 30]))
    assert list(broken) == [False, False, True, False]  # before the third and the fourth sequence
    assert np.isnan(log_odds(graph, closed(CLEAN), EVERY, LAP * np.arange(1, LAPS))).all()


def test_views_count_up_to_a_break_and_no_further_than_the_keyframes_known(graph):
    cases = [evidence(graph, closed(CLEAN), FIRST, *case) for case in ((), ((), 0), ([LAP + 30],))]
    whole, ended, cut = (case.counts.sum(axis=(2, 3)) for case in cases)
    assert np.all((ended < whole) & (whole <= 20 + 2 * closure_judge.BEYOND))
    assert np.all((ended <= cut) & (cut < whole))


def test_judging_changes_nothing_and_is_silent_on_views_without_weights_or_carried_robots(judged):
    graph, log = judged
    before = {**graph.arrays(), **log.arrays()}
    first, again = (judged_odds(graph, log, EVERY) for _ in range(2))
    assert first.tobytes() == again.tobytes()
    after = {**graph.arrays(), **log.arrays()}
    assert all(np.array_equal(before[name], after[name], equal_nan=True) for name in before)
    assert np.isfinite(first[0])
    graph.config = graph.config.model_copy(update={"may_be_carried": True})
    assert np.isnan(judged_odds(graph, log)).all()
    assert np.isnan(judged_odds(drive_laps(LabelAppearance()), closed(CLEAN))).all()


def test_closures_of_a_false_map_are_doubted_and_those_of_a_true_one_are_not(judged):
    graph, _ = judged
    clean, false = (solution(graph, closed(sequences)) for sequences in (CLEAN, FALSE))
    assert closure_judge.doubt_of_closures(clean) < 0.1 < DOUBTED < closure_judge.doubt_of_closures(false)
    assert np.isnan(closure_judge.doubt_of_closures(solution(graph, closed([]))))


def test_a_map_that_odometry_excludes_is_doubted_unless_it_may_be_as_noisy_as_that(judged, monkeypatch):
    """However well all views agree. Odometry gives the false sequences R of -10 and -58: a factor of two and
    a half on its noise, which has log odds of -3.4, takes them to -1.6 and -9."""
    graph, _ = judged
    clean, false = (solution(graph, closed(sequences)) for sequences in (CLEAN, FALSE))
    for odds, doubted in ((1.0, True), (8.0, False)):
        agreed = np.zeros_like(closure_judge.shipped_weights())
        agreed[:, 0] = odds  # L of every sequence
        monkeypatch.setattr(closure_judge, "shipped_weights", lambda agreed=agreed: agreed)
        assert closure_judge.doubt_of_closures(clean) < 0.1
        assert (closure_judge.doubt_of_closures(false) > DOUBTED) == doubted


def test_a_sequence_that_has_lost_keyframes_keeps_its_log_odds_and_counts_less_as_they_fall(judged):
    graph, log = judged
    log.set_log_odds(EVERY, np.full(len(CLEAN), -7.0))
    number = np.arange(graph.count)
    log.merge(number == log.members(1)[0, 0], number, number < 0)
    closure_judge.judge_anew(with_log(graph, log), EVERY)
    assert list(log.log_odds() == -7.0) == [False, True, False, False]
    log.set_log_odds(np.arange(3), np.array([UNLIKELY + np.log(0.25), UNLIKELY / 2, np.nan]))
    assert log.credit() == pytest.approx([0.25, 1.0, 1.0, 1.0])


@pytest.mark.parametrize(("every", "odds", "accepted"), [(50, -1.0, False), (50, 3.0, True), (0, -1.0, True)])
def test_an_unlikely_sequence_waits_for_a_selection(monkeypatch, judged, every, odds, accepted):
    graph, _ = judged
    graph.config = KeyframeMapConfig(select_every=every)
    monkeypatch.setattr("ratslam.mapping.acceptance.judge_sequences", lambda *_: np.array([odds]))
    log = closed(CLEAN[:1])
    log.judge(0, Verdict.OPEN)
    assert AcceptByEvidence().judge(with_log(graph, log), 0, log.last()) is accepted
    assert (odds >= closure_judge.AT_ONCE) == accepted or not every


def test_shipped_weights_are_those_of_the_features(judged):
    graph, log = judged
    weights = closure_judge.shipped_weights()
    assert weights.shape == evidence(graph, log, FIRST).features().shape[1:]
    assert np.all(weights[:, 1:3] >= 0)  # what odometry foretells is never evidence against it
    contradictions = np.array([3, 4, 3 + closure_judge.KINDS, 4 + closure_judge.KINDS])
    assert np.all(weights[:, contradictions] <= 0)  # nor are they evidence for it


def test_a_map_with_false_loops_is_doubted_and_one_of_true_closures_is_not(graph):
    clean, false = (solution(graph, closed(rows)) for rows in (CLEAN, FALSE))
    assert worse_than_odometry(clean) < 0.2 < DOUBTED < worse_than_odometry(false)
    true, wrong = (map_solution.health_features(found) for found in (clean, false))
    assert true[0] > wrong[0]
    assert true[2] < wrong[2]
    moved = clean.trial()
    moved.pose.rows[:] = compose(np.array([3.0, -2.0, 0.0]), clean.pose.rows)
    assert map_solution.health_features(moved) == pytest.approx(true, abs=1e-6)
    clean.log.weigh(np.full(len(CLEAN), 0.1))
    assert np.isfinite(worse_than_odometry(clean))  # closures of little weight are closures
    for sequence in range(false.log.sequences):
        false.log.judge(sequence, Verdict.OPEN)
    assert np.isnan(worse_than_odometry(with_log(graph, false.log).solved()))  # and none are none


def test_true_poses_claim_revisits_that_the_views_confirm(graph):
    frame, match, rank, examined = claimed_revisits(graph, TRUTH, 300)
    assert examined == len(TRUTH) - GUARD - 1
    assert len(frame) > 2 * LAP
    assert rank.mean() > 0.8
    assert np.all(frame - match > GUARD)
    assert np.count_nonzero(frame == 4 * LAP + 10) == 4  # each pass is a claim of its own
    alike = drive_laps(LabelAppearance(), places=1)  # views without information bear nothing out
    assert np.all(claimed_revisits(alike, TRUTH, 300)[2] == 0.5)


def test_right_poses_cost_less_than_wrong_ones_and_those_that_claim_nothing_nothing(graph, monkeypatch):
    right, wrong = claims_cost(graph, TRUTH), claims_cost(graph, TURNED_LAPS)
    false = claims_cost(graph, solution(graph, closed(FALSE)).pose.rows)
    assert right < 0 < wrong
    assert right < false
    assert claims_cost(graph, solution(graph, closed(CLEAN)).pose.rows) < false
    for poses, cost in ((TRUTH, right), (TURNED_LAPS, wrong)):  # wherever the map lies
        elsewhere = compose(np.array([-1.0, 5.0, -3.0]), poses)
        assert claims_cost(graph, elsewhere) == pytest.approx(cost, rel=1e-9)
    apart = TRUTH + np.arange(len(TRUTH))[:, None] * [1.0, 0.0, 0.0]
    assert claims_cost(graph, apart) == claims_cost(graph, TRUTH[: GUARD + 1]) == 0.0
    monkeypatch.setattr("ratslam.mapping.map_solution.JUDGED", 60)  # however many keyframes are examined
    assert claims_cost(graph, TRUTH) == pytest.approx(right, rel=0.1)
