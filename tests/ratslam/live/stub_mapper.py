"""Stub of the mapper process: follows its protocol without mapping, and loads almost nothing."""

from __future__ import annotations

import os
import pickle
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

SHORT = 64
"""Bytes; shorter messages are not samples."""


class Answer:
    """Pickles as `ratslam.live.mapper_process.MappedSample`, without importing it here."""

    def __init__(self, *fields: Any) -> None:
        self.fields = fields

    def __reduce__(self) -> tuple[Any, ...]:
        return result_of, self.fields


def result_of(number: int, seconds: float) -> Any:
    """The result of a sample."""
    import numpy as np

    from ratslam.live.mapper_process import MappedSample

    return MappedSample(number, np.zeros(3), -1, seconds, np.nan, False, np.zeros((0, 2)))


def mapping(directory: str, seconds: float, line: Connection) -> None:
    """The main function of the process.

    Args:
        directory: that a mapper would make; `mapper.pid` in it holds the process id. seconds: for each
            sample.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        line.recv_bytes()  # the job
        line.send(True)
        line.recv_bytes()  # the calibration
        Path(directory).mkdir(parents=True)
        Path(directory, "mapper.pid").write_text(str(os.getpid()))
        line.send(True)
        number = 0
        while True:
            word = line.recv_bytes()
            if len(word) < SHORT and isinstance(pickle.loads(word), bool):
                return  # without a score
            time.sleep(seconds)
            line.send(Answer(number, seconds))
            number += 1
    except (EOFError, OSError):
        pass  # the parent has ended
