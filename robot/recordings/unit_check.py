"""Checks whether a recording is in seconds, metres and radians, from most of its motion.

The typical speed is the one above which half of the path was covered; the typical turn rate the one above
which half of all turning was done. Standing still and sensor noise do not affect them, and the two fastest
steps are ignored, so that a single glitch has no effect. Data in millimetres are a thousand times too fast,
data in degrees turn 57 times too fast. Of a very slow robot this is detectable only by comparison with the
truth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import Field

from tactile.base.config import Settings
from tactile.base.errors import InputError

GLITCHES = 2  # number of fastest steps that are ignored
PAUSE = 1000.0  # median steps: a longer step is an error of the clock and is ignored
RATIO = 30.0  # of odometry and truth; correct data are near 1, a wrong unit gives 57 or 1000
LEAST, MOST = 0.3, 5.0  # m or rad: smaller and larger total below which the ratio is not judged
RULER = 0.05  # m: smallest step in measuring the true path, so that noise does not add up
STRETCHES = 50  # net turning is compared over this many, so that noise does not add up


class UnitLimits(Settings):
    """Limits of the unit check. Raise a limit for a robot that exceeds it."""

    speed: float = Field(default=25.0, gt=0)
    """Largest typical speed, m/s: a car in town drives 15; an arm of 30 mm/s, read as m/s, 30."""
    turn_rate: float = Field(default=6.0, gt=0)
    """Largest typical turn rate, rad/s: robots turn at 0.2 to 1, which in degrees is 11 to 57."""
    interval: float = Field(default=60.0, gt=0)
    """Longest median step, s: 100 ms taken for seconds is 100."""


DEFAULT_LIMITS = UnitLimits()


class MotionTrack(NamedTuple):
    """The data of a recording used by the unit check.

    Attributes:
        time: [N] s. moved: [N] rows with odometry. motion: [N, 4] (dx m, dy m, dtheta rad, dt s).
        truth: [N, 3] (x m, y m, heading rad), NaN where unknown; or None.
    """

    time: np.ndarray
    moved: np.ndarray
    motion: np.ndarray
    truth: np.ndarray | None


class TypicalMotion(NamedTuple):
    """Typical motion of a robot.

    Attributes:
        interval: median time between rows, s. speed: m/s. turn_rate: rad/s. turn: rad in one step.
        true_speed: of the truth, m/s. path, turning: totals (odometry, truth), m and net rad. NaN without
            truth.
    """

    interval: float
    speed: float
    turn_rate: float
    turn: float
    true_speed: float
    path: tuple[float, float]
    turning: tuple[float, float]


def typical_motion(track: MotionTrack) -> TypicalMotion:
    """The typical motion in a track; rows with errors are ignored."""
    steps = np.diff(track.time[track.moved & np.isfinite(track.time)])
    interval = float(np.median(steps)) if len(steps) else 0.0
    dt = track.motion[:, 3]
    good = np.isfinite(track.motion).all(axis=1) & (dt > 0) & (dt <= PAUSE * interval)
    length, turn = np.hypot(track.motion[good, 0], track.motion[good, 1]), np.abs(track.motion[good, 2])
    true_speed, path, turning = _compare_with_truth(track, good)
    speed, turn_rate = _typical(length, dt[good]), _typical(turn, dt[good])
    in_step = _typical(turn, np.ones_like(turn))
    return TypicalMotion(interval, speed, turn_rate, in_step, true_speed, path, turning)


def unit_errors(track: MotionTrack, where: str, limits: UnitLimits = DEFAULT_LIMITS) -> list[InputError]:
    """Errors of a whole recording: times not in s, motion not in m or rad, odometry that disagrees with
    truth.

    Each cause is reported once: the truth is compared only where no other check has found an error.
    """
    errors = []
    if track.truth is not None:
        errors = heading_errors(track.truth[:, 2], track.time, "the truth's heading", where, limits)
        if errors:
            track = track._replace(truth=track.truth * (1, 1, np.pi / 180))
    found = _possible_errors(typical_motion(track), limits)
    return errors + [InputError(where, *words) for wrong, *words in found if wrong]


def _possible_errors(robot: TypicalMotion, limits: UnitLimits) -> tuple[tuple[bool, str, str, str], ...]:
    """All possible faults: (present, finding, expectation, cure)."""
    rushes, truth_rushes = robot.speed > limits.speed, robot.true_speed > limits.speed
    spins = robot.turn_rate > limits.turn_rate or robot.turn > np.pi
    fast, quick = _else("speed", limits), _else("turn_rate", limits)
    slow = f"divide by 1000 if they are ms; {_else('interval', limits)}"
    turning = f"half of the turning is done at over {robot.turn_rate:.4g} rad/s, {robot.turn:.3g} rad a step"
    paths = "the odometry covers {:.4g} m, the truth {:.4g} m".format(*robot.path)
    turns = "the odometry turns by {:.4g} rad, the truth by {:.4g} rad".format(*robot.turning)
    half = "half of the {} is driven at over {:.4g} m/s"
    unlike_paths = not rushes and not truth_rushes and _differ_by_unit(*robot.path)
    interval = f"half of the steps take over {robot.interval:.4g} s"
    return (
        (robot.interval > limits.interval, interval, "times in seconds", slow),
        (rushes, half.format("path", robot.speed), "odometry in metres", f"{_MILLIMETRES}; {fast}"),
        (spins, turning, "odometry in radians", f"{_DEGREES}; {quick}"),
        (
            truth_rushes,
            half.format("truth's path", robot.true_speed),
            "truth in metres",
            f"{_MILLIMETRES}; {fast}",
        ),
        (unlike_paths, paths, "both in metres", _MILLIMETRES),
        (not spins and _differ_by_unit(*robot.turning), turns, "both in radians", _DEGREES),
    )


def heading_errors(
    heading: np.ndarray, time: np.ndarray, what: str, where: str, limits: UnitLimits = DEFAULT_LIMITS
) -> list[InputError]:
    """Errors of a heading column [N] that must be in degrees: wider than a turn and too fast for radians."""
    good = np.isfinite(heading) & np.isfinite(time)
    heading, dt = heading[good], np.diff(time[good])
    if not len(heading) or np.abs(heading).max() <= 2 * np.pi + 0.1:
        return []  # wrapped radians, or too few degrees to decide
    turn = np.abs(np.diff(heading))
    turn = np.minimum(turn, np.abs(360 - turn))[dt > 0]
    rate = _typical(turn, dt[dt > 0])
    if rate <= limits.turn_rate and _typical(turn, np.ones_like(turn)) <= np.pi:
        return []
    found = f"{what} runs from {heading.min():.4g} to {heading.max():.4g}, mostly at {rate:.3g} a second"
    return [InputError(where, found, "a heading in radians", f"{_DEGREES}; {_else('turn_rate', limits)}")]


def _typical(amount: np.ndarray, duration: np.ndarray) -> float:
    """The rate above which half of the total amount [N] falls."""
    rate = amount / duration
    order = np.argsort(rate)[: max(len(rate) - GLITCHES, 0)]
    done = np.cumsum(amount[order])
    return float(rate[order][np.searchsorted(done, done[-1] / 2)]) if len(done) and done[-1] > 0 else 0.0


def _compare_with_truth(
    track: MotionTrack, good: np.ndarray
) -> tuple[float, tuple[float, float], tuple[float, float]]:
    """Speed of the truth; path and net turning of odometry and truth. NaN without truth."""
    nothing = np.nan, (np.nan, np.nan), (np.nan, np.nan)
    if track.truth is None:
        return nothing
    rows = np.flatnonzero(np.isfinite(track.truth).all(axis=1))
    if len(rows) <= GLITCHES + 1:
        return nothing
    motion, truth = np.where(good[:, None], track.motion, 0.0), track.truth[rows]
    driven = np.diff(np.cumsum(np.hypot(motion[:, 0], motion[:, 1]))[rows])
    length, dt = np.hypot(*np.diff(truth[:, :2], axis=0).T), np.diff(track.time[rows])
    speed = _typical(length[dt > 0], dt[dt > 0])
    path = _most_of(driven), _most_of(_ruler_steps(truth[:, :2]))
    ends = np.unique(np.linspace(0, len(rows) - 1, STRETCHES + 1).astype(int))
    turned = np.abs(np.diff(np.cumsum(motion[:, 2])[rows][ends]))
    return speed, path, (_most_of(turned), _most_of(np.abs(np.diff(np.unwrap(truth[:, 2])[ends]))))


def _ruler_steps(points: np.ndarray) -> np.ndarray:
    """Lengths of steps of at least `RULER` along the points [N, 2]."""
    steps, last = [0.0], complex(*points[0])
    for point in (points[:, 0] + 1j * points[:, 1]).tolist():
        if (step := abs(point - last)) >= RULER:
            steps.append(step)
            last = point
    return np.array(steps)


def _most_of(amounts: np.ndarray) -> float:
    return float(np.sort(amounts)[:-GLITCHES].sum())


def _differ_by_unit(a: float, b: float) -> bool:
    """Whether two totals differ by more than `RATIO`, as with a wrong unit; never for NaN."""
    least, most = min(a, b), max(a, b)
    return least > LEAST and most > MOST and most > RATIO * least


def _else(name: str, limits: UnitLimits) -> str:
    return f"if it really is so, raise limits.{name} ({getattr(limits, name):g})"


_DEGREES = "multiply by pi/180 if it is degrees"
_MILLIMETRES = "divide by 1000 if it is millimetres"
