"""The machine of a run: name, versions, load of other processes, peak memory, and one core to measure on."""

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

from tactile.base.config import Settings

PACKAGES = ("ratslam", "tactile", "robot", "evaluation")
OBSERVED = 0.2
"""Time over which the load of the cores is observed before one of them is chosen, s."""
_IDLE = slice(3, 5)
"""Idle time and time waiting for a disk, among the times of a core (proc(5))."""


class Machine(Settings):
    """Where a run was computed."""

    processor: str
    """Name of the processor."""
    device: str
    """Device of the kernels: `cpu`, or the name of an accelerator."""
    versions: dict[str, str]
    """Versions of what decides the speed."""
    build: str
    """First digits of the sha256 of ratslam's code: other code may give other results."""
    workers: int = 1
    """Number of processes that shared the work."""
    other_load: float | None = None
    """Number of cores that other processes kept busy meanwhile; None where the system does not say."""


@lru_cache(maxsize=1)
def machine() -> Machine:
    """This machine."""
    import jax  # here, so that `one_core` can be used before JAX starts its threads

    device = jax.devices()[0]
    return Machine(
        processor=_processor(),
        device="cpu" if device.platform == "cpu" else device.device_kind,
        versions={name: version(name) for name in ("jax", "jaxlib", "numpy")}
        | {"python": platform.python_version()},
        build=_build(),
    )


@contextmanager
def one_core() -> Iterator[None]:
    """Keeps this process and those it starts on the idlest core, where the system supports that."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {_idlest(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def watch_load() -> Callable[[], float | None]:
    """A function for the mean number of cores that other processes kept busy since; None if unknown."""
    began, before, ours = time.monotonic(), _busy(), _own_time()

    def load() -> float | None:
        now = _busy()
        taken = sum(now.values()) - sum(before.values()) - (_own_time() - ours)
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


def _build() -> str:
    total = hashlib.sha256()
    for name in PACKAGES:
        folder = Path(str(sys.modules[name].__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            total.update(f"{name}/{path.relative_to(folder).as_posix()}\n".encode() + path.read_bytes())
    return total.hexdigest()[:12]


def _idlest(allowed: set[int]) -> int:
    before = _busy() if len(allowed) > 1 else {}
    if before:
        time.sleep(OBSERVED)
    now = _busy()
    return min(sorted(allowed), key=lambda core: now.get(core, 0.0) - before.get(core, 0.0))


def _busy() -> dict[int, float]:
    """Time that each core has been busy, s; {} where the system does not say."""
    try:
        lines = Path("/proc/stat").read_text(encoding="ascii").splitlines()
        tick = os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):
        return {}
    cores = [line.split() for line in lines if line.startswith("cpu") and not line.startswith("cpu ")]
    times = {int(name[3:]): [int(part) for part in parts[:8]] for name, *parts in cores}
    return {core: (sum(parts) - sum(parts[_IDLE])) / tick for core, parts in times.items()}


def _own_time() -> float:
    """Processor time of this process and of its children that have ended, s."""
    return sum(os.times()[:4])


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
