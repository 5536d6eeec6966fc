"""Runs commands of the program one after the other in another process, within bounds of time and memory."""

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
SECONDS, MEMORY = 200.0, 2 << 30
"""Most time and memory (s, bytes) until a command has refused its input or made its first step."""
LONG = 25.0
"""A run that made steps is interrupted after this time, s."""


class Outcome(NamedTuple):
    """What a command did: its exit code, None after a traceback or if it was killed, and its text."""

    code: int | None
    said: str


class CommandWorker:
    """A process that runs commands; started again when one was killed or it has become large."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        code = "from tests.helpers.command_worker import serve; serve()"
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        command, environment = [sys.executable, "-c", code], os.environ | {"PYTHONPATH": str(ROOT)}
        self._process = subprocess.Popen(command, env=environment, **pipes)
        self._answer(ROOT, 600.0, LONG)  # until it has imported the program

    def run(self, folder: Path, *command: object, long: float = LONG) -> Outcome:
        """Runs one command in a folder; a run that made steps is interrupted after `long` s."""
        if self._process.poll() is not None or self._memory() > MEMORY // 2:
            self.close()
            self._start()
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([str(folder), [*map(str, command)]]).encode() + b"\n")
        self._process.stdin.flush()
        return self._answer(folder, SECONDS, long)

    def _answer(self, folder: Path, most: float, long: float) -> Outcome:
        output, begun, told = self._process.stdout, time.monotonic(), False
        assert output is not None
        while not select.select([output], [], [], 0.1)[0]:
            took = time.monotonic() - begun
            stepped = any(file.stat().st_size for file in folder.glob("*/online.tum"))
            if stepped and not told and took > long:
                self._process.send_signal(signal.SIGINT)
                most, told = took + SECONDS, True
            if took > most or (self._memory() > MEMORY and not stepped):
                found = Outcome(None, f"killed after {took:.0f} s, {self._memory() >> 20} MiB")
                self.close()
                return found
        line = output.readline()
        if told or not line:
            return Outcome(130 if line else None, "" if line else "the process died")
        return Outcome(*json.loads(line))

    def _memory(self) -> int:
        pages = Path(f"/proc/{self._process.pid}/statm").read_text(encoding="ascii").split()[1]
        return int(pages) * os.sysconf("SC_PAGESIZE")

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


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
