"""Measures the figures of pose cells and writes them as one page with pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path

from ratslam.experiments.cells.figure import CellFigure, CellTask
from tactile.base.atomic_write import write_text_atomically

NAMES: tuple[str, ...] = (
    "drift",
    "anchoring",
    "rotation",
    "boxes",
    "torus",
    "recording_cost",
    "analysis_cost",
    "agreement",
    "shuffles",
    "networks",
)
"""The figures and tables: names of modules of this room."""


def find_figure(name: str) -> CellFigure:
    """The figure of a name in `NAMES`."""
    return import_module(f"ratslam.experiments.cells.{name}").FIGURE


def reproduce_cells(names: Sequence[str], task: CellTask, output: Path) -> Iterator[str]:
    """The lines of the page, each table as soon as it is measured; writes `cells.md` and a PNG per figure.

    Args:
        output: folder for the page, made if it does not exist.

    Raises:
        InputError: a package to compare with is not installed.
    """
    page: list[str] = []
    for name in names:
        figure = find_figure(name)
        result = figure.measure(task)
        output.mkdir(parents=True, exist_ok=True)
        lines = [f"## {figure.title}", "", *figure.table(result), ""]
        if figure.draw is not None:
            picture = output / f"{name}.png"
            figure.draw(result, picture)
            lines += [f"![{figure.title}]({picture.name})", ""]
        yield from lines
        page += lines
        write_text_atomically(output / "cells.md", "\n".join(page))
