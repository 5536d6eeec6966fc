"""Common parts of the commands: registration, the configuration argument, number types, JAX settings."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import shtab

from ratslam.runs.settings.packaged import packaged_configs
from tactile.base.files import require_new_file

if TYPE_CHECKING:
    from ratslam.runs.settings.run_config import RunConfig

INPUT_ERROR = 2
"""Exit code after an error that the user can correct."""
INTERRUPTED = 130
"""Exit code after Ctrl-C; the results up to then are on disk."""
TERMINATED = 143
"""The same after SIGTERM, as of `kill`, `timeout`, systemd and Docker."""


NEGATIVE = re.compile(r"-\.?\d")
"""Beginning of an argument that is a value, such as -0.1,0.2, and no option (as in Python from 3.14 on)."""


class CommandParser(argparse.ArgumentParser):
    """The parser of one command; a shell completes its arguments of type `Path` with file names.

    Attributes:
        group, help: heading and line in the help of the program.
        arguments: its own, in their order. commands: its commands, None if it has none.
    """

    group = help = ""
    commands: Commands | None = None

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.arguments: list[argparse.Action] = []
        super().__init__(*arguments, **options)
        self._negative_number_matcher = NEGATIVE

    def add_argument(
        self, *names: Any, check: Callable[[Path], None] | None = None, **options: Any
    ) -> argparse.Action:
        """Adds an argument; `check` is called with the value of `-o` before the command, by default for a new
        file, or a new folder `DIR` and those above it."""
        action = super().add_argument(*names, **options)
        self.arguments.append(action)
        if "-o" in names:
            new = partial(require_new_file, parents=options.get("metavar") == "DIR")
            self.set_defaults(check=check or new)
        if options.get("type") is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        return action

    def add_path(self, name: str, metavar: str, help: str, **options: Any) -> None:
        """Adds an argument or an option for a file or folder; the name `-o` stands for `--output` too."""
        names = ("-o", "--output") if name == "-o" else (name,)
        self.add_argument(*names, type=Path, metavar=metavar, help=help, **options)

    def add_flag(self, name: str, help: str) -> None:
        """Adds an option without a value."""
        self.add_argument(name, action="store_true", help=help)


class Commands:
    """The commands of a parser: of the program, or of a command that has commands of its own.

    Attributes:
        parser: theirs. parsers: of each command by its name, in the order of registration.
    """

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.parser = parser
        self._subparsers = parser.add_subparsers(
            required=True, metavar="COMMAND", title="commands", parser_class=CommandParser
        )
        self.parsers: dict[str, CommandParser] = self._subparsers.choices
        if isinstance(parser, CommandParser):
            parser.commands = self

    def add(
        self,
        name: str,
        run: Callable[[argparse.Namespace], int | None] | None,
        help: str,
        example: str,
        group: str = "",
    ) -> CommandParser:
        """Registers a command.

        Args:
            run: takes the parsed arguments, returns the exit code or nothing for 0; None for a command with
                commands of its own (`Commands(parser)` adds them).
            help: one line, at most 60 characters.
            example: the arguments of a call that works, without `ratslam`.
            group: heading under which the program's help lists it.
        """
        description = f"{help[0].upper()}{help[1:]}."
        parser = self._subparsers.add_parser(
            name, help=help, description=description, epilog=f"Example: python -m ratslam {example}"
        )
        parser.group, parser.help = group, help
        if run is not None:
            parser.set_defaults(command=run)
        return parser


def add_config(parser: CommandParser, what: str = "configuration file (YAML)") -> None:
    """Adds the configuration, `--list` for those that come with the program, and `--set`."""
    parser.add_path("config", "CONFIG", f"{what}, or the name of a packaged one (--list)")
    parser.add_argument("--list", action=_ListConfigs, help="list the packaged configurations and exit")
    add_set(parser)


def add_set(parser: argparse.ArgumentParser) -> None:
    """Adds `--set`."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="a.b=value", help="replace a setting; may be repeated"
    )


def positive_integer(text: str) -> int:
    """Argument type of an integer from 1 on."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} must be a positive integer")
    return int(text)


def positive_rate(text: str) -> float:
    """Argument type of a rate in Hz."""
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0 < rate < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} must be a number above 0")
    return rate


def count_from_zero(text: str) -> int:
    """Argument type of a seed, or of a number that may be 0."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} must be an integer from 0 on")
    return int(text)


class _ListConfigs(argparse.Action):
    """Prints the packaged configurations and ends the program."""

    def __init__(self, **options: Any) -> None:
        super().__init__(nargs=0, **options)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        configs = packaged_configs()
        width = max(map(len, configs), default=0)
        print("\n".join(f"{name:<{width}}  {line}" for name, line in configs.items()))
        parser.exit()


def read_config(arguments: argparse.Namespace) -> RunConfig:
    """The configuration given by the arguments of `add_config`."""
    from ratslam.runs.settings.run_config import load_config

    return load_config(arguments.config, arguments.set)


def prepare_jax(keep_compiled: bool = True) -> None:
    """Sets the variables that JAX reads at import: `ratslam.core.compilation`, and a disk cache.

    Args:
        keep_compiled: whether compiled kernels are cached on disk; of no use to commands that run many
            sessions in one process.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # what fails is raised; a slow compilation is no bug
    from ratslam.core.compilation import add_xla_flags, cache_settings, keep_kernels

    os.environ["XLA_FLAGS"] = add_xla_flags(os.environ.get("XLA_FLAGS", ""))
    if not keep_compiled:
        return
    for name, value in cache_settings().items():
        os.environ.setdefault(name.upper(), str(value))  # for child processes
    keep_kernels()
