"""How much memory a piece of work takes, as the operating system sees it."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ratslam.experiments.studies.results import Memory

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_MIB = 1 << 20


@contextmanager
def weighed() -> Iterator[Callable[[], Memory]]:
    """Weighs what is done within; call what it gives at the end."""
    exact = _forget()
    before = _held("VmRSS")

    def told() -> Memory:
        peak = max(_held("VmHWM") or _ever(), before)  # the kernel counts pages by the dozen
        return Memory(peak=peak, before=before or peak, exact=exact)

    yield told


def _forget() -> bool:
    """Has the kernel count the peak anew, where it can (Linux: proc(5), clear_refs); whether it did."""
    try:
        _RESET.write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def _held(name: str) -> float:
    """A line of the process' status, MiB; 0 where there is none."""
    try:
        lines = _STATUS.read_text(encoding="ascii").splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{name}:")), 0.0)


def _ever() -> float:
    """The most that the process has ever held, MiB."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (_MIB if sys.platform == "darwin" else 1024)
