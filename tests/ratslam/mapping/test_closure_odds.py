"""Acceptance of closure sequences by their odds: on a wide circle that the robot drives twice, with recall
written by hand."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ratslam.mapping.acceptance import MIN_LOG_ODDS, AcceptByEvidence
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.optimizer import CalibrationPrior
from tactile.base.se2 import correct_heading, integrate
from tests.ratslam.mapping.map_cases import CELL, LAP, TRUE, drive, new_map, same, sequence, with_log


def by_evidence(graph):
    return AcceptByEvidence()


def many(starts, length, ratio):
    """Sequences at these keyframes that find the place of 40 keyframes before, where odometry never leads."""
    return {k: v for start in starts for k, v in sequence(start, start - 40, length, ratio).items()}


FALSE = sequence(LAP - 20, 0, 4, 4.0)
"""The beginning of the lap, seen too early: within the reach of the heading bias, and wrong."""
DECOYS = many(range(50, 185, 7), 4, 4.0)
BOTH = FALSE | TRUE


@cache
def loop_map():
    """The map of the true sequence; tests share it and do not change it."""
    return drive(new_map(), TRUE)


@cache
def alias_map():
    """The same of the true sequence and the false one."""
    return drive(new_map(), BOTH)


def verdicts(map):
    """Verdict and log odds of every sequence."""
    table = map.candidates()
    return {int(row[5]): (Verdict(int(row[7])), float(row[9])) for row in table}


def test_an_alias_that_the_covariance_allows_is_refused():
    """Evidence and covariance accept the alias, and then refuse the true sequence that contradicts it."""
    before, after = drive(new_map(by_evidence), BOTH), alias_map()
    assert [verdict for verdict, _ in verdicts(before).values()] == [Verdict.ACCEPTED, Verdict.OPEN]
    assert [verdict for verdict, _ in verdicts(after).values()] == [Verdict.OPEN, Verdict.ACCEPTED]
    assert np.hypot(*(after.trajectory()[LAP + 5] - after.trajectory()[5])[:2]) < CELL


def test_false_sequences_raise_the_evidence_that_is_needed():
    strong, longer = sequence(LAP + 2, 2, 12, 2.0), sequence(LAP + 2, 2, 30, 4.0)
    alone, among = drive(new_map(), strong), drive(new_map(), DECOYS | strong)
    assert [verdict for verdict, _ in verdicts(alone).values()] == [Verdict.ACCEPTED]
    assert {verdict for verdict, _ in verdicts(among).values()} == {Verdict.OPEN}
    assert len(among.closures()) == 0
    (_, before), *_, (_, after) = *verdicts(alone).values(), *verdicts(among).values()
    assert after < min(before, MIN_LOG_ODDS)
    *refused, (verdict, _) = verdicts(drive(new_map(), DECOYS | longer)).values()
    assert verdict == Verdict.ACCEPTED
    assert {verdict for verdict, _ in refused} == {Verdict.OPEN}


def test_a_pending_verdict_has_its_odds_in_the_table():
    weak = sequence(LAP + 2, 2, 6, 0.5) | {190: (90, 5.0)}
    table = drive(new_map(), weak).candidates()
    single, pending = table[table[:, 5] == 0], table[table[:, 5] == 1]
    assert np.isnan(single[:, 9]).all()  # never judged: a sequence has two members or more
    assert (pending[:, 7] == Verdict.OPEN).all()
    assert len(set(pending[:, 9])) == 1
    assert -np.inf < pending[0, 9] < MIN_LOG_ODDS
    assert len(loop_map().closures()) == len(TRUE)
    accepted = loop_map().candidates()
    assert (accepted[:, 7] == Verdict.ACCEPTED).all()
    assert (accepted[:, 9] >= MIN_LOG_ODDS).all()
    assert np.isnan(drive(new_map(by_evidence), TRUE).candidates()[:, 9]).all()


CARRIED = {"may_be_carried": True, "break_length": 8, "break_score": 30.0}
CONTRADICTION = sequence(130, 20, 14, 5.0)
CASES = {
    "loop": (DECOYS | BOTH, {}),
    "carried": (DECOYS | BOTH | CONTRADICTION, CARRIED),
    "selected": (BOTH | CONTRADICTION, {"may_be_carried": True, "select_every": 25}),
}


def moments():
    """Cases and keyframes at which a map is restored; most for the soak."""
    for case in CASES:
        for at in (60, 136, 155, LAP - 18, LAP + 7):
            often = (at == LAP + 7 and case != "selected") or (at == 136 and case == "carried")
            yield pytest.param(case, at, marks=() if often else pytest.mark.soak)


@pytest.mark.parametrize(("case", "at"), list(moments()))
def test_a_restored_map_continues_bit_for_bit(case, at):
    recalled, settings = CASES[case]
    whole = drive(new_map(**settings), recalled, last=at)
    again = new_map(**settings)
    again.restore(whole.arrays())
    assert same(whole, again)
    for map in (whole, again):
        drive(map, recalled, first=at)
    assert same(whole, again)
    assert np.array_equal(whole.trajectory(), again.trajectory())
    assert np.array_equal(whole.candidates(), again.candidates(), equal_nan=True)


@pytest.mark.parametrize(
    "case", [one if one == "carried" else pytest.param(one, marks=pytest.mark.soak) for one in CASES]
)
def test_asking_for_the_final_map_changes_nothing(case):
    recalled, settings = CASES[case]
    asked, silent = new_map(**settings), new_map(**settings)
    for first in range(0, LAP + 60, 65):
        last = min(first + 65, LAP + 60)
        before = drive(silent, recalled, first, last)
        drive(asked, recalled, first, last)
        asked.trajectory(), asked.closures(), asked.files()
        assert same(asked, before)


def test_a_long_contradiction_cuts_the_odometry_of_a_robot_that_may_be_carried():
    carried = drive(new_map(**CARRIED), CONTRADICTION, last=150)
    assert np.flatnonzero(carried.arrays()["graph/cut"] >= 0).size == 1
    assert [verdict for verdict, _ in verdicts(carried).values()] == [Verdict.ACCEPTED]
    assert (drive(new_map(), CONTRADICTION, last=150).arrays()["graph/cut"] < 0).all()


@pytest.mark.parametrize(("at", "length"), [(130, 14), (110, 30)])
def test_no_evidence_joins_what_a_carried_robot_contradicts(at, length):
    """It would be accepted of a robot that is never carried, if it had evidence enough."""
    contradiction = sequence(at, 20, length, 20.0)
    never, maybe = (
        drive(new_map(may_be_carried=carried, break_length=99), contradiction) for carried in (False, True)
    )
    assert [verdict for verdict, _ in verdicts(never).values()] == [Verdict.ACCEPTED]
    assert [verdict for verdict, _ in verdicts(maybe).values()] == [Verdict.OPEN]


def test_an_undone_sequence_stays_undone():
    found = new_map()
    found.restore(loop_map().arrays())
    found.undo(0)
    assert len(found.closures()) == 0
    assert verdicts(found)[0][0] == Verdict.UNDONE
    drive(found, TRUE | sequence(LAP + 60, 60, 12, 4.0), first=LAP + 60, last=LAP + 80)
    assert [verdict for verdict, _ in verdicts(found).values()] == [Verdict.UNDONE, Verdict.ACCEPTED]


def test_recall_gets_the_calibration_of_the_map():
    found, without = loop_map(), drive(new_map(turn_error_sd=0.0), TRUE)
    for map in (found, without):
        graph, feedback = map.state.unmerged, map.feedback()
        assert (feedback.bias, feedback.turn_error) == (graph.bias, graph.turn_error)
    assert found.feedback().turn_error != 0.0 == without.feedback().turn_error


def test_poses_follow_the_believed_calibration_until_a_closure_fixes_them():
    graph, log = drive(new_map(), {}, last=50).state.unmerged, ClosureLog()
    belief = CalibrationPrior(0.05, 0.01, -0.2, 0.02)
    moved = correct_heading(graph.motion.rows[1:], graph.length.rows[1:], belief.bias, belief.turn_error)
    with_log(graph, log).adopt_prior(belief)
    assert graph.pose.rows[1:] == pytest.approx(integrate(moved, graph.pose.rows[0]), abs=1e-9)
    log.judge(log.add(Candidate(40, 3, 0, 1.0, 5.0), False), Verdict.ACCEPTED)
    with_log(graph, log).adopt_prior(belief._replace(bias=0.0, turn_error=0.0))
    assert (graph.bias, graph.turn_error) == (belief.bias, belief.turn_error)
    assert graph.pose.rows[1:] == pytest.approx(integrate(moved, graph.pose.rows[0]), abs=1e-9)
    assert graph.prior.turn_error == 0.0
