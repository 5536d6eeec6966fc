"""Time per step, separate from compilation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from time import perf_counter
from typing import Any

import jax
import numpy as np

COMPILED = "/jax/core/compile/backend_compile_duration"
"""JAX's event of a compiled or fetched kernel."""


class Stopwatch:
    """Measures calls of one or more steps.

    Args:
        compilations: gives the number of kernels compiled so far; None: by this process.
    """

    def __init__(self, compilations: Callable[[], int] | None = None) -> None:
        self._compilations = compilations or _counter().__len__
        self._steps: list[tuple[int, float]] = []  # number of steps, duration in s
        self._compiling: list[tuple[int, float]] = []
        self._preparing = self._finishing = 0.0
        self._first = self._compilations()

    @contextmanager
    def preparing(self) -> Iterator[None]:
        """Surrounds the work before the first step."""
        began = perf_counter()
        yield
        self._preparing += perf_counter() - began

    @contextmanager
    def taking(self, steps: int) -> Iterator[None]:
        """Surrounds the given number of steps."""
        before, began = self._compilations(), perf_counter()
        yield
        taken = steps, perf_counter() - began
        (self._compiling if self._compilations() > before else self._steps).append(taken)

    @contextmanager
    def finishing(self) -> Iterator[None]:
        """Surrounds the work after the last step."""
        began = perf_counter()
        yield
        self._finishing += perf_counter() - began

    def summary(self) -> dict[str, Any]:
        """Fields of `ratslam.experiments.studies.records.Timing`."""
        each = np.array([seconds / steps for steps, seconds in self._steps])
        usual = float(np.median(each)) if len(each) else None
        extra = sum(seconds - steps * (usual or 0.0) for steps, seconds in self._compiling)
        return {
            "median_us": None if usual is None else 1e6 * usual,
            "p99_us": float(1e6 * np.quantile(each, 0.99)) if len(each) else None,
            "compile_s": self._preparing + max(extra, 0.0),
            "compilations": self._compilations() - self._first,
            "finish_s": self._finishing,
        }


@lru_cache(maxsize=1)
def _counter() -> list[None]:
    """As many items as this process has compiled or fetched kernels since the first call."""
    count: list[None] = []

    def count_event(event: str, duration_secs: float, **_: str | int) -> None:
        if event == COMPILED:
            count.append(None)

    jax.monitoring.register_event_duration_secs_listener(count_event)
    return count
