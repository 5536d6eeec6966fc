"""Passes the progress of a run to the process that draws it, and drops what that cannot take in time.

The run puts messages into a bounded queue and never waits; a thread writes them into a pipe. If the viewer is
slow, the pipe and then the queue fill up and messages are dropped; if it ends, all later ones are.
`prepare_target` checks where the view goes: an .rrd file, or a viewer on this machine.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from typing import Any

from ratslam.runs.runner import Observer
from robot.drivers.processes import put_last
from robot.emulators.listening import is_loopback
from tactile.base.errors import InputError, tell
from tactile.base.files import require_new_file

QUEUE = 256
"""Messages that wait at most; one is a chunk of a run."""
END = 10.0
"""Time limit of the viewer to draw the last messages, s."""
GONE = 3
"""Exit code of the drawing process after it has said that the viewer is gone."""


class Viewer(AbstractContextManager["Viewer"]):
    """An observer of a run and a context manager; its process starts at once, to be ready early.

    Args:
        target: from `prepare_target`. end: time limit of the last messages, s. command: of the drawing
            process; None: `ratslam.service.viewer_process`.

    Attributes:
        offered, dropped: number of messages so far, and of those that were dropped.
    """

    def __init__(self, target: str, end: float = END, command: Sequence[str] | None = None) -> None:
        self.target, self.offered, self.dropped = target, 0, 0
        self._end = end
        # rerun logs broken connections at length; the process says it in one line.
        environment = os.environ | {"RUST_LOG": "off", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self._process = subprocess.Popen(
            [*(command or (sys.executable, "-m", "ratslam.service.viewer_process")), target],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,  # it gets no Ctrl-C
        )
        put_last(self._process.pid)
        self._queue: queue.Queue[Any] = queue.Queue(QUEUE)
        self._writer = Thread(target=self._write, daemon=True, name="to viewer")
        self._writer.start()

    def __call__(self, message: Any) -> None:
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


VIEWER = "127.0.0.1:9876"
"""Address of a viewer with its default port."""
START = "start"
"""The word that starts a viewer at `VIEWER`."""
START_TIMEOUT = 20.0
"""Time limit of the start of a viewer, s."""
SETTLING = 1.5
"""Time after its first answer in which a viewer without a screen ends, s."""
EXPECTED = f"an .rrd file, a loopback address such as {VIEWER}, or `{START}`"


def prepare_target(text: str) -> str:
    """Checks a target before a run, and starts a viewer if it is `START`.

    Args:
        text: an .rrd file, `HOST:PORT` of a viewer on loopback, or `START`.

    Returns:
        the absolute path of the file, or the address.

    Raises:
        InputError: rerun is not installed, the target is of none of these kinds, the file cannot be new, or
            no viewer answers.
    """
    if find_spec("rerun") is None:
        cure = "pip install 'ratslam[view]'"
        raise InputError("--rerun", "rerun is not installed", "the extra 'view'", cure)
    if text.endswith(".rrd"):
        require_new_file(Path(text))
        return os.path.abspath(text)
    if text == START:
        _start_viewer()
        return VIEWER
    host, port = _split_address(text)
    if not _answers(host, port):
        cure = f"start one with `rerun --bind 127.0.0.1`, or let `--rerun {START}` do it"
        raise InputError(f"--rerun {text}", "no viewer answers", "a running one", cure)
    return text


def _split_address(text: str) -> tuple[str, int]:
    """Host and port of a loopback address."""
    host, _, port = text.rpartition(":")
    number = int(port) if port.isdecimal() else 0
    if not is_loopback(host) or not 0 < number < 1 << 16:
        raise InputError("--rerun", repr(text), EXPECTED, "reach another machine through an ssh tunnel")
    return host, number


def _start_viewer() -> None:
    """Starts a viewer that outlives this program; rerun's default would listen on every interface."""
    host, port = _split_address(VIEWER)
    if _answers(host, port):
        return
    command = [sys.executable, "-m", "rerun", "--bind", host, "--port", str(port), "--expect-data-soon"]
    quiet = subprocess.DEVNULL
    viewer = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
    due = time.monotonic() + START_TIMEOUT
    answered: float | None = None
    while answered is None or time.monotonic() < answered + SETTLING:
        if answered is None and _answers(host, port):
            answered = time.monotonic()
        if viewer.poll() is not None or time.monotonic() > due:
            with suppress(ProcessLookupError):
                os.killpg(viewer.pid, signal.SIGKILL)  # with the process that it starts in turn
            cure = "without a screen, `--rerun FILE.rrd` keeps the view for later"
            raise InputError(f"--rerun {START}", "the viewer did not start", "a screen", cure)
        time.sleep(0.1)


def _answers(host: str, port: int) -> bool:
    with suppress(OSError):
        socket.create_connection((host.strip("[]"), port), timeout=1.0).close()
        return True
    return False
