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

from ratslam.experiments.studies.records import Machine

PACKAGES = ("ratslam", "tactile", "robot", "evaluation")
OBSERVED = 0.2
"""Time over which the load of the cores is observed before one of them is chosen, s."""
_IDLE = slice(3, 5)
"""Idle time and time waiting for a disk, among the times of a core (proc(5))."""


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
        build=build(),
    )


@lru_cache(maxsize=1)
def build() -> str:
    """First digits of the sha256 of all code of ratslam: other code may give other results."""
    total = hashlib.sha256()
    for name in PACKAGES:
        folder = Path(str(sys.modules[name].__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            total.update(f"{name}/{path.relative_to(folder).as_posix()}\n".encode() + path.read_bytes())
    return total.hexdigest()[:12]


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


@contextmanager
def other_load() -> Iterator[Callable[[], float | None]]:
    """Gives a function for the mean number of cores that other processes kept busy since; None if unknown."""
    began, before, ours = time.monotonic(), _busy(), _own_time()

    def load() -> float | None:
        now = _busy()
        if not before or not now:
            return None
        taken = sum(now.values()) - sum(before.values()) - (_own_time() - ours)
        return max(taken, 0.0) / max(time.monotonic() - began, 1e-9)

    yield load


@contextmanager
def peak_memory() -> Iterator[Callable[[], float]]:
    """Gives a function for the peak memory since, MiB; of the whole process where it cannot be reset."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    yield _peak


def _peak() -> float:
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (1 << 20 if sys.platform == "darwin" else 1024)


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
    taken = os.times()
    return taken.user + taken.system + taken.children_user + taken.children_system


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
