"""The commands for whiskers: reproduce, tune, tiers."""

from __future__ import annotations

import argparse
from pathlib import Path

from ratslam.cli.common import (
    INTERRUPTED,
    Commands,
    add_config,
    add_set,
    add_workers,
    positive_integer,
    prepare_jax,
)
from ratslam.cli.create import SETS
from tactile.base.errors import InputError

NAMES = ("fig2", "fig3", "fig4", "fig5", "fig6", "fig7", "reverse", "controls", "matched")
"""Of the reproductions of Salman & Pearson 2016, known before jax is loaded; Fox et al.'s are in `SETS`."""
USUAL = 3
"""Sets of each."""


def add_commands(commands: Commands) -> None:
    """Registers them."""
    reproduce = commands.add(
        "reproduce", _reproduce, "reproduce a figure of a paper, with controls",
        "reproduce fig2 --sets 1", "papers",
    )  # fmt: skip
    every, usual = (*NAMES, *SETS), ", ".join(f"{name} {sets}" for name, sets in SETS.items())
    reproduce.add_argument("name", choices=every, metavar="NAME", help=", ".join(every))
    reproduce.add_argument(
        "--sets",
        type=positive_integer,
        metavar="N",
        help=f"mazes or trials a condition (default {USUAL}; {usual})",
    )
    reproduce.add_argument("--seed", type=int, default=0, metavar="S", help="of all sets (default 0)")
    reproduce.add_argument(
        "-o", "--output", type=Path, default=Path("runs") / "reproduce", metavar="DIR",
        help="where NAME.csv and NAME.png go (default runs/reproduce)",
    )  # fmt: skip
    add_set(reproduce)
    add_workers(reproduce)

    tune = commands.add(
        "tune", _tune, "choose the classic matcher's threshold as the paper does",
        "tune configs/whisker_maze.yaml", "papers",
    )  # fmt: skip
    add_config(tune)
    add_workers(tune, 1)
    tune.add_argument("-o", "--output", type=Path, metavar="DIR", help="leave tune.png and tune.csv there")

    tiers = commands.add(
        "tiers", _tiers, "run a scene through all tiers of simulation",
        "tiers configs/whisker_maze.yaml --seconds 60", "study",
    )  # fmt: skip
    add_config(tiers)
    tiers.add_argument(
        "--seconds", type=float, default=600.0, metavar="S", help="of the session at most (default 600)"
    )


def _reproduce(arguments: argparse.Namespace) -> int:
    if arguments.seed < 0:
        raise InputError("--seed", str(arguments.seed), "a whole number from 0 on")
    prepare_jax(keep_compiled=False)
    if arguments.name in SETS:
        from ratslam.experiments.fox2012.reproduction import reproduce
    else:
        from ratslam.experiments.salman2016.reproduction import reproduce

    text, interrupted = reproduce(
        arguments.name,
        arguments.output,
        sets=arguments.sets or SETS.get(arguments.name, USUAL),
        workers=arguments.workers,
        seed=arguments.seed,
        assignments=arguments.set,
    )
    print(text)
    left = "the rows" if interrupted else f"the figure; {arguments.output / arguments.name}.csv the rows"
    kind = "csv" if interrupted else "png"
    print(f"\n{arguments.output / arguments.name}.{kind} holds {left}")
    return INTERRUPTED if interrupted else 0


def _tune(arguments: argparse.Namespace) -> int:
    prepare_jax(keep_compiled=False)
    from ratslam.config.strict_yaml import load, override
    from ratslam.experiments.salman2016.threshold_tuning import render_tuning, save_tuning, tune_threshold

    document = override(load(arguments.config), arguments.set)
    found = tune_threshold(document, Path(arguments.config).parent, arguments.workers)
    print(render_tuning(found))
    if arguments.output:
        picture, table = save_tuning(found, arguments.output)
        print(f"\n{picture} shows the distances and thresholds, {table} holds them")
    return 0


def _tiers(arguments: argparse.Namespace) -> int:
    if not 0 < arguments.seconds < float("inf"):
        raise InputError("--seconds", str(arguments.seconds), "a time above 0 s")
    prepare_jax(keep_compiled=False)
    from ratslam.config.strict_yaml import load, override
    from ratslam.experiments.fidelity_comparison import report, tiers

    document = override(load(arguments.config), arguments.set)
    print(report(*tiers(document, Path(arguments.config).parent, arguments.seconds)))
    return 0
