"""The commands that make a run, run and simulate, and those that look at one: watch, score, report."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from shutil import get_terminal_size
from typing import TYPE_CHECKING

from evaluation.report import PAGE_START
from ratslam.cli.common import INTERRUPTED, CommandParser, Commands, add_config, prepare_jax, read_config
from tactile.base.errors import InputError
from tactile.base.files import require_new_file

if TYPE_CHECKING:
    from evaluation.metrics.scorecard import Scorecard


def add_look(commands: Commands) -> None:
    """Registers the commands of this module."""
    watch = commands.add(
        "watch", _watch, "show the progress of a run in another process", "watch runs/square", "look"
    )
    watch.add_path("directory", "RUN_DIR", "run directory, running or finished")
    watch.add_argument(
        "--every", type=float, default=2.0, metavar="SECONDS", help="time between updates (default 2)"
    )
    watch.add_flag("--once", "show the state once and exit")
    watch.add_argument(
        "--patience", type=float, default=300.0, metavar="SECONDS",
        help="a run that writes nothing for this long counts as killed (default 300)",
    )  # fmt: skip

    score = commands.add(
        "score", _score, "score a run directory or the log of any SLAM system", "score runs/square", "look"
    )
    score.add_path("log", "LOG", "run directory, or CSV with t, id, x, y, theta")
    score.add_argument(
        "--mode", choices=("strict", "paper", "or", "literal"), default="strict",
        help="how the Experience Metric counts (default strict)",
    )  # fmt: skip
    score.add_argument(
        "--base", type=int, metavar="STEP",
        help="last step of the base set of the Experience Metric (default: the first return)",
    )  # fmt: skip
    score.add_argument(
        "--metric", dest="metrics", action="append", metavar="NAME",
        help="a registered metric to compute too; may be repeated",
    )  # fmt: skip
    score.add_path(
        "--relations", "CSV", "true relative poses (t1,t2,x,y,z,roll,pitch,yaw) for the Energy Metric"
    )
    score.add_flag("--json", "print JSON instead of a table")

    report = commands.add(
        "report", _report, "write a page (HTML) about a run, or several compared",
        "report runs/square -o report.html", "look",
    )  # fmt: skip
    report.add_path("runs", "RUN_DIR", "run directory", nargs="+")
    report.add_path(
        "-o", "HTML", "the page; one that is there is replaced (default ./report.html)",
        default=Path("report.html"), check=partial(require_new_file, replaces=PAGE_START),
    )  # fmt: skip


def _watch(arguments: argparse.Namespace) -> None:
    from evaluation.artifacts.run_reader import RUNNING
    from evaluation.monitor import KILLED, WATCH_IMAGE, watch_run

    for name in ("every", "patience"):
        if not 0 < getattr(arguments, name) < float("inf"):
            raise InputError(f"--{name}", str(getattr(arguments, name)), "a time above 0 s")
    line = _StatusLine()
    try:
        seen = watch_run(
            arguments.directory, line, every=arguments.every, patience=arguments.patience, once=arguments.once
        )
    finally:
        line.end()
    silent = f"no output for {seen.silence:.0f} s: " if seen.status == RUNNING else ""
    if seen.status == KILLED or (silent and not arguments.once):
        print(f"{silent}the run was killed; `run --continue {arguments.directory}` continues")
    print(f"{arguments.directory / WATCH_IMAGE} shows its map")


def _score(arguments: argparse.Namespace) -> None:
    from evaluation.artifacts.run_reader import read_run
    from evaluation.metrics.energy_metric import read_relations
    from evaluation.metrics.exm import ExmConfig, read_experience_log
    from evaluation.metrics.metric_registry import build_metrics
    from evaluation.metrics.scorecard import score_log, score_run
    from tactile.base.plugins import PluginConfig

    if arguments.base is not None and arguments.base < 0:
        raise InputError("--base", str(arguments.base), "the number of a step, from 0")
    exm = ExmConfig(mode=arguments.mode, base=arguments.base)
    if arguments.log.is_dir():
        relations = read_relations(arguments.relations) if arguments.relations else None
        metrics = build_metrics([PluginConfig(plugin=name) for name in arguments.metrics or []])
        run = read_run(arguments.log)
        card = score_run(run, arguments.log.name, exm=exm, relations=relations, metrics=metrics)
    else:
        card = score_log(read_experience_log(arguments.log), arguments.log.stem, exm=exm)
    print(card.model_dump_json(indent=2) if arguments.json else _render_scores(arguments.log, card))


def _render_scores(path: Path, card: Scorecard) -> str:
    """All figures as text: the table, that of the grid in a run directory with one, warnings and health."""
    from evaluation.metrics.occupancy_score import GridScore, render_grid_scores
    from evaluation.metrics.scorecard import render_health, render_scorecard, render_warnings
    from tactile.base.bounded import read_json

    parts, grid = [render_scorecard(card)], path / "gridscore.json"
    if grid.exists():
        parts.append(render_grid_scores([read_json(grid, "the scores of a grid", GridScore.model_validate)]))
    parts.append("\n".join([*render_warnings(card), render_health(card)]))
    return "\n\n".join(part for part in parts if part)


def _report(arguments: argparse.Namespace) -> None:
    from ratslam.runs.map_results import write_report

    write_report(arguments.runs, arguments.output)
    print(f"{arguments.output}: open it in a browser; it needs no network")


class _StatusLine:
    """Prints a line over the last one on a terminal; elsewhere prints each new line."""

    def __init__(self) -> None:
        self._last = ""

    def __call__(self, line: str) -> None:
        if sys.stdout.isatty():
            width = get_terminal_size().columns - 1
            print(f"\r{line[:width]:<{width}}", end="", flush=True)
        elif line != self._last:
            print(line, flush=True)
        self._last = line

    def end(self) -> None:
        if self._last and sys.stdout.isatty():
            print()


def add_run(commands: Commands) -> None:
    """Registers the commands of this module."""
    run = commands.add(
        "run", _run, "map a recording or a simulated session and score it",
        "run square -o runs/square", "run",
    )  # fmt: skip
    add_config(run)
    add_run_directory(run)
    run.add_path(
        "--continue", "MAP",
        "map to continue: a run directory, or a map file (.npz). The same recording goes on after the "
        "last sample mapped; another begins a separate piece, joined once its views place it in the map, and "
        "is refused in maps of methods other than `backend: recall`, which are one piece", dest="resume",
    )  # fmt: skip
    run.add_flag("--full", "print all figures, as `score` does")
    run.add_flag("--report", "write map_results.html, a page, to the run directory")
    run.add_path("--movie", "GIF", "animate the belief of `backend: recall`", check=require_new_file)
    add_rerun(run)

    simulate = commands.add(
        "simulate", _simulate, "write a simulated session to a recording",
        "simulate whisker_maze -o runs/session.mcap", "run",
    )  # fmt: skip
    add_config(simulate)
    simulate.add_path("-o", "MCAP", "the new file", required=True)
    simulate.add_flag("--raw", "record raw 2 kHz samples instead of contact features")


def add_run_directory(parser: CommandParser) -> None:
    """Adds the option that names the run directory."""
    parser.add_path("-o", "DIR", "new run directory (default runs/CONFIG)")


def add_rerun(parser: argparse.ArgumentParser) -> None:
    """Adds the option for a live view."""
    parser.add_argument(
        "--rerun", nargs="?", const="127.0.0.1:9876", metavar="TARGET",
        help="show the run in rerun: a new .rrd file, the address of a viewer on this machine (default "
        "127.0.0.1:9876), or `start` to start one",
    )  # fmt: skip


def open_target(arguments: argparse.Namespace) -> str | None:
    """The target of the live view, or None without one."""
    from ratslam.service.viewer_link import prepare_target

    return None if arguments.rerun is None else prepare_target(arguments.rerun)


def run_directory(arguments: argparse.Namespace) -> Path:
    """The run directory: `-o`, or runs/CONFIG."""
    return arguments.output or Path("runs") / arguments.config.stem


def _run(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from evaluation.report.verdict import summarise
    from ratslam.methods.method_registry import LOCALISING
    from ratslam.runs import map_results
    from ratslam.runs.localise import describe_localisation
    from ratslam.runs.run import run
    from ratslam.service.belief_movie import BeliefMovie, write_movie
    from ratslam.service.viewer_link import open_viewer

    if arguments.report:
        map_results.check_report_libraries("--report")
    directory, config, target = run_directory(arguments), read_config(arguments), open_target(arguments)
    movies = [BeliefMovie(arguments.movie, config.backend)] if arguments.movie else []
    with open_viewer(target) as observers:
        card, interrupted = run(config, directory, arguments.resume, [*observers, *movies])
    for movie in movies:
        write_movie(arguments.movie, directory.name, movie.frames)
    if arguments.full:
        print(f"{_render_scores(directory, card)}\n")
    print(f"{directory}/map.png shows the map, {directory}/trajectory.tum holds the trajectory")
    if not arguments.full:
        print(f"python -m ratslam score {directory} prints all figures")
    if arguments.report:
        map_results.write_report([directory], directory / map_results.NAME)
        print(f"{directory / map_results.NAME} is a page about the run")
    if config.backend in LOCALISING.values():
        print(describe_localisation(directory))
    print(summarise(directory, card, config.backend))
    return INTERRUPTED if interrupted else 0


def _simulate(arguments: argparse.Namespace) -> int:
    from ratslam.runs.run import simulate

    if arguments.raw:
        arguments.set.append("simulation.raw=true")
    count, interrupted = simulate(read_config(arguments), arguments.output)
    print(f"{arguments.output}: {count} steps")
    return INTERRUPTED if interrupted else 0
