"""The commands that weigh speed against error: frontier, size."""

from __future__ import annotations

import argparse
from pathlib import Path

from ratslam.cli.common import (
    Commands,
    add_config,
    add_set,
    add_workers,
    positive_integer,
    prepare_jax,
    read_config,
)
from ratslam.cli.studies import Progress, settle_threads
from ratslam.config.completion import complete
from tactile.base.errors import InputError

CYCLES = 800
"""Of a session on which settings are tried."""
LEAST = 50
"""In fewer nothing is known again."""


def add_commands(commands: Commands) -> None:
    """Registers them."""
    frontier = commands.add(
        "frontier", _frontier, "run a study and compare speed with error",
        "frontier configs/study_frontier.yaml", "study",
    )  # fmt: skip
    frontier.add_argument("study", help="the YAML file, as for sweep")
    add_set(frontier)
    add_workers(frontier, 1)
    frontier.add_argument(
        "--error", metavar="NAME",
        help="to hold speed against: em, ate, arr, arcr, exm (ARR x ARCR), map or any quantity of the "
        "scorecards (default: the first of em, ate, map that all rows have)",
    )  # fmt: skip
    frontier.add_argument(
        "-o", "--output", type=Path, metavar="DIR",
        help="where all goes, and results are taken from if they are there (default runs/frontier/<study>)",
    )  # fmt: skip

    size = commands.add(
        "size", _size, "recommend settings for a scene", "size configs/whisker_maze.yaml", "study"
    )
    add_config(size)
    size.add_argument(
        "--cycles", type=positive_integer, default=CYCLES, metavar="N",
        help=f"of the session to try them on (default {CYCLES})",
    )  # fmt: skip


def _frontier(arguments: argparse.Namespace) -> int:
    settle_threads()
    prepare_jax()
    from ratslam.experiments.pareto.benchmark import measured
    from ratslam.experiments.pareto.environment import circumstances, disturbances, most_others
    from ratslam.experiments.pareto.error_metrics import error_named, usual_error
    from ratslam.experiments.pareto.report import Frontier, save, text
    from ratslam.experiments.pareto.summary import grouped, lines
    from ratslam.experiments.studies.recorded_runs import FOLDER
    from ratslam.experiments.studies.report import remarks
    from ratslam.experiments.studies.study import jobs, read_study

    error = error_named(arguments.error) if arguments.error else None
    study = read_study(arguments.study, arguments.set)
    directory = arguments.output or Path("runs") / "frontier" / study.name
    asked = jobs(study)
    with Progress(len({job.key for job in asked}), directory / FOLDER) as progress:
        found = measured(asked, directory, arguments.workers, progress)
    groups = grouped(found.results)
    error = error or usual_error([[each for each in group if each.error is None] for group in groups])
    kept = found.fresh < len({job.key for job in asked})
    others = most_others(found.others, directory / "frontier.json") if kept else found.others
    told = Frontier(
        study.name,
        error,
        lines(groups, error),
        circumstances(found.results, study.plan.pace),
        [*remarks(found.results, directory / FOLDER), *disturbances(others, arguments.workers)],
        others,
    )
    paths = save(told, directory)
    print(text(told))
    print(f"\n{paths[-1]} shows it, {', '.join(path.name for path in paths[:-1])} hold it")
    return progress.told()


def _size(arguments: argparse.Namespace) -> int:
    if arguments.cycles < LEAST:
        raise InputError("--cycles", str(arguments.cycles), f"{LEAST} and more")
    settle_threads()
    prepare_jax()
    from ratslam.experiments.sizing.recommendation import proposals
    from ratslam.experiments.sizing.report import length_text, proposed_text, snippet, tried_text
    from ratslam.experiments.sizing.scene_statistics import cheapest, scene_of
    from ratslam.experiments.sizing.trial_runs import tried
    from ratslam.pipeline.source import open_source

    path, config = arguments.config, read_config(arguments)
    with open_source(cheapest(config)) as source:
        scene, config = scene_of(source), complete(config, source)
    found = proposals(config, scene)
    print(f"{scene.told()}\n\n{proposed_text(found)}\n", flush=True)
    steps = tried(config, found, arguments.cycles)
    print(f"What each cheaper step costs, over {length_text(steps[0].result, scene.cycles)}:\n")
    print(tried_text(steps))
    text = snippet(found)
    print(f"\nFor {path.name}:\n\n{text}" if text else f"\n{path.name} has it like that already")
    return 0
