"""Runs tasks in this process, in processes of this machine, or in those of a Dask cluster.

This module loads without JAX, whose environment must be set before a worker process loads it.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent import futures
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from typing import Any, TypeVar

from tactile.base.errors import InputError

DEATHS = 5
"""Number of times that processes start anew after one was killed; then each task has a process of its own."""
ANSWER_TIME = 10
"""Time that a scheduler has for its first answer, s."""
ENVIRONMENT = (
    "XLA_FLAGS",
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES",
)
"""Variables that a process of a cluster takes from this one before it loads JAX."""

Task = TypeVar("Task")
Result = TypeVar("Result")
Submit = Callable[[Any, Any], "futures.Future[Any]"]


def run_tasks(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    workers: int | None = None,
    scheduler: str | None = None,
) -> Iterator[Result]:
    """Yields `function(task)` for each task, in the order of the tasks.

    After Ctrl-C, or when the iteration is abandoned, the processes that were started end.

    Args:
        function: of a module, so that other processes can import it; what it raises is raised here.
        workers, scheduler: see `Executor`.

    Raises:
        InputError: Dask is missing, a scheduler does not answer, or a task's process was killed.
    """
    found: dict[int, Result] = {}
    with Executor(workers, scheduler) as executor, closing(executor.completed(function, tasks)) as completed:
        for index in range(len(tasks)):
            while index not in found:
                found.update([next(completed)])
            yield found.pop(index)


class Executor(ExitStack):
    """Worker processes that start with the first tasks and serve until the end of the `with` block.

    Args:
        workers: number of processes; 1: tasks run in this process; None or 0: one per core.
        scheduler: address of a Dask scheduler whose workers are used instead.
        fresh: run every task in a new process of this machine, one after another.

    Attributes:
        processes: number of processes that share the work.
    """

    def __init__(self, workers: int | None = None, scheduler: str | None = None, fresh: bool = False) -> None:
        super().__init__()
        self.processes = 1
        self._workers, self._scheduler, self._fresh = workers or os.cpu_count() or 1, scheduler, fresh
        self._submit: Submit | None = None
        self._most = 1

    def completed(
        self,
        function: Callable[[Task], Result],
        tasks: Sequence[Task],
        killed: Callable[[Task], Result] | None = None,
    ) -> Generator[tuple[int, Result], None, None]:
        """Yields (index of the task, result) in the order of completion.

        Args:
            killed: gives the result of a task whose process was killed, e.g. for lack of memory; None: this
                raises an `InputError`.
        """
        left = dict(enumerate(tasks))
        if not self._fresh and self._scheduler is None and min(self._workers, len(tasks)) <= 1:
            yield from enumerate(map(function, tasks))
            return
        for _ in range(0 if self._fresh else DEATHS if self._scheduler is None else 1):
            for index, result in self._answers(function, left.copy()):
                del left[index]
                yield index, result
            if not left:
                return
        for index, task in left.items():
            try:
                yield index, self._answer_alone(function, task)
            except BrokenProcessPool:
                if killed is None:
                    found = "a process was killed, for lack of memory for example"
                    raise InputError("--workers", found, "memory for all", "ask for fewer") from None
                yield index, killed(task)

    def _answers(self, function: Callable[[Task], Result], tasks: dict[int, Task]) -> Iterator[Any]:
        """(index, result) in the order of completion, without those of processes that were killed."""
        if self._submit is None:
            pool = _cluster(self._scheduler) if self._scheduler else _local(self._workers)
            self._submit, self._most = self.enter_context(pool)
        self.processes = max(self.processes, min(self._most, len(tasks)))
        with _ignoring_interrupts():
            pending = {self._submit(function, task): index for index, task in tasks.items()}
        for future in futures.as_completed(pending):
            try:
                result = future.result()
            except BrokenProcessPool:
                self._submit = None
            except Exception as error:
                if self._scheduler is None or not _is_killed(error):
                    raise
            else:
                yield pending[future], result

    def _answer_alone(self, function: Callable[[Task], Result], task: Task) -> Result:
        if self._scheduler is not None:
            raise BrokenProcessPool
        with _local(1) as (submit, _):
            with _ignoring_interrupts():
                future = submit(function, task)
            return future.result()


def call_in_worker(environment: dict[str, str], packed: bytes) -> Any:
    """The result of a pickled (function, task), whose unpickling may load JAX."""
    for name, value in environment.items():
        os.environ.setdefault(name, value)
    function, task = pickle.loads(packed)
    return function(task)


@contextmanager
def _local(count: int) -> Iterator[tuple[Submit, int]]:
    """Submits to processes of this machine, which end with the block, whatever they are doing."""
    context = multiprocessing.get_context("spawn")  # forked children of a process with JAX hang
    others = multiprocessing.active_children()
    pool = futures.ProcessPoolExecutor(count, context, _end_with_parent)
    try:
        yield pool.submit, count
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            if process not in others:
                process.kill()
                process.join()


def _end_with_parent() -> None:
    """Ends this process when its parent was killed, which could not end it."""

    def wait() -> None:
        if (parent := multiprocessing.parent_process()) is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def _cluster(address: str) -> Iterator[tuple[Submit, int]]:
    """Submits to the processes of a Dask scheduler."""
    try:
        from distributed import Client
        from distributed.utils import silence_logging_cmgr
    except ImportError:
        cure = "pip install 'ratslam[sweep]'"
        raise InputError("--scheduler", "Dask is not installed", "the extra 'sweep'", cure) from None
    environment = {name: os.environ[name] for name in ENVIRONMENT if name in os.environ}
    with silence_logging_cmgr(logging.CRITICAL):  # the log repeats what our errors say
        try:
            client = Client(address, timeout=ANSWER_TIME, set_as_default=False)
        except (OSError, ValueError) as error:
            found = f"no scheduler answers at {address!r} ({type(error).__name__})"
            raise InputError("--scheduler", found, "the address of one, such as tcp://HOST:8786") from None
        with client:
            if not client.nthreads():
                print(f"ratslam: waiting for workers to join {address} ...", file=sys.stderr)
            submit = partial(client.get_executor(pure=False).submit, call_in_worker, environment)
            yield lambda function, task: submit(pickle.dumps((function, task))), len(client.nthreads()) or 1


def _is_killed(error: Exception) -> bool:
    """Whether an error of a cluster is that a task's process was killed.

    Raises:
        InputError: the cluster is at fault.
    """
    if isinstance(error, futures.CancelledError):
        cure = "what was done is kept; run it again"
        raise InputError("--scheduler", "the scheduler went away", "one that stays", cure) from None
    if isinstance(error, ImportError) or "deserialization" in str(error):
        found = f"its processes cannot load ratslam ({error})".splitlines()[0]
        raise InputError("--scheduler", found, "the same ratslam, installed there too") from None
    return type(error).__name__ == "KilledWorker"


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
    """Processes started within ignore Ctrl-C, which this process acts on."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
