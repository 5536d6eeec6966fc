"""`python -m tests.ratslam.live.session_server`: forks sessions from a process that has loaded all modules.

Each line of JSON on its standard input starts one; the process id is printed. The line gives the `arguments`
of `python -m ratslam`, files for the output (`log`) and the exit code (`code`), how long the stub mapper
takes for a sample (`mapper`, s; null for no stub), whether the self-test checks the head's rate
(`rate_check`), and the libraries that the session cannot import (`without`: modules, or `libusb`).
"""

from __future__ import annotations

import ctypes.util
import importlib
import json
import os
import sys
import warnings
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

LOADED = (
    "ratslam.cli.live",
    "ratslam.live.live_session",
    "ratslam.live.mapper_process",
    "robot.live.whisk_loop",
    "robot.drivers.head.emulated_cable",
    "evaluation.metrics.scorecard",
    "usb.core",
    "usb.util",
)
"""Modules that a session loads."""


def main() -> None:
    for name in LOADED:
        importlib.import_module(name)
    from ratslam.cli import main as program

    print("ready", flush=True)
    for line in sys.stdin:
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if not _fork():
            session = _fork()
            if not session:
                _become_session(json.loads(line), program)
            print(session, flush=True)
            code = os.waitstatus_to_exitcode(os.waitpid(session, 0)[1])
            file = Path(json.loads(line)["code"])
            file.with_suffix(".new").write_text(str(code))
            file.with_suffix(".new").rename(file)
            os._exit(0)


def _fork() -> int:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX is loaded, but has started no threads
        return os.fork()


def _become_session(order: dict[str, Any], program: Any) -> None:
    """Runs the program in a new session of processes; does not return."""
    import ratslam.live.live_session
    from robot.live import selftest
    from tests.ratslam.live import stub_mapper

    os.setsid()
    log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for fd, target in ((os.open(os.devnull, os.O_RDONLY), 0), (log, 1), (log, 2)):
        os.dup2(fd, target)
    _hide(order["without"], Path(order["code"]).parent / "hidden")
    arguments = order["arguments"]
    directory, takes = arguments[arguments.index("-o") + 1], order["mapper"]
    mapping = None if takes is None else partial(stub_mapper.mapping, directory, takes)
    run = ratslam.live.live_session.run_live_session
    # Without the process that draws the map.
    ratslam.live.live_session.run_live_session = lambda *given, armed, view: run(
        *given, mapping=mapping, view=view
    )
    if not order["rate_check"]:
        selftest.LISTEN_TIME = 0.3
        selftest.MIN_RATE_SHARE = 0.0  # on a busy machine the emulated head may be late in so short a time
    code = 1
    try:
        code = program(arguments)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _hide(names: list[str], folder: Path) -> None:
    """Hides libraries from this process and, by modules in a folder on its path, from those it starts."""
    if "libusb" in names:
        ctypes.util.find_library = lambda name: None  # type: ignore[assignment]
    folder.mkdir()
    for name in names:
        for loaded in [module for module in sys.modules if module.split(".")[0] == name]:
            sys.modules[loaded] = None  # type: ignore[assignment]
        sys.modules[name] = None  # type: ignore[assignment]
        (folder / f"{name}.py").write_text("raise ImportError('hidden')\n")
    os.environ["PYTHONPATH"] = str(folder)


if __name__ == "__main__":
    main()
