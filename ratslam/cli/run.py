"""The commands run and simulate."""

from __future__ import annotations

import argparse
from pathlib import Path

from ratslam.cli.common import INTERRUPTED, Commands, add_config, prepare_jax, read_config
from ratslam.cli.look import render_scores


def add_commands(commands: Commands) -> None:
    """Registers the commands of this module."""
    run = commands.add(
        "run", _run, "map a recording or a simulated session and score it",
        "run square -o runs/square", "run",
    )  # fmt: skip
    add_config(run)
    add_run_directory(run)
    run.add_argument(
        "--continue", dest="resume", type=Path, metavar="MAP",
        help="map to continue: a run directory, or a map file (.npz). The same recording goes on after the "
        "last sample mapped; another begins a separate piece, joined once its views place it in the map, and "
        "is refused in maps of methods other than `backend: recall`, which are one piece",
    )  # fmt: skip
    run.add_argument("--full", action="store_true", help="print all figures, as `score` does")
    run.add_argument("--report", action="store_true", help="write report.html, a page, to the run directory")
    add_rerun(run)

    simulate = commands.add(
        "simulate", _simulate, "write a simulated session to a recording",
        "simulate whisker_maze -o runs/session.mcap", "run",
    )  # fmt: skip
    add_config(simulate)
    simulate.add_argument("-o", "--output", type=Path, required=True, metavar="MCAP", help="the new file")
    simulate.add_argument(
        "--raw", action="store_true", help="record raw 2 kHz samples instead of contact features"
    )


def add_run_directory(parser: argparse.ArgumentParser) -> None:
    """Adds the option that names the run directory."""
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="new run directory (default runs/CONFIG)"
    )


def add_rerun(parser: argparse.ArgumentParser) -> None:
    """Adds the option for a live view."""
    parser.add_argument(
        "--rerun", nargs="?", const="127.0.0.1:9876", metavar="TARGET",
        help="show the run in rerun: a new .rrd file, the address of a viewer on this machine (default "
        "127.0.0.1:9876), or `start` to start one",
    )  # fmt: skip


def open_target(arguments: argparse.Namespace) -> str | None:
    """The target of the live view, or None without one.

    Raises:
        InputError: it cannot be used.
    """
    from ratslam.service.viewer.target import prepare_target

    return None if arguments.rerun is None else prepare_target(arguments.rerun)


def run_directory(arguments: argparse.Namespace) -> Path:
    """The run directory: `-o`, or runs/CONFIG."""
    return arguments.output or Path("runs") / arguments.config.stem


def _run(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from evaluation.report.summary import summarise
    from ratslam.runs import report
    from ratslam.runs.run import run
    from ratslam.service.viewer.observer import open_viewer

    if arguments.report:
        report.check_report_libraries("--report")
    directory, config, target = run_directory(arguments), read_config(arguments), open_target(arguments)
    with open_viewer(target) as observers:
        card, interrupted = run(config, directory, arguments.resume, observers)
    if arguments.full:
        print(f"{render_scores(directory, card)}\n")
    print(f"{directory}/map.png shows the map, {directory}/trajectory.tum holds the trajectory")
    if not arguments.full:
        print(f"python -m ratslam score {directory} prints all figures")
    if arguments.report:
        report.write_report([directory], directory / report.NAME)
        print(f"{directory / report.NAME} is a page about the run")
    print(summarise(directory, card, config.backend))
    return INTERRUPTED if interrupted else 0


def _simulate(arguments: argparse.Namespace) -> int:
    from ratslam.runs.run import simulate

    if arguments.raw:
        arguments.set.append("simulation.raw=true")
    count, interrupted = simulate(read_config(arguments), arguments.output)
    print(f"{arguments.output}: {count} steps")
    return INTERRUPTED if interrupted else 0
