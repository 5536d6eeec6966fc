"""Runs tasks in this process, or in Dask processes: of this machine, or of a cluster.

This module loads without JAX, whose environment must be set before a worker process loads it.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent import futures
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, suppress
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from robot.drivers.processes import withheld_signals
from tactile.base.errors import InputError, tell

ANSWER_TIME = 10  # time that a scheduler has for its first answer, s
ENVIRONMENT = (
    "XLA_FLAGS",
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES",
)
"""Variables that a process of a cluster takes from this one before it loads JAX."""
DASK_SETTINGS: dict[str, Any] = {
    "distributed.nanny.pre-spawn-environ": {},
    "distributed.scheduler.worker-ttl": None,
    "distributed.worker.profile.enabled": False,
}
"""Processes of this machine have its environment, may compute for any time, and are not profiled."""

Task = TypeVar("Task")
Result = TypeVar("Result")


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
        workers: number of processes; 1: tasks run in this process; None or 0: one per core, without Dask 1.
        scheduler: address of a Dask scheduler whose workers are used instead.
        fresh: run every task in a new process of this machine, one after another; needs no Dask.

    Attributes:
        processes: number of processes that share the work.
    """

    def __init__(self, workers: int | None = None, scheduler: str | None = None, fresh: bool = False) -> None:
        super().__init__()
        self.processes = 1
        self._workers, self._scheduler, self._fresh = workers, scheduler, fresh
        self._client: Any = None

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
        if not self._fresh:
            if not self._connect(len(tasks)):
                yield from enumerate(map(function, tasks))
                return
            for index, result in self._answers(function, tasks):
                del left[index]
                yield index, result
            if left:
                self.close()  # all memory for the task at fault
        for index, task in left.items():
            try:
                if self._scheduler is not None:
                    raise BrokenProcessPool
                yield index, _call_afresh(function, task)
            except BrokenProcessPool:
                if killed is None:
                    found = "a process was killed, for lack of memory for example"
                    raise InputError("--workers", found, "memory for all", "ask for fewer") from None
                yield index, killed(task)

    def _connect(self, tasks: int) -> bool:
        """Whether worker processes serve; else tasks run in this process."""
        workers = min(self._workers or os.cpu_count() or 1, tasks)
        if self._scheduler is None and workers <= 1:
            return False
        try:
            import distributed  # noqa: F401
        except ImportError:
            cure = "pip install 'ratslam[sweep]'"
            if self._scheduler is None and not self._workers:
                tell(f"one process, for lack of Dask ({cure})")
                return False
            option = "--workers" if self._scheduler is None else "--scheduler"
            raise InputError(option, "Dask is not installed", "the extra 'sweep'", cure) from None
        if self._scheduler is None and workers > self.processes:
            self.close()
        if self._client is None:
            with withheld_signals([signal.SIGINT]):
                self._client = self._client_of(workers)
                self.callback(setattr, self, "_client", None)
        self.processes = max(self.processes, min(len(self._client.nthreads()) or 1, tasks))
        return True

    def _client_of(self, workers: int) -> Any:
        """A client of the scheduler, or of a new one with processes of this machine."""
        import dask
        from distributed import Client, LocalCluster
        from distributed.utils import silence_logging_cmgr

        self.enter_context(silence_logging_cmgr(logging.CRITICAL))  # the log repeats what our errors say
        address = self._scheduler
        if address is None:
            folder = self.enter_context(TemporaryDirectory())
            self.enter_context(dask.config.set(DASK_SETTINGS | {"temporary-directory": folder}))
            # The scheduler answers HTTP without a dashboard too, by default at port 8787 of all networks.
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1", memory_limit=0,
                dashboard_address=None, scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
                silence_logs=logging.CRITICAL,
            )  # fmt: skip
            self.enter_context(cluster)
            self.callback(_kill_workers, cluster)
            address = str(cluster.scheduler_address)
        try:
            client = self.enter_context(Client(address, timeout=ANSWER_TIME, set_as_default=False))
        except (OSError, ValueError) as error:
            found = f"no scheduler answers at {address!r} ({type(error).__name__})"
            raise InputError("--scheduler", found, "the address of one, such as tcp://HOST:8786") from None
        if not client.nthreads():
            tell(f"waiting for workers to join {address} ...")
        return client

    def _answers(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[Any]:
        """(index, result) in the order of completion, without those of processes that were killed."""
        environment = {name: os.environ[name] for name in ENVIRONMENT if name in os.environ}
        pool = self._client.get_executor(pure=False)
        packed = (pickle.dumps((function, task)) for task in tasks)
        pending = {pool.submit(_call_in_worker, environment, each): k for k, each in enumerate(packed)}
        for future in futures.as_completed(pending):
            try:
                result = future.result()
            except Exception as error:
                if self._scheduler is not None and isinstance(error, futures.CancelledError):
                    found, cure = "the scheduler went away", "what was done is kept; run it again"
                    raise InputError("--scheduler", found, "one that stays", cure) from None
                unloadable = isinstance(error, ImportError) or "deserialization" in str(error)
                if self._scheduler is not None and unloadable:
                    found = f"its processes cannot load ratslam ({error})".splitlines()[0]
                    wanted = "the same ratslam, installed there too"
                    raise InputError("--scheduler", found, wanted) from None
                if type(error).__name__ != "KilledWorker":
                    raise
            else:
                yield pending[future], result


def _call_in_worker(environment: dict[str, str], packed: bytes) -> Any:
    """The result of a pickled (function, task), whose unpickling may load JAX."""
    for name, value in environment.items():
        os.environ.setdefault(name, value)
    function, task = pickle.loads(packed)
    return function(task)


def _kill_workers(cluster: Any) -> None:
    """Ends the processes of a cluster, whatever they are doing."""
    for nanny in cluster.workers.values():
        nanny.close_gracefully()  # it starts no other process
        if nanny.pid is not None:
            with suppress(ProcessLookupError):  # it has just ended
                os.kill(nanny.pid, signal.SIGTERM)


def _call_afresh(function: Callable[[Task], Result], task: Task) -> Result:
    """The result of a task in a new process; raises a `BrokenProcessPool` if that was killed."""
    others = multiprocessing.active_children()
    context = multiprocessing.get_context("spawn")  # forked children of a process with JAX hang
    with futures.ProcessPoolExecutor(1, context, _end_with_parent) as pool:
        try:
            with withheld_signals([signal.SIGINT]):
                future = pool.submit(function, task)
            return future.result()
        finally:
            for process in set(multiprocessing.active_children()).difference(others):
                process.kill()


def _end_with_parent() -> None:
    """Ends this process when its parent was killed, which could not end it."""

    def wait() -> None:
        if (parent := multiprocessing.parent_process()) is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
