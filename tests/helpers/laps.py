"""Sessions on laps around a square, made up."""

import numpy as np

from evaluation.studies.metrics import SessionResult


def square(word, side=12):
    """True poses of laps around a square of 0.36 m, 3 cm a step; C clockwise, A anticlockwise."""
    way = np.linspace(0, 1, side, endpoint=False)
    zero, one = np.zeros(side), np.ones(side)
    x = 0.36 * np.concatenate([way, one, 1 - way, zero])
    y = 0.36 * np.concatenate([zero, way, one, 1 - way])
    heading = np.repeat([0, np.pi / 2, np.pi, -np.pi / 2], side)
    lap = np.column_stack([x, y, heading])
    back = np.roll(lap[::-1], 1, axis=0) + [0, 0, np.pi]
    laps = [lap if letter == "A" else back for letter in word]
    return np.concatenate([*laps, laps[-1][:1]])


def session(truth, **given):
    still = dict.fromkeys(("truth", "odometry", "trajectory", "node", "live"), truth)
    still |= {"place": np.arange(len(truth)), "piece": np.zeros(len(truth), int)}
    return SessionResult(**still | {"closures": np.zeros((0, 2), int)} | given)
