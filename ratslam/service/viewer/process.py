"""The process that draws: reads messages from its standard input and logs them with rerun.

python -m ratslam.service.viewer.process TARGET
"""

from __future__ import annotations

import os
import pickle
import sys
import time
from typing import Any, BinaryIO

from ratslam.runs.progress import MapReport, RunDescription
from ratslam.service.viewer.drawing import Drawing, open_recording
from ratslam.service.viewer.observer import GONE

PATIENCE = 30.0
"""Time that a viewer may take for one message, s."""


def main(target: str, source: BinaryIO) -> int:
    """Draws all messages; returns the exit code."""
    recording = open_recording(target)
    drawing = Drawing(recording)
    try:
        while True:
            try:
                message = pickle.load(source)
            except (EOFError, pickle.UnpicklingError):
                break
            if isinstance(message, RunDescription):
                drawing.begin(message)
            elif isinstance(message, MapReport):
                drawing.finish(message)
            else:
                drawing.update(*message)
            _flush(recording)
        if target.endswith(".rrd"):
            recording.disconnect()  # completes the file; with a viewer this may wait for ever
    except (RuntimeError, TimeoutError) as error:
        print(
            f"ratslam: warning: the view at {target} is gone ({error}); the run goes on without it",
            file=sys.stderr,
            flush=True,
        )
        return GONE
    return 0


def _flush(recording: Any) -> None:
    """Waits until the viewer has the data, so that no more than one message is ever on the way.

    Raises:
        RuntimeError: the connection is broken, or the disk refuses the data.
        TimeoutError: the viewer has taken nothing for `PATIENCE`.
    """
    due = time.monotonic() + PATIENCE
    while True:
        try:
            recording.flush(timeout_sec=1.0)
        except RuntimeError as error:
            if "timed out" not in str(error):
                raise
            if time.monotonic() > due:
                raise TimeoutError(f"it has taken no data for {PATIENCE:g} s") from None
        else:
            return


if __name__ == "__main__":
    code = main(sys.argv[1], sys.stdin.buffer)
    os._exit(code)  # at a normal exit rerun would wait for a viewer that takes no data
