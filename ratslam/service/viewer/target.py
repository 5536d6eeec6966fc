"""Where the view goes: an .rrd file, or a viewer on this machine."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from robot.emulators.listening import is_loopback
from tactile.base.errors import InputError
from tactile.base.new_file import require_new_file

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
        raise InputError(
            "--rerun", "rerun is not installed", "the extra 'view'", "pip install 'ratslam[view]'"
        )
    if text.endswith(".rrd"):
        require_new_file(Path(text))
        return os.path.abspath(text)
    if text == START:
        _start_viewer()
        return VIEWER
    host, port = split_address(text)
    if not _answers(host, port):
        cure = f"start one with `rerun --bind 127.0.0.1`, or let `--rerun {START}` do it"
        raise InputError(f"--rerun {text}", "no viewer answers", "a running one", cure)
    return text


def split_address(text: str) -> tuple[str, int]:
    """Host and port of a loopback address.

    Raises:
        InputError: it is not one.
    """
    host, _, port = text.rpartition(":")
    number = int(port) if port.isdecimal() else 0
    if not is_loopback(host) or not 0 < number < 1 << 16:
        raise InputError("--rerun", repr(text), EXPECTED, "reach another machine through an ssh tunnel")
    return host, number


def _start_viewer() -> None:
    """Starts a viewer that outlives this program; rerun's default would listen on every interface."""
    host, port = split_address(VIEWER)
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
    try:
        socket.create_connection((host.strip("[]"), port), timeout=1.0).close()
    except OSError:
        return False
    return True
