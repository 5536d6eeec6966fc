"""The program: `python -m ratslam COMMAND`."""

from __future__ import annotations

import argparse
import errno
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import entry_points
from types import FrameType

# Only the imports of argparse are made here, so that `--help` does not wait for JAX and NumPy.
from ratslam.cli import cells, doctor, live, maps, run, tools
from ratslam.cli.common import INPUT_ERROR, INTERRUPTED, TERMINATED, Commands
from robot.drivers.processes import postpone_interrupt
from tactile.base.errors import InputError, printable, tell
from tactile.base.files import FULL

COMMANDS = (
    run.add_run, live.add_commands, maps.add_localise, maps.add_merge, maps.add_map, maps.add_path,
    run.add_look, doctor.add_commands, cells.add_cells, tools.add_export, tools.add_check, tools.add_tools,
)  # fmt: skip
"""The commands that are always there, in the order of the help."""
INSTALLED = "ratslam.commands"
"""Group of the entry points of further commands: functions that take `Commands` and register theirs."""
GROUPS = ("run", "live", "maps", "look", "study", "papers", "files")
"""Headings of the help, in this order."""
DESCRIPTION = "Maps an area and localises a robot by whiskers, camera or laser (RatSLAM)."


def main(argv: list[str] | None = None) -> int:
    """Parses the arguments and runs one command; returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    arguments = build_parser().parse_args(argv)
    with _catch_signals() as terminated:
        code = _run_command(arguments)
    return TERMINATED if code == INTERRUPTED and terminated else code


@contextmanager
def _catch_signals() -> Iterator[list[int]]:
    """Lets SIGTERM (of `kill`, `timeout`, systemd, Docker) do what Ctrl-C does, and Ctrl-C wait for a moment
    at which it is not lost; yields the list to which each SIGTERM is added."""
    caught: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield caught
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        handler = signal.getsignal(signal.SIGINT)
        if not callable(handler):  # a program in the background ignores Ctrl-C
            raise KeyboardInterrupt
        handler(signal.SIGINT, frame)

    def interrupt_later(number: int, frame: FrameType | None) -> None:
        if not postpone_interrupt(frame):
            raise KeyboardInterrupt

    before, usual = signal.signal(signal.SIGTERM, interrupt), signal.getsignal(signal.SIGINT)
    if usual is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt_later)
    try:
        yield caught
    finally:
        signal.signal(signal.SIGTERM, before)
        signal.signal(signal.SIGINT, usual)


def _run_command(arguments: argparse.Namespace) -> int:
    """Runs a command and prints its errors; returns the exit code."""
    try:
        if getattr(arguments, "output", None) is not None:
            arguments.check(arguments.output)
        code: int = arguments.command(arguments) or 0
        sys.stdout.flush()
        return code
    except InputError as error:
        print("\n".join(f"ratslam: error: {line}" for line in str(error).split("\n")), file=sys.stderr)
    except OSError as error:
        # The file, what is wrong with it, and what to do. All files are named in their errors: without a name
        # nothing could be printed.
        printing = error.filename is None and error.errno in (errno.EPIPE, *FULL)
        where = "the output: " if printing else f"{error.filename}: " if error.filename else ""
        full = "free some space or choose another folder with -o"
        cure = full if error.errno in FULL else "check the path and its permissions"
        cures = [cure] if error.errno in FULL or error.filename else []
        text = "; ".join([error.strerror or str(error), *getattr(error, "__notes__", ()), *cures])
        print(f"ratslam: error: {printable(where + text)}", file=sys.stderr)
        if printing:  # what was not printed stays so; else Python would try again at the end, and say so
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        print("ratslam: interrupted", file=sys.stderr)
        return INTERRUPTED
    return INPUT_ERROR


class Program(argparse.ArgumentParser):
    """A parser whose help lists the commands by group, on one screen."""

    commands: Commands

    def format_help(self) -> str:
        lines = ["usage: ratslam COMMAND ...", DESCRIPTION]
        groups = dict.fromkeys([*GROUPS, *(parser.group for parser in self.commands.parsers.values())])
        for group in groups:
            heading = group
            for name, parser in self.commands.parsers.items():
                if parser.group == group:
                    lines.append(f"{heading:<8}{name:<17}{parser.help}")
                    heading = ""
        lines += ["ratslam COMMAND --help shows the options of a command and an example."]
        return "\n".join(lines) + "\n"


def build_parser() -> Program:
    """The parser of the whole program."""
    parser = Program(prog="ratslam", description=DESCRIPTION)
    parser.commands = Commands(parser)
    for add in COMMANDS:
        add(parser.commands)
    for point in sorted(entry_points(group=INSTALLED), key=lambda point: point.name):
        try:
            point.load()(parser.commands)
        except Exception as error:  # whatever a package does; it harms no other command
            cause = f"{type(error).__name__}: {error}"
            tell(f"the commands '{point.name}' ({point.value}) cannot be loaded: {cause}; repair them")
    return parser
