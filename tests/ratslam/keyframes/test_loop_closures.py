"""Laws of the ledger: what is written down, what counts, and that both survive."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.keyframes.loop_closures import Candidate, ClosureLog, Verdict

VARIANCE = np.array([0.1, 0.1, 0.02])
SCALES = (0.5, 2.0, 20.0)
steps = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.booleans(), st.floats(-5, 30)),
        st.tuples(st.just("judge"), st.integers(0, 9), st.sampled_from(Verdict)),
        st.tuples(st.just("strike"), st.integers(0, 9), st.integers(0, 9)),
    ),
    max_size=30,
)


def filled():
    """Sequences of 2, 3 and 1 candidates at frames 50, 52, ..; sequence k's candidates have the gain k +
    1."""
    ledger = ClosureLog()
    for k, sequence in enumerate([0, 0, 1, 1, 1, 2]):
        first = k in (0, 2, 5)
        assert ledger.add(Candidate(50 + 2 * k, k, k - 3, 0.9, sequence + 1.0), not first) == sequence
    return ledger


@given(steps)
def test_the_ledger_is_a_list_of_candidates(steps):
    ledger, rows, verdicts, counts = ClosureLog(), [], [], []
    for kind, a, b in steps:
        if kind == "add":
            follows = a and bool(verdicts)
            candidate = Candidate(50 + len(rows), len(rows) // 2, len(rows) % 7 - 3, 0.5 + len(rows) / 99, b)
            if not follows:
                verdicts.append(Verdict.OPEN)
            assert ledger.add(candidate, follows) == len(verdicts) - 1
            rows.append([candidate, len(verdicts) - 1])
            assert ledger.last() == candidate
        elif kind == "judge" and verdicts:
            verdicts[a % len(verdicts)] = b
            ledger.judge(a % len(verdicts), b)
        elif kind == "strike" and verdicts:
            frame, spare = 50 + a, b % len(verdicts)
            ledger.strike(frame, spare)
            for row in rows:
                accepted = row[1] >= 0 and verdicts[row[1]] == Verdict.ACCEPTED
                if row[0].keyframe >= frame and accepted and row[1] != spare:
                    row[1] = -1
        # After every step, so that nothing once looked up outlives a change.
        counts = [
            k
            for k, (_, sequence) in enumerate(rows)
            if sequence >= 0 and verdicts[sequence] == Verdict.ACCEPTED
        ]
        assert ledger.accepted().tolist() == counts
    assert ledger.sequences == len(verdicts)
    assert [ledger.verdict(sequence) for sequence in range(ledger.sequences)] == verdicts
    for sequence in range(ledger.sequences):
        mine = [candidate for candidate, of in rows if of == sequence]
        assert ledger.members(sequence).tolist() == [[*c[:3], sequence] for c in mine]
        assert ledger.score(sequence) == pytest.approx(sum(c.log_ratio for c in mine))
    table = ledger.table()
    assert table.shape == (len(rows), 9)
    assert table[:, :6].tolist() == [[*candidate, sequence] for candidate, sequence in rows]
    assert table[:, 7].tolist() == [
        verdicts[sequence] if sequence >= 0 else Verdict.UNDONE for _, sequence in rows
    ]

    closures = ledger.closures(0.2, VARIANCE, SCALES)
    mine = [rows[k] for k in counts]
    sequences = sorted({sequence for _, sequence in mine})
    assert closures.i.tolist() == [candidate.match for candidate, _ in mine]
    assert closures.j.tolist() == [candidate.keyframe for candidate, _ in mine]
    assert np.allclose(closures.turn, [-0.2 * candidate.shift for candidate, _ in mine])
    assert closures.sequence.tolist() == [sequences.index(sequence) for _, sequence in mine]
    assert np.allclose(
        closures.scale, [min(max(0.5 * ledger.score(sequence), 2), 20) for sequence in sequences]
    )
    assert closures.variance is VARIANCE

    again = ClosureLog()
    again.add(Candidate(1, 0, 0, 1.0, 1.0), False)
    again.restore(ledger.arrays())
    assert np.array_equal(again.table(), table)
    assert np.array_equal(again.accepted(), ledger.accepted())
    assert (again.sequences, again.last()) == (ledger.sequences, ledger.last())


def test_an_empty_ledger_has_no_closures():
    ledger = ClosureLog()
    assert ledger.last() is None
    assert ledger.sequences == 0
    assert ledger.table().shape == (0, 9)
    assert [len(rows) for rows in ledger.closures(0.1, VARIANCE, SCALES)[:4]] == [0] * 4
    assert ledger.closures(0.1, VARIANCE, SCALES).scale.shape == (0,)
    ledger.weigh(np.zeros(0))
    assert ledger.weights().shape == (0,)


def test_a_run_counts_while_it_is_accepted():
    ledger = filled()
    assert len(ledger.accepted()) == 0
    ledger.judge(1, Verdict.ACCEPTED, 3.0)
    assert ledger.accepted().tolist() == [2, 3, 4]
    ledger.add(Candidate(62, 9, 0, 0.9, 1.0), True)  # of the open sequence 2
    ledger.judge(2, Verdict.ACCEPTED)
    assert ledger.accepted().tolist() == [2, 3, 4, 5, 6]
    ledger.add(Candidate(64, 9, 0, 0.9, 1.0), True)  # of a sequence accepted already
    assert ledger.accepted().tolist() == [2, 3, 4, 5, 6, 7]
    ledger.judge(1, Verdict.UNDONE)
    assert ledger.accepted().tolist() == [5, 6, 7]
    assert ledger.closures(0.1, VARIANCE, SCALES).sequence.tolist() == [0, 0, 0]


def test_a_break_strikes_out_what_was_said_after_it():
    ledger = filled()
    for sequence in (0, 1):
        ledger.judge(sequence, Verdict.ACCEPTED)
    ledger.strike(56, 2)
    assert ledger.accepted().tolist() == [0, 1, 2]  # sequence 1 keeps what it said before the break
    assert ledger.score(1) == 2.0
    assert ledger.table()[:, 5].tolist() == [
        0,
        0,
        1,
        -1,
        -1,
        2,
    ]  # an open sequence is spared, accepted or not
    assert ledger.table()[3, 6:].tolist() == [np.inf, Verdict.UNDONE, 0.0]
    ledger.judge(2, Verdict.ACCEPTED)
    ledger.strike(0, 2)
    assert ledger.accepted().tolist() == [5]


@given(steps)
def test_runs_are_summed_up_as_their_members_say(steps):
    ledger = ClosureLog()
    for k, (kind, a, b) in enumerate(steps):
        if kind == "add":
            ledger.add(Candidate(50 + k, k, 0, 0.9, b), a and ledger.sequences > 0)
        elif kind == "judge" and ledger.sequences:
            ledger.judge(a % ledger.sequences, b)
        elif kind == "strike" and ledger.sequences:
            ledger.strike(50 + a, b % ledger.sequences)
    members = [ledger.members(sequence) for sequence in range(ledger.sequences)]
    assert ledger.sizes().tolist() == [len(rows) for rows in members]
    assert ledger.scores() == pytest.approx(
        [ledger.score(sequence) for sequence in range(ledger.sequences)], abs=1e-12
    )
    assert ledger.verdicts().tolist() == [ledger.verdict(sequence) for sequence in range(ledger.sequences)]
    assert ledger.spans().shape == (ledger.sequences, 2)
    for (first, last), rows in zip(ledger.spans().tolist(), members, strict=True):
        if len(rows):
            assert (first, last) == (rows[0, 0], rows[-1, 0])
        else:
            assert first > last


def test_closures_bring_the_evidence_of_their_runs():
    ledger = filled()
    for sequence in (0, 2):
        ledger.judge(sequence, Verdict.ACCEPTED)
    closures = ledger.closures(0.1, VARIANCE, SCALES)
    assert closures.score.tolist() == [2.0, 3.0]
    assert closures.sequence.tolist() == [0, 0, 1]


def test_scales_grow_with_the_score_between_their_limits():
    ledger = filled()
    for sequence in range(3):
        ledger.judge(sequence, Verdict.ACCEPTED)
    assert np.allclose(ledger.closures(0.1, VARIANCE, (1.0, 2.5, 4.0)).scale, [2.5, 4.0, 3.0])


def test_weights_go_to_the_runs_that_count():
    ledger = filled()
    for sequence in (0, 2):
        ledger.judge(sequence, Verdict.ACCEPTED)
    assert ledger.weights().tolist() == [1, 1, 1]
    ledger.weigh(np.array([0.25, 0.75]))
    assert ledger.weights().tolist() == [0.25, 0.25, 0.75]
    assert ledger.table()[:, 8].tolist() == [0.25, 0.25, 0, 0, 0, 0.75]
    ledger.judge(0, Verdict.UNDONE)
    ledger.weigh(np.array([0.5]))
    assert ledger.weights().tolist() == [0.5]


def test_the_table_tells_all_evidence():
    ledger = ClosureLog()
    ledger.add(Candidate(30, 4, -2, 0.75, 6.5), False)
    ledger.add(Candidate(40, 5, 1, 0.5, -1.5), False)
    ledger.judge(0, Verdict.ACCEPTED, 2.25)
    ledger.judge(0, Verdict.ACCEPTED)  # without a distance, the one known stays
    ledger.weigh(np.array([0.5]))
    assert ledger.table().tolist() == [
        [30, 4, -2, 0.75, 6.5, 0, 2.25, Verdict.ACCEPTED, 0.5],
        [40, 5, 1, 0.5, -1.5, 1, np.inf, Verdict.OPEN, 0.0],
    ]


def test_what_is_kept_is_a_copy():
    ledger = filled()
    kept = ledger.arrays()
    before = ledger.table()
    ledger.judge(0, Verdict.ACCEPTED, 1.0)
    ledger.strike(50, 2)
    ledger.restore(kept)
    assert np.array_equal(ledger.table(), before)
    assert len(ledger.accepted()) == 0
