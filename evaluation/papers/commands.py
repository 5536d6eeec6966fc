"""The command `reproduce`, for figures of the whisker papers and tables of results."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from functools import partial
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

from evaluation.papers.figure import CELLS, MAPS, REAL, Figure, Task, write_page
from ratslam.cli.common import (
    INTERRUPTED,
    CommandParser,
    Commands,
    add_config,
    add_set,
    positive_integer,
    prepare_jax,
    read_config,
)
from ratslam.runs.settings.packaged import find_config
from tactile.base.errors import InputError
from tactile.base.files import require_new_file, require_own_folder

SALMAN2016 = {
    "fig2": "odometry drift over three clockwise laps",
    "fig3": "experience history",
    "fig4": "with and without kidnaps",
    "fig5": "clockwise and anticlockwise laps",
    "fig6": "open loop against RCP, max_angle",
    "fig7": "contact_angle against max_angle",
    "reverse": "driving forwards and backwards (added)",
    "controls": "the contribution of the images (added)",
    "matched": "conditions at matched ARCR, classic matcher",
}
"""Reproductions of Salman & Pearson 2016."""
FOX2012 = {
    "fox-fig4": "mean maps of three mappers",
    "fox-fig5": "maps of single trials",
    "fox-fig6": "a larger arena at two levels of odometry noise",
}
"""Reproductions of Fox et al. 2012."""
SETS = {"fox-fig4": 20, "fox-fig5": 2}
"""Default number of sets of figures that do not use `USUAL_SETS`."""
USUAL_SETS = 3


def add_commands(commands: Commands) -> None:
    """Registers `reproduce` with a command for each figure and table, and for strain templates."""
    reproduce = commands.add(
        "reproduce", None, "reproduce a figure or table, with controls", "reproduce fig2 --sets 1", "papers"
    )
    names = Commands(reproduce)
    for paper, figures in (("Salman & Pearson", SALMAN2016), ("Fox et al.", FOX2012)):
        for name, title in figures.items():
            parser = names.add(name, _figure, f"{paper}: {title}", f"reproduce {name} --sets 1")
            _add_count(parser, "--sets", SETS.get(name, USUAL_SETS), "mazes or trials per condition")
            help = "seed of all sets (default 0)"
            parser.add_argument("--seed", type=int, default=0, metavar="S", help=help)
            marks = [f"{figure}.csv" for figure in SALMAN2016 | FOX2012]
            _add_output(parser, f"folder for {name}.csv and {name}.png", marks, "reproduce")
            add_set(parser)
            _add_count(parser, "--workers", 0, "processes")
            parser.set_defaults(name=name)
    threshold = names.add(
        "threshold", _threshold, "Salman & Pearson: threshold tuning, classic method",
        "reproduce threshold whisker_maze -o runs/threshold",
    )  # fmt: skip
    add_config(threshold)
    _add_count(threshold, "--workers", 1, "processes")
    threshold.add_path("-o", "DIR", "new folder for threshold.png and threshold.csv")
    tables = names.add(
        "tables", None, "print a table of the results as Markdown", "reproduce tables laser --rows square"
    )
    _add_tables(Commands(tables))
    real = names.add(
        "real", _figures, "figures on recordings of real whiskers and wheels",
        "reproduce real --rows contact -o runs/real",
    )  # fmt: skip
    _add_row_names(real, REAL)
    real.set_defaults(page="real")
    _add_output(real, "folder for real.md and a picture per figure", ["real.md"], "real")
    title = "maps found again, continued, merged and changed"
    # Mazes 31000 to 31030, 32700 to 32707 and 33000 to 33059 were used to choose settings.
    maps = _add_rows(names, "maps", _maps, title, MAPS, 32000)
    _add_against(maps, "maps.csv")
    title = "pose cells: drift, anchoring, cues, maps, scores, with controls"
    _add_rows(names, "cells", _figures, title, CELLS, 40000)
    train = names.add(
        "templates", _train, "Fox et al.: strain templates of a simulated Create",
        "reproduce templates create_arena -o runs/templates.npz",
    )  # fmt: skip
    add_config(train)
    train.add_path("-o", "NPZ", "the new file", required=True, check=partial(require_new_file, parents=True))


def _add_rows(
    names: Commands, name: str, command: Callable[..., Any], title: str, rows: Iterable[str], first: int
) -> CommandParser:
    """Registers a set of tables and figures, of which each is a row; its parser.

    Args:
        title: line of the help. rows: names of the rows; the first is in the example. first: default seed of
            the first session.
    """
    example = f"reproduce {name} --rows {next(iter(rows))} --sessions 1 -o runs/{name}"
    parser = names.add(name, command, title, example)
    _add_row_names(parser, rows)
    parser.set_defaults(page=name)
    help = "sessions or repeats per row (default: of the row)"
    parser.add_argument("--sessions", type=positive_integer, metavar="N", help=help)
    _add_count(parser, "--first", first, "seed of the first session; each has the next one")
    kept = f"folder for {name}.md, a picture per row, and what is used again"
    _add_output(parser, kept, [f"{name}.md", name], name)
    _add_count(parser, "--workers", 1, "processes")
    return parser


def _add_output(parser: CommandParser, help: str, marks: Sequence[str], default: str | None = None) -> None:
    """Registers `-o` for a folder that is known by one of the marks; by default in `runs`."""
    folder, note = (Path("runs") / default, f" (default runs/{default})") if default else (None, "")
    parser.add_path("-o", "DIR", help + note, default=folder, check=partial(require_own_folder, marks=marks))


def _add_row_names(parser: argparse.ArgumentParser, rows: Iterable[str]) -> None:
    """Registers `--rows`, whose help lists the names of all rows."""
    listed = ", ".join(f"'{name}'" if " " in name else name for name in rows)
    parser.add_argument("--rows", nargs="+", metavar="ROW", help=f"only these of: {listed} (default: all)")


def _figure(arguments: argparse.Namespace) -> int:
    if arguments.seed < 0:
        raise InputError("--seed", str(arguments.seed), "a non-negative integer")
    prepare_jax(keep_compiled=False)
    if arguments.name in FOX2012:
        from evaluation.papers.fox2012.reproduction import PAPER
    else:
        from evaluation.papers.salman2016.reproduction import PAPER
    from evaluation.papers.paper_sets import reproduce

    name, folder = arguments.name, arguments.output
    sets, workers, seed = arguments.sets, arguments.workers, arguments.seed
    text, interrupted = reproduce(PAPER, name, folder, sets, workers, seed, arguments.set)
    print(f"{text}\n\nwrote {folder / name}.csv" + ("" if interrupted else f" and {folder / name}.png"))
    return INTERRUPTED if interrupted else 0


def _threshold(arguments: argparse.Namespace) -> None:
    prepare_jax(keep_compiled=False)
    from evaluation.papers.salman2016.threshold_tuning import tune_threshold
    from ratslam.runs.settings.strict_yaml import load, override

    path = find_config(arguments.config)
    document = override(load(path), arguments.set)
    for line in tune_threshold(document, path.parent, arguments.workers, arguments.output):
        print(line)


def _train(arguments: argparse.Namespace) -> None:
    from evaluation.papers.fox2012.template_training import drive_held_out, render_drives
    from robot.simulation.create.simulated_session import train_strain_templates

    create_simulation = read_config(arguments).create_simulation
    if create_simulation is None:
        where, cure = f"{arguments.config}: create_simulation", "`create_simulation: {}` gives the default"
        raise InputError(where, "missing", "the Create to train", cure)
    templates = train_strain_templates(create_simulation)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    templates.write(arguments.output)
    print(render_drives(drive_held_out(create_simulation, templates), templates.training.repeats))
    print(f"\nwrote {arguments.output}; `touch.reports.templates: {arguments.output}` uses it")


def _figures(arguments: argparse.Namespace) -> None:
    """The figures of pose cells, or those of real recordings."""
    from evaluation.papers.tables.markdown import select_rows
    from evaluation.papers.tables.recordings import DATA, UNPROVEN, real_recordings

    if arguments.page == "cells":
        task: object = Task(arguments.first, arguments.sessions, arguments.workers)
        places, ending = CELLS, []
    else:
        task, places, ending = real_recordings(), REAL, [UNPROVEN]
        if task is None:
            raise InputError(DATA, "not set", "the folder of the real recordings", f"export {DATA}=DIR")
    prepare_jax(keep_compiled=False)
    names = select_rows(arguments.rows, places)

    def measure(name: str, figure: Figure) -> tuple[Sequence[str], Any]:
        return (), figure.measure(task)

    page = arguments.output / f"{arguments.page}.md"
    for line in write_page(page, places, names, measure, ending):
        print(line, flush=True)
    print(f"wrote {page}")


def _maps(arguments: argparse.Namespace) -> None:
    prepare_jax(keep_compiled=False)
    from evaluation.papers.maps.operations import Methods, reproduce_maps
    from evaluation.papers.tables.markdown import select_rows

    names = select_rows(arguments.rows, MAPS)
    first, sessions, workers = arguments.first, arguments.sessions, arguments.workers
    output, against = arguments.output, arguments.against
    for line in reproduce_maps(names, Methods(), output, first, sessions, workers, against):
        print(line, flush=True)
    print(f"wrote {output / 'maps.md'} and {output / 'maps.csv'}")


BACKENDS = ("recall", "classic")
SESSION_FILES = ("touch.csv", "buildings.csv")
"""Files of the sessions of tables, which may be in one folder."""

TABLES = {
    "touch": "touch_table.touch_table", "grid": "grid_table.grid_table", "laser": "buildings.laser_table",
    "buildings": "buildings.buildings_table", "health": "health.health_table",
    "closures": "closures.closures_table", "speed": "speed.speed_table", "cycles": "cycles.cycle_table",
    "batches": "batches.batch_table",
}  # fmt: skip
"""Functions of the tables, in the folder `tables`."""
TIMED = ("speed", "cycles", "batches")
"""Tables of times."""


def _add_count(parser: argparse.ArgumentParser, name: str, default: int, help: str) -> None:
    """Adds an option for a positive integer; the default 0 stands for the number of cores."""
    help = f"{help} (default {default or 'the number of cores'})"
    parser.add_argument(name, type=positive_integer, default=default, metavar="N", help=help)


def _add_tables(tables: Commands) -> None:
    """Registers the tables."""

    def add(name: str, help: str, example: str) -> CommandParser:
        parser = tables.add(name, _print_table, help, f"reproduce tables {name} {example}")
        parser.set_defaults(table=name, file="")
        return parser

    touch = add("touch", "whisker sessions under many conditions", "--rows main --sessions 1")
    _add_count(touch, "--first", 31100, "number of the first maze; each session has the next one")
    help = "sessions per row (default: of the row, 12 to 40)"
    touch.add_argument("--sessions", type=positive_integer, metavar="N", help=help)
    touch.add_argument("--backend", choices=BACKENDS, default="recall", help="the method (default recall)")
    _add_session_file(touch, "touch.csv")
    grid = add("grid", "the grid filter in arenas", "--rows bias --worlds A --arenas 1")
    _add_count(grid, "--arenas", 10, "arenas per row")
    _add_count(grid, "--first", 9000, "seed of the first arena")
    grid.add_argument("--worlds", nargs="+", choices=("A", "B", "rotated"), help="only these kinds of arena")
    laser = add("laser", "recordings with laser views or given places", "--rows square")
    _add_count(laser, "--copies", 10, "perturbed copies per recording")
    buildings = add("buildings", "real buildings: map against odometry", "--copies 2")
    _add_count(buildings, "--copies", 10, "perturbed copies per recording")
    _add_session_file(buildings, "buildings.csv")
    health = add("health", "how well the health estimate detects bad maps", "--sessions 1")
    _add_count(health, "--sessions", 2, "sessions per row")
    _add_count(health, "--workers", 0, "processes")
    closures = add("closures", "fits and tests the log-odds of closure sequences", "--sessions 2")
    _add_count(closures, "--sessions", 6, "sessions per row")
    _add_count(closures, "--workers", 0, "processes")
    closures.add_path("-o", "DIR", "folder for closure_judge.json, the weights")
    closures.set_defaults(file="closure_judge.json")
    for parser in (touch, grid, laser, buildings):
        parser.add_argument("--rows", nargs="+", metavar="ROW", help="only these rows")
        _add_count(parser, "--workers", 0, "processes")
    speed = add("speed", "microseconds per pose-cell step by network size", "--rows 21 41")
    speed.add_argument(
        "--rows", nargs="+", type=positive_integer, metavar="N", help="only these numbers of cells a side"
    )
    _add_count(speed, "--rounds", 5, "repeats, of which the median is taken")
    cycles = add("cycles", "microseconds per whole cycle, map included", "--rows square")
    cycles.add_argument("--rows", nargs="+", metavar="ROW", help="only these sessions")
    _add_count(cycles, "--rounds", 5, "repeats, of which the median is taken")
    cycles.add_argument("--profile", action="store_true", help="where the time goes instead")
    batches = add("batches", "many sets or sessions in one call, on a GPU too", "--steps 160")
    _add_count(batches, "--sets", 1000, "parameter sets in one call")
    _add_count(batches, "--sessions", 256, "sessions in one call")
    _add_count(batches, "--steps", 1600, "steps of a session")
    _add_count(batches, "--rounds", 3, "repeats, of which the median is taken")


def _add_session_file(parser: CommandParser, file: str) -> None:
    """Registers `-o` and `--against` of a table whose sessions are written to a file."""
    _add_output(
        parser, f"folder for {file}, the figures of each session as soon as it is done", SESSION_FILES
    )
    _add_against(parser, file)
    parser.set_defaults(file=file)


def _add_against(parser: CommandParser, file: str) -> None:
    """Registers `--against`."""
    help = f"compare with the same sessions in {file} of an earlier run, given -o DIR"
    parser.add_path("--against", "DIR", help)


def _print_table(arguments: argparse.Namespace) -> None:
    """Prints a table, each line as soon as it is measured.

    Its function takes the options of its command. Only its modules are loaded, those of a table of times once
    the process is on one core.
    """
    prepare_jax(keep_compiled=False)
    from evaluation.studies.machine import one_core

    module, function = TABLES[arguments.table].split(".")
    with one_core() if arguments.table in TIMED else nullcontext():
        measure = getattr(import_module(f"evaluation.papers.tables.{module}"), function)
        for line in measure(**{name: getattr(arguments, name) for name in signature(measure).parameters}):
            print(line, flush=True)
    if arguments.file and arguments.output is not None:
        print(f"\nwrote {arguments.output / arguments.file}")
