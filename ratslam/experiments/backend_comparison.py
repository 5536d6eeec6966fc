"""The same session through both backends: RatSLAM's pose cells and the grid particle filter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.trajectory import ate
from ratslam.config.completion import complete
from ratslam.config.run_config import RunConfig
from ratslam.core.session import CHUNK
from ratslam.pipeline.runner import build_session
from ratslam.pipeline.source import open_source
from robot.sources.source import Sample, Source
from robot.touch_source import observation_of, open_touch_source
from tactile.base.errors import InputError
from tactile.base.se2 import compose, integrate, inverse
from tactile.base.types import Observation

RECKONED = "dead reckoning"


class Compared(NamedTuple):
    """What one backend made of a session; NaN where that cannot be told.

    Attributes:
        told, final: mean error of position, as told at the time and as known in the end, m, the start given.
        ate: of the final path, aligned, root mean square, m. energy: over all pairs, m^2 + rad^2.
        rate: steps a second, of the median chunk. compiling: s, all in all.
    """

    name: str
    steps: int
    told: float
    final: float
    ate: float
    energy: float
    rate: float
    compiling: float


def compared(config: RunConfig, folder: Path) -> list[Compared]:
    """Both backends on the session of a configuration, and dead reckoning.

    Args:
        folder: of the configuration file; relative paths start there.

    Raises:
        InputError: it cannot be used, has no whiskers, or nobody knows where the robot was.
    """
    config = config.with_absolute_paths(folder.resolve())
    first = "recall" if config.backend == "grid" else config.backend
    found = [_played(config.model_copy(update={"backend": backend})) for backend in (first, "grid")]
    return [*(one for one, _ in found), found[0][1]]


def report(found: Sequence[Compared]) -> str:
    """A table."""
    lines = [
        f"{found[0].steps} steps",
        f"{'':<16}{'told':>9}{'final':>9}{'ATE':>9}{'energy':>9}{'steps / s':>12}{'compiling':>12}",
    ]
    for one in found:
        errors = "".join(f"{value:>9.3f}" for value in (one.told, one.final, one.ate, one.energy))
        speed = (
            f"{one.rate:>12.0f}{one.compiling:>10.1f} s" if np.isfinite(one.rate) else f"{'-':>12}{'-':>12}"
        )
        lines.append(f"{one.name:<16}{errors}{speed}")
    lines.append(
        "told, final: mean error of position as told at the time and as known in the end, m, start given, "
        "not aligned;\nATE: of the final path, aligned, RMS, m; energy: Energy Metric over all pairs of its "
        "steps, m2 + rad2;\nsteps / s: once compiled."
    )
    return "\n".join(lines)


def _played(config: RunConfig) -> tuple[Compared, Compared]:
    """What a configuration's backend made of its session, and what dead reckoning makes of it."""
    with open_source(config) as source:
        config = complete(config, source)
        if not source.whiskers:
            raise InputError(
                source.name, "no whiskers", "a session of whiskers", "the grid filter needs them"
            )
        source = open_touch_source(source, config.touch)
        samples = _known(source)
        session = build_session(config, source)
    reports: list[Observation] = [observation_of(sample) for sample in samples]
    told: list[np.ndarray] = []
    chunks: list[float] = []
    compiled: list[float] = []
    for first in range(0, len(reports), CHUNK):
        before, began = session.compilations(), perf_counter()
        told += [step.pose for step in session.replay(reports[first : first + CHUNK])]
        (chunks if session.compilations() == before else compiled).append(perf_counter() - began)
    truth = np.array([sample.truth for sample in samples])
    odometry = integrate(np.array([report.odometry[:3] for report in reports], float))
    # The first step is odometry's in all of them, so its error is nobody's.
    start = compose(truth[0], inverse(odometry[0]))
    whole = chunks[:-1] if len(reports) % CHUNK and len(chunks) > 1 else chunks
    usual = float(np.median(whole)) if whole else np.nan
    extra = sum(compiled) - (len(compiled) * usual if whole else 0.0)
    ours = _judged(config.backend, np.array(told), session.map.trajectory(), start, truth)
    return (
        ours._replace(rate=CHUNK / usual, compiling=extra),
        _judged(RECKONED, odometry, odometry, start, truth),
    )


def _known(source: Source) -> list[Sample]:
    """All samples of a source.

    Raises:
        InputError: there are none, or some without a true pose.
    """
    samples = list(source)
    if not samples:
        raise InputError(source.name, "no samples", "a session")
    if any(sample.truth is None or not np.isfinite(sample.truth).all() for sample in samples):
        raise InputError(source.name, "steps without a true pose", "the truth of every step, to judge by")
    return samples


def _judged(name: str, told: np.ndarray, final: np.ndarray, start: np.ndarray, truth: np.ndarray) -> Compared:
    told, final = compose(start, told), compose(start, final)
    online, late = (float(np.hypot(*(path - truth)[:, :2].T).mean()) for path in (told, final))
    energy = energy_all_pairs(final, truth).total
    return Compared(name, len(truth), online, late, ate(final, truth), energy, np.nan, np.nan)
