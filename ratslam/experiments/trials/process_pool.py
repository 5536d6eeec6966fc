"""A few processes that share out work."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from tactile.base.errors import InputError

Task = TypeVar("Task")
Result = TypeVar("Result")


def shared_out(
    function: Callable[[Task], Result], tasks: Sequence[Task], workers: int = 0
) -> Iterator[Result]:
    """The function's results in the order of the tasks, whichever is done first; errors come out whole.

    Args:
        function: of a module, so that other processes find it. workers: processes; 0: as many as there are
            cores. One does its work right here.

    Raises:
        InputError: a process was killed, for want of memory say.
    """
    count = min(workers or os.cpu_count() or 1, len(tasks))
    if count <= 1:
        yield from map(function, tasks)
        return
    # Forked children of a process that runs JAX may hang; spawned ones start clean.
    context = multiprocessing.get_context("spawn")
    # An interrupt is for this process, which then ends the others.
    pool = ProcessPoolExecutor(count, context, signal.signal, (signal.SIGINT, signal.SIG_IGN))
    try:
        for pending in [pool.submit(function, task) for task in tasks]:
            yield pending.result()
    except BrokenProcessPool:
        raise InputError(
            "--workers", "a process ended before its work was done", "memory for all", "ask for fewer"
        ) from None
    finally:
        left = list((pool._processes or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in left:
            worker.terminate()
