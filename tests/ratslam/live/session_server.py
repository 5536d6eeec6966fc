"""`python -m tests.ratslam.live.session_server`: forks sessions from a process that has loaded all modules.

Each line of JSON on its standard input starts one; the process id is printed. The line gives the `arguments`
of `python -m ratslam`, the `folder` for its output (`log`) and exit code (`code`), how long the stub mapper
takes for a sample (`mapper`, s; null for no stub), whether the self-test checks the head's rate
(`rate_check`), and variables of its `environment`.
"""

import importlib
import json
import os
import pickle
import signal
import sys
import time
import warnings
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

LOADED = (
    "ratslam.cli.live", "ratslam.live.live_session", "ratslam.live.mapper_process", "robot.live.whisk_loop",
    "robot.drivers.head.emulated_cable", "evaluation.metrics.scorecard", "usb.core", "usb.util",
)  # fmt: skip
"""Modules that a session loads."""


def main() -> None:
    for name in LOADED:
        importlib.import_module(name)
    print("ready", flush=True)
    for line in sys.stdin:
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if not _fork():
            order, session = json.loads(line), _fork()
            if not session:
                _become_session(order, Path(order["folder"]))
            print(session, flush=True)
            code = os.waitstatus_to_exitcode(os.waitpid(session, 0)[1])
            new = Path(order["folder"], "code.new")
            new.write_text(str(code))
            new.rename(new.with_suffix(""))
            os._exit(0)


def _fork() -> int:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX is loaded, but has started no threads
        return os.fork()


def _become_session(order: dict[str, Any], folder: Path) -> None:
    """Runs the program in a new session of processes; does not return."""
    import ratslam.live.live_session
    from ratslam.cli import main as program
    from robot.live import selftest

    os.setsid()
    log = os.open(folder / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for fd, target in ((os.open(os.devnull, os.O_RDONLY), 0), (log, 1), (log, 2)):
        os.dup2(fd, target)
    os.environ.update(order["environment"])
    takes = order["mapper"]
    # Not of `__main__`, so that the process of the mapper loads it by its name.
    stub = importlib.import_module("tests.ratslam.live.session_server").map_nothing
    mapping = None if takes is None else partial(stub, str(folder / "run"), takes)
    run = ratslam.live.live_session.run_live_session
    # Without the process that draws the map.
    ratslam.live.live_session.run_live_session = lambda *given, armed, **more: run(
        *given, mapping=mapping, **more
    )
    if not order["rate_check"]:
        selftest.LISTEN_TIME = 0.3
        selftest.MIN_RATE_SHARE = 0.0  # on a busy machine the emulated head may be late in so short a time
    code = 1
    try:
        code = program(order["arguments"])
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


class Answer:
    """A stub's answer; pickles as `ratslam.live.mapper_process.MappedSample`, without importing it here."""

    def __init__(self, *fields: Any) -> None:
        self.fields = fields

    def __reduce__(self) -> tuple[Any, ...]:
        return result_of, self.fields


def result_of(number: int, seconds: float) -> Any:
    import numpy as np

    from ratslam.live.mapper_process import MappedSample

    return MappedSample(number, np.zeros(3), -1, seconds, np.nan, False, np.zeros((0, 2)), np.zeros(3))


def map_nothing(directory: str, seconds: float, line: Connection) -> None:
    """Stub of the mapper's main function: follows its protocol without mapping and loads almost nothing."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        line.recv_bytes()  # the job
        line.send(True)
        line.recv_bytes()  # the calibration
        Path(directory).mkdir(parents=True)
        line.send(True)
        number = 0
        while True:
            word = line.recv_bytes()
            if len(word) < 64 and isinstance(pickle.loads(word), bool):  # samples are longer
                return  # without a score
            time.sleep(seconds)
            line.send(Answer(number, seconds))
            number += 1
    except (EOFError, OSError):
        pass  # the parent has ended


if __name__ == "__main__":
    main()
