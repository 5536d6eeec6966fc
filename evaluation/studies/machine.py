"""The machine of a run: processor, versions, load of its cores, peak memory, and one core to measure on.

`Stopwatch` times the steps of a run apart from compilation. This module loads without NumPy, so that
`one_core` can be used before its threads start.
"""

from __future__ import annotations

import hashlib
import os
import platform
import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

from numba.core import event as events

from tactile.base.settings import Settings

OBSERVED = 0.2  # time over which the load of the cores is observed before one of them is chosen, s
_IDLE = slice(3, 5)  # idle time and time waiting for a disk, among the times of a core (proc(5))


def processor_name() -> str:
    """Name of the processor."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@contextmanager
def one_core() -> Iterator[None]:
    """Keeps this process and those it starts on the idlest core, where the system supports that."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed, before = os.sched_getaffinity(0), _busy()
    if before and len(allowed) > 1:
        time.sleep(OBSERVED)
    now = _busy()
    idlest = min(sorted(allowed), key=lambda core: now.get(core, 0.0) - before.get(core, 0.0))
    os.sched_setaffinity(0, {idlest})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def watch_load() -> Callable[[], float | None]:
    """A function for the mean number of cores that other processes kept busy since; None if unknown."""
    began, before, ours = time.monotonic(), _busy(), sum(os.times()[:4])  # with children that have ended

    def load() -> float | None:
        now = _busy()
        taken = sum(now.values()) - sum(before.values()) - (sum(os.times()[:4]) - ours)
        return max(taken, 0.0) / max(time.monotonic() - began, 1e-9) if before and now else None

    return load


def reset_peak_memory() -> None:
    """Starts `peak_memory` anew, where the system supports that (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory() -> float:
    """Peak memory since it was reset, MiB; of the whole process where it cannot be reset."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (1 << 20 if sys.platform == "darwin" else 1024)


def _busy() -> dict[int, float]:
    """Time that each core has been busy, s; {} where the system does not say."""
    try:
        lines = Path("/proc/stat").read_text(encoding="ascii").splitlines()
        tick = os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):
        return {}
    cores = [line.split() for line in lines if line.startswith("cpu") and not line.startswith("cpu ")]
    times = {int(name[3:]): list(map(int, parts[:8])) for name, *parts in cores}
    return {core: (sum(parts) - sum(parts[_IDLE])) / tick for core, parts in times.items()}


PACKAGES = ("ratslam", "tactile", "robot", "evaluation")
COMPILED = "/jax/core/compile/backend_compile_duration"  # JAX's event of a compiled or fetched kernel
NUMBA_COMPILED = "numba:compiler_lock"  # Numba's event of a compiled or fetched function


class Machine(Settings):
    """Where a run was computed."""

    processor: str  # name of the processor
    device: str  # device of the kernels: `cpu`, or the name of an accelerator
    versions: dict[str, str]  # versions of what decides the speed
    build: str  # first digits of the sha256 of ratslam's code: other code may give other results
    workers: int = 1  # number of processes that shared the work
    other_load: float | None = None
    """Number of cores that other processes kept busy meanwhile; None where the system does not say."""


@lru_cache(maxsize=1)
def machine() -> Machine:
    """This machine."""
    import jax

    device, libraries = jax.devices()[0], ("jax", "jaxlib", "numpy")
    kind = "cpu" if device.platform == "cpu" else device.device_kind
    versions = {name: version(name) for name in libraries} | {"python": platform.python_version()}
    return Machine(processor=processor_name(), device=kind, versions=versions, build=code_digest())


def watch_machine() -> Callable[[], tuple[float, Machine]]:
    """A function for the peak memory since, MiB, and this machine with the load of other processes since."""
    load = watch_load()
    reset_peak_memory()
    return lambda: (peak_memory(), machine().model_copy(update={"other_load": load()}))


class Stopwatch:
    """Measures a run and its calls of one or more steps, apart from compilation."""

    def __init__(self) -> None:
        self._compiled = compilations()
        self._steps: list[tuple[int, float]] = []  # number of steps, duration in s
        self._compiling: list[tuple[int, float]] = []
        self._began = perf_counter()

    def elapsed(self) -> float:
        """Time since the start, s."""
        return perf_counter() - self._began

    @contextmanager
    def taking(self, steps: int) -> Iterator[None]:
        """Surrounds the given number of steps; of none, what is prepared before the first."""
        before, began = len(self._compiled), perf_counter()
        yield
        taken = steps, perf_counter() - began
        (self._compiling if not steps or len(self._compiled) > before else self._steps).append(taken)

    def times(self) -> dict[str, float | None]:
        """The quantities of time in `metrics.MEASURED`; None where too few steps were taken."""
        import numpy as np

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
def compilations() -> list[str]:
    """An event for each compilation or fetch of code by JAX and Numba in this process since the first call;
    grows."""
    import jax

    found: list[str] = []

    def note(event: str, duration_secs: float, **_: str | int) -> None:
        if event == COMPILED:
            found.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    events.register(NUMBA_COMPILED, _CompilationListener(found))
    return found


class _CompilationListener(events.Listener):
    """Appends to a list when Numba begins to compile or to fetch."""

    def __init__(self, found: list[str]) -> None:
        self._found = found

    def on_start(self, event: events.Event) -> None:
        self._found.append(event.kind)

    def on_end(self, event: events.Event) -> None:
        pass


@lru_cache(maxsize=1)
def code_digest() -> str:
    """The first digits of the sha256 over the sources of all packages, as this process first asks for it."""
    total = hashlib.sha256()
    for name in PACKAGES:
        folder = Path(str(sys.modules[name].__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            total.update(f"{name}/{path.relative_to(folder).as_posix()}\n".encode() + path.read_bytes())
    return total.hexdigest()[:12]
