"""Time per step, separate from compilation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from time import perf_counter

import jax
import numpy as np

COMPILED = "/jax/core/compile/backend_compile_duration"
"""JAX's event of a compiled or fetched kernel."""


class Stopwatch:
    """Measures a run and its calls of one or more steps.

    Args:
        compilations: gives the number of kernels compiled so far; None: by this process.
    """

    def __init__(self, compilations: Callable[[], int] | None = None) -> None:
        self._compilations = compilations or _counter().__len__
        self._steps: list[tuple[int, float]] = []  # number of steps, duration in s
        self._compiling: list[tuple[int, float]] = []
        self._began = perf_counter()

    def elapsed(self) -> float:
        """Time since the start, s."""
        return perf_counter() - self._began

    @contextmanager
    def taking(self, steps: int) -> Iterator[None]:
        """Surrounds the given number of steps; of none, what is prepared before the first."""
        before, began = self._compilations(), perf_counter()
        yield
        taken = steps, perf_counter() - began
        (self._compiling if not steps or self._compilations() > before else self._steps).append(taken)

    def times(self) -> dict[str, float | None]:
        """The quantities of time in `metrics.MEASURED`; None where too few steps were taken."""
        each = np.array([seconds / steps for steps, seconds in self._steps])
        usual = float(np.median(each)) if len(each) else None
        count = sum(steps for steps, _ in [*self._steps, *self._compiling])
        compiling = max(sum(seconds - steps * (usual or 0.0) for steps, seconds in self._compiling), 0.0)
        return {
            "step_time": None if usual is None else 1e6 * usual,
            "step_time_p99": float(1e6 * np.quantile(each, 0.99)) if len(each) else None,
            "run_time": 1e6 * max(self.elapsed() - compiling, 0.0) / count if count else None,
            "compile_time": compiling,
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
