"""Processes that run jobs: our own on this machine, or those of a Dask scheduler somewhere."""

from __future__ import annotations

import logging
import pickle
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from typing import Any
from uuid import uuid4

from ratslam.experiments.studies.results import Result
from ratslam.experiments.studies.study import Job
from ratslam.experiments.studies.worker import environment, work
from tactile.base.errors import InputError

DEATHS = 5
"""How often a job is tried again after its process was killed."""
PATIENCE = 10
"""How long a scheduler may take to answer, s."""


def answers(client: Any, jobs: Sequence[Job]) -> Iterator[tuple[Job, Result | None]]:
    """Jobs and their results as they come; None if a job's process was killed again and again.

    Raises:
        InputError: the scheduler is gone, or knows nothing of ratslam.
    """
    from distributed import KilledWorker, as_completed

    settled, asked = environment(), uuid4().hex  # a scheduler may be asked for the same by others
    pending = {
        client.submit(work, settled, pickle.dumps(job), key=f"{job.key}-{asked}", pure=False): job
        for job in jobs
    }
    for future in as_completed(list(pending), loop=client.loop):
        job = pending.pop(future)
        try:
            result: Result = future.result()
        except KilledWorker:
            yield job, None
        except (ImportError, RuntimeError) as error:
            if isinstance(error, ImportError) or "deserialization" in str(error):
                found = f"its processes cannot load ratslam ({error})".splitlines()[0]
                raise InputError("--scheduler", found, "the same ratslam, installed there too") from None
            raise
        except CancelledError:
            cure = "what was done is kept; run it again"
            raise InputError("--scheduler", "the scheduler went away", "one that stays", cure) from None
        else:
            ran = result.machine and result.machine.model_copy(update={"workers": len(client.nthreads())})
            yield job, result.model_copy(update={"machine": ran})


@contextmanager
def connected(count: int, scheduler: str | None) -> Iterator[Any]:
    """A Dask client of so many processes of our own, which no other machine can reach, or of a scheduler.

    Raises:
        InputError: Dask is missing, or no scheduler answers.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
        from distributed.utils import silence_logging_cmgr
    except ImportError:
        option = "--workers" if scheduler is None else "--scheduler"
        cure = "pip install 'ratslam[sweep]', or run it in this process with --workers 1"
        raise InputError(option, "Dask is not installed", "the extra 'sweep'", cure) from None
    if scheduler is not None:
        # What its log would say is said by errors of ours.
        with silence_logging_cmgr(logging.CRITICAL), _reached(Client, scheduler) as client:
            yield client
        return
    settings = {
        "distributed.worker.multiprocessing-method": "spawn",  # forked children of a process with JAX hang
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.scheduler.worker-saturation": 1.0,  # a job that only waited is not to blame for a death
    }
    with dask.config.set(settings):
        with _unheard():
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


def _reached(make: Any, address: str) -> Any:
    """The client of a scheduler that runs already."""
    try:
        client = make(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        found = f"no scheduler answers at {address!r} ({type(error).__name__})"
        raise InputError("--scheduler", found, "the address of one, as tcp://HOST:8786") from None
    if not client.nthreads():
        print(f"ratslam: waiting for workers to join {address} ...", file=sys.stderr)
    return client


@contextmanager
def _unheard() -> Iterator[None]:
    """Processes started within do not hear Ctrl-C, which is for this one to act on."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
