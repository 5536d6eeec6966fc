"""The scores of networks over a course: drift, decoding error, rate maps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evaluation.studies.study_course import StudyCourse
from ratslam.classic.cell_batch import SEGMENT, CellSets, CellTrack, walk
from ratslam.classic.pose_cell_config import rings, units
from ratslam.classic.pose_cells import Outcome


class SetScores(NamedTuple):
    """The scores of B networks.

    Drift is the packet, followed round the torus, minus the pose that it would have without drift. The
    decoding error is the same on the torus, the shortest way.

    Attributes:
        drift, drift_heading: [B] rms over the course, m and rad. drift_end, drift_heading_end: [B] after the
            last step, m and rad. decoding, decoding_heading: [B] mean over the course, m and rad. reseeded:
            [B] share of steps at which activity had died out. larger: [B] share of steps that needed more
            than the smallest window. maps: [B, C, H, W] float32 mean activity of the chosen cells in each
            place bin, NaN where the robot never was.
    """

    drift: np.ndarray
    drift_heading: np.ndarray
    drift_end: np.ndarray
    drift_heading_end: np.ndarray
    decoding: np.ndarray
    decoding_heading: np.ndarray
    reseeded: np.ndarray
    larger: np.ndarray
    maps: np.ndarray


class _Sums:
    """What is summed over the segments of a course, for B networks, in float64."""

    def __init__(self, study: StudyCourse, count: int) -> None:
        self._study = study
        self._ring, self._unit = rings(study.config, np.dtype(float)), units(study.config, np.dtype(float))
        self._bins = (len(study.y_edges) - 1) * (len(study.x_edges) - 1)
        self._before = np.tile(self._ring // 2, (count, 1))  # wrapped packets
        self._packet = self._before.copy()  # the same, followed round the torus
        self._last = np.zeros((count, 2))
        self._squares, self._errors = np.zeros((count, 2)), np.zeros((count, 2))
        self._reseeded, self._larger = np.zeros(count), np.zeros(count)
        self._maps = np.zeros((count, len(study.chosen) * self._bins))

    def add(self, first: int, track: CellTrack) -> None:
        """Adds a segment [B, S] that begins at step `first`."""
        pose, activity, outcome, level = track
        count, length = outcome.shape
        rows = slice(first, first + length)
        wrapped = np.concatenate([self._before[:, None], pose], axis=1)
        gone = self._shortest(np.diff(wrapped, axis=1))
        packet = self._packet[:, None] + np.cumsum(gone, axis=1)
        self._before, self._packet = wrapped[:, -1], packet[:, -1]
        error = packet - self._study.expected[None, rows]
        drift = self._lengths(error)
        self._last = drift[:, -1]
        self._squares += (drift**2).sum(axis=1)
        self._errors += self._lengths(self._shortest(error)).sum(axis=1)
        self._reseeded += (outcome == Outcome.RESEEDED).sum(axis=1)
        self._larger += (level > 0).sum(axis=1)
        cells = activity.shape[2]
        at = np.arange(cells) * self._bins + self._study.bin[rows, None]
        at = at[None] + np.arange(count)[:, None, None] * (cells * self._bins)
        weight = activity * self._study.seconds[None, rows, None]
        self._maps += np.bincount(at.ravel(), weight.ravel(), self._maps.size).reshape(self._maps.shape)

    def scores(self) -> SetScores:
        """The scores of all steps added."""
        study, steps = self._study, len(self._study.expected)
        seconds = np.bincount(study.bin, study.seconds, self._bins)
        maps = self._maps.reshape(len(self._maps), -1, self._bins)
        mean = np.divide(maps, seconds, out=np.full_like(maps, np.nan), where=seconds > 0)
        place = len(study.y_edges) - 1, len(study.x_edges) - 1
        rms, mean_error = np.sqrt(self._squares / steps), self._errors / steps
        return SetScores(
            rms[:, 0], rms[:, 1], self._last[:, 0], self._last[:, 1], mean_error[:, 0], mean_error[:, 1],
            self._reseeded / steps, self._larger / steps,
            mean.astype(np.float32).reshape(*maps.shape[:2], *place),
        )  # fmt: skip

    def _shortest(self, difference: np.ndarray) -> np.ndarray:
        return difference - self._ring * np.round(difference / self._ring)

    def _lengths(self, error: np.ndarray) -> np.ndarray:
        """[..., 2] m and rad of differences [..., 3] in cells."""
        x, y, heading = np.moveaxis(error * self._unit, -1, 0)
        return np.stack([np.hypot(x, y), np.abs(heading)], axis=-1)


def score_sets(study: StudyCourse, sets: CellSets, dtype: np.dtype) -> SetScores:
    """Simulates B networks over the course in the given precision and scores them.

    Memory does not depend on the length of the course, apart from the course itself.
    """
    course = study.course._replace(
        **{
            name: np.asarray(getattr(study.course, name), dtype)
            for name in ("motion", "noise", "turned", "energy")
        }
    )
    sums = _Sums(study, len(sets.speed_noise))
    for k, track in enumerate(walk(study.config, sets, course, study.chosen)):
        sums.add(k * SEGMENT, track)
    return sums.scores()
