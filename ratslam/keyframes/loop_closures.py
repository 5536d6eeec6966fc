"""Closures and why they are believed: candidates of recall, gathered in runs that stand or fall together.

A single candidate is never believed. Candidates that follow each other as the odometry does form a run; the
map accepts a run, refuses it or, later, gives it up. Nothing is forgotten: each row keeps its evidence.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from ratslam.core.growable_array import GrowableArray, copy_arrays, restore_arrays
from ratslam.keyframes.optimizer import Closures


class Verdict(IntEnum):
    """What became of a run."""

    OPEN = 0
    """Not accepted: too short, too little evidence, or it contradicts the map."""
    ACCEPTED = 1
    """Its candidates are closures of the map."""
    UNDONE = 2
    """Taken back: by the user, or a candidate struck out because a break lies before it."""


class Candidate(NamedTuple):
    """A frame that recall takes for another: their numbers, the sector shift, posterior mass, and the
    log-likelihood ratio against novelty."""

    frame: int
    match: int
    shift: int
    mass: float
    gain: float


class ClosureLog:
    """All candidates and runs, in order of time."""

    def __init__(self) -> None:
        self._candidate = GrowableArray((4,), np.int64)  # frame, match, shift, run (-1: struck out)
        self._evidence = GrowableArray((2,), np.float64)  # mass, gain
        self._verdict = GrowableArray((), np.int64)
        self._distance = GrowableArray((), np.float64)
        self._weight = GrowableArray((), np.float64)
        self._lines: np.ndarray | None = None

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return len(self._verdict.rows)

    def last(self) -> Candidate | None:
        """The newest candidate."""
        if not len(self._candidate.rows):
            return None
        frame, match, shift, _ = self._candidate.rows[-1].tolist()
        return Candidate(frame, match, shift, *self._evidence.rows[-1].tolist())

    def add(self, candidate: Candidate, follows: bool) -> int:
        """Writes a candidate down, in the newest run if it follows that, else in a new one; the run."""
        if not follows:
            self._verdict.append(Verdict.OPEN)
            self._distance.append(np.inf)
            self._weight.append(0.0)
        self._candidate.append((candidate.frame, candidate.match, candidate.shift, self.runs - 1))
        self._evidence.append((candidate.mass, candidate.gain))
        self._lines = None
        return self.runs - 1

    def members(self, run: int) -> np.ndarray:
        """[n, 4] frame, match, shift, run of one run's candidates."""
        return self._candidate.rows[self._candidate.rows[:, 3] == run]

    def score(self, run: int) -> float:
        """Evidence of a run: the log-likelihood ratios of its candidates, added up."""
        return float(self._evidence.rows[self._candidate.rows[:, 3] == run, 1].sum())

    def scores(self) -> np.ndarray:
        """[R] the same of every run."""
        rows, known = self._candidate.rows, self._candidate.rows[:, 3] >= 0
        return np.bincount(rows[known, 3], self._evidence.rows[known, 1], self.runs)

    def sizes(self) -> np.ndarray:
        """[R] candidates in every run."""
        run = self._candidate.rows[:, 3]
        return np.bincount(run[run >= 0], minlength=self.runs)

    def spans(self) -> np.ndarray:
        """[R, 2] first and last frame of every run; first after last where all is struck out."""
        spans = np.tile(np.array([np.iinfo(np.int64).max, -1]), (self.runs, 1))
        rows = self._candidate.rows[self._candidate.rows[:, 3] >= 0]
        np.minimum.at(spans[:, 0], rows[:, 3], rows[:, 0])
        np.maximum.at(spans[:, 1], rows[:, 3], rows[:, 0])
        return spans

    def verdicts(self) -> np.ndarray:
        """[R] what became of every run."""
        return self._verdict.rows

    def verdict(self, run: int) -> Verdict:
        """What became of a run."""
        return Verdict(int(self._verdict.rows[run]))

    def judge(self, run: int, verdict: Verdict, distance: float | None = None) -> None:
        """Accepts, refuses or undoes a run; `distance` is its squared Mahalanobis distance."""
        self._verdict.rows[run] = verdict
        self._weight.rows[run] = float(verdict == Verdict.ACCEPTED)
        if distance is not None:
            self._distance.rows[run] = distance
        self._lines = None

    def strike(self, frame: int, spare: int) -> None:
        """Strikes out what accepted runs but `spare` say of `frame` and later: a break lies before it."""
        rows = self._candidate.rows
        accepted = self._verdict.rows[rows[:, 3]] == Verdict.ACCEPTED
        rows[(rows[:, 0] >= frame) & accepted & (rows[:, 3] != spare) & (rows[:, 3] >= 0), 3] = -1
        self._lines = None

    def accepted(self) -> np.ndarray:
        """[M] rows of the candidates that are closures."""
        if self._lines is None:
            run = self._candidate.rows[:, 3]
            self._lines = np.flatnonzero((run >= 0) & (self._verdict.rows[run] == Verdict.ACCEPTED))
        return self._lines

    def closures(self, angle: float, variance: np.ndarray, scales: tuple[float, float, float]) -> Closures:
        """The closures of the map.

        Args:
            angle: of a sector, rad. variance: [3] of a closure. scales: robust scale for each unit of a
                run's score, and the least and the largest scale.
        """
        rows = self._candidate.rows[self.accepted()]
        runs, run = np.unique(rows[:, 3], return_inverse=True)
        score = np.bincount(run, self._evidence.rows[self.accepted(), 1], len(runs))
        return Closures(
            i=rows[:, 1],
            j=rows[:, 0],
            turn=-rows[:, 2] * angle,
            run=run,
            variance=variance,
            scale=np.clip(scales[0] * score, *scales[1:]),
            score=score,
        )

    def weigh(self, weights: np.ndarray) -> None:
        """Notes the robust weights of the accepted runs, in order."""
        self._weight.rows[np.unique(self._candidate.rows[self.accepted(), 3])] = weights

    def weights(self) -> np.ndarray:
        """[M] weight of each closure's run."""
        return self._weight.rows[self._candidate.rows[self.accepted(), 3]]

    def table(self) -> np.ndarray:
        """[n, 9] all candidates: frame, match, shift, mass, gain, run, its distance, verdict and weight."""
        run = self._candidate.rows[:, 3]
        of_run = np.stack([self._distance.rows, self._verdict.rows, self._weight.rows], axis=1)[run]
        of_run[run < 0] = np.inf, Verdict.UNDONE, 0.0
        return np.concatenate(
            [self._candidate.rows[:, :3], self._evidence.rows, run[:, None], of_run], axis=1
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Its whole state."""
        return copy_arrays(self)

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        restore_arrays(self, arrays)
        self._lines = None
