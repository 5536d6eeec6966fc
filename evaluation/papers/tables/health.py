"""The table of map health: whether a map's own doubt tells bad maps from good ones.

Each session is finished once and its map spoilt in many ways (`spoilt_maps`). A map is bad if its
error exceeds `HARM_FACTOR` times odometry's (recordings: and 0.3 m): whisker sessions by the Energy Metric,
recordings by ATE, both of keyframes. Even sessions fit the regression, odd ones test it; the weights below
the table, of all sessions, become those of `ratslam.mapping.map_solution`. Only maps with closures count.
Sessions are of mazes and recordings used for development.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.papers.tables.buildings import HARM_FACTOR, HARM_MARGIN
from evaluation.papers.tables.closures import area, regress
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.papers.tables.recordings import real_recordings
from evaluation.papers.tables.spoilt_maps import spoilt_maps
from evaluation.papers.tables.touch_table import MAIN, NOISE, ROWS, touch_config
from evaluation.papers.trial_sessions import known_ate, run_recording
from evaluation.studies.executor import run_tasks
from evaluation.studies.perturbation import miscalibrate
from ratslam.mapping.closure_selection import ACCEPTED_WEIGHT
from ratslam.mapping.map import KeyframeMap
from ratslam.mapping.map_solution import DOUBTED, INTERCEPT, WEIGHTS, health_features
from ratslam.runs.settings.run_config import RunConfig, load_config

FIRST_MAZE = 31000
RIDGE = 2.0
"""Penalty on the squared weights of standardised features."""
CLEAR = 1.25
"""Ratio of the errors of map and odometry beyond which one is clearly better."""
EXPLORATION = {"path": {"explore": 900}}
TOUCH: dict[str, dict[str, Any]] = {
    "main": MAIN,
    "exploration": EXPLORATION,
    "open arena": ROWS["open arena"].simulation | EXPLORATION,
    "tree": ROWS["tree"].simulation | EXPLORATION,
    "good odometry": EXPLORATION
    | {"odometry": {"length": 0.25 * NOISE.length, "heading": 0.25 * NOISE.heading}},
    "white": ROWS["white"].simulation,
    "noise x 2": ROWS["noise x 2"].simulation,
}
"""Settings `simulation` of the whisker sessions."""
REAL = {
    "acapulco": ("configs/building.yaml", "buildings/acapulco_odom_gt.csv"),
    "aces": ("configs/building.yaml", "buildings/aces_odom_gt.csv"),
    "intel": ("configs/intel_laser.yaml", ""),
    "lecture hall": ("configs/tuc_lecture_hall.yaml", ""),
}
"""Configuration of each real recording, and the recording in the folder of these where it names none."""
COLUMNS = (
    "sessions", "maps", "bad", "AUC", "AUC, clear maps", "AUC of the number of closures",
    "alarms in good maps", "misses of bad maps",
)  # fmt: skip


RATIO, BAD, CLOSURES = -3, -2, -1
"""Columns of the maps of sessions, [n, 8], after those of `health_features`: error over odometry's, whether
it is bad, number of closures."""


def health_table(sessions: int = 2, workers: int = 0) -> Iterator[str]:
    """The lines of the table.

    Args:
        sessions: of each row; recordings are perturbed copies but the first.
    """
    rows = [*TOUCH, *(REAL if real_recordings() else ())]
    tasks = [(row, number) for row in rows for number in range(sessions)]
    found = list(run_tasks(_judge_session, tasks, workers=workers))
    weights, final = (fit_weights(np.concatenate(maps)) for maps in (found[0::2], found))
    constants = np.array([INTERCEPT, *WEIGHTS])
    yield markdown_header(COLUMNS)
    for row in rows:
        yield _line(row, [one for task, one in zip(tasks, found, strict=True) if task[0] == row], constants)
    yield _line("all", found, constants)
    yield _line("even, fitted on these", found[0::2], weights)
    yield _line("odd, fitted on even ones", found[1::2], weights)
    yield f"\nIntercept and weights fitted on all sessions: {', '.join(f'{w:.2f}' for w in final)}."


def _judge_session(task: tuple[str, int]) -> np.ndarray:
    """Runs a session, of a row and a number, and judges its spoilt maps."""
    number = task[1]
    config, touch = task_config(*task)
    copied = number > 0 and not touch
    _, session, run = run_recording(config, miscalibrate if copied else None, number)
    map = session.map
    assert isinstance(map, KeyframeMap)
    truth = run.truth[map.keyframe_steps()]
    known = np.isfinite(truth).all(axis=1)

    def error(poses: np.ndarray) -> float:
        return energy_all_pairs(poses[known], truth[known]).total if touch else known_ate(poses, truth)

    before = error(map.solution().dead_reckoned())
    limit = HARM_FACTOR * before + (0.0 if touch else HARM_MARGIN)
    rows = []
    for _, solution in spoilt_maps(map, truth, number):
        closures = int((solution.log.weights() > ACCEPTED_WEIGHT).sum())
        if closures:
            after = error(solution.pose.rows)
            rows.append((*health_features(solution), after / before, after > limit, closures))
    return np.array(rows, float).reshape(len(rows), len(WEIGHTS) + 3)


def task_config(row: str, number: int) -> tuple[RunConfig, bool]:
    """The configuration of a session, and whether it is a whisker session."""
    if row in TOUCH:
        return touch_config(FIRST_MAZE + number, number, TOUCH[row], session={"reserve": 2048}), True
    config, file = REAL[row]
    settings = (f"recording.file={(real_recordings() or Path()).absolute() / file}",) if file else ()
    return load_config(config, [*settings, "session.reserve=1024"]), False


def fit_weights(maps: np.ndarray) -> np.ndarray:
    """[6] intercept and weights of a logistic regression with a ridge on standardised features."""
    features, bad = maps[:, :RATIO], maps[:, BAD] > 0
    mean, sd = features.mean(axis=0), features.std(axis=0) + 1e-9
    columns = np.column_stack([np.ones(len(bad)), (features - mean) / sd])

    weights = regress(columns, bad, RIDGE)
    scaled = weights[1:] / sd
    return np.array([weights[0] - scaled @ mean, *scaled])


def _line(name: str, sessions: Sequence[np.ndarray], weights: np.ndarray) -> str:
    """A row of the table with an intercept and weights [6]."""
    maps = np.concatenate(sessions)
    ratio, bad = maps[:, RATIO], maps[:, BAD] > 0
    worse = expit(weights[0] + maps[:, :RATIO] @ weights[1:])
    clear, doubted = (ratio > CLEAR) | (ratio < 1 / CLEAR), worse > DOUBTED
    areas = area(worse, bad), area(worse[clear], bad[clear]), area(-maps[:, CLOSURES], bad)
    shares = (f"{happened.sum()} of {len(happened)}" for happened in (doubted[~bad], ~doubted[bad]))
    return markdown_row([name, len(bad), int(bad.sum()), *areas, *shares])
