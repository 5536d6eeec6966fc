"""Where, with what and how often it was measured, and what was in the way."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from ratslam.experiments.studies.results import Machine, Result

BUSY = 0.3
"""Cores' worth of other work from which a measurement is said to be disturbed."""
PACES = {"live": "one cycle at a time", "replay": "a chunk of cycles at a time"}


def circumstances(results: Sequence[Result], pace: str) -> dict[str, str]:
    """By name, what a figure of speed means nothing without."""
    machines = [result.machine for result in results if result.machine]
    seeds = len({result.seed for result in results})

    def every(what: Callable[[Machine], str]) -> str:
        return " and ".join(dict.fromkeys(map(what, machines))) or "unknown"

    return {
        "machine": every(_where),
        "versions": every(lambda each: ", ".join(f"{name} {value}" for name, value in each.versions.items())),
        "build": f"build {every(lambda each: each.build)}",
        "seeds": f"{seeds} seed{'s' if seeds != 1 else ''}",
        "pace": PACES[pace],
    }


def most_others(others: float | None, path: Path) -> float | None:
    """Cores that others kept busy, now or when what stands in the file of an earlier call was measured: at
    most so many."""
    try:
        earlier = json.loads(path.read_bytes()).get("others")
    except (OSError, ValueError, AttributeError):
        earlier = None
    known = [each for each in (others, earlier) if isinstance(each, float)]
    return max(known, default=None)


def disturbances(others: float | None, workers: int) -> list[str]:
    """What spoils the times: sentences.

    Args:
        others: cores that other processes kept busy meanwhile. workers: runs at a time.
    """
    told = []
    if workers > 1:
        told.append(f"{workers} runs at a time disturb each other; for times to rely on, leave --workers 1")
    if others is not None and others > BUSY:
        told.append(f"other processes kept {others:.1f} cores busy meanwhile; times are longer for it")
    return told


def _where(machine: Machine) -> str:
    if machine.device != "cpu":
        return f"{machine.processor}, {machine.device}"
    at_once = "one run at a time" if machine.workers == 1 else f"{machine.workers} runs at a time"
    return f"{machine.processor}, {os.cpu_count()} cores, {at_once}"
