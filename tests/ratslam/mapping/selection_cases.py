"""Worlds to select closure sequences from: laps with noise, true sequences and a false one."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ratslam.mapping.closure_selection import STEPS, MapHypotheses, SelectionProblem
from ratslam.mapping.optimizer import CalibrationPrior, LoopClosures, MapFit, MapProblem, OdometryChain, solve
from tactile.base.se2 import between, compose, fit_rigid_motion, integrate, wrap

LAP, STEP, RUN = 60, 0.03, 12
NOISE = np.array([0.006, 0.006, 0.012])  # of odometry, at each frame
SPREAD = np.array([0.03, 0.03, 0.08])  # of closures
PRIOR = CalibrationPrior(0.0, 0.02)


class World(NamedTuple):
    """A robot on a loop: true poses [N, 3], the R sequences to select from in order of time, and which of
    them [R] are false."""

    truth: np.ndarray
    case: SelectionProblem
    false: np.ndarray

    def reckoned(self) -> MapFit:
        poses = integrate(self.case.measurements.chain.motion, self.truth[0])
        return MapFit(np.vstack([self.truth[:1], poses]), 0.0, np.zeros(0))

    def present(self) -> MapFit:
        """A map that takes all sequences as they fit, starting from odometry."""
        return solve(self.reckoned(), self.case.measurements, STEPS)

    def starts(self) -> list[MapFit]:
        """The maps that a selection starts from."""
        return [self.present(), *self.hypotheses()]

    def hypotheses(self) -> list[MapFit]:
        return MapHypotheses().follow(self.case, np.arange(len(self.case.evidence)))

    def find_cut(self, poses, onwards, carried, since):
        """The frame from which the carried poses are nearer to the truth, as ideal views would show."""
        frames = np.arange(since + 1, since + 1 + len(onwards))
        truth = compose(fit_rigid_motion(self.truth[:LAP], poses[:LAP]), self.truth[frames])
        stays, goes = (
            np.minimum(np.hypot(*(rows - truth)[:, :2].T) / 0.1, 1.0)
            for rows in (onwards, compose(carried, onwards))
        )
        cost = np.concatenate([[0], np.cumsum(stays)[:-1]]) + np.cumsum(goes[::-1])[::-1]
        return int(frames[len(cost) - 1 - np.argmin(cost[::-1])])


def lap_poses(place: np.ndarray) -> np.ndarray:
    """[n, 3] the poses at places (in frames) along a lap that is not a circle."""
    at = 2 * np.pi * np.arange(LAP) / LAP
    x, y = 0.35 * np.cos(at) + 0.06 * np.cos(3 * at), 0.25 * np.sin(at)
    heading = np.arctan2(np.roll(y, -1) - y, np.roll(x, -1) - x)
    return np.column_stack([x, y, heading])[place % LAP]


def world(
    seed: int,
    laps: int = 4,
    jumps: tuple[tuple[int, int], ...] = (),
    false: float = 0.0,
    false_at: tuple[int, int] = (2 * LAP + 6, LAP // 2),
    least: float = 25.0,
    noise: float = 1.0,
) -> World:
    """Laps with noise, and true sequences of closures with the first lap, every 20 frames.

    Args:
        jumps: (frame, places) by which the robot is carried ahead before a frame. false: evidence of one
            sequence more. false_at: its first frame, and by how many places it is wrong. least: evidence of
            the true sequences. noise: factor on the noise of the odometry.
    """
    stream, place = np.random.default_rng(seed), np.arange(laps * LAP)
    steps = between(lap_poses(place[:-1]), lap_poses(place[1:]))
    for frame, places in jumps:
        place[frame:] += places
    truth = lap_poses(place)
    true = between(truth[:-1], truth[1:])
    for frame, _ in jumps:
        true[frame - 1] = steps[frame - 1]  # odometry does not measure the jump
    motion = true + noise * stream.normal(0, NOISE, true.shape)
    motion[:, 2] = wrap(motion[:, 2])
    variance = np.tile((noise * NOISE) ** 2, (len(motion), 1))
    chain = OdometryChain(motion, np.hypot(motion[:, 0], motion[:, 1]), variance)

    edges = sorted({*range(LAP, len(place) + 1, 20), *(frame for frame, _ in jumps)})
    spans = [(first + int(stream.integers(0, 4)), end) for first, end in pairwise(edges)]
    sequences = [np.arange(first, min(first + RUN, end)) for first, end in spans if end - first >= 8]
    evidence = stream.uniform(least, 40.0, len(sequences))
    ahead = np.zeros(len(sequences), int)
    if false:
        sequences.append(np.arange(false_at[0], false_at[0] + RUN))
        evidence, ahead = np.append(evidence, false), np.append(ahead, false_at[1])
    order = sorted(range(len(sequences)), key=lambda k: int(sequences[k][0]))
    sequences, evidence, ahead = [sequences[k] for k in order], evidence[order], ahead[order]
    match = [(place[frames] + off) % LAP for frames, off in zip(sequences, ahead, strict=True)]
    problem = MapProblem(chain, closures_of(sequences, match, evidence), PRIOR)
    first, last = np.array([[frames[0], frames[-1]] for frames in sequences]).T
    return World(truth, SelectionProblem(problem, evidence, first, last, lambda poses: 0.0), ahead != 0)


def closures_of(frames: list[np.ndarray], match: list[np.ndarray], evidence: np.ndarray) -> LoopClosures:
    """The closures of R sequences, each of frames [n] with older ones [n], that cost what their evidence [R]
    allows."""
    members = np.array([len(sequence) for sequence in frames])
    scale, sequence = 2 * (evidence - 6) / members, np.repeat(np.arange(len(frames)), members)
    closures = np.concatenate(match), np.concatenate(frames), np.zeros(members.sum()), sequence
    limit = np.maximum(6.0, 1.5 * scale)
    return LoopClosures(*closures, variance=SPREAD**2, scale=scale, score=evidence, cost_limit=limit)


def off(fit: MapFit, truth: np.ndarray) -> float:
    """Largest distance from the truth, m."""
    aligned = compose(fit_rigid_motion(fit.poses, truth), fit.poses)
    return float(np.hypot(*(aligned - truth)[:, :2].T).max())
