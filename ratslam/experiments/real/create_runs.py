"""Sessions of a real Create with a depth camera of nine rays, by method, cell size and sector width."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.trajectory import ate
from ratslam.experiments.tables.buildings import BuildingsRow, buildings_rows
from ratslam.experiments.trials.recording_trial import RecordingRun, closure_claims, run_recording
from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.keyframes.map import KeyframeMap
from ratslam.keyframes.map_solution import cheapest_map
from tactile.base.se2 import between, integrate, wrap

FALSE_DISTANCE, FALSE_TURN = 0.5, np.radians(30)
"""A closure is false if its true positions are further apart, m, or its claimed difference of headings is off
by more. The room is 4.6 m wide."""
TRUE_DISTANCE, TRUE_TURN = 0.3, np.radians(15)
"""A keyframe is a true revisit of an older one this near that faces alike."""
DEFAULT = "create 1 1"
"""Name of the session with the settings of the configuration."""
REVISIT_SCORE = 3.0
"""Evidence given to each true revisit, as of the candidates of recall."""


class Variant(NamedTuple):
    """One session.

    Attributes:
        odometry, final, live, map: ATE of odometry, of the trajectory given at the end, of the live pose and
            of the map, m. doubt: final probability that the map is worse than odometry. accepted, false:
            closures. candidates, right: all candidates in sequences, and those that are not false.
        revisits: ATE of odometry with true revisits in place of the candidates, m.
    """

    odometry: float
    final: float
    live: float
    map: float
    doubt: float
    accepted: int
    false: int
    candidates: int
    right: int
    revisits: float


def create_rows() -> dict[str, BuildingsRow]:
    """The sessions by keyframes: half, once and twice the cell size and sector width of the configuration."""
    return {name: row for name, row in buildings_rows().items() if row.section == "create"}


def run_variants(folder: Path) -> Iterator[tuple[str, RecordingRun]]:
    """The sessions of `create_rows`, and one by the classic method.

    Args:
        folder: of the repository, which holds `configs`.
    """
    rows = create_rows()
    default = rows[DEFAULT].recording
    yield "classic", run_recording(default.configuration(folder, "backend=classic"))
    for name, row in rows.items():
        yield name, run_recording(row.configuration(folder))


def measure_variant(run: RecordingRun) -> Variant:
    """The figures of a session."""
    claims, slam_map = closure_claims(run), run.session.map
    false = (claims.distance > FALSE_DISTANCE) | (claims.turn > FALSE_TURN)
    return Variant(
        odometry=run.ate(run.odometry),
        final=run.ate(run.final),
        live=run.ate(run.online),
        map=run.ate(slam_map.map_trajectory()),
        doubt=slam_map.final_doubt(),
        accepted=int(claims.accepted.sum()),
        false=int((false & claims.accepted).sum()),
        candidates=len(false),
        right=int((~false).sum()),
        revisits=revisits_ate(run, slam_map) if isinstance(slam_map, KeyframeMap) else float("nan"),
    )


def revisits_ate(run: RecordingRun, slam_map: KeyframeMap) -> float:
    """ATE of the keyframes with the true revisits as closures in the same graph, m: what recall could give
    if it recognised every revisit, with the sectors' resolution, and nothing else."""
    graph, steps = slam_map.keyframes().copy(), slam_map.keyframe_steps()
    truth, log = run.truth[steps], ClosureLog()
    for candidate in true_revisits(graph, truth):
        last = log.last()
        log.add(candidate, last is not None and candidate.keyframe - last.keyframe <= graph.config.max_gap)
    for sequence in range(log.sequences):
        log.judge(sequence, Verdict.ACCEPTED)
    graph.dead_reckon()
    known = np.isfinite(truth).all(axis=1)
    poses = cheapest_map(graph, log, [graph.start]).fit.poses
    return ate(poses[known], truth[known])


def true_revisits(graph: KeyframeGraph, truth: np.ndarray) -> Iterator[Candidate]:
    """Of each keyframe, the nearest older one at the same true place; `truth` is [N, 3]."""
    for k in range(graph.guard, len(truth)):
        old = truth[: k - graph.guard]
        apart = np.hypot(*(old - truth[k])[:, :2].T)
        turn = wrap(truth[k, 2] - old[:, 2])
        same = (apart < TRUE_DISTANCE) & (np.abs(turn) < TRUE_TURN)
        if same.any():
            match = int(np.argmin(np.where(same, apart, np.inf)))
            shift = round(-float(turn[match]) / graph.sector_angle)
            yield Candidate(k, match, shift, 1.0, REVISIT_SCORE)


def true_turns_ate(run: RecordingRun) -> float:
    """ATE of odometry whose turns are replaced by the true ones, m: what is left if headings were known."""
    known = np.isfinite(run.truth).all(axis=1)
    odometry, truth = run.odometry[known], run.truth[known]
    motion = between(odometry[:-1], odometry[1:])
    forward = motion[:, 0] * np.cos(motion[:, 2] / 2) + motion[:, 1] * np.sin(motion[:, 2] / 2)
    turn = wrap(np.diff(truth[:, 2]))
    driven = np.stack([forward * np.cos(turn / 2), forward * np.sin(turn / 2), turn], axis=1)
    return ate(np.concatenate([np.zeros((1, 3)), integrate(driven)]), truth)
