"""Laws of the closure log: candidates, accepted closures and restored state."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict

VARIANCE = np.array([0.1, 0.1, 0.02])
SCALES = (0.5, 2.0, 20.0)
steps = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.booleans(), st.floats(-5, 30)),
        st.tuples(st.just("judge"), st.integers(0, 10), st.sampled_from(Verdict)),
        st.tuples(st.just("strike"), st.integers(0, 10), st.integers(0, 10)),
    ),
    max_size=30,
)


def filled():
    """Sequences of 2, 3 and 1 candidates at frames 50, 52, ..; those of sequence k have the gain k + 1."""
    log = ClosureLog()
    for k, sequence in enumerate([0, 0, 1, 1, 1, 2]):
        first = k in (0, 2, 5)
        assert log.add(Candidate(50 + 2 * k, k, k - 3, 0.9, sequence + 1.0), not first) == sequence
    return log


@given(steps)
def test_the_log_is_a_list_of_candidates(steps):
    log, rows, verdicts, odds, counts = ClosureLog(), [], [], {}, []
    for kind, a, b in steps:
        if kind == "add":
            follows = a and bool(verdicts)
            candidate = Candidate(50 + len(rows), len(rows) // 2, len(rows) % 7 - 3, 0.5 + len(rows) / 99, b)
            if not follows:
                verdicts.append(Verdict.OPEN)
            assert log.add(candidate, follows) == len(verdicts) - 1
            rows.append([candidate, len(verdicts) - 1])
            assert log.last() == candidate
        elif kind == "judge" and verdicts:
            verdicts[a % len(verdicts)] = b
            log.judge(a % len(verdicts), b)
        elif kind == "rate" and verdicts:
            odds[a % len(verdicts)] = b
            log.raise_log_odds(np.array([a % len(verdicts)]), np.array([b]))
        elif kind == "strike" and verdicts:
            frame, spare = 50 + a, b % len(verdicts)
            log.reject(frame, spare)
            for row in rows:
                accepted = row[1] >= 0 and verdicts[row[1]] == Verdict.ACCEPTED
                if row[0].keyframe >= frame and accepted and row[1] != spare:
                    row[1] = -1
        # After every step, so that no cached rows survive a change.
        counts = [
            k
            for k, (_, sequence) in enumerate(rows)
            if sequence >= 0 and verdicts[sequence] == Verdict.ACCEPTED
        ]
        assert log.accepted_rows().tolist() == counts
    assert log.sequences == len(verdicts)
    assert [log.verdict(sequence) for sequence in range(log.sequences)] == verdicts
    for sequence in range(log.sequences):
        mine = [candidate for candidate, of in rows if of == sequence]
        assert log.members(sequence).tolist() == [[*c[:3], sequence] for c in mine]
        assert log.score(sequence) == pytest.approx(sum(c.log_ratio for c in mine))
    table = log.table()
    assert table.shape == (len(rows), 10)
    assert table[:, :6].tolist() == [[*candidate, sequence] for candidate, sequence in rows]
    assert table[:, 7].tolist() == [
        verdicts[sequence] if sequence >= 0 else Verdict.UNDONE for _, sequence in rows
    ]
    assert np.array_equal(table[:, 9], [odds.get(sequence, np.nan) for _, sequence in rows], equal_nan=True)

    closures = log.closures(0.2, VARIANCE, SCALES)
    mine = [rows[k] for k in counts]
    sequences = sorted({sequence for _, sequence in mine})
    assert closures.i.tolist() == [candidate.match for candidate, _ in mine]
    assert closures.j.tolist() == [candidate.keyframe for candidate, _ in mine]
    assert np.allclose(closures.turn, [-0.2 * candidate.shift for candidate, _ in mine])
    assert closures.sequence.tolist() == [sequences.index(sequence) for _, sequence in mine]
    assert np.allclose(closures.scale, [min(max(0.5 * log.score(sequence), 2), 20) for sequence in sequences])
    assert closures.variance is VARIANCE

    again = ClosureLog()
    again.add(Candidate(1, 0, 0, 1.0, 1.0), False)
    again.restore(log.arrays())
    assert np.array_equal(again.table(), table, equal_nan=True)
    assert np.array_equal(again.accepted_rows(), log.accepted_rows())
    assert (again.sequences, again.last()) == (log.sequences, log.last())


def test_an_empty_log_has_no_closures():
    log = ClosureLog()
    assert log.last() is None
    assert log.sequences == 0
    assert log.table().shape == (0, 10)
    assert [len(rows) for rows in log.closures(0.1, VARIANCE, SCALES)[:4]] == [0] * 4
    assert log.closures(0.1, VARIANCE, SCALES).scale.shape == (0,)
    log.weigh(np.zeros(0))
    assert log.weights().shape == (0,)


def test_a_sequence_counts_while_it_is_accepted():
    log = filled()
    assert len(log.accepted_rows()) == 0
    log.judge(1, Verdict.ACCEPTED, 3.0)
    assert log.accepted_rows().tolist() == [2, 3, 4]
    log.add(Candidate(62, 9, 0, 0.9, 1.0), True)  # of the open sequence 2
    log.judge(2, Verdict.ACCEPTED)
    assert log.accepted_rows().tolist() == [2, 3, 4, 5, 6]
    log.add(Candidate(64, 9, 0, 0.9, 1.0), True)  # of a sequence accepted already
    assert log.accepted_rows().tolist() == [2, 3, 4, 5, 6, 7]
    log.judge(1, Verdict.UNDONE)
    assert log.accepted_rows().tolist() == [5, 6, 7]
    assert log.closures(0.1, VARIANCE, SCALES).sequence.tolist() == [0, 0, 0]


def test_the_odds_of_an_accepted_sequence_do_not_fall():
    log = filled()
    log.raise_log_odds(np.array([0, 1]), np.array([3.0, 3.0]))
    log.judge(0, Verdict.ACCEPTED)
    log.judge(2, Verdict.ACCEPTED)
    for odds in (1.0, 4.0, 2.0):
        log.raise_log_odds(np.arange(3), np.full(3, odds))
    assert log.table()[[0, 2, 5], 9].tolist() == [4.0, 2.0, 4.0]


def test_a_break_strikes_out_later_candidates():
    log = filled()
    for sequence in (0, 1):
        log.judge(sequence, Verdict.ACCEPTED)
    log.reject(56, 2)
    assert log.accepted_rows().tolist() == [0, 1, 2]  # sequence 1 keeps its candidates before the break
    assert log.score(1) == 2.0
    assert log.table()[:, 5].tolist() == [0, 0, 1, -1, -1, 2]  # an open sequence is spared, accepted or not
    assert log.table()[3, 6:9].tolist() == [np.inf, Verdict.UNDONE, 0.0]
    assert np.isnan(log.table()[3, 9])
    log.judge(2, Verdict.ACCEPTED)
    log.reject(0, 2)
    assert log.accepted_rows().tolist() == [5]


@given(steps, st.lists(st.integers(50, 85), max_size=3, unique=True))
def test_no_sequence_lies_across_a_cut(steps, cuts):
    log, cuts = ClosureLog(), np.sort(np.array(cuts, int))
    for k, (kind, a, b) in enumerate(steps):
        if kind == "add":
            log.add(Candidate(50 + k, k, 0, 0.9, b), a and log.sequences > 0)
    before = [log.members(sequence)[:, 0] for sequence in range(log.sequences)]
    log.reject_across(cuts)
    for sequence, frames in enumerate(before):
        parts = np.searchsorted(cuts, frames, side="right")
        largest = np.bincount(parts).max()
        left = log.members(sequence)[:, 0]
        assert len(left) == largest
        assert len(np.unique(np.searchsorted(cuts, left, side="right"))) == 1
        assert np.isin(left, frames).all()


@given(steps)
def test_summaries_of_sequences_follow_from_their_members(steps):
    log = ClosureLog()
    for k, (kind, a, b) in enumerate(steps):
        if kind == "add":
            log.add(Candidate(50 + k, k, 0, 0.9, b), a and log.sequences > 0)
        elif kind == "judge" and log.sequences:
            log.judge(a % log.sequences, b)
        elif kind == "strike" and log.sequences:
            log.reject(50 + a, b % log.sequences)
    members = [log.members(sequence) for sequence in range(log.sequences)]
    assert log.sizes().tolist() == [len(rows) for rows in members]
    assert log.scores() == pytest.approx(
        [log.score(sequence) for sequence in range(log.sequences)], abs=1e-12
    )
    assert log.verdicts().tolist() == [log.verdict(sequence) for sequence in range(log.sequences)]
    assert log.spans().shape == (log.sequences, 2)
    for (first, last), rows in zip(log.spans().tolist(), members, strict=True):
        if len(rows):
            assert (first, last) == (rows[0, 0], rows[-1, 0])
        else:
            assert first > last


def test_closures_have_the_evidence_of_their_sequences():
    log = filled()
    for sequence in (0, 2):
        log.judge(sequence, Verdict.ACCEPTED)
    closures = log.closures(0.1, VARIANCE, SCALES)
    assert closures.score.tolist() == [2.0, 3.0]
    assert closures.sequence.tolist() == [0, 0, 1]


def test_scales_grow_with_the_score_between_their_limits():
    log = filled()
    for sequence in range(3):
        log.judge(sequence, Verdict.ACCEPTED)
    assert np.allclose(log.closures(0.1, VARIANCE, (1.0, 2.5, 4.0)).scale, [2.5, 4.0, 3.0])


def test_weights_belong_to_the_accepted_sequences():
    log = filled()
    for sequence in (0, 2):
        log.judge(sequence, Verdict.ACCEPTED)
    assert log.weights().tolist() == [1, 1, 1]
    log.weigh(np.array([0.25, 0.75]))
    assert log.weights().tolist() == [0.25, 0.25, 0.75]
    assert log.table()[:, 8].tolist() == [0.25, 0.25, 0, 0, 0, 0.75]
    log.judge(0, Verdict.UNDONE)
    log.weigh(np.array([0.5]))
    assert log.weights().tolist() == [0.5]


def test_the_table_has_all_evidence():
    log = ClosureLog()
    log.add(Candidate(30, 4, -2, 0.75, 6.5), False)
    log.add(Candidate(40, 5, 1, 0.5, -1.5), False)
    log.judge(0, Verdict.ACCEPTED, 2.25)
    log.judge(0, Verdict.ACCEPTED)  # without a distance, the one known stays
    log.weigh(np.array([0.5]))
    log.raise_log_odds(np.array([1]), np.array([-0.75]))
    expected = [
        [30, 4, -2, 0.75, 6.5, 0, 2.25, Verdict.ACCEPTED, 0.5, np.nan],
        [40, 5, 1, 0.5, -1.5, 1, np.inf, Verdict.OPEN, 0.0, -0.75],
    ]
    assert np.array_equal(log.table(), expected, equal_nan=True)


def test_saved_arrays_are_copies():
    log = filled()
    saved = log.arrays()
    before = log.table()
    log.judge(0, Verdict.ACCEPTED, 1.0)
    log.reject(50, 2)
    log.restore(saved)
    assert np.array_equal(log.table(), before, equal_nan=True)
    assert len(log.accepted_rows()) == 0
