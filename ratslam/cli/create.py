"""The commands for the Create and for two backends: train-templates, compare; and names of reproductions."""

from __future__ import annotations

import argparse
from pathlib import Path

from ratslam.cli.common import Commands, add_config, prepare_jax, read_config
from tactile.base.errors import InputError

SETS = {"fox-fig4": 20, "fox-fig5": 2, "fox-fig6": 3}
"""Of the reproductions, known before jax is loaded: sets of each."""


def add_commands(commands: Commands) -> None:
    """Registers them."""
    train = commands.add(
        "train-templates", _train, "record strain templates of a simulated Create",
        "train-templates configs/create_arena.yaml -o runs/templates.npz", "papers",
    )  # fmt: skip
    add_config(train)
    train.add_argument("-o", "--output", type=Path, required=True, metavar="NPZ", help="the new file")

    compare = commands.add(
        "compare", _compare, "run a whisker session through both backends",
        "compare configs/create_arena.yaml", "study",
    )  # fmt: skip
    add_config(compare)


def _train(arguments: argparse.Namespace) -> int:
    from ratslam.experiments.fox2012.template_training import held_out, report, schooled

    roving = read_config(arguments).roving
    if roving is None:
        raise InputError(
            str(arguments.config), "no `roving:`", "the Create to train", "`roving: {}` is the usual one"
        )
    templates = schooled(roving, arguments.output)
    print(report(held_out(roving, templates), templates.training.repeats))
    print(
        f"\n{arguments.output} holds the templates: `touch.reports.templates: {arguments.output}` uses them"
    )
    return 0


def _compare(arguments: argparse.Namespace) -> int:
    prepare_jax(keep_compiled=False)
    from ratslam.experiments.backend_comparison import compared, report

    print(report(compared(read_config(arguments), arguments.config.parent)))
    return 0
