"""Time per step, separate from compilation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from time import perf_counter
from typing import Any

import jax
import numpy as np

_COMPILED = "/jax/core/compile/backend_compile_duration"


class Stopwatch:
    """Measures calls of one or more steps."""

    def __init__(self) -> None:
        self._counted = _compilations()
        self._taken: list[tuple[int, float]] = []  # steps, s
        self._compiling: list[tuple[int, float]] = []
        self._preparing = self._finishing = 0.0
        self._kernels = 0

    @contextmanager
    def preparing(self) -> Iterator[None]:
        """Surrounds the work before the first step."""
        before, began = self._counted[0], perf_counter()
        yield
        self._preparing += perf_counter() - began
        self._kernels += self._counted[0] - before

    @contextmanager
    def taking(self, steps: int) -> Iterator[None]:
        """Surrounds the given number of steps."""
        before, began = self._counted[0], perf_counter()
        yield
        taken = steps, perf_counter() - began
        new = self._counted[0] - before
        (self._compiling if new else self._taken).append(taken)
        self._kernels += new

    @contextmanager
    def finishing(self) -> Iterator[None]:
        """Surrounds the work after the last step."""
        began = perf_counter()
        yield
        self._finishing += perf_counter() - began

    def summary(self) -> dict[str, Any]:
        """Fields of `ratslam.experiments.studies.records.Timing`."""
        each = np.array([seconds / steps for steps, seconds in self._taken])
        usual = float(np.median(each)) if len(each) else None
        extra = sum(seconds - steps * (usual or 0.0) for steps, seconds in self._compiling)
        return {
            "median_us": None if usual is None else 1e6 * usual,
            "p99_us": float(1e6 * np.quantile(each, 0.99)) if len(each) else None,
            "compile_s": self._preparing + max(extra, 0.0),
            "compilations": self._kernels,
            "finish_s": self._finishing,
        }


@lru_cache(maxsize=1)
def _compilations() -> list[int]:
    """[number of kernels that this process has compiled or fetched since the first call]."""
    count = [0]

    def count_event(event: str, duration_secs: float, **_: str | int) -> None:
        if event == _COMPILED:
            count[0] += 1

    jax.monitoring.register_event_duration_secs_listener(count_event)
    return count
