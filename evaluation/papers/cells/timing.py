"""Processor and wall time of calls on one core, and the load of the machine meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter, process_time
from typing import NamedTuple

import numpy as np

from evaluation.studies.resources import one_core, processor_name, watch_load


class Taken(NamedTuple):
    """Time of a call, s: of all threads of this process on processors, and on the wall."""

    processor: float
    wall: float


class Circumstances:
    """Where times are measured; `text` is complete after the block of `on_one_core`."""

    text = ""


def time_call(call: Callable[[], object]) -> Taken:
    """The time of a call."""
    wall, processor = perf_counter(), process_time()
    call()
    return Taken(process_time() - processor, perf_counter() - wall)


def median(times: list[Taken]) -> Taken:
    """The median of each time."""
    return Taken(*np.median(np.array(times), axis=0).tolist())


@contextmanager
def on_one_core() -> Iterator[Circumstances]:
    """Keeps the process on its idlest core, and describes the machine and its load afterwards."""
    found, load = Circumstances(), watch_load()
    with one_core():
        yield found
    others = load()
    busy = "unknown" if others is None else f"{others:.1f} cores busy with other processes in the mean"
    found.text = f"On one core of {processor_name()}; load of the machine: {busy}."
