"""Load of the machine's cores, peak memory of this process, and one core to measure on.

This module loads without NumPy, so that `one_core` can be used before its threads start.
"""

from __future__ import annotations

import os
import platform
import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

OBSERVED = 0.2  # time over which the load of the cores is observed before one of them is chosen, s
_IDLE = slice(3, 5)  # idle time and time waiting for a disk, among the times of a core (proc(5))


def processor_name() -> str:
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


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
