"""Runs commands of the program one after the other in another process, within bounds of time and memory."""

from __future__ import annotations

import contextlib
import io
import json
import os
import select
import signal
import subprocess
import sys
import time
import traceback
import warnings
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
SECONDS, MEMORY = 60.0, 2 << 30
"""Most time and memory (s, bytes) until a command has refused its input or made its first step."""
LONG = 25.0
"""A run that made steps is interrupted after this time, s."""


class Outcome(NamedTuple):
    """What a command did: its exit code, or None where it ended in a traceback or was killed, and its text."""

    code: int | None
    said: str


class CommandWorker:
    """A process that runs commands; started again when one was killed or it has become large."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def run(self, folder: Path, *command: object, long: float = LONG) -> Outcome:
        """Runs one command in a folder.

        Args:
            long: time after which a run that made steps is interrupted, s.
        """
        if self._process is None or self._memory() > MEMORY // 2:
            self.close()
            code = "from tests.helpers.command_worker import serve; serve()"
            paths = {"PYTHONPATH": str(ROOT)}
            self._process = subprocess.Popen(
                [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                env=os.environ | paths, stderr=subprocess.DEVNULL,
            )  # fmt: skip
            self._answer(folder, 600.0, LONG)  # until it has imported the program
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([str(folder), [str(part) for part in command]]).encode() + b"\n")
        self._process.stdin.flush()
        return self._answer(folder, SECONDS, long)

    def _answer(self, folder: Path, most: float, long: float) -> Outcome:
        process, begun, told = self._process, time.monotonic(), False
        end = begun + most
        assert process is not None
        assert process.stdout is not None
        while not select.select([process.stdout], [], [], 0.1)[0]:
            now, stepped = time.monotonic(), any(file.stat().st_size for file in folder.glob("*/online.tum"))
            if stepped and not told and now > begun + long:
                process.send_signal(signal.SIGINT)
                end, told = now + SECONDS, True
            if now > end or (self._memory() > MEMORY and not stepped):
                memory = self._memory() >> 20
                self.close()
                return Outcome(None, f"killed after {now - begun:.0f} s, {memory} MiB")
        line = process.stdout.readline()
        if not line:
            self.close()
            return Outcome(None, "the process died")
        return Outcome(130, "") if told else Outcome(*json.loads(line))

    def _memory(self) -> int:
        assert self._process is not None
        try:
            pages = int(Path(f"/proc/{self._process.pid}/statm").read_text(encoding="ascii").split()[1])
        except (OSError, IndexError):
            return 0
        return pages * os.sysconf("SC_PAGESIZE")

    def close(self) -> None:
        """Ends the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


def serve() -> None:
    """Runs the commands of standard input; answers each with one line."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    from ratslam.cli import main

    warnings.simplefilter("always")
    print(json.dumps([0, ""]), file=answers, flush=True)
    for line in sys.stdin:
        folder, command = json.loads(line)
        said, code = io.StringIO(), None
        os.chdir(folder)
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            try:
                code = main(command)
            except SystemExit as error:
                code = error.code
            except BaseException:
                traceback.print_exc()
        print(json.dumps([code, said.getvalue()]), file=answers, flush=True)
