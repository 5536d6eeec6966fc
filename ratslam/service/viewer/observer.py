"""Passes the progress of a run to the process that draws it, and drops what that cannot take in time.

The run puts messages into a bounded queue and never waits; a thread writes them into a pipe. If the viewer is
slow, the pipe and then the queue fill up and messages are dropped; if it ends, all later ones are.
"""

from __future__ import annotations

import os
import pickle
import queue
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from threading import Thread
from typing import Any, Self

from ratslam.runs.progress import MapReport, Observer, RunDescription, StepReport
from robot.drivers.process_priority import put_last
from tactile.base.errors import tell

QUEUE = 256
"""Messages that wait at most; one is a chunk of a run."""
END = 10.0
"""Time limit of the viewer to draw the last messages, s."""
GONE = 3
"""Exit code of the drawing process after it has said that the viewer is gone."""


class Viewer:
    """An observer of a run and a context manager; its process starts at once, to be ready early.

    Args:
        target: from `prepare_target`. end: time limit of the last messages, s. command: of the drawing
            process; None: `ratslam.service.viewer.process`.

    Attributes:
        offered, dropped: number of messages so far, and of those that were dropped.
    """

    def __init__(self, target: str, end: float = END, command: Sequence[str] | None = None) -> None:
        self.target, self.offered, self.dropped = target, 0, 0
        self._end, self._warned = end, False
        # rerun logs broken connections at length; the process says it in one line.
        environment = os.environ | {"RUST_LOG": "off", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self._process = subprocess.Popen(
            [*(command or (sys.executable, "-m", "ratslam.service.viewer.process")), target],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,  # it gets no Ctrl-C
        )
        put_last(self._process.pid)
        self._queue: queue.Queue[Any] = queue.Queue(QUEUE)
        self._writer = Thread(target=self._write, daemon=True, name="to viewer")
        self._writer.start()

    def begin(self, run: RunDescription) -> None:
        self._offer(run)

    def update(self, steps: Sequence[StepReport], map: MapReport | None) -> None:
        self._offer((tuple(steps), map))

    def finish(self, map: MapReport) -> None:
        self._offer(map)

    def _offer(self, message: Any) -> None:
        self.offered += 1
        try:
            self._queue.put_nowait(message)
        except queue.Full:
            self.dropped += 1

    def _write(self) -> None:
        """Writes messages until None; after the process has ended, only takes them away."""
        pipe: Any = self._process.stdin
        while (message := self._queue.get()) is not None:
            if pipe is None:
                self.dropped += 1
                continue
            try:
                pickle.dump(message, pipe, pickle.HIGHEST_PROTOCOL)
                pipe.flush()
            except OSError:
                self.dropped += 1
                with suppress(OSError):
                    pipe.close()
                pipe = None
        if pipe is not None:
            with suppress(OSError):
                pipe.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Lets the process draw the rest, for a limited time, and ends it."""
        due = time.monotonic() + self._end
        with suppress(queue.Full):
            self._queue.put(None, timeout=self._end)
        late = False
        try:
            code = self._process.wait(max(0.0, due - time.monotonic()))
        except subprocess.TimeoutExpired:
            late = True
            self._process.kill()
            code = self._process.wait()
        with suppress(queue.Full):
            self._queue.put(None, timeout=0.0)  # if the queue was full before, the thread has emptied it now
        self._writer.join(1.0)
        if code == GONE:
            return  # the process has said so
        if late or self.dropped or code:
            lost = f", {self.dropped} of {self.offered} messages were dropped" if self.dropped else ""
            state = "did not keep up" if late or code == 0 else "ended early"
            tell(f"warning: the view at {self.target} {state}{lost}; the results are complete")


@contextmanager
def open_viewer(target: str | None) -> Iterator[list[Observer]]:
    """The observers of a run with a view at this target; none for None."""
    if target is None:
        yield []
        return
    with Viewer(target) as viewer:
        yield [viewer]
