"""Random poses and motions, and a loop of keyframes that all look different."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ratslam.mapping.ground import GainOdds, Ground, Motion, PoseHypothesis, learn_gain_odds
from tactile.base.se2 import between, compose, integrate, wrap

REACH, REACH_HEADING = 0.06, 0.3
VARIANCE = np.array([0.04, 0.04, 0.12]) ** 2

POSES = st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-np.pi, np.pi)).map(np.array)
VARIANCES = arrays(np.float64, 3, elements=st.sampled_from((0.0, 1e-5, 1e-4, 1e-3, 0.01)))
STEPS = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.5, 0.5)).map(np.array)
MOTIONS = st.builds(Motion, STEPS, VARIANCES)
SEEDS = st.integers(0, 2**32 - 1)


def ground_at(poses: np.ndarray, turns: tuple[float, ...] = (0.0,)) -> Ground:
    return Ground(np.atleast_2d(poses), np.array(turns), REACH, REACH_HEADING, VARIANCE)


def supposed(pose: np.ndarray, deviation: float = 0.02) -> PoseHypothesis:
    return PoseHypothesis(pose, np.diag(np.full(3, deviation**2)))


def assert_same_pose(found: np.ndarray, expected: np.ndarray, tolerance: float = 1e-9) -> None:
    error = np.asarray(found) - expected
    error[..., 2] = wrap(error[..., 2])
    np.testing.assert_allclose(error, 0, atol=tolerance)


class Loop:
    """A square loop whose places all look different, with keyframes 0.05 m apart, 20 along each edge."""

    def __init__(self) -> None:
        motion = np.array([[0.05, 0.0, 0.0]] * 79)
        motion[19::20, 2] = np.pi / 2
        self.poses = np.vstack([np.zeros(3), integrate(motion)])
        self.ground = ground_at(self.poses)

    def drive(self, begin: int, count: int, seed: int) -> np.ndarray:
        """[count, 3] true poses of a robot that drives along the loop, and is a little beside it."""
        beside = np.random.default_rng(seed).normal(0, [0.005, 0.005, 0.03], (count, 3))
        return compose(self.poses[(begin + np.arange(count)) % len(self.poses)], beside)

    def gains(self, truth: np.ndarray, seed: int) -> np.ndarray:
        """[n, 1, N] gains of views at true poses [n, 3]: high at the keyframes near by, low elsewhere."""
        stream, ground = np.random.default_rng([seed, 1]), self.ground
        gain = stream.normal(-0.5, 1.0, (len(truth), 1, len(self.poses)))
        for k, pose in enumerate(truth):
            near = ground.near(pose, 1.5 * REACH, 2 * REACH_HEADING)
            gain[k][near] = stream.normal(2.0, 0.7, len(near[0]))
        return gain.astype(np.float32)


def odds_of(true: float = 2.0, false: float = -0.3) -> GainOdds:
    """Log-odds of gains that were counted at these means."""
    stream = np.random.default_rng(0)
    return learn_gain_odds(stream.normal(true, 0.8, 2000), stream.normal(false, 1.0, 2000))


def motions_of(truth: np.ndarray, noise: float, seed: int) -> list[Motion]:
    """Measured motions into each of the poses [n, 3] but the first, into which there is none."""
    variance = np.full(3, noise**2)
    error = np.random.default_rng([seed, 2]).normal(0, noise, (len(truth) - 1, 3))
    steps = between(truth[:-1], truth[1:]) + error
    return [Motion(np.zeros(3), np.zeros(3)), *(Motion(step, variance) for step in steps)]
