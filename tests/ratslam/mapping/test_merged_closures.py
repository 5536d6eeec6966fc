"""The closure log when keyframes are merged, and the selections that its sequences stand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict

SCALES = (0.5, 2.0, 20.0)
KEYFRAMES = 60


def random_log(stream, sequences=5):
    """Sequences of keyframes 30.. matched to 0..29, some accepted, the last candidates rejected."""
    log, frame = ClosureLog(), 30
    for _ in range(sequences):
        for k in range(int(stream.integers(1, 7))):
            evidence = stream.uniform(0.5, 1), stream.normal(3, 2)
            log.add(
                Candidate(frame, int(stream.integers(30)), int(stream.integers(2)), *map(float, evidence)),
                k > 0,
            )
            frame += 1
        log.judge(log.sequences - 1, stream.choice([Verdict.OPEN, Verdict.ACCEPTED]), 1.5)
    log.reject(frame - 3, 0)
    accepted = int((np.bincount(log.table()[log.accepted_rows(), 5].astype(int)) > 0).sum())
    log.weigh(stream.uniform(0, 1, accepted))
    return log


def random_merge(stream):
    """Which of `KEYFRAMES` keyframes are gone, the new numbers, and which are merged turned."""
    gone = stream.random(KEYFRAMES) < 0.5
    gone[0] = False
    kept = np.flatnonzero(~gone)
    onto = np.array([k if not gone[k] else stream.choice(kept[kept < k]) for k in range(KEYFRAMES)])
    return gone, (np.cumsum(~gone) - 1)[onto], gone & (stream.random(KEYFRAMES) < 0.5)


@given(st.integers(0, 2**32 - 1))
def test_a_merge_keeps_the_evidence_of_every_sequence(seed):
    stream = np.random.default_rng(seed)
    log = random_log(stream)
    whole = log.copy()
    gone, onto, turned = random_merge(stream)
    log.merge(gone, onto, turned)
    assert np.array_equal(log.sizes(), whole.sizes())
    assert np.allclose(log.scores(), whole.scores())
    assert [log.score(k) for k in range(log.sequences)] == pytest.approx(whole.scores().tolist())
    assert np.array_equal(log.verdicts(), whole.verdicts())
    assert np.array_equal(log.sequence_weights(), whole.sequence_weights())

    before = whole.table()
    left = before[~gone[before[:, 0].astype(int)]]
    frame, match = left[:, :2].astype(int).T
    expected = left.copy()
    expected[:, 0], expected[:, 1] = onto[frame], onto[match]
    expected[:, 2] = np.where(turned[match], 1 - left[:, 2], left[:, 2])
    assert np.array_equal(log.table(), expected, equal_nan=True)
    rows = left[:, 5].astype(int)
    assert log.left().tolist() == np.bincount(rows[rows >= 0], minlength=log.sequences).tolist()
    merged = [bool((gone[whole.members(k)[:, 0]]).any()) for k in range(log.sequences)]
    assert [log.has_merged(k) for k in range(log.sequences)] == merged


@given(st.integers(0, 2**32 - 1))
def test_closures_count_what_was_merged(seed):
    stream = np.random.default_rng(seed)
    log = random_log(stream)
    gone, onto, turned = random_merge(stream)
    log.accepted_rows()  # remembered, and forgotten by the merge
    log.merge(gone, onto, turned)
    closures = log.closures(np.pi, np.ones(3), SCALES)
    accepted = log.table()[log.accepted_rows()]
    sequences = np.unique(accepted[:, 5]).astype(int)
    assert closures.j.tolist() == accepted[:, 0].tolist()
    assert closures.i.tolist() == accepted[:, 1].tolist()
    assert np.allclose(closures.score, log.scores()[sequences])
    assert closures.size.tolist() == log.sizes()[sequences].tolist()
    assert np.array_equal(np.bincount(closures.sequence, minlength=len(sequences)), log.left()[sequences])


def test_a_sequence_goes_on_after_it_was_merged():
    log = ClosureLog()
    for k in range(4):
        log.add(Candidate(30 + k, k, 0, 1.0, 2.0), k > 0)
    gone = np.isin(np.arange(40), [30, 31])
    log.merge(gone, np.where(gone, np.arange(40) - 30, np.cumsum(~gone) - 1), np.zeros(40, bool))
    assert log.last() == Candidate(31, 3, 0, 1.0, 2.0)
    assert log.add(Candidate(32, 4, 0, 1.0, 2.0), True) == 0
    assert (log.score(0), log.sizes().tolist(), log.left().tolist()) == (10.0, [5], [3])
    again = ClosureLog()
    again.restore(log.arrays())
    assert (again.score(0), again.sizes().tolist(), again.has_merged(0)) == (10.0, [5], True)


def judged(*weights):
    """One sequence for each weight, accepted with it; None: open."""
    log = ClosureLog()
    for k, weight in enumerate(weights):
        log.add(Candidate(30 + k, k, 0, 1.0, 2.0), False)
        log.judge(k, Verdict.OPEN if weight is None else Verdict.ACCEPTED)
    log.weigh(np.array([weight for weight in weights if weight is not None]))
    return log


def test_a_sequence_stands_selections_in_a_row():
    log = judged(0.9, 0.5, None)
    counts = []
    for _ in range(3):
        log.count_selection()
        counts.append(log.confirmations().tolist())
    assert counts == [[1, 0, 0], [2, 0, 0], [3, 0, 0]]
    log.judge(2, Verdict.ACCEPTED)
    log.weigh(np.array([0.4, 0.6, 1.0]))
    log.count_selection()
    assert log.confirmations().tolist() == [0, 1, 1]
    log.judge(1, Verdict.OPEN)
    log.count_selection()
    assert log.confirmations().tolist() == [0, 0, 2]


def test_sequences_are_confirmed_by_their_weight():
    log = judged(0.9, 0.5, None, 0.8)
    for _ in range(3):
        log.count_selection()
    log.weigh(np.array([0.9, 0.9, 0.4]))
    log.confirm(2)
    assert log.confirmations().tolist() == [
        3,
        2,
        0,
        3,
    ]  # the second has begun to count, the last no longer does
    log.confirm(5)
    assert log.confirmations().tolist() == [5, 5, 0, 3]


def test_verdicts_are_taken_over_whatever_was_merged():
    whole = judged(0.9, None, 0.7)
    log = whole.copy()
    log.merge(np.isin(np.arange(33), [30, 32]), np.arange(33), np.zeros(33, bool))
    log.judge(1, Verdict.ACCEPTED, 2.5)
    log.raise_log_odds(np.array([1]), np.array([4.0]))
    log.judge(2, Verdict.UNDONE)
    log.count_selection()
    whole.accepted_rows()
    whole.follow(log)
    table = whole.table()
    assert table[:, 7].tolist() == [Verdict.ACCEPTED, Verdict.ACCEPTED, Verdict.UNDONE]
    assert table[:, 8].tolist() == [0.9, 1.0, 0.0]
    assert table[1, [6, 9]].tolist() == [2.5, 4.0]
    assert whole.confirmations().tolist() == [1, 1, 0]
    assert whole.accepted_rows().tolist() == [0, 1]
    assert whole.left().tolist() == [1, 1, 1]
    log.judge(0, Verdict.OPEN)
    assert whole.verdict(0) == Verdict.ACCEPTED
