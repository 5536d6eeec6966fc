"""The command export."""

from __future__ import annotations

import argparse
from pathlib import Path

from ratslam.cli.common import Commands
from tactile.base.errors import tell


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
        "experiences, .yaml nav2 map, .nwb or .npz spikes of recorded pose cells, .csv their scores; a name "
        "without a suffix becomes a ROS 2 bag folder",
    )  # fmt: skip
    export.add_argument(
        "--peak-rate", type=_rate, default=20.0, metavar="HZ",
        help="cells: rate of a cell at the peak of a settled packet (default 20 Hz)",
    )  # fmt: skip
    export.add_argument("--spike-seed", type=_seed, default=0, metavar="N", help="spikes: seed (default 0)")


def _export(arguments: argparse.Namespace) -> int:
    from ratslam.service.export.export_formats import export_run
    from ratslam.service.rats.spikes import SpikeConfig

    export_run(
        arguments.run,
        arguments.output,
        lambda text: tell(f"warning: {text}"),
        SpikeConfig(peak_rate=arguments.peak_rate, seed=arguments.spike_seed),
    )
    print(f"{arguments.output}: written")
    return 0


def _rate(text: str) -> float:
    """Argument type of a rate in Hz."""
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0 < rate < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} must be a number above 0")
    return rate


def _seed(text: str) -> int:
    """Argument type of a seed."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} must be an integer from 0 on")
    return int(text)
