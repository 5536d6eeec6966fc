"""The commands cells score and cells compare: recorded cells, alone and beside those of a run."""

from __future__ import annotations

import argparse
import csv
from typing import TYPE_CHECKING

from ratslam.cli.common import (
    Commands,
    add_set,
    count_from_zero,
    positive_integer,
    positive_rate,
    prepare_jax,
)
from tactile.base.errors import InputError, tell
from tactile.base.files import make_new_file

if TYPE_CHECKING:
    from pathlib import Path

    from ratslam.cli.common import CommandParser
    from robot.recordings.nwb_file import NwbConfig


def add_cells(commands: Commands) -> None:
    """Registers `cells` with its commands."""
    help = "score recorded cells, or compare them with a run's"
    cells = Commands(commands.add("cells", None, help, "cells score rat.nwb -o rat.csv", "look"))
    score = cells.add(
        "score", _score, "score the units of an NWB file, with controls", "cells score rat.nwb -o rat.csv"
    )
    _add_data(score)
    score.add_path("-o", "CSV", "the new file, a line for each unit", required=True)
    score.add_argument(
        "--seed", type=count_from_zero, default=0, metavar="N", help="of the shuffles (default 0)"
    )
    compare = cells.add(
        "compare", _compare, "compare cells of a run with those of an NWB file",
        "cells compare runs/rat rat.nwb --turn 600",
    )  # fmt: skip
    compare.add_path("run", "RUN", "the run directory, with recorded pose cells")
    _add_data(compare)
    compare.add_path("-o", "FILE", "new file: .csv the comparison, .png the distributions of the scores")
    compare.add_argument(
        "--turn",
        type=float,
        metavar="S",
        help="time at which cues turned in the data, s (default: they did not)",
    )
    compare.add_argument(
        "--peak-rate", type=positive_rate, default=20.0, metavar="HZ",
        help="rate of a cell of the run at the peak of a settled packet (default 20 Hz)",
    )  # fmt: skip
    help = "spikes from which a cell is compared (default 50)"
    compare.add_argument("--least", type=positive_integer, default=50, metavar="N", help=help)
    help = "seed of spikes, shuffles and intervals (default 0)"
    compare.add_argument("--seed", type=count_from_zero, default=0, metavar="N", help=help)


def _add_data(parser: CommandParser) -> None:
    parser.add_path("data", "NWB", "the recorded cells: positions, head direction and units")
    parser.add_argument(
        "--shuffles", type=positive_integer, default=100, metavar="N", help="of each cell (default 100)"
    )
    add_set(parser)


def _series(assignments: list[str]) -> NwbConfig:
    """The settings of `--set`: position, heading, leds, unit."""
    from ratslam.runs.settings.strict_yaml import override, parse, validate
    from robot.recordings.nwb_file import NwbConfig

    return validate(override(parse("{}", "--set"), assignments), NwbConfig)


def _warn(text: str) -> None:
    tell(f"warning: {text}")


def _score(arguments: argparse.Namespace) -> None:
    prepare_jax()
    from ratslam.service.own_cells import score_own_cells

    own = arguments.data, arguments.output, _series(arguments.set), _warn
    print(score_own_cells(*own, arguments.shuffles, arguments.seed))
    print(f"{arguments.output}: written")


def _compare(arguments: argparse.Namespace) -> None:
    prepare_jax()
    from evaluation.plots.cell_plot import draw_distributions
    from ratslam.service.own_cells import compare_run, comparison_table
    from ratslam.service.spikes import SpikeConfig

    output = arguments.output
    if output is not None and output.suffix not in (".csv", ".png"):
        raise InputError(str(output), f"an unknown suffix {output.suffix!r}", ".csv or .png")
    spikes = SpikeConfig(peak_rate=arguments.peak_rate, seed=arguments.seed)
    own = arguments.run, arguments.data, _series(arguments.set), _warn, arguments.turn
    described, rows = compare_run(*own, spikes, arguments.shuffles, arguments.least)
    table = list(comparison_table(rows))
    widths = [max(len(row[k]) for row in table) for k in range(len(table[0]))]
    print(described)
    for row in table:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    print(
        "medians, shares and turns, each with the 95 % interval of a bootstrap over cells, not over animals"
    )
    if output is None:
        return

    def write(path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            parts = ("model", "data", "difference", "above")
            ends = [f"{part}{end}" for part in parts for end in ("", "_low", "_high")]
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["score", "cells_model", "cells_data", *ends])
            for row in rows:
                numbers = row.model + row.data + row.difference + row.above
                writer.writerow([row.score, *row.cells, *numbers])

    figure = draw_distributions(f"{arguments.run.name} beside {arguments.data.name}", rows)
    make_new_file(
        output, write if output.suffix == ".csv" else lambda path: figure.savefig(path, format="png")
    )
    print(f"{output}: written")
