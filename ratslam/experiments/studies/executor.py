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
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, closing, contextmanager
from importlib.util import find_spec
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Self, TypeVar
from uuid import uuid4

from tactile.base.errors import InputError

DEATHS = 5
"""Number of times that a task is repeated after its process was killed."""
ANSWER_TIME = 10
"""Time that a scheduler has for its first answer, s."""
ENVIRONMENT = (
    "XLA_FLAGS",
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES",
)
"""Variables that a worker process takes from this one before it loads JAX."""
LOCAL = {
    "distributed.worker.multiprocessing-method": "spawn",  # forked children of a process with JAX hang
    "distributed.scheduler.allowed-failures": DEATHS,
    "distributed.scheduler.worker-saturation": 1.0,  # a task that only waited is not to blame for a death
    "distributed.scheduler.worker-ttl": None,  # compiling may hold a worker's heartbeat back
    "distributed.comm.timeouts.connect": "120s",
    "distributed.nanny.pre-spawn-environ": {},  # workers compute with as many threads as this process
}
"""Dask's settings for processes of this machine."""

Task = TypeVar("Task")
Result = TypeVar("Result")


def run_tasks(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], object] | None = None,
) -> Iterator[Result]:
    """Yields `function(task)` for each task, in the order of the tasks.

    After Ctrl-C, or when the iteration is abandoned, the processes that were started end.

    Args:
        function: of a module, so that other processes can import it; what it raises is raised here.
        workers, scheduler: see `Executor`.
        progress: called with the index of each task that is complete, in the order of completion.

    Raises:
        InputError: Dask is missing, a scheduler does not answer, or a task's process was killed repeatedly.
    """
    found: dict[int, Result] = {}
    with (
        Executor(workers, scheduler) as executor,
        closing(executor.completed(function, tasks)) as completed,
    ):
        for index in range(len(tasks)):
            while index not in found:
                done, result = next(completed)
                found[done] = result
                if progress:
                    progress(done)
            yield found.pop(index)


class Executor:
    """Worker processes that start with the first tasks and serve until the end of the `with` block.

    Args:
        workers: number of processes; 1: tasks run in this process; None or 0: one per core where Dask is
            installed, else 1.
        scheduler: address of a Dask scheduler whose workers are used instead.
        most: largest number of tasks asked for at once, where that is known before.
        fresh: run every task in a new process of this machine, one after another.
    """

    def __init__(
        self, workers: int | None = None, scheduler: str | None = None, most: int = 0, fresh: bool = False
    ) -> None:
        usual = (os.cpu_count() or 1) if find_spec("distributed") else 1
        self._workers, self._scheduler, self._most, self._fresh = workers or usual, scheduler, most, fresh
        self._client: Any = None
        self._open = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.__exit__(kind, error, trace)

    @property
    def processes(self) -> int:
        """Number of processes that share the work."""
        return len(self._client.nthreads()) if self._client is not None else 1

    def completed(
        self,
        function: Callable[[Task], Result],
        tasks: Sequence[Task],
        killed: Callable[[Task], Result] | None = None,
    ) -> Generator[tuple[int, Result], None, None]:
        """Yields (index of the task, result) in the order of completion.

        Args:
            killed: gives the result of a task whose process was killed `DEATHS` + 1 times, e.g. for lack of
                memory; None: this raises an `InputError`.
        """
        if self._fresh:
            for index, task in enumerate(tasks):
                yield index, _in_new_process(function, task, killed)
            return
        count = min(self._workers, max(len(tasks), self._most))
        if self._scheduler is None and (count <= 1 or (len(tasks) <= 1 and self._client is None)):
            yield from enumerate(map(function, tasks))
            return
        if self._client is None:
            self._client = self._open.enter_context(_connected(count, self._scheduler))
        yield from _answers(self._client, function, tasks, killed)


def call_in_worker(environment: dict[str, str], packed: bytes) -> Any:
    """The result of a pickled (function, task), whose unpickling may load JAX."""
    for name, value in environment.items():
        os.environ.setdefault(name, value)
    function, task = pickle.loads(packed)
    return function(task)


def _in_new_process(
    function: Callable[[Task], Result], task: Task, killed: Callable[[Task], Result] | None
) -> Result:
    context = multiprocessing.get_context("spawn")
    answer, send = context.Pipe(duplex=False)
    process = context.Process(target=_send_result, args=(send, function, task), daemon=True)
    with _ignoring_interrupts():
        process.start()
    send.close()
    try:
        result, error = answer.recv()
    except EOFError:
        return _after_kill(task, killed, 1)
    finally:
        process.kill()
        process.join()
    if error is not None:
        raise error
    return result


def _send_result(send: Connection, function: Callable[[Task], Result], task: Task) -> None:
    try:
        send.send((function(task), None))
    except Exception as error:
        send.send((None, error))


def _after_kill(task: Task, killed: Callable[[Task], Result] | None, times: int) -> Result:
    if killed is not None:
        return killed(task)
    found = f"a process was killed {times} times, for lack of memory for example"
    raise InputError("--workers", found, "memory for all", "ask for fewer")


def _answers(
    client: Any,
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    killed: Callable[[Task], Result] | None,
) -> Generator[tuple[int, Result], None, None]:
    from distributed import KilledWorker, as_completed

    environment = {name: os.environ[name] for name in ENVIRONMENT if name in os.environ}
    asked = uuid4().hex  # a scheduler may be asked for the same by others
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sending large graph")
        pending = {
            client.submit(
                call_in_worker,
                environment,
                pickle.dumps((function, task)),
                key=f"{asked}-{index}",
                pure=False,
            ): index
            for index, task in enumerate(tasks)
        }
    for future in as_completed(list(pending), loop=client.loop):
        index = pending.pop(future)
        try:
            result: Result = future.result()
        except KilledWorker:
            result = _after_kill(tasks[index], killed, DEATHS + 1)
        except (ImportError, RuntimeError) as error:
            if isinstance(error, ImportError) or "deserialization" in str(error):
                found = f"its processes cannot load ratslam ({error})".splitlines()[0]
                raise InputError("--scheduler", found, "the same ratslam, installed there too") from None
            raise
        except CancelledError:
            cure = "what was done is kept; run it again"
            raise InputError("--scheduler", "the scheduler went away", "one that stays", cure) from None
        yield index, result


@contextmanager
def _connected(count: int, scheduler: str | None) -> Iterator[Any]:
    """A Dask client of `count` processes of our own, which no other machine can reach, or of a scheduler."""
    try:
        import dask
        from distributed import Client, LocalCluster
        from distributed.utils import silence_logging_cmgr
    except ImportError:
        option = "--workers" if scheduler is None else "--scheduler"
        cure = "pip install 'ratslam[sweep]', or run it in this process with --workers 1"
        raise InputError(option, "Dask is not installed", "the extra 'sweep'", cure) from None
    if scheduler is not None:
        # The log repeats what our errors say.
        with silence_logging_cmgr(logging.CRITICAL), _client_of(Client, scheduler) as client:
            yield client
        return
    with dask.config.set(LOCAL):
        with _ignoring_interrupts():
            cluster = LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                protocol="tcp",
                dashboard_address="127.0.0.1:0",
                worker_dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            )
        with cluster, Client(cluster, set_as_default=False) as client:
            yield client


def _client_of(make: Any, address: str) -> Any:
    """The client of a scheduler that runs already."""
    try:
        client = make(address, timeout=ANSWER_TIME, set_as_default=False)
    except (OSError, ValueError) as error:
        found = f"no scheduler answers at {address!r} ({type(error).__name__})"
        raise InputError("--scheduler", found, "the address of one, such as tcp://HOST:8786") from None
    if not client.nthreads():
        print(f"ratslam: waiting for workers to join {address} ...", file=sys.stderr)
    return client


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
