"""The commands that compare methods and tiers of simulation: compare, tiers."""

from __future__ import annotations

import argparse

from ratslam.cli.common import Commands, add_config, prepare_jax, read_config
from tactile.base.errors import InputError


def add_commands(commands: Commands) -> None:
    """Registers them."""
    compare = commands.add(
        "compare", _compare, "run a whisker session through both backends",
        "compare configs/create_arena.yaml", "study",
    )  # fmt: skip
    add_config(compare)
    tiers = commands.add(
        "tiers", _tiers, "run a scene through all tiers of simulation",
        "tiers configs/whisker_maze.yaml --seconds 60", "study",
    )  # fmt: skip
    add_config(tiers)
    tiers.add_argument(
        "--seconds", type=float, default=600.0, metavar="S", help="of the session at most (default 600)"
    )


def _compare(arguments: argparse.Namespace) -> int:
    prepare_jax(keep_compiled=False)
    from ratslam.experiments.backend_comparison import compared, report

    print(report(compared(read_config(arguments), arguments.config.parent)))
    return 0


def _tiers(arguments: argparse.Namespace) -> int:
    if not 0 < arguments.seconds < float("inf"):
        raise InputError("--seconds", str(arguments.seconds), "a time above 0 s")
    prepare_jax(keep_compiled=False)
    from ratslam.config.strict_yaml import load, override
    from ratslam.experiments.fidelity_comparison import report, tiers

    document = override(load(arguments.config), arguments.set)
    print(report(*tiers(document, arguments.config.parent, arguments.seconds)))
    return 0
