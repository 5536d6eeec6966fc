"""The judge of closures: true sequences have higher log-odds than false ones, and what they are worth."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.core.arrays import GrowableArray
from ratslam.mapping.acceptance import AcceptByEvidence
from ratslam.mapping.appearance import LabelAppearance
from ratslam.mapping.closure_judge import (
    AT_ONCE,
    BEYOND,
    KINDS,
    doubt_of_closures,
    judge_anew,
    judge_sequences,
    sequence_evidence,
    shipped_weights,
)
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.loop_closures import UNLIKELY, Candidate, Verdict
from ratslam.mapping.map_solution import DOUBTED
from tests.ratslam.mapping.lap_cases import APPEARANCES, CLEAN, FALSE, LAP, LAPS, closed, drive, solution

FIRST = np.array([0])


class JudgedLabels(LabelAppearance):
    """Ids that count as views with weights."""

    JUDGED = True


@pytest.fixture(params=APPEARANCES)
def graph(request):
    return drive(APPEARANCES[request.param]())


@pytest.fixture
def judged():
    """Laps that are judged, and their clean map."""
    graph = drive(JudgedLabels())
    found = solution(graph, closed(CLEAN))
    graph.pose.rows[:] = found.fit.poses
    return graph, found.log


def cuts(graph, *frames):
    """Breaks of the odometry before keyframes."""
    cut = GrowableArray((), np.int64)
    cut.replace(np.full(graph.count, -1))
    cut.rows[list(frames)] = 0
    return cut


def evidence(graph, log, sequences, cut=None, after=BEYOND):
    fit = solution(graph, log).fit
    return sequence_evidence(graph, fit, log, cuts(graph) if cut is None else cut, sequences, after)


def test_a_true_sequence_has_higher_log_odds_than_a_false_one_of_the_same_map(graph):
    log = closed([*CLEAN, FALSE[1]])
    odds = evidence(graph, log, np.arange(log.sequences)).log_odds(shipped_weights())
    assert odds[:-1].min() > odds[-1]


def test_nothing_is_said_of_a_sequence_across_a_break_of_the_odometry(graph):
    log, every = closed(CLEAN), np.arange(len(CLEAN))
    odds = evidence(graph, log, every, cuts(graph, 2 * LAP + 30)).log_odds(shipped_weights())
    assert list(np.isnan(odds)) == [False, False, True, False]  # before the third and the fourth sequence
    apart = cuts(graph, *(LAP * np.arange(1, LAPS)))
    assert np.isnan(evidence(graph, log, every, apart).log_odds(shipped_weights())).all()


def test_views_count_up_to_a_break_and_no_further_than_the_keyframes_known(graph):
    log = closed(CLEAN)
    whole = evidence(graph, log, FIRST).counts.sum(axis=(2, 3))
    ended = evidence(graph, log, FIRST, after=0).counts.sum(axis=(2, 3))
    assert np.all(ended < whole)
    assert np.all(whole <= 20 + 2 * BEYOND)
    cut = evidence(graph, log, FIRST, cuts(graph, LAP + 30)).counts.sum(axis=(2, 3))
    assert np.all((ended <= cut) & (cut < whole))


def test_judging_changes_nothing_and_gives_the_same_bits_again(judged):
    graph, log = judged
    before = {**graph.arrays(), **log.arrays()}
    first, again = (
        judge_sequences(graph, graph.fit(), log, graph.cut, np.arange(len(CLEAN))) for _ in range(2)
    )
    assert first.tobytes() == again.tobytes()
    after = {**graph.arrays(), **log.arrays()}
    assert all(np.array_equal(before[name], after[name], equal_nan=True) for name in before)


def test_of_views_without_weights_and_of_a_robot_that_may_be_carried_nothing_is_said(judged):
    graph, log = judged
    assert np.isfinite(judge_sequences(graph, graph.fit(), log, graph.cut, FIRST)).all()
    graph.config = graph.config.model_copy(update={"may_be_carried": True})
    assert np.isnan(judge_sequences(graph, graph.fit(), log, graph.cut, FIRST)).all()
    graph = drive(LabelAppearance())
    assert np.isnan(judge_sequences(graph, graph.fit(), closed(CLEAN), graph.cut, FIRST)).all()


def test_a_map_of_false_closures_is_doubted_and_one_of_true_ones_is_not(judged):
    graph, _ = judged
    clean, false = (solution(graph, closed(sequences)) for sequences in (CLEAN, FALSE))
    assert doubt_of_closures(graph, *clean) < 0.1
    assert doubt_of_closures(graph, *false) > DOUBTED
    assert np.isnan(doubt_of_closures(graph, *solution(graph, closed([]))))


def test_an_unlikely_sequence_counts_less_as_its_odds_fall(judged):
    _, log = judged
    log.set_log_odds(np.arange(3), np.array([UNLIKELY + np.log(0.25), UNLIKELY / 2, np.nan]))
    assert log.credit() == pytest.approx([0.25, 1.0, 1.0, 1.0])


def test_a_sequence_that_has_lost_keyframes_keeps_its_log_odds(judged):
    graph, log = judged
    log.set_log_odds(np.arange(len(CLEAN)), np.full(len(CLEAN), -7.0))
    gone = np.zeros(graph.count, bool)
    gone[log.members(1)[0, 0]] = True
    log.merge(gone, np.arange(graph.count), np.zeros(graph.count, bool))
    judge_anew(graph, log, np.arange(len(CLEAN)))
    assert list(log.log_odds() == -7.0) == [False, True, False, False]


@pytest.mark.parametrize(
    ("select_every", "odds", "accepted"), [(50, -1.0, False), (50, 3.0, True), (0, -1.0, True)]
)
def test_an_unlikely_sequence_waits_for_a_selection(monkeypatch, judged, select_every, odds, accepted):
    graph, _ = judged
    graph.config = KeyframeMapConfig(select_every=select_every)
    judge = "ratslam.mapping.acceptance.judge_sequences"
    monkeypatch.setattr(judge, lambda *map_and_sequences: np.array([odds]))
    log = closed(CLEAN[:1])
    log.judge(0, Verdict.OPEN)
    frame, match, shift, _ = log.members(0)[-1].tolist()
    assert AcceptByEvidence().judge(graph, log, 0, Candidate(frame, match, shift, 0.9, 3.0)) is accepted
    assert (odds >= AT_ONCE) == accepted or not select_every


def test_shipped_weights_are_those_of_the_features(judged):
    graph, log = judged
    weights = shipped_weights()
    assert weights.shape == evidence(graph, log, FIRST).features().shape[1:]
    assert np.all(weights[:, 1:3] >= 0)  # what odometry foretells is never evidence against it
    within, around = weights[:, 3 : 3 + KINDS], weights[:, 3 + KINDS :]
    assert np.all(within[:, :2] <= 0)
    assert np.all(around[:, :2] <= 0)  # nor are contradictions evidence for it
