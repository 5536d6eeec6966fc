"""What float32 costs: the same whisker sessions in both precisions, seed by seed.

    python -m ratslam.experiments.tables.precision [--seeds 20] [--backends recall classic] [--workers N]

A seed is a maze never used for tuning, a route through it and its odometry; every arm sees the same whisks.
Beside float32 runs a control: float64 whose odometry is off by one part in ten million, as it is when rounded
to float32. What the control does to a figure is what any change of rounding does.

Printed are medians and spread over seeds, the mean difference to float64 with its 95 % interval (Student's),
the largest difference of a seed, the median difference with its 99 % interval (order statistics: it assumes
nothing), and the verdict: an arm is accepted where that interval lies within 5 % of the spread over seeds for
every figure. An arm whose median differed by more in any figure would be accepted at most once in 200 tables.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

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
"""Ours, and RatSLAM as published (as in `ratslam.experiments.salman2016`)."""
SESSION: dict[str, Any] = {
    "path": {"circuits": "CCAAC"},
    "motion": {"jitter": {"position": 0.005, "yaw_deg": 1.5, "speed": 0.05}},
}
ROUNDING = 1e-7
RESERVE = 1024
"""Rows of memory: one kernel for all seeds."""
MARGIN = 0.05
"""Median difference that does not matter, in standard deviations over seeds."""
LEVEL = 0.99
"""Of the intervals of medians. All figures must pass, so none need be stricter for there being many."""


class Figures(NamedTuple):
    """Of one run. em: Energy Metric over all pairs, m2 + rad2. arr, arcr: Experience Metric, strict. ate: m.
    closures: how many. alike: share of steps at which the place is that of float64."""

    em: float
    arr: float
    arcr: float
    ate: float
    closures: float
    alike: float


JUDGED = Figures._fields[:-1]
"""What the verdict is on."""


class Task(NamedTuple):
    """All arms of one backend and seed."""

    backend: str
    seed: int


class Difference(NamedTuple):
    """An arm against float64 in one figure, over N seeds that have it.

    Attributes:
        mean, half: of the paired differences, and half of its 95 % interval. worst: the largest, either way.
        median, low, high: of the differences, and its interval. equal: share of seeds without any. spread:
            of float64 over seeds.
    """

    mean: float
    half: float
    worst: float
    median: float
    low: float
    high: float
    equal: float
    spread: float


def sessions(task: Task) -> dict[str, Figures]:
    """The figures of each arm."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from evaluation.metrics.trajectory import ate
    from ratslam.config.run_config import RunConfig
    from ratslam.experiments.trials.touch_trial import figures, play, session_log

    simulation = SESSION | {"seed": task.seed, "maze": {"seed": task.seed}}
    given = {"simulation": simulation, "session": {"reserve": RESERVE}} | BACKENDS[task.backend]
    config, log = session_log(RunConfig.model_validate(given))
    off = 1 + ROUNDING * stream(task.seed, "tests.precision").uniform(-1, 1, (log.length, 3))
    rounded = replace(log, motion=np.column_stack([log.motion[:, :3] * off, log.motion[:, 3]]))
    told: dict[str, Figures] = {}
    places = np.zeros(0)
    for arm in ARMS:
        single = "float32" if arm == "float32" else "float64"
        settings = config.session.model_copy(update={"precision": single})
        played = play(config.model_copy(update={"session": settings}), rounded if arm == "control" else log)
        found = figures(played)
        places = played.place if arm == ARMS[0] else places
        error, alike = ate(played.trajectory, played.truth), float((played.place == places).mean())
        told[arm] = Figures(found.em, found.arr, found.arcr, error, found.closures, alike)
    return told


def measured(seeds: Sequence[int], backend: str, workers: int = 1) -> dict[str, np.ndarray]:
    """Of each arm [seeds, figures]."""
    from ratslam.experiments.trials.process_pool import shared_out

    rows = list(shared_out(sessions, [Task(backend, seed) for seed in seeds], workers))
    return {arm: np.array([row[arm] for row in rows], float) for arm in ARMS}


def judged(arm: np.ndarray, against: np.ndarray) -> list[Difference]:
    """Of every figure that is judged, from [seeds, figures] of both."""
    return [difference(arm[:, k], against[:, k]) for k in range(len(JUDGED))]


def difference(values: np.ndarray, against: np.ndarray) -> Difference:
    """Of paired values [N]."""
    both = np.isfinite(values) & np.isfinite(against)
    apart = values[both] - against[both]
    if len(apart) < 2:
        return Difference(*[np.nan] * 8)
    half = float(stats.t.ppf(0.975, len(apart) - 1) * stats.sem(apart))
    low, high = median_interval(apart, LEVEL)
    return Difference(
        mean=float(apart.mean()),
        half=half,
        worst=float(apart[np.argmax(np.abs(apart))]),
        median=float(np.median(apart)),
        low=low,
        high=high,
        equal=float((apart == 0).mean()),
        spread=float(against[both].std()),
    )


def median_interval(values: np.ndarray, level: float) -> tuple[float, float]:
    """Holds the median of what the values [N] were drawn from, at least so often, whatever that is.

    From order statistics: the k-th smallest is above it only if fewer than k values are below. Infinite
    where so few values tell nothing at that level.
    """
    values = np.sort(values)
    outside = int(stats.binom.ppf((1 - level) / 2, len(values), 0.5))  # P(B <= outside) >= (1 - level) / 2
    if outside < 1:
        return -np.inf, np.inf
    return float(values[outside - 1]), float(values[len(values) - outside])


def accepted(differences: Sequence[Difference]) -> bool:
    """Whether every figure's median is shown to differ by no more than the margin."""
    return all(max(-found.low, found.high) <= MARGIN * found.spread for found in differences)


def lines(backend: str, found: dict[str, np.ndarray]) -> Iterator[str]:
    """The table of a backend."""
    before = found[ARMS[0]]
    heads = f"{'float64':>9s}{'spread':>8s}{'arm':>10s}{'mean difference':>22s}{'worst':>10s}"
    yield f"{backend}, {len(before)} seeds".ljust(29) + heads + f"{'median, its interval':>33s}{'equal':>7s}"
    for arm in ARMS[1:]:
        told = judged(found[arm], before)
        for k, (name, d) in enumerate(zip(JUDGED, told, strict=True)):
            yield (
                f"  {arm:8s} {name:18s}{np.nanmedian(before[:, k]):>9.4f}{d.spread:>8.3f}"
                f"{np.nanmedian(found[arm][:, k]):>10.4f} {d.mean:>+10.1e} +- {d.half:>7.1e}{d.worst:>+10.1e}"
                f"   {d.median:>+9.1e} [{d.low:>+8.1e}, {d.high:>+8.1e}]{d.equal:>7.2f}"
            )
        most = max(max(abs(d.low), abs(d.high)) / d.spread if d.spread else 0.0 for d in told)
        alike = found[arm][:, -1]
        verdict = "accepted" if accepted(told) else "not accepted"
        yield (
            f"  {arm}: {verdict}: no median difference larger than {most:.1g} of the spread over seeds; "
            f"steps at the same place: mean {alike.mean():.3f}, least {alike.min():.3f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--backends", nargs="*", choices=BACKENDS, default=list(BACKENDS))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, help="a folder for NAME.npz of all figures")
    given = parser.parse_args()
    for backend in given.backends:
        found = measured(range(FIRST_SEED, FIRST_SEED + given.seeds), backend, given.workers)
        if given.output is not None:
            np.savez(given.output / f"{backend}.npz", allow_pickle=True, **found)
        print("\n".join(lines(backend, found)), flush=True)


if __name__ == "__main__":
    main()
