"""Handle of the RTDE subprocess, for the session."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.driver_config import ArmConfig
from robot.drivers.ur10.safety import Finding
from robot.drivers.withheld_signals import withheld_signals

CONNECTION_LOST = ("closed the connection", "Connection reset", "Connection refused", "End of file")


class ArmProcess:
    """A running `robot.drivers.ur10.rtde_process`. The pipes close at any end of this process; the
    subprocess then stops the arm and ends.

    Args:
        shared: file descriptor of the shared memory."""

    def __init__(self, shared: int, config: ArmConfig) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        paths = [str(Path(__file__).parents[3]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(paths),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        module = "robot.drivers.ur10.rtde_process"
        with withheld_signals():
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, str(shared), config.model_dump_json()],
                pass_fds=[shared],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                bufsize=0,
                env=environment,
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._orders, self._reports = self._process.stdin, self._process.stdout
        os.set_blocking(self._orders.fileno(), False)
        os.set_blocking(self._reports.fileno(), False)
        self._rest = b""

    @property
    def pid(self) -> int:
        return self._process.pid

    def send(self, **fields: Any) -> None:
        """Sends a command; without effect after the end of the process, which `exit_finding` reports."""
        with contextlib.suppress(OSError, ValueError):  # ValueError: the pipe is closed
            self._orders.write(json.dumps(fields).encode() + b"\n")

    def reports(self) -> list[dict[str, Any]]:
        """Reports since the last call."""
        data = self._reports.read(65536) or b""
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines]

    def exit_finding(self) -> Finding | None:
        """Reason for the end of the process; None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        said = self.stderr_tail()
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        lines = [line for line in said.splitlines() if "what():" in line] or said.splitlines() or [""]
        last = lines[-1].replace("what():", "").strip()[-200:]
        detail = f"the RTDE process ended ({name})" + (f": {last}" if last else "")
        if code == -signal.SIGABRT and not any(word in said for word in CONNECTION_LOST):
            return Finding(SessionOutcome.ARM_MALFORMED, detail)
        return Finding(SessionOutcome.ARM_GONE, detail)

    def stderr_tail(self) -> str:
        """The last 4 kB of output of the process and the library."""
        # pread: the writing process shares the file position
        size = os.fstat(self._errors.fileno()).st_size
        return os.pread(self._errors.fileno(), 4096, max(0, size - 4096)).decode(errors="replace")

    def end(self, patience: float) -> bool:
        """Asks the process to stop the arm and end; False if it has not ended within `patience` s."""
        self.send(do="end")
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            return False
        return True

    def kill(self) -> None:
        """Kills the process."""
        self._process.kill()
        self._process.wait()
        for file in (self._orders, self._reports, self._errors):
            with contextlib.suppress(OSError):
                file.close()
