"""One core to measure on, and what everybody else does meanwhile."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_STAT = Path("/proc/stat")
_LOOK = 0.2
"""How long is looked at what the cores do before one of them is taken, s."""
_IDLE = slice(3, 5)
"""Idle, and waiting for a disk, among the times of a core (proc(5))."""


@contextmanager
def one_core() -> Iterator[None]:
    """Keeps this process and those that it starts on one core, the idlest, where the system can do that."""
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
def others() -> Iterator[Callable[[], float | None]]:
    """Asked at the end, how many cores other processes kept busy; None where nobody knows."""
    began, before, ours = time.monotonic(), _busy(), _ours()

    def told() -> float | None:
        now = _busy()
        if not before or not now:
            return None
        taken = sum(now.values()) - sum(before.values()) - (_ours() - ours)
        return max(taken, 0.0) / max(time.monotonic() - began, 1e-9)

    yield told


def _idlest(allowed: set[int]) -> int:
    before = _busy() if len(allowed) > 1 else {}
    if before:
        time.sleep(_LOOK)
    now = _busy()
    return min(sorted(allowed), key=lambda core: now.get(core, 0.0) - before.get(core, 0.0))


def _busy() -> dict[int, float]:
    """For how long each core has been busy, s; {} where nobody knows."""
    try:
        lines = _STAT.read_text(encoding="ascii").splitlines()
        tick = os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):
        return {}
    cores = [line.split() for line in lines if line.startswith("cpu") and not line.startswith("cpu ")]
    times = {int(name[3:]): [int(part) for part in parts[:8]] for name, *parts in cores}
    return {core: (sum(parts) - sum(parts[_IDLE])) / tick for core, parts in times.items()}


def _ours() -> float:
    """Processor time of this process and of those of its children that have ended, s."""
    taken = os.times()
    return taken.user + taken.system + taken.children_user + taken.children_system
