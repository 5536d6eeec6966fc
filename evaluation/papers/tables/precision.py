"""The precision table: the same whisker sessions in float64 and float32, seed by seed.

A seed is a maze never used for tuning, a route through it and its odometry; all arms get the same whisks. The
arm `control` is float64 with odometry changed by one part in ten million, as rounding to float32 changes it:
the effect of any change of rounding.

The table gives medians and the spread over seeds, the mean difference from float64 with its 95 % interval
(Student's t), the largest difference of a seed, and the median difference with its 99 % interval (order
statistics, without assumptions on the distribution). An arm is accepted if that interval lies within 5 % of
the spread over seeds for all figures; an arm whose median differs by more in one figure is accepted at most
once in 200 tables.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from evaluation.metrics.session_metrics import touch_metrics
from evaluation.metrics.trajectory import ate
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.papers.trials.touch_trial import collect_session, run_session
from evaluation.studies.executor import run_tasks
from ratslam.core.precision import prepare_precision
from ratslam.runs.settings.run_config import RunConfig
from tactile.base.random_streams import stream

FIRST_SEED = 9200
SEEDS = 20
ARMS = "float64", "float32", "control"
BACKENDS: dict[str, dict[str, Any]] = {
    "recall": {"backend": "recall"},
    "classic": {
        "backend": "classic",
        "pose_cells": {"cells_xy": 31},
        "templates": {"energy": 0.05, "threshold": 0.05},
        "experience": {"solver": {"name": "relaxation"}},
    },
}
"""Recall, and RatSLAM as published (as in `evaluation.papers.salman2016`)."""
SESSION: dict[str, Any] = {
    "path": {"circuits": "CCAAC"},
    "motion": {"jitter": {"position": 0.005, "yaw_deg": 1.5, "speed": 0.05}},
}
ROUNDING = 1e-7
"""Relative change of the odometry in the control arm."""
RESERVE = 1024
"""Memory rows reserved, so that all seeds share one kernel."""
MARGIN = 0.05
"""Largest acceptable median difference, in standard deviations over seeds."""
LEVEL = 0.99
"""Confidence level of the intervals of medians. All figures must pass, so no correction for their number."""

FIGURES = ("em", "arr", "arcr", "ate", "closures", "same_place")
"""Energy Metric (all pairs, m^2 + rad^2), strict Experience Metric, ATE (m), number of closures, and share of
steps with the same current place as in float64."""
JUDGED = FIGURES[:-1]
"""Figures that must pass."""
COLUMNS = (
    "arm", "figure", "float64", "arm's", "spread", "mean difference", "worst", "median difference", "equal"
)  # fmt: skip


class Difference(NamedTuple):
    """The difference of an arm from float64 in one figure, over the seeds where both are defined.

    Attributes:
        mean, half: mean paired difference and half of its 95 % interval. worst: the largest difference of
            either sign. median, low, high: median difference and its interval. equal: share of seeds without
            a difference. spread: standard deviation of float64 over seeds.
    """

    mean: float
    half: float
    worst: float
    median: float
    low: float
    high: float
    equal: float
    spread: float


def run_arms(task: tuple[str, int]) -> list[list[float]]:
    """`FIGURES` of each of `ARMS` for a backend and a seed."""
    backend, seed = task
    prepare_precision("float64")
    simulation = SESSION | {"seed": seed, "maze": {"seed": seed}}
    given = {"simulation": simulation, "session": {"reserve": RESERVE}} | BACKENDS[backend]
    config, log = collect_session(RunConfig.model_validate(given))
    factor = 1 + ROUNDING * stream(seed, "tests.precision").uniform(-1, 1, (log.length, 3))
    rounded = replace(log, motion=np.column_stack([log.motion[:, :3] * factor, log.motion[:, 3]]))
    single = config.session.model_copy(update={"precision": "float32"})
    arms = (config, log), (config.model_copy(update={"session": single}), log), (config, rounded)
    results = [run_session(*arm) for arm in arms]
    return [
        [
            *(getattr(metrics, name) for name in ("em", "arr", "arcr")),
            ate(one.trajectory, one.truth),
            metrics.closures,
            float((one.place == results[0].place).mean()),
        ]
        for one, metrics in zip(results, map(touch_metrics, results), strict=True)
    ]


def measure_arms(seeds: Sequence[int], backend: str, workers: int = 1) -> dict[str, np.ndarray]:
    """[seeds, figures] of each arm."""
    rows = list(run_tasks(run_arms, [(backend, seed) for seed in seeds], workers=workers))
    return dict(zip(ARMS, np.array(rows, float).transpose(1, 0, 2), strict=True))


def differences(arm: np.ndarray, against: np.ndarray) -> list[Difference]:
    """The difference in each figure of `JUDGED`, from [seeds, figures] of both arms."""
    return [difference(arm[:, k], against[:, k]) for k in range(len(JUDGED))]


def difference(values: np.ndarray, against: np.ndarray) -> Difference:
    """The difference of paired values [N]."""
    both = np.isfinite(values) & np.isfinite(against)
    apart = values[both] - against[both]
    if len(apart) < 2:
        return Difference(*[np.nan] * 8)
    low, high = median_interval(apart, LEVEL)
    return Difference(
        mean=float(apart.mean()),
        half=float(stats.t.ppf(0.975, len(apart) - 1) * stats.sem(apart)),
        worst=float(apart[np.argmax(np.abs(apart))]),
        median=float(np.median(apart)),
        low=low,
        high=high,
        equal=float((apart == 0).mean()),
        spread=float(against[both].std()),
    )


def median_interval(values: np.ndarray, level: float) -> tuple[float, float]:
    """A confidence interval of the median of any distribution from samples [N]; infinite with too few."""
    ranks = _median_ranks(len(values), level)
    if ranks is None:
        return -np.inf, np.inf
    low, high = np.sort(values)[list(ranks)]
    return float(low), float(high)


@cache
def _median_ranks(count: int, level: float) -> tuple[int, int] | None:
    """The interval's ends among so many sorted values, from 0; None with too few."""
    low, high = stats.quantile_test(np.arange(float(count)), p=0.5).confidence_interval(level)
    return (int(low), int(high)) if np.isfinite(low) else None


def is_accepted(found: Sequence[Difference]) -> bool:
    """Whether the median interval of each figure lies within the margin."""
    return all(max(-d.low, d.high) <= MARGIN * d.spread for d in found)


def precision_table(
    backends: Sequence[str], seeds: int = SEEDS, workers: int = 1, output: Path | None = None
) -> Iterator[str]:
    """The lines of the tables, one table for each backend as soon as it is done.

    Args:
        output: folder for BACKEND.npz with all figures.
    """
    for backend in backends:
        found = measure_arms(range(FIRST_SEED, FIRST_SEED + seeds), backend, workers)
        if output is not None:
            output.mkdir(parents=True, exist_ok=True)
            np.savez(output / f"{backend}.npz", allow_pickle=True, **found)
        yield from render_arms(backend, found)


def render_arms(backend: str, found: dict[str, np.ndarray]) -> Iterator[str]:
    """The table of a backend, and the verdict on each arm."""
    before = found[ARMS[0]]
    verdicts = []
    yield f"{backend}, {len(before)} seeds\n\n{markdown_header(COLUMNS)}"
    for arm in ARMS[1:]:
        compared = differences(found[arm], before)
        for k, (name, d) in enumerate(zip(JUDGED, compared, strict=True)):
            medians = (f"{np.nanmedian(values[:, k]):.4f}" for values in (before, found[arm]))
            yield markdown_row(
                (
                    arm, name, *medians, f"{d.spread:.3f}", f"{d.mean:+.1e} +- {d.half:.1e}",
                    f"{d.worst:+.1e}", f"{d.median:+.1e} [{d.low:+.1e}, {d.high:+.1e}]", f"{d.equal:.2f}",
                )
            )  # fmt: skip
        most = max(max(abs(d.low), abs(d.high)) / d.spread if d.spread else 0.0 for d in compared)
        alike = found[arm][:, -1]
        verdicts.append(
            f"{arm}: {'accepted' if is_accepted(compared) else 'not accepted'}: no median difference above "
            f"{most:.1g} of the spread over seeds; steps at the same place: mean {alike.mean():.3f}, "
            f"least {alike.min():.3f}"
        )
    yield "\n".join(["", *verdicts, ""])
