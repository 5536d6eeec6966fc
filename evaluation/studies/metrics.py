"""The quantities of a run by name: label, unit, and which values are better; the columns of tables.

Beside those of the scorecard: metrics of Salman & Pearson 2016 on a session held in memory, closures, laps
that end at the start; and whether views alone separate places, by differences of views of the same place and
of different places.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.exm import ExmConfig, ExperienceMetric, experience_metric
from evaluation.metrics.metric import Finding, Metric, Quantity
from evaluation.metrics.occupancy_score import GRID_METRICS
from evaluation.metrics.run_metrics import RUN_METRICS
from evaluation.metrics.statistics import auc
from tactile.base.errors import InputError, did_you_mean
from tactile.base.se2 import wrap

MEASURED = (
    Metric("step_time", "time per step, median", "us", "low", "Study"),
    Metric("step_time_p99", "time per step, 99 % quantile", "us", "low", "Study"),
    Metric("run_time", "time per step with simulation, sensing and scoring", "us", "low", "Study"),
    Metric("compile_time", "time of compilation", "s", "low", "Study"),
    Metric("memory", "peak memory", "MiB", "low", "Study"),
)
"""Quantities that depend on the machine and its load."""
STUDY_METRICS = (
    Metric("recognition_error", "steps not recognised correctly, 1 - ARR x ARCR", "", "low", "Study"),
    Metric("map_error", "map error, eq. 6", "", "low", "Study"),
    Metric("error_online", "position error, online", "m", "low", "Study"),
    Metric("error_final", "position error, final", "m", "low", "Study"),
    Metric("closures", "loop closures", "", None, "Study"),
    Metric("false_closures", "false loop closures", "", "low", "Study"),
    Metric("lost_share", "share of steps lost", "", "low", "Study"),
    Metric("simulation_time", "simulation per second", "us", "low", "Study"),
    Metric("contact_difference", "contact pixels unlike the reference tier", "", "low", "Study"),
    Metric("height_difference", "height unlike the reference tier", "mm", "low", "Study"),
)
"""Quantities of a run beside those of its scorecard."""
METRICS = {metric.name: metric for metric in (*RUN_METRICS, *GRID_METRICS, *STUDY_METRICS, *MEASURED)}
"""All quantities."""
COLUMNS = {
    "means": ("energy_all", "exm_arr", "exm_arcr_strict", "ate_final", "anytime_late", "map_error", "map_auc",
              "step_time", "step_time_p99", "compile_time", "memory"),
    "pareto": (*(metric.name for metric in MEASURED), "exm_arr", "exm_arcr_strict", "energy_all",
               "ate_final", "map_error"),
    "medians": ("error_online", "error_final", "ate_final", "energy_all", "anytime_median", "anytime_late",
                "closures", "false_closures", "lost_share", "map_error", "step_time", "compile_time"),
    "differences": ("ate_final", "ate_online", "anytime_median", "anytime_late", "closures", "false_closures",
                    "lost_share"),
    "tiers": ("simulation_time", "contact_difference", "height_difference", "exm_arr", "exm_arcr_strict",
              "energy_all", "ate_final"),
    "costs": ("step_time", "step_time_p99", "run_time", "energy_all", "ate_final", "exm_arr",
              "exm_arcr_strict", "map_error"),
}  # fmt: skip
"""Columns of each kind of report, in order; those without a value are left out."""
ERRORS = {
    "em": "energy_all", "ate": "ate_final", "online": "ate_online", "late": "anytime_late",
    "arr": "exm_arr", "arcr": "exm_arcr_strict", "exm": "recognition_error", "map": "map_error",
    "auc": "map_auc", "relations": "relations_translation",
}  # fmt: skip
"""Short names of quantities for `--error`."""
DEFAULT_ERRORS = ("energy_all", "ate_final", "map_error", "relations_translation", "recognition_error")
"""Errors of a Pareto front, tried in this order if none is named."""


def quantities_of(findings: Mapping[str, Finding]) -> dict[str, Quantity]:
    """Findings by name, with label and unit."""
    return {name: METRICS[name].quantity(finding) for name, finding in findings.items()}


def find_error(name: str) -> str:
    """The quantity that a short or full name of `--error` means; an `InputError` if it names no error."""
    found = ERRORS.get(name, name)
    if found not in METRICS or METRICS[found].direction is None or METRICS[found] in MEASURED:
        every = [*ERRORS, *(each.name for each in METRICS.values() if each.direction)]
        raise InputError("--error", repr(name), f"one of {', '.join(ERRORS)}, ...", did_you_mean(name, every))
    return found


FALSE_CLOSURE_DISTANCE = 0.1
"""A closure is false if its steps are farther apart in truth, m (Salman & Pearson 2016, III-G)."""
HOME_RADIUS = 0.09
"""A robot this near to its start has returned to it, m: half a micromouse cell."""


class SessionResult(NamedTuple):
    """The outcome of a session of T steps.

    Attributes:
        truth, odometry, trajectory: [T, 3] true, dead-reckoned and final mapped poses. place: [T] current
            experience, -1 for none. node: [M, 3] poses of the experiences in the final map.
        closures: [K, 2] later and earlier step of each loop closure. live: [T, 3] pose given at each step, in
            the map of that time. piece: [T] piece of the map of each step.
    """

    truth: np.ndarray
    odometry: np.ndarray
    trajectory: np.ndarray
    place: np.ndarray
    node: np.ndarray
    closures: np.ndarray
    live: np.ndarray
    piece: np.ndarray


class TouchMetrics(NamedTuple):
    """Metrics of one session; NaN where a metric is not defined.

    Attributes:
        em: Energy Metric over all pairs of steps of the final map, m^2 + rad^2. em_experiences: the same with
            each step at the pose of its experience. em_odometry: the same of dead reckoning.
        arr, arcr: strict Experience Metric. arcr_chain_free: share of the re-localisations within its
            thresholds, whether or not earlier ones were correct.
        relocalisations, closures: counts. false_closures: closures beyond `FALSE_CLOSURE_DISTANCE`.
        experiences: in the map. steps: of the session.
    """

    em: float
    em_experiences: float
    em_odometry: float
    arr: float
    arcr: float
    arcr_chain_free: float
    relocalisations: int
    closures: int
    false_closures: int
    experiences: int
    steps: int


def touch_metrics(result: SessionResult, exm: ExmConfig | None = None) -> TouchMetrics:
    """All metrics of one session."""
    truth, place = result.truth, result.place
    known = place >= 0
    metric = experience_metric_if_defined(result, exm)
    return TouchMetrics(
        em=energy_all_pairs(result.trajectory, truth).total,
        em_experiences=energy_all_pairs(result.node[place[known]], truth[known]).total,
        em_odometry=energy_all_pairs(result.odometry, truth).total,
        arr=metric.arr if metric else np.nan,
        arcr=metric.arcr if metric else np.nan,
        arcr_chain_free=metric.arcr_chain_free if metric else np.nan,
        relocalisations=metric.relocalisations if metric else 0,
        closures=len(result.closures),
        false_closures=int((closure_errors(truth, result.closures) > FALSE_CLOSURE_DISTANCE).sum()),
        experiences=len(result.node),
        steps=len(truth),
    )


def closure_errors(truth: np.ndarray, closures: np.ndarray) -> np.ndarray:
    """[K] true distance between the two steps of each closure [K, 2], m, by true poses [T, 3]."""
    return np.hypot(*(truth[closures[:, 0]] - truth[closures[:, 1]])[:, :2].T)


def experience_metric_if_defined(
    result: SessionResult, exm: ExmConfig | None = None
) -> ExperienceMetric | None:
    """The Experience Metric; None where the robot never returned to its start or has no experience."""
    try:
        return experience_metric(result.place, result.truth, exm or ExmConfig())
    except InputError:
        return None


def lap_ends(truth: np.ndarray) -> np.ndarray:
    """[L] steps at which the robot returned to its start: the nearest step of each visit.

    Args:
        truth: [T, 3] true poses.
    """
    away = np.hypot(*(truth[:, :2] - truth[0, :2]).T)
    change = np.flatnonzero(np.diff((away < HOME_RADIUS).astype(int))) + 1
    visits = np.split(np.arange(len(truth)), change)[2::2]  # the path alternates: home, away, home, ...
    return np.array([visit[np.argmin(away[visit])] for visit in visits], int)


SAME_DISTANCE, SAME_HEADING, VISIT_GAP = 0.05, np.radians(15), 60.0
"""Two views are of the same place if taken within this distance (m) and heading (rad) on two visits, at least
this far apart in time (s)."""
OTHER_DISTANCE = 0.3
"""Two views are of different places if taken farther apart, m."""
BINS = 60
ROWS = 64
"""Views compared with all others at a time."""


class ViewDifferences(NamedTuple):
    """Differences of pairs of views.

    Attributes:
        edge: [BINS + 1] of the histograms. same, other: [BINS] pairs of views of one place, of two places.
        auc: probability that a pair of different places differs more than a pair of the same; 0.5: the views
            do not separate places.
    """

    edge: np.ndarray
    same: np.ndarray
    other: np.ndarray
    auc: float

    def quantile(self, count: np.ndarray, share: float) -> float:
        """The difference below which this share of the pairs of a histogram [BINS] lies."""
        return float(np.interp(share * count.sum(), _below_edges(count), self.edge))

    def share_below(self, count: np.ndarray, difference: float) -> float:
        """The share of the pairs of a histogram [BINS] below a difference."""
        return np.interp(difference, self.edge, _below_edges(count)) / count.sum()


def compare_views(
    views: np.ndarray,
    truth: np.ndarray,
    time: np.ndarray,
    differences: Callable[[np.ndarray, np.ndarray], np.ndarray],
    name: str,
) -> ViewDifferences:
    """The differences of the views of a session, of the same place and of different ones.

    Args:
        views: [T, ...]. truth: [T, 3] true poses. time: [T] s. differences: of N views from M others, [N, M].
            name: of the session, for errors.

    Raises:
        InputError: no place was visited twice.
    """
    same, other = [np.zeros(0)], [np.zeros(0)]
    for start in range(0, len(views), ROWS):
        rows = slice(start, start + ROWS)
        later = np.arange(len(views)) > np.arange(len(views))[rows, None]
        apart = np.hypot(*(truth[None, :, :2] - truth[rows, None, :2]).transpose(2, 0, 1))
        turned = np.abs(wrap(truth[None, :, 2] - truth[rows, None, 2]))
        again = np.abs(time - time[rows, None]) >= VISIT_GAP
        difference = differences(views[rows], views)
        same.append(difference[later & again & (apart < SAME_DISTANCE) & (turned < SAME_HEADING)])
        other.append(difference[later & (apart > OTHER_DISTANCE)])
    a, b = np.concatenate(same), np.concatenate(other)
    if not len(a) or not len(b):
        found = "no place with views of two visits" if len(b) else "a path that stays at one place"
        raise InputError(name, found, "a path that returns to earlier places")
    edge = np.linspace(0.0, max(a.max(), b.max(), 1e-9), BINS + 1)
    return ViewDifferences(edge, np.histogram(a, edge)[0], np.histogram(b, edge)[0], auc(a, b))


def image_difference(views: np.ndarray, reference: np.ndarray, tallest: float) -> tuple[float, float]:
    """Difference of images [N, R, C, K] in their first channel.

    Args:
        tallest: height of a white pixel, m.

    Returns:
        share of pixels whose contact state differs; mean absolute height difference where both have contact,
        m, NaN where none do.
    """
    a, b = views[..., 0], reference[..., 0]
    both = (a > 0) & (b > 0)
    height = float(np.abs(a - b)[both].mean() * tallest) if both.any() else np.nan
    return float(((a > 0) != (b > 0)).mean()), height


def _below_edges(count: np.ndarray) -> np.ndarray:
    """[BINS + 1] number of pairs below each edge."""
    return np.concatenate([[0], np.cumsum(count)])
