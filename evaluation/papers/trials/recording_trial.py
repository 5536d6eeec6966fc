"""A recording with truth, or a perturbed copy of it, through one backend, held in memory."""

from __future__ import annotations

import csv
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from evaluation.metrics.trajectory import ate
from evaluation.studies.perturbation import Perturbation
from ratslam.core.session import Session
from ratslam.runs.build_session import build_session
from ratslam.runs.open_source import open_observations
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.in_memory import load_into_memory
from robot.touch_source import observation_of
from tactile.base.errors import InputError
from tactile.base.se2 import integrate, wrap


class RecordingRun(NamedTuple):
    """A finished session of T steps over a recording.

    Attributes:
        config: completed for the recording. truth: [T, 3] true poses, rows of NaN where unknown. odometry,
            online, final: [T, 3] poses by dead reckoning, as estimated at the time, and of the final map.
    """

    config: RunConfig
    session: Session
    truth: np.ndarray
    odometry: np.ndarray
    online: np.ndarray
    final: np.ndarray

    def ate(self, poses: np.ndarray) -> float:
        """ATE of poses [T, 3] at the steps with truth, m."""
        known = np.isfinite(self.truth).all(axis=1)
        return ate(poses[known], self.truth[known])


class ClosureClaims(NamedTuple):
    """What n candidates of closure sequences claim, beside the truth; n is 0 for maps without candidates.

    A candidate claims that its two steps have the same position, and headings that differ by the sectors that
    its view is shifted by.

    Attributes:
        sequence: [n] number of its sequence. accepted: [n] bool. distance: [n] between the true positions, m;
            NaN where the truth is unknown. turn: [n] between the claimed difference of the headings and the
            true one, rad, not negative; NaN likewise. log_odds: [n] that its sequence is true; NaN where no
            odds decide.
    """

    sequence: np.ndarray
    accepted: np.ndarray
    distance: np.ndarray
    turn: np.ndarray
    log_odds: np.ndarray


def run_recording(config: RunConfig, perturbation: Perturbation | None = None, seed: int = 0) -> RecordingRun:
    """Maps a recording, or the perturbed copy of a seed.

    Raises:
        InputError: the recording cannot be used, or has no truth.
    """
    with open_observations(config) as (config, source):
        log = load_into_memory(source)
    if log.truth is None:
        raise InputError(log.name, "no true poses", "a recording with truth")
    if perturbation is not None:
        log = perturbation(log, seed)
    session = build_session(config, log)
    steps = list(session.replay(observation_of(sample) for sample in log))
    return RecordingRun(
        config=config,
        session=session,
        truth=np.asarray(log.truth),
        odometry=integrate(log.motion[:, :3]),
        online=np.array([step.pose for step in steps]),
        final=session.map.trajectory(),
    )


def closure_claims(run: RecordingRun) -> ClosureClaims:
    """The claims of all candidates in closures.csv that belong to a sequence."""
    rows = [row for row in _closure_rows(run.session) if int(row["sequence"]) >= 0]
    step, match, shift, sequence = (
        np.array([int(row[name]) for row in rows], int)
        for name in ("step", "match_step", "shift", "sequence")
    )
    later, earlier = run.truth[step], run.truth[match]
    angle = run.session.map.feedback().angle if rows else 0.0
    return ClosureClaims(
        sequence=sequence,
        accepted=np.array([row["verdict"] == "accepted" for row in rows], bool),
        distance=np.hypot(*(later - earlier)[:, :2].T),
        turn=np.abs(wrap(later[:, 2] - earlier[:, 2] + shift * angle)),
        log_odds=np.array([float(row["log_odds"]) for row in rows], float),
    )


def _closure_rows(session: Session) -> list[dict[str, str]]:
    """The rows of closures.csv by column; none for a map without that file."""
    write = session.map.files().get("closures.csv")
    if write is None:
        return []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "closures.csv"
        write(path)
        return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
