"""Laws of the closure log: candidates, verdicts, accepted closures, merged keyframes and restored state."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from tests.helpers.merges import random_merge

VARIANCE, SCALES, KEYFRAMES = np.array([0.1, 0.1, 0.02]), (0.5, 2.0, 20.0), 60
number, odd = st.integers(0, 10), st.floats(-5, 30)
add = st.tuples(st.just("add"), st.booleans(), odd)
judge = st.tuples(st.just("judge"), number, st.sampled_from(Verdict), st.none() | odd)
rate, strike = st.tuples(st.just("rate"), number, odd), st.tuples(st.just("strike"), number, number)
steps = st.lists(add | judge | rate | strike, max_size=30)


@given(steps)
def test_the_log_is_a_list_of_candidates(steps):
    log, rows = ClosureLog(), []
    known: list[list[float]] = []  # distance, verdict, weight and log odds of each sequence
    counts: list[int] = []
    for kind, a, *more in steps:
        sequence = a % max(len(known), 1)
        if kind == "add":
            follows = bool(a and known)
            n = len(rows)
            candidate = Candidate(50 + n, n // 2, n % 7 - 3, 0.5 + n / 99, *more)
            if not follows:
                known.append([np.inf, Verdict.OPEN, 0.0, np.nan])
            assert log.add(candidate, follows) == len(known) - 1
            rows.append([candidate, len(known) - 1])
            assert log.last() == candidate
        elif kind == "judge" and known:
            verdict, distance = more
            known[sequence][1:3] = verdict, float(verdict == Verdict.ACCEPTED)
            known[sequence][0] = known[sequence][0] if distance is None else distance
            log.judge(sequence, verdict, distance)
        elif kind == "rate" and known:
            _, verdict, _, before = known[sequence]  # the odds of an accepted sequence do not fall
            known[sequence][3] = np.fmax(before, more[0]) if verdict == Verdict.ACCEPTED else more[0]
            log.raise_log_odds(np.array([sequence]), np.array(more))
        elif kind == "strike" and known:
            frame, spare = 50 + a, more[0] % len(known)
            log.reject(frame, spare)
            for row in rows:
                accepted = row[1] >= 0 and known[row[1]][1] == Verdict.ACCEPTED
                if row[0].keyframe >= frame and accepted and row[1] != spare:
                    row[1] = -1
        # After every step, so that no cached rows survive a change.
        counts = [k for k, (_, of) in enumerate(rows) if of >= 0 and known[of][1] == Verdict.ACCEPTED]
        assert log.accepted_rows().tolist() == counts
    assert log.sequences == len(known)
    scores = [sum(c.log_ratio for c, of in rows if of == sequence) for sequence in range(len(known))]
    for sequence in range(log.sequences):
        mine = [candidate for candidate, of in rows if of == sequence]
        assert log.members(sequence).tolist() == [[*c[:3], sequence] for c in mine]
        assert log.score(sequence) == pytest.approx(scores[sequence])
        assert log.sizes()[sequence] == len(mine)
        first, last = log.spans()[sequence].tolist()
        assert (first, last) == (mine[0].keyframe, mine[-1].keyframe) if mine else first > last
    assert log.scores() == pytest.approx(scores, abs=1e-12)
    assert [log.verdict(k) for k in range(len(known))] == log.verdicts().tolist() == [row[1] for row in known]
    nothing = np.inf, Verdict.UNDONE, 0.0, np.nan
    expected, table = [[*one, of, *(known[of] if of >= 0 else nothing)] for one, of in rows], log.table()
    assert np.array_equal(table, np.reshape(expected, (-1, 10)), equal_nan=True)
    signs = [[0, 1, -1][known[of][1]] if of >= 0 else -1 for _, of in rows]
    judged = [[one.match, one.keyframe, sign] for (one, _), sign in zip(rows, signs, strict=True)]
    assert np.array_equal(log.judged(), np.reshape(judged, (-1, 3)))

    closures = log.closures(0.2, VARIANCE, SCALES)
    mine = [rows[k] for k in counts]
    sequences = sorted({sequence for _, sequence in mine})
    assert closures.i.tolist() == [candidate.match for candidate, _ in mine]
    assert closures.j.tolist() == [candidate.keyframe for candidate, _ in mine]
    assert np.allclose(closures.turn, [-0.2 * candidate.shift for candidate, _ in mine])
    assert closures.sequence.tolist() == [sequences.index(sequence) for _, sequence in mine]
    assert closures.score == pytest.approx([scores[sequence] for sequence in sequences])
    assert np.allclose(closures.scale, [min(max(0.5 * scores[sequence], 2), 20) for sequence in sequences])
    assert closures.variance is VARIANCE

    again = ClosureLog()
    again.add(Candidate(1, 0, 0, 1.0, 1.0), False)
    again.restore(log.arrays())
    if known:  # what was saved are copies
        log.judge(0, Verdict.UNDONE, 1.0)
    assert np.array_equal(again.table(), table, equal_nan=True)
    assert again.accepted_rows().tolist() == counts
    assert (again.sequences, again.last()) == (log.sequences, log.last())


@given(st.lists(add, max_size=30), st.lists(st.integers(50, 85), max_size=3, unique=True))
def test_no_sequence_lies_across_a_cut(steps, cuts):
    log, cuts = ClosureLog(), np.sort(np.array(cuts, int))
    for k, (_, follows, ratio) in enumerate(steps):
        log.add(Candidate(50 + k, k, 0, 0.9, ratio), follows and log.sequences > 0)
    before = [log.members(sequence)[:, 0] for sequence in range(log.sequences)]
    log.reject_across(cuts)
    for sequence, frames in enumerate(before):
        left = log.members(sequence)[:, 0]
        assert len(left) == np.bincount(np.searchsorted(cuts, frames, side="right")).max()
        assert len(np.unique(np.searchsorted(cuts, left, side="right"))) == 1
        assert np.isin(left, frames).all()


def test_weights_belong_to_the_accepted_sequences():
    log = ClosureLog()
    for k, sequence in enumerate([0, 0, 1, 1, 1, 2]):
        assert log.add(Candidate(50 + 2 * k, k, k - 3, 0.9, sequence + 1.0), k not in (0, 2, 5)) == sequence
    for sequence in (0, 2):
        log.judge(sequence, Verdict.ACCEPTED)
    assert log.weights().tolist() == [1, 1, 1]
    log.weigh(np.array([0.25, 0.75]))
    assert log.weights().tolist() == [0.25, 0.25, 0.75]
    assert log.table()[:, 8].tolist() == [0.25, 0.25, 0, 0, 0, 0.75]
    log.judge(0, Verdict.UNDONE)
    log.weigh(np.array([0.5]))
    assert log.weights().tolist() == [0.5]


def random_log(stream, sequences=5):
    """Sequences of keyframes 30.. matched to 0..29, some accepted, the last candidates rejected."""
    log, frame = ClosureLog(), 30
    for _ in range(sequences):
        for k in range(int(stream.integers(1, 7))):
            seen = int(stream.integers(30)), int(stream.integers(2))
            log.add(Candidate(frame, *seen, stream.uniform(0.5, 1), stream.normal(3, 2)), k > 0)
            frame += 1
        log.judge(log.sequences - 1, stream.choice([Verdict.OPEN, Verdict.ACCEPTED]), 1.5)
    log.reject(frame - 3, 0)
    log.weigh(stream.uniform(0, 1, len(np.unique(log.table()[log.accepted_rows(), 5]))))
    return log


@given(st.integers(0, 2**32 - 1))
def test_a_merge_keeps_the_evidence_of_every_sequence(seed):
    stream = np.random.default_rng(seed)
    log = random_log(stream)
    whole = log.copy()
    merge = random_merge(stream, KEYFRAMES)
    gone, onto, turned = ~merge.is_kept(), merge.onto, merge.turned()
    log.accepted_rows()  # remembered, and forgotten by the merge
    log.merge(gone, onto, turned)
    assert np.array_equal(log.sizes(), whole.sizes())
    assert np.allclose(log.scores(), whole.scores())
    assert [log.score(k) for k in range(log.sequences)] == pytest.approx(whole.scores().tolist())
    assert np.array_equal(log.verdicts(), whole.verdicts())
    assert np.array_equal(log.sequence_weights(), whole.sequence_weights())

    before = whole.table()
    left = before[~gone[before[:, 0].astype(int)]]
    frame, match = left[:, :2].astype(int).T
    shift = np.where(turned[match], 1 - left[:, 2], left[:, 2])
    expected = np.column_stack([onto[frame], onto[match], shift, left[:, 3:]])
    assert np.array_equal(log.table(), expected, equal_nan=True)
    rows = left[:, 5].astype(int)
    assert log.left().tolist() == np.bincount(rows[rows >= 0], minlength=log.sequences).tolist()
    for k in range(log.sequences):
        assert log.has_merged(k) == gone[whole.members(k)[:, 0]].any()

    closures, accepted = log.closures(np.pi, np.ones(3), SCALES), log.table()[log.accepted_rows()]
    sequences = np.unique(accepted[:, 5]).astype(int)
    assert closures.j.tolist() == accepted[:, 0].tolist()
    assert closures.i.tolist() == accepted[:, 1].tolist()
    assert np.allclose(closures.score, log.scores()[sequences])
    assert closures.size.tolist() == log.sizes()[sequences].tolist()
    assert np.array_equal(np.bincount(closures.sequence, minlength=len(sequences)), log.left()[sequences])


def test_a_sequence_goes_on_after_it_was_merged():
    log, again = ClosureLog(), ClosureLog()
    for k in range(4):
        log.add(Candidate(30 + k, k, 0, 1.0, 2.0), k > 0)
    gone = np.isin(np.arange(40), [30, 31])
    log.merge(gone, np.where(gone, np.arange(40) - 30, np.cumsum(~gone) - 1), np.zeros(40, bool))
    assert log.last() == Candidate(31, 3, 0, 1.0, 2.0)
    assert log.add(Candidate(32, 4, 0, 1.0, 2.0), True) == 0
    again.restore(log.arrays())
    for one in (log, again):
        found = one.score(0), one.sizes().tolist(), one.left().tolist(), one.has_merged(0)
        assert found == (10.0, [5], [3], True)


def judged(*weights):
    """One sequence for each weight, accepted with it; None: open."""
    log = ClosureLog()
    for k, weight in enumerate(weights):
        log.add(Candidate(30 + k, k, 0, 1.0, 2.0), False)
        log.judge(k, Verdict.OPEN if weight is None else Verdict.ACCEPTED)
    log.weigh(np.array([weight for weight in weights if weight is not None]))
    return log


def test_a_sequence_stands_selections_in_a_row_and_is_confirmed_by_its_weight():
    log = judged(0.9, 0.5, None)
    for stood in (1, 2, 3):
        log.count_selection()
        assert log.confirmations().tolist() == [stood, 0, 0]
    log.judge(2, Verdict.ACCEPTED)
    log.weigh(np.array([0.4, 0.6, 1.0]))
    log.count_selection()
    assert log.confirmations().tolist() == [0, 1, 1]
    log.judge(1, Verdict.OPEN)
    log.count_selection()
    assert log.confirmations().tolist() == [0, 0, 2]
    log = judged(0.9, 0.5, None, 0.8)
    for _ in range(3):
        log.count_selection()
    log.weigh(np.array([0.9, 0.9, 0.4]))
    log.confirm(2)
    # The second has begun to count, the last no longer does.
    assert log.confirmations().tolist() == [3, 2, 0, 3]
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
