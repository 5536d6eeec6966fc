"""The command merge."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ratslam.cli.common import Commands, prepare_jax
from tactile.base.errors import tell


def add_commands(commands: Commands) -> None:
    """Registers the command."""
    merge = commands.add(
        "merge", _merge, "make one map of the sessions in several",
        "merge runs/monday runs/tuesday -o runs/both", "maps",
    )  # fmt: skip
    merge.add_argument("maps", type=Path, nargs="+", metavar="MAP", help="run directories or map files")
    merge.add_argument(
        "-o", "--output", type=Path, required=True, metavar="MAP",
        help="the new map: a file that ends in .npz, or a folder for it with its trajectory and graph",
    )  # fmt: skip
    merge.add_argument("--json", action="store_true", help="print JSON")


def _merge(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from ratslam.runs.merge import merge_maps

    report = merge_maps(arguments.maps, arguments.output, tell)
    print(json.dumps(report.to_json(), indent=2) if arguments.json else report.describe())
    return 0
