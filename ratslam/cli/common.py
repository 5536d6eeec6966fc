"""What the commands share: how they are added, numbers from arguments, and JAX set up."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

MENDABLE = 2
"""Exit code after an error the user can mend."""
INTERRUPTED = 130
"""Exit code after an interrupt; what was done by then is on disk."""


class Add(Protocol):
    """Adds a command to the program: its name, what it does (arguments to exit code) and what it is for."""

    def __call__(
        self, name: str, does: Callable[[argparse.Namespace], int], help: str
    ) -> argparse.ArgumentParser: ...


def configured(parser: argparse.ArgumentParser) -> None:
    """The arguments of a command that takes a configuration."""
    parser.add_argument("config", help="the YAML file")
    settable(parser)


def settable(parser: argparse.ArgumentParser) -> None:
    """The option to override settings."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="a.b=value", help="override a setting; may be repeated"
    )


def shared(parser: argparse.ArgumentParser, processes: int = 0) -> None:
    """The option to share work out among processes; 0: as many as there are cores."""
    usual = processes or "cores"
    parser.add_argument(
        "--workers", type=count, default=processes, metavar="N", help=f"processes (default: {usual})"
    )


def count(text: str) -> int:
    """A whole number from 1 on, for argparse."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from 1 on")
    return int(text)


def prepare_jax(lasting: bool = True) -> None:
    """What must be settled before jax loads: one thread (more double the latency) and a lasting cache.

    Args:
        lasting: whether compiled kernels are kept on disk. Commands that run many sessions in one process
            compile once anyway.
    """
    flag = "--xla_cpu_multi_thread_eigen=false"
    if flag not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}".strip()
    if not lasting:
        return
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    wanted = {
        "jax_compilation_cache_dir": str(Path(home) / "ratslam" / "jax"),
        # The defaults keep nothing that compiles as fast as our kernels do on a CPU.
        "jax_persistent_cache_min_compile_time_secs": 0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    os.environ.update({name.upper(): str(value) for name, value in wanted.items()})  # for child processes
    import jax

    for name, value in wanted.items():
        jax.config.update(name, value)
