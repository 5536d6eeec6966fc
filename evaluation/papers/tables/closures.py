"""The table of closures: fits and tests the log-odds that a closure sequence is true.

Each touch session is simulated and finished. The weights of `ratslam.mapping.closure_judge` are fitted on
the sequences of its final map, by a logistic regression with a ridge; each sequence counts three times, with
all keyframes after it, with `YOUNG` and with none, because it is judged while it is young too. Views that
contradict a place never count for it: recall leaves so few of them within its sequences that their weight
would be an accident. Every session is tested with weights fitted on the others. A sequence is true if most of
its claims are.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from evaluation.metrics.statistics import auc
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.papers.tables.touch_table import CHANGE, TouchTask, task_config
from evaluation.papers.trial_sessions import collect_session, run_session, start_session
from evaluation.studies.executor import run_tasks
from ratslam.mapping.closure_judge import BEYOND, KINDS, WEIGHTS, SequenceEvidence, sequence_evidence
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.map import KeyframeMap
from tactile.base.se2 import between, wrap

ROWS = (
    "main", "exploration", "open arena", "tree", "noise x 2", "white", "control: other maze", "new ground",
)  # fmt: skip
"""Rows of the touch table."""
FIRST = 31000
"""Number of the first maze."""
FEW = 2
"""Fewest sessions; with one none is left to fit on."""
RIDGE = 10.0
"""Penalty on the squared weights."""
YOUNG = 10
"""Keyframes after a sequence that is judged while it is young."""
COLUMNS = (
    "condition", "sessions", "sequences", "true", "AUC: recall's evidence", "accepted or not", "log-odds",
    "log-odds when they end",
)  # fmt: skip


JudgedSession = tuple[np.ndarray, np.ndarray, np.ndarray, tuple[SequenceEvidence, ...]]
"""The n sequences of a session: [n] bool, true; [n] evidence of recall; [n] bool, accepted; evidence when
all, `YOUNG` and no keyframes have followed them."""


def closures_table(sessions: int = 6, workers: int = 0, output: Path | None = None) -> Iterator[str]:
    """The lines of the table, and the weights.

    Args:
        sessions: of each row. output: folder that gets the weights as a file to ship; None: no file.
    """
    sessions = max(sessions, FEW)
    tasks = [TouchTask(row, FIRST + number) for row in ROWS for number in range(sessions)]
    every = list(run_tasks(_judge_session, tasks, workers=workers))
    fitted = [fit_weights([other for other in every if other is not one]) for one in every]
    yield markdown_header(COLUMNS)
    for k, row in enumerate(ROWS):
        own = slice(k * sessions, (k + 1) * sessions)
        yield _line(row, every[own], fitted[own])
    yield _line("all", every, fitted)
    weights = fit_weights(every)
    text = json.dumps({"weights": np.round(weights, 3).tolist()}, indent=1)
    yield f"\n```json\n{text}\n```"
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
        (output / WEIGHTS).write_text(text + "\n", encoding="utf-8")


def _judge_session(task: TouchTask) -> JudgedSession:
    """Runs a session and judges the sequences of its final map."""
    config, log = collect_session(task_config(task))
    session = start_session(config, log)
    truth, map = run_session(config, log, session).truth, session.map
    assert isinstance(map, KeyframeMap)
    final, steps = map.solution(), map.keyframe_steps()
    scores = final.log.scores()
    # Sequences count from this evidence of recall and this number of candidates on.
    chosen = np.flatnonzero((scores >= 5.0) & (final.log.left() >= 2))
    later = steps >= (int(CHANGE * len(truth)) if task.row == "control: other maze" else 0)
    known = (sequence_evidence(final, chosen, after) for after in (BEYOND, YOUNG, 0))
    # At least half of the candidates of a true sequence agree with the truth, to 3.6 cells and 30 degrees.
    table, poses = final.log.table(), truth[steps]
    frame, match = table[:, 0].astype(int), table[:, 1].astype(int)
    error = between(poses[match], poses[frame])
    turned = np.abs(wrap(error[:, 2] + table[:, 2] * final.sector_angle))
    right = (np.hypot(error[:, 0], error[:, 1]) < 3.6 * final.cell) & (turned < np.radians(30))
    right &= later[frame] == later[match]  # the later keyframes may be of another world
    true = np.array([right[table[:, 5] == sequence].mean() >= 0.5 for sequence in chosen.tolist()], bool)
    return true, scores[chosen], final.log.verdicts()[chosen] == Verdict.ACCEPTED, tuple(known)


def fit_weights(sessions: Sequence[JudgedSession]) -> np.ndarray:
    """The weights [2, 3 + 2 KINDS] of a logistic regression over the map, and of one over the older pass."""
    versions = [(evidence, true) for true, _, _, known in sessions for evidence in known]
    features = np.concatenate([evidence.features() for evidence, _ in versions])
    true = np.concatenate([true for _, true in versions]).astype(float)
    known = np.isfinite(features).all(axis=(1, 2))
    against = np.zeros(2 * KINDS, bool)
    against[[0, 1, KINDS, KINDS + 1]] = True
    bounds = [(None, None), (0, None), (0, None), *((None, 0 if one else None) for one in against)]
    # A sequence counts once, however often it is judged.
    return np.stack([regress(features[known, way], true[known], RIDGE, 1 / 3, bounds) for way in (0, 1)])


def regress(
    features: np.ndarray, true: np.ndarray, ridge: float, worth: float = 1.0, bounds: Any = None
) -> np.ndarray:
    """Weights of features [n, F], the first of which is 1, by which they tell what is true [n] (logistic
    regression).

    Args:
        ridge: penalty on the squared weights but the first. worth: of a row. bounds: of the weights.
    """
    ridges = ridge * (np.arange(features.shape[1]) > 0)

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        z = features @ weights
        value = worth * (np.logaddexp(0, z) - true * z).sum() + (ridges * weights**2).sum() / 2
        return float(value), worth * features.T @ (expit(z) - true) + ridges * weights

    return cast(np.ndarray, minimize(loss, np.zeros(features.shape[1]), jac=True, bounds=bounds).x)


def area(values: np.ndarray, true: np.ndarray) -> str:
    """AUC of values [n] by which they tell what is true [n] bool; `-` if all or nothing is."""
    return f"{auc(values[~true], values[true]):.3f}" if true.any() and not true.all() else "-"


def _line(name: str, sessions: Sequence[JudgedSession], fitted: Sequence[np.ndarray]) -> str:
    """A row of the table; each session with its own weights."""
    true, score, accepted = (np.concatenate([one[k] for one in sessions]) for k in range(3))
    odds, ended = (
        np.concatenate([one[3][k].log_odds(own) for one, own in zip(sessions, fitted, strict=True)])
        for k in (0, 2)
    )
    known = np.isfinite(odds)
    areas = (area(values[known], true[known]) for values in (score, accepted.astype(float), odds, ended))
    return markdown_row([name, len(sessions), int(known.sum()), int(true[known].sum()), *areas])
