"""The commands that run a recording many times: ablate, vary, spread."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ratslam.cli.common import Commands, add_config, add_workers, positive_integer, prepare_jax
from tactile.base.errors import InputError

if TYPE_CHECKING:
    from ratslam.experiments.trials.ablation import Variant


def add_commands(commands: Commands) -> None:
    """Registers them."""
    ablate = commands.add(
        "ablate", _ablate, "switch off each part of recall and map in turn",
        "ablate configs/square.yaml", "study",
    )  # fmt: skip
    vary = commands.add(
        "vary", _vary, "vary each number of recall and map in turn", "vary configs/square.yaml", "study"
    )
    vary.add_argument("--by", type=float, default=0.2, metavar="SHARE", help="by this share (default 0.2)")
    vary.add_argument(
        "--limit", type=float, metavar="M", help="final ATE that counts as kept (default 1.25 of the first)"
    )
    spread = commands.add(
        "spread", _spread, "run perturbed copies of a recording", "spread configs/square.yaml", "study"
    )
    spread.add_argument(
        "-n", dest="runs", type=positive_integer, default=10, metavar="N", help="copies (default 10)"
    )
    for several in (ablate, vary, spread):
        add_config(several)
        add_workers(several)
    for several in (ablate, vary):
        several.add_argument(
            "--perturbed",
            type=positive_integer,
            default=0,
            metavar="N",
            help="run on N perturbed copies instead",
        )


def _ablate(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from ratslam.experiments.trials.ablation import PARTS

    _table(arguments, list(PARTS.items()))
    return 0


def _vary(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from ratslam.config.strict_yaml import load, override
    from ratslam.experiments.trials.ablation import Variant, variations

    if not 0 < arguments.by < 1:
        raise InputError("--by", str(arguments.by), "a share between 0 and 1")
    document = override(load(arguments.config), arguments.set)
    lines = [
        (f"{name} = {value:.4g}", Variant((f"{name}={value!r}",)))
        for name, value in variations(document, arguments.by)
    ]
    finals = _table(arguments, [("as configured", Variant()), *lines])
    limit = 1.25 * finals[0] if arguments.limit is None else arguments.limit
    if finals[0] != finals[0]:
        print("the recording has no truth, so nothing can be said of what is kept")
        return 0
    kept = sum(final <= limit for final in finals[1:])
    print(f"{kept} of {len(lines)} variations ({kept / len(lines):.0%}) end at {limit:.3g} m or less")
    return 0


def _spread(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from ratslam.experiments.trials.ablation import HEADER, Variant, compare, row

    print(HEADER)
    variants = [(Variant(), seed) for seed in range(arguments.runs + 1)]
    trials = []
    for seed, trial in enumerate(compare(Path(arguments.config), arguments.set, variants, arguments.workers)):
        print(row(f"perturbed, seed {seed}" if seed else "as it is", [trial]), flush=True)
        trials.append(trial)
    print(row("all perturbed", trials[1:]))
    return 0


def _table(arguments: argparse.Namespace, lines: list[tuple[str, Variant]]) -> list[float]:
    """Prints a row as soon as all of its trials are done; returns the final errors."""
    from ratslam.experiments.trials.ablation import HEADER, compare, row

    seeds = range(1, arguments.perturbed + 1) if arguments.perturbed else (0,)
    variants = [(variant, seed) for _, variant in lines for seed in seeds]
    trials = compare(Path(arguments.config), arguments.set, variants, arguments.workers)
    print(HEADER)
    finals = []
    for name, _ in lines:
        these = [next(trials) for _ in seeds]
        print(row(name, these), flush=True)
        finals.append(max(trial.final for trial in these))
    return finals
