"""Ctrl-C and SIGTERM, withheld from the processes of a session, which it ends itself."""

from __future__ import annotations

import signal
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker

STOPS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def withheld_signals(stops: Collection[signal.Signals] = STOPS) -> Iterator[None]:
    """Processes started in the block, and their successors, get none of the signals from their first
    instruction on: a terminal, `timeout` and systemd send them to all processes of a program. In this process
    they wait for the end of the block."""
    resource_tracker.ensure_running()  # its start would end the block of the signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, stops)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
