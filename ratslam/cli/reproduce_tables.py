"""The tables of the command `reproduce tables`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

from ratslam.cli.common import Commands, add_count, add_workers, positive_integer, prepare_jax

BACKENDS, MOTIONS = ("recall", "classic"), ("random", "drive")

Lines = Callable[[argparse.Namespace], Iterator[str]]


def add_tables(tables: Commands) -> None:
    """Registers the tables."""

    def add(name: str, lines: Lines, help: str, example: str) -> argparse.ArgumentParser:
        parser = tables.add(name, _print_table, help, f"reproduce tables {name} {example}")
        parser.set_defaults(lines=lines)
        return parser

    touch = add("touch", _touch_lines, "whisker sessions under many conditions", "--rows main --sessions 1")
    add_count(touch, "--first", 31100, "number of the first maze; each session has the next one")
    sessions = "sessions per row (default: of the row, 12 to 40)"
    touch.add_argument("--sessions", type=positive_integer, metavar="N", help=sessions)
    touch.add_argument("--backend", choices=BACKENDS, default="recall", help="the method (default recall)")
    grid = add("grid", _grid_lines, "the grid filter in arenas", "--rows bias --worlds A --arenas 1")
    add_count(grid, "--arenas", 10, "arenas per row")
    add_count(grid, "--first", 9000, "seed of the first arena")
    grid.add_argument("--worlds", nargs="+", choices=("A", "B", "rotated"), help="only these kinds of arena")
    laser = add("laser", _laser_lines, "recordings with laser views or given places", "--rows square")
    add_count(laser, "--copies", 10, "perturbed copies per recording")
    buildings = add("buildings", _buildings_lines, "real buildings: map against odometry", "--copies 2")
    add_count(buildings, "--copies", 10, "perturbed copies per recording")
    health = add("health", _health_lines, "how well the health estimate detects bad maps", "--sessions 1")
    add_count(health, "--sessions", 2, "sessions per row")
    add_workers(health)
    for parser in (touch, grid, laser, buildings):
        parser.add_argument("--rows", nargs="+", metavar="ROW", help="only these rows")
        add_workers(parser)
    speed = add("speed", _speed_lines, "microseconds per pose-cell step by network size", "--rows 21 41")
    speed.add_argument(
        "--rows", nargs="+", type=positive_integer, metavar="N", help="only these numbers of cells a side"
    )
    add_count(speed, "--rounds", 5, "repeats, of which the median is taken")
    cycles = add("cycles", _cycle_lines, "microseconds per whole cycle, map included", "--rows square")
    cycles.add_argument("--rows", nargs="+", metavar="ROW", help="only these sessions")
    add_count(cycles, "--rounds", 5, "repeats, of which the median is taken")
    precision = add("precision", _precision_lines, "float32 against float64", "--seeds 2 --backends recall")
    add_count(precision, "--seeds", 20, "sessions per method")
    precision.add_argument("--backends", nargs="+", choices=BACKENDS, default=BACKENDS, help="the methods")
    precision.add_argument("-o", "--output", type=Path, metavar="DIR", help="new folder for BACKEND.npz")
    add_workers(precision, 1)
    chaos = add("chaos", _chaos_lines, "divergence of two almost equal pose-cell networks", "--steps 1000")
    add_count(chaos, "--steps", 100_000, "steps per walk")
    add_count(chaos, "--walks", 3, "walks per row")
    chaos.add_argument("--pairs", nargs="+", metavar="PAIR", help="only these pairs of networks")
    chaos.add_argument("--motions", nargs="+", choices=MOTIONS, default=MOTIONS, help="only these motions")


def _print_table(arguments: argparse.Namespace) -> int:
    prepare_jax(keep_compiled=False)
    for line in arguments.lines(arguments):
        print(line, flush=True)
    return 0


def _touch_lines(arguments: argparse.Namespace) -> Iterator[str]:
    from ratslam.experiments.tables.markdown import select_rows
    from ratslam.experiments.tables.touch import DEFAULT_ROWS, ROWS, touch_table

    rows = select_rows(arguments.rows, ROWS, DEFAULT_ROWS)
    return touch_table(rows, arguments.first, arguments.sessions, arguments.workers, arguments.backend)


def _grid_lines(arguments: argparse.Namespace) -> Iterator[str]:
    from ratslam.experiments.tables.grid import DEFAULT_ROWS, ODOMETRY_ERRORS, ROWS, grid_table
    from ratslam.experiments.tables.markdown import select_rows

    if arguments.rows or arguments.worlds:
        names = select_rows(arguments.rows, ROWS, tuple(ODOMETRY_ERRORS))
        rows = tuple((world, row) for world in arguments.worlds or "AB" for row in names)
    else:
        rows = DEFAULT_ROWS
    return grid_table(rows, arguments.arenas, arguments.first, arguments.workers)


def _laser_lines(arguments: argparse.Namespace) -> Iterator[str]:
    from ratslam.experiments.tables.laser import ROWS, laser_table
    from ratslam.experiments.tables.markdown import select_rows

    return laser_table(select_rows(arguments.rows, ROWS, tuple(ROWS)), arguments.copies, arguments.workers)


def _buildings_lines(arguments: argparse.Namespace) -> Iterator[str]:
    from ratslam.experiments.tables.buildings import buildings_table, choose_rows

    return buildings_table(choose_rows(arguments.rows), arguments.copies, arguments.workers)


def _health_lines(arguments: argparse.Namespace) -> Iterator[str]:
    from ratslam.experiments.tables.health import health_table

    return health_table(arguments.sessions, arguments.workers)


def _speed_lines(arguments: argparse.Namespace) -> Iterator[str]:
    from evaluation.metrics.resources import one_core

    with one_core():
        from ratslam.experiments.tables.speed import SIZES, speed_table

        yield from speed_table(arguments.rows or SIZES, arguments.rounds)


def _cycle_lines(arguments: argparse.Namespace) -> Iterator[str]:
    from evaluation.metrics.resources import one_core

    with one_core():
        from ratslam.experiments.tables.cycles import cycle_table

        yield from cycle_table(arguments.rows, arguments.rounds)


def _precision_lines(arguments: argparse.Namespace) -> Iterator[str]:
    from ratslam.experiments.tables.precision import precision_table

    return precision_table(arguments.backends, arguments.seeds, arguments.workers, arguments.output)


def _chaos_lines(arguments: argparse.Namespace) -> Iterator[str]:
    from ratslam.experiments.tables.chaos import PAIRS, chaos_table
    from ratslam.experiments.tables.markdown import select_rows

    pairs = select_rows(arguments.pairs, PAIRS, tuple(PAIRS))
    return chaos_table(pairs, arguments.motions, arguments.steps, arguments.walks)
