"""The command that looks at a run which another process makes: watch."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from shutil import get_terminal_size

from ratslam.cli.common import Add
from tactile.base.errors import InputError


def add(command: Add) -> None:
    """Adds it to the program."""
    watch = command("watch", _watch, "look at a run while another process makes it")
    watch.add_argument("directory", type=Path, metavar="RUN_DIR", help="of a run, at work or done")
    watch.add_argument(
        "--every", type=float, default=2.0, metavar="SECONDS", help="from one look to the next (default 2)"
    )
    watch.add_argument("--once", action="store_true", help="look but once")
    watch.add_argument(
        "--patience", type=float, default=300.0, metavar="SECONDS",
        help="a run that writes nothing for so long was killed (default 300)",
    )  # fmt: skip


def _watch(arguments: argparse.Namespace) -> int:
    from evaluation.monitor.progress import PICTURE, RUNNING
    from evaluation.monitor.watch import watch

    for name in ("every", "patience"):
        if not 0 < getattr(arguments, name) < float("inf"):
            raise InputError(f"--{name}", str(getattr(arguments, name)), "a time above 0 s")
    tell = _OneLine()
    try:
        seen = watch(
            arguments.directory, tell, every=arguments.every, patience=arguments.patience, once=arguments.once
        )
    finally:
        tell.end()
    if seen.status == RUNNING and not arguments.once:
        cure = f"; `run --continue {arguments.directory / 'map.npz'}` goes on" if seen.saved else ""
        print(f"it wrote nothing for {seen.silent:.0f} s: it was killed{cure}")
    print(f"{arguments.directory / PICTURE} shows it")
    return 0


class _OneLine:
    """Lines over each other where a terminal can; elsewhere each that is new."""

    def __init__(self) -> None:
        self._last = ""

    def __call__(self, line: str) -> None:
        if sys.stdout.isatty():
            width = get_terminal_size().columns - 1
            print(f"\r{line[:width]:<{width}}", end="", flush=True)
        elif line != self._last:
            print(line, flush=True)
        self._last = line

    def end(self) -> None:
        if self._last and sys.stdout.isatty():
            print()
