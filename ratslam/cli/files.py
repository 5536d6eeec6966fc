"""The command export."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ratslam.cli.common import Commands


def add_commands(commands: Commands) -> None:
    """Registers the command of this module."""
    export = commands.add(
        "export", _export, "write a run as a standard file",
        "export runs/square -o runs/square.mcap", "files",
    )  # fmt: skip
    export.add_argument("run", type=Path, metavar="RUN", help="the run directory")
    export.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE",
        help="the new file: .mcap for ROS 2 tools, .tum trajectory, .g2o pose graph, .json or .graphml "
        "experiences, .yaml nav2 map; a name without a suffix becomes a ROS 2 bag folder",
    )  # fmt: skip


def _export(arguments: argparse.Namespace) -> int:
    from ratslam.export.formats import export_run

    export_run(
        arguments.run, arguments.output, lambda text: print(f"ratslam: warning: {text}", file=sys.stderr)
    )
    print(f"{arguments.output}: written")
    return 0
