"""The commands for the Create and for two backends: train-templates, compare; and names of reproductions."""

from __future__ import annotations

import argparse
from pathlib import Path

from ratslam.cli.common import Add, configured, prepare_jax
from tactile.base.errors import InputError

SETS = {"fox-fig4": 20, "fox-fig5": 2, "fox-fig6": 3}
"""Of the reproductions, known before jax is loaded: sets of each."""


def add(command: Add) -> None:
    """Adds them to the program."""
    train = command(
        "train-templates",
        _train,
        "drive a simulated Create into walls at fifteen angles and keep what its whiskers felt",
    )
    configured(train)
    train.add_argument("-o", "--output", type=Path, required=True, metavar="NPZ", help="the new file")

    compare = command(
        "compare", _compare, "run one session of whiskers through both backends, RatSLAM and the grid filter"
    )
    configured(compare)


def _train(arguments: argparse.Namespace) -> int:
    from ratslam.config.run_config import RunConfig
    from ratslam.config.strict_yaml import load, override, validate
    from ratslam.experiments.fox2012.template_training import held_out, report, schooled
    from ratslam.pipeline.run import located

    config = validate(override(load(arguments.config), arguments.set), RunConfig)
    roving = located(config, Path(arguments.config).parent.resolve()).roving
    if roving is None:
        raise InputError(
            arguments.config, "no `roving:`", "the Create to train", "`roving: {}` is the usual one"
        )
    templates = schooled(roving, arguments.output)
    print(report(held_out(roving, templates), templates.training.repeats))
    print(
        f"\n{arguments.output} holds the templates: `touch.reports.templates: {arguments.output}` uses them"
    )
    return 0


def _compare(arguments: argparse.Namespace) -> int:
    prepare_jax(lasting=False)
    from ratslam.config.run_config import RunConfig
    from ratslam.config.strict_yaml import load, override, validate
    from ratslam.experiments.backend_comparison import compared, report

    config = validate(override(load(arguments.config), arguments.set), RunConfig)
    print(report(compared(config, Path(arguments.config).parent)))
    return 0
