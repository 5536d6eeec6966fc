"""Loop closures: candidates of recall in sequences that are accepted or refused as a whole.

A single candidate is never accepted. Consecutive candidates that agree with the odometry form a sequence. The
map accepts a sequence, refuses it, or removes it later; every candidate stays in the log with its evidence.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.mapping.optimizer import LoopClosures

HEADER = "keyframe,match,step,match_step,shift,posterior,log_ratio,sequence,distance,verdict,weight,log_odds"

UNLIKELY = -1.5
"""Log-odds below which the evidence of a sequence counts less; true ones of a young session, or of one
whose odometry is noisier than its settings say, reach it."""
CONFIRMED_WEIGHT = 0.5
"""Robust weight above which a sequence confirms what it joins."""


class Verdict(IntEnum):
    """Verdict on a closure sequence."""

    OPEN = 0
    """Not accepted: too short, too little evidence, or in contradiction to the map."""
    ACCEPTED = 1
    """Its candidates are closures of the map."""
    UNDONE = 2
    """Removed: by the user, or a candidate after a break of the odometry."""


SIGNS = np.array([0, 1, -1])
"""Of verdicts: open, accepted, removed."""


class Candidate(NamedTuple):
    """A proposed closure: the keyframe, the older keyframe matched, the sector shift, the posterior mass,
    and the log-likelihood ratio against novelty."""

    keyframe: int
    match: int
    shift: int
    posterior: float
    log_ratio: float


class ClosureLog(Checkpointed):
    """All candidates and closure sequences, in order of time."""

    def __init__(self) -> None:
        self._candidate = GrowableArray((4,), np.int64)  # keyframe, match, shift, sequence (-1: rejected)
        self._evidence = GrowableArray((2,), np.float64)  # posterior, log-likelihood ratio
        self._verdict = GrowableArray((), np.int64)
        self._distance = GrowableArray((), np.float64)
        self._weight = GrowableArray((), np.float64)
        self._log_odds = GrowableArray((), np.float64)
        self._stood = GrowableArray((), np.int64)  # selections in a row with a confirming weight
        self._merged = GrowableArray((2,), np.float64)  # evidence and number of the merged candidates
        self._lines: np.ndarray | None = None
        self._begun: list[int] | None = None  # the row of each sequence's first candidate

    @property
    def sequences(self) -> int:
        """Number of sequences."""
        return len(self._verdict.rows)

    def copy(self) -> ClosureLog:
        """A copy, to try verdicts on."""
        return deepcopy(self)

    def last(self) -> Candidate | None:
        """The newest candidate, None before the first."""
        if not len(self._candidate.rows):
            return None
        frame, match, shift, _ = self._candidate.rows[-1].tolist()
        return Candidate(frame, match, shift, *self._evidence.rows[-1].tolist())

    def add(self, candidate: Candidate, follows: bool) -> int:
        """Adds a candidate to the newest sequence if it follows that, else to a new one.

        Returns:
            the number of the sequence.
        """
        if not follows:
            self._verdict.append(Verdict.OPEN)
            self._distance.append(np.inf)
            self._weight.append(0.0)
            self._log_odds.append(np.nan)
            self._stood.append(0)
            self._merged.append((0.0, 0.0))
            if self._begun is not None:
                self._begun.append(len(self._candidate.rows))
        self._candidate.append((candidate.keyframe, candidate.match, candidate.shift, self.sequences - 1))
        self._evidence.append((candidate.posterior, candidate.log_ratio))
        self._lines = None
        return self.sequences - 1

    def add_accepted(self, candidates: Iterable[Candidate]) -> None:
        """Adds the candidates of one sequence, which is accepted."""
        for k, candidate in enumerate(candidates):
            self.judge(self.add(candidate, k > 0), Verdict.ACCEPTED)

    def extend(self, other: ClosureLog, frames: int) -> None:
        """Adds the candidates and sequences of another map, whose keyframes follow `frames` ones of this."""
        candidate, arrays = other._candidate.rows.copy(), other._growable_arrays()
        candidate[:, :2] += frames
        candidate[candidate[:, 3] >= 0, 3] += self.sequences
        for name, array in self._growable_arrays().items():
            array.extend(candidate if name == "candidate" else arrays[name].rows)
        self._lines = self._begun = None

    def members(self, sequence: int) -> np.ndarray:
        """[n, 4] keyframe, match, shift, sequence of the candidates of one sequence."""
        rows = self._candidate.rows[self._among(sequence)]
        own = rows[:, 3] == sequence
        return rows.copy() if own.all() else rows[own]

    def score(self, sequence: int) -> float:
        """Evidence of a sequence: the sum of the log-likelihood ratios of its candidates."""
        among = self._among(sequence)
        own = self._evidence.rows[among, 1][self._candidate.rows[among, 3] == sequence].sum()
        return float(own + self._merged.rows[sequence, 0])

    def _among(self, sequence: int) -> slice:
        """The rows from the first candidate of a sequence to before that of the next one."""
        if self._begun is None:
            newest = np.maximum.accumulate(self._candidate.rows[:, 3])
            self._begun = np.searchsorted(newest, np.arange(self.sequences)).tolist()
        following = self._begun[sequence + 1 : sequence + 2]
        return slice(self._begun[sequence], following[0] if following else None)

    def scores(self) -> np.ndarray:
        """[R] evidence of every sequence, merged candidates included."""
        rows, known = self._candidate.rows, self._candidate.rows[:, 3] >= 0
        own = np.bincount(rows[known, 3], self._evidence.rows[known, 1], self.sequences)
        return own + self._merged.rows[:, 0]

    def credit(self) -> np.ndarray:
        """[R] share of its evidence that counts for every sequence: 1 down to log-odds of `UNLIKELY`, below
        them as the odds fall."""
        return np.exp(np.nan_to_num(np.minimum(self._log_odds.rows - UNLIKELY, 0.0)))

    def sizes(self) -> np.ndarray:
        """[R] number of candidates of every sequence, merged ones included."""
        return self.left() + self._merged.rows[:, 1].astype(np.int64)

    def left(self) -> np.ndarray:
        """[R] number of candidates of every sequence that are not merged."""
        sequence = self._candidate.rows[:, 3]
        return np.bincount(sequence[sequence >= 0], minlength=self.sequences)

    def has_merged(self, sequence: int) -> bool:
        """Whether candidates of a sequence belong to merged keyframes."""
        return bool(self._merged.rows[sequence, 1] > 0)

    def confirmations(self) -> np.ndarray:
        """[R] number of selections in a row in which every sequence kept a confirming weight."""
        return self._stood.rows

    def count_selection(self) -> None:
        """Counts one more selection for the sequences that it confirmed."""
        strong = (self._verdict.rows == Verdict.ACCEPTED) & (self._weight.rows > CONFIRMED_WEIGHT)
        self._stood.rows[:] = np.where(strong, self._stood.rows + 1, 0)

    def confirm(self, times: int) -> None:
        """Lets the sequences with a confirming weight count as confirmed by at least that many selections."""
        strong = (self._verdict.rows == Verdict.ACCEPTED) & (self._weight.rows > CONFIRMED_WEIGHT)
        self._stood.rows[strong] = np.maximum(self._stood.rows[strong], times)

    def merge(self, gone: np.ndarray, onto: np.ndarray, turned: np.ndarray) -> None:
        """Removes the candidates of merged keyframes; their evidence still counts for their sequence.

        Args:
            gone: [N] bool, merged keyframes. onto: [N] new number of each keyframe, or of the one that it
                is merged with. turned: [N] bool: faces opposite to that one.
        """
        rows, evidence = self._candidate.rows, self._evidence.rows
        lost = gone[rows[:, 0]]
        counted = lost & (rows[:, 3] >= 0)
        merged = np.column_stack([evidence[counted, 1], np.ones(int(counted.sum()))])
        np.add.at(self._merged.rows, rows[counted, 3], merged)
        shift = np.where(turned[rows[:, 1]], 1 - rows[:, 2], rows[:, 2])
        moved = np.column_stack([onto[rows[:, 0]], onto[rows[:, 1]], shift, rows[:, 3]])
        self._candidate.replace(moved[~lost])
        self._evidence.replace(evidence[~lost].copy())
        self._lines = self._begun = None

    def take(self, number: np.ndarray) -> np.ndarray:
        """Reduces the log to candidates of keyframes that remain, and to sequences that have some.

        Args:
            number: [N] new number of each keyframe, -1 if it does not remain.

        Returns:
            [r] the former numbers of the sequences.
        """
        rows = self._candidate.rows
        ends = number[rows[:, :2]]
        left = (ends >= 0).all(axis=1)
        sequence = rows[left, 3]
        sequences = np.unique(sequence[sequence >= 0])
        renumbered = np.where(sequence >= 0, np.searchsorted(sequences, sequence), -1)
        self._candidate.replace(np.column_stack([ends[left], rows[left, 2], renumbered]))
        self._evidence.replace(self._evidence.rows[left])
        for array in self._growable_arrays().values():
            if array is not self._candidate and array is not self._evidence:
                array.replace(array.rows[sequences])
        self._lines = self._begun = None
        return sequences

    def take_verdicts(self, other: ClosureLog, sequences: np.ndarray) -> None:
        """Takes over what is known of sequences [n] from a log of the same candidates."""
        for name in ("_verdict", "_weight", "_log_odds"):
            getattr(self, name).rows[sequences] = getattr(other, name).rows[sequences]
        self._lines = None

    def follow(self, other: ClosureLog) -> None:
        """Takes over everything known of all sequences from a log whose first ones they are."""
        count = self.sequences
        for name in ("_verdict", "_distance", "_weight", "_log_odds", "_stood"):
            getattr(self, name).replace(getattr(other, name).rows[:count].copy())
        self._lines = None

    def spans(self) -> np.ndarray:
        """[R, 2] first and last keyframe of every sequence; first > last where all are rejected."""
        spans = np.tile(np.array([np.iinfo(np.int64).max, -1]), (self.sequences, 1))
        rows = self._candidate.rows[self._candidate.rows[:, 3] >= 0]
        np.minimum.at(spans[:, 0], rows[:, 3], rows[:, 0])
        np.maximum.at(spans[:, 1], rows[:, 3], rows[:, 0])
        return spans

    def verdicts(self) -> np.ndarray:
        """[R] verdict on every sequence."""
        return self._verdict.rows

    def verdict(self, sequence: int) -> Verdict:
        """Verdict on a closure sequence."""
        return Verdict(int(self._verdict.rows[sequence]))

    def judge(self, sequence: int, verdict: Verdict, distance: float | None = None) -> None:
        """Sets the verdict on a sequence, and its squared Mahalanobis `distance`."""
        self._verdict.rows[sequence] = verdict
        self._weight.rows[sequence] = float(verdict == Verdict.ACCEPTED)
        if distance is not None:
            self._distance.rows[sequence] = distance
        self._lines = None

    def raise_log_odds(self, sequences: np.ndarray, log_odds: np.ndarray) -> None:
        """Stores the log odds [n] that sequences [n] are true; those of an accepted one do not fall,
        because the map that it has bent says no more about it."""
        accepted = self._verdict.rows[sequences] == Verdict.ACCEPTED
        before = np.where(accepted, self._log_odds.rows[sequences], np.nan)
        self._log_odds.rows[sequences] = np.fmax(before, log_odds)

    def log_odds(self) -> np.ndarray:
        """[R] log odds that every sequence is true, NaN where it is not judged."""
        return self._log_odds.rows

    def set_log_odds(self, sequences: np.ndarray, log_odds: np.ndarray) -> None:
        """Stores the log odds [n] that sequences [n] are true, NaN where nothing is said."""
        self._log_odds.rows[sequences] = log_odds

    def reject(self, frame: int, spare: int) -> None:
        """Rejects the candidates of accepted sequences other than `spare` at `frame` and later, because
        the odometry breaks before it."""
        rows = self._candidate.rows
        accepted = self._verdict.rows[rows[:, 3]] == Verdict.ACCEPTED
        rows[(rows[:, 0] >= frame) & accepted & (rows[:, 3] != spare) & (rows[:, 3] >= 0), 3] = -1
        self._lines = None

    def reject_sequences(self, sequences: np.ndarray) -> None:
        """Rejects the candidates of sequences [n]."""
        self._candidate.rows[np.isin(self._candidate.rows[:, 3], sequences), 3] = -1
        self._lines = None

    def reject_across(self, cuts: np.ndarray) -> None:
        """Rejects candidates of sequences that lie across breaks of the odometry before keyframes `cuts`
        [n], ascending: of each sequence all but those of the part with the most."""
        rows = self._candidate.rows
        part = np.searchsorted(cuts, rows[:, 0], side="right")
        for sequence in range(self.sequences):
            own = np.flatnonzero(rows[:, 3] == sequence)
            if len(own):
                rows[own[part[own] != np.bincount(part[own]).argmax()], 3] = -1
        self._lines = None

    def accepted_rows(self) -> np.ndarray:
        """[M] rows of the accepted candidates."""
        if self._lines is None:
            sequence = self._candidate.rows[:, 3]
            self._lines = np.flatnonzero((sequence >= 0) & (self._verdict.rows[sequence] == Verdict.ACCEPTED))
        return self._lines

    def accepted_pairs(self) -> np.ndarray:
        """[M, 2] keyframe and match of the accepted candidates."""
        return self._candidate.rows[self.accepted_rows(), :2]

    def judged(self) -> np.ndarray:
        """[n, 3] match, keyframe, and 1 where accepted, 0 where open, -1 where removed, of all candidates."""
        sequence = self._candidate.rows[:, 3]
        sign = np.where(sequence < 0, -1, SIGNS[self._verdict.rows[sequence]])
        return np.column_stack([self._candidate.rows[:, 1::-1], sign])

    def accepted_middle_first(self) -> np.ndarray:
        """[M] rows of the accepted candidates, those in the middle of their sequences first."""
        rows = self.accepted_rows()
        sequence = self._candidate.rows[rows, 3]
        order = np.argsort(sequence, kind="stable")
        _, start, count = np.unique(sequence[order], return_index=True, return_counts=True)
        within = np.arange(len(rows)) - np.repeat(start, count)
        off = np.abs(within - np.repeat(count // 2, count))
        ordered: np.ndarray = rows[order][np.argsort(off, kind="stable")]
        return ordered

    def closures(self, angle: float, variance: np.ndarray, scale: tuple[float, float, float]) -> LoopClosures:
        """The accepted closures, for the optimiser.

        Args:
            angle: turn per sector shift, rad. variance: [3] of a closure. scale: robust scale per unit of
                a sequence's evidence, least scale, largest scale.
        """
        rows = self._candidate.rows[self.accepted_rows()]
        sequences, sequence = np.unique(rows[:, 3], return_inverse=True)
        score = np.bincount(sequence, self._evidence.rows[self.accepted_rows(), 1], len(sequences))
        merged = self._merged.rows[sequences]
        return LoopClosures(
            i=rows[:, 1],
            j=rows[:, 0],
            turn=-rows[:, 2] * angle,
            sequence=sequence,
            variance=variance,
            scale=np.clip(scale[0] * score, *scale[1:]),
            score=score + merged[:, 0],
            size=np.bincount(sequence, minlength=len(sequences)) + merged[:, 1],
            credit=self.credit()[sequences],
        )

    def weigh(self, weights: np.ndarray) -> None:
        """Stores the robust weights of the accepted sequences, in order."""
        self._weight.rows[np.unique(self._candidate.rows[self.accepted_rows(), 3])] = weights

    def weights(self) -> np.ndarray:
        """[M] robust weight of the sequence of each accepted candidate."""
        return self._weight.rows[self._candidate.rows[self.accepted_rows(), 3]]

    def sequence_weights(self) -> np.ndarray:
        """[R] robust weight of every sequence."""
        return self._weight.rows

    def table(self) -> np.ndarray:
        """[n, 10] all candidates: keyframe, match, shift, posterior, log-likelihood ratio, sequence, its
        distance, verdict, weight and log odds (NaN: not judged by odds)."""
        sequence = self._candidate.rows[:, 3]
        columns = self._distance.rows, self._verdict.rows, self._weight.rows, self._log_odds.rows
        of_sequence = np.stack(columns, axis=1)[sequence]
        of_sequence[sequence < 0] = np.inf, Verdict.UNDONE, 0.0, np.nan
        parts = self._candidate.rows[:, :3], self._evidence.rows, sequence[:, None], of_sequence
        return np.concatenate(parts, axis=1)

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        super().restore(arrays)
        self._lines = self._begun = None


def write_closures(path: Path, table: np.ndarray, first_step: np.ndarray) -> None:
    """Writes the candidates of `ClosureLog.table` as CSV; first_step: [N] the step of each keyframe."""
    lines = [HEADER]
    for frame, match, shift, posterior, ratio, sequence, distance, verdict, weight, odds in table.tolist():
        frame, match = int(frame), int(match)
        lines.append(
            f"{frame},{match},{first_step[frame]},{first_step[match]},{int(shift)},{posterior!r},{ratio!r},"
            f"{int(sequence)},{distance!r},{Verdict(int(verdict)).name.lower()},{weight!r},{odds!r}"
        )
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")
