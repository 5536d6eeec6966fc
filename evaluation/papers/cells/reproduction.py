"""Measures the figures of pose cells and writes them as one page with pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path

from evaluation.papers.cells.figure import CellFigure, CellTask
from tactile.base.files import write_text_atomically

NAMES: tuple[str, ...] = (
    "drift",
    "anchoring",
    "rotation",
    "boxes",
    "torus",
    "analysis_cost",
    "agreement",
    "shuffles",
    "networks",
    "posterior",
    "alike_rooms",
    "kidnap",
    "cue_conflict",
    "lesions",
    "scale",
)
"""The figures and tables. The first nine are modules of this room and on `backend: classic`, the others on
`backend: recall`."""
MODULES = {
    "drift": "packet_figures",
    "anchoring": "packet_figures",
    "posterior": "belief_rows",
    "alike_rooms": "belief_rows",
    "kidnap": "belief_rows",
    "cue_conflict": "belief_rows",
    "lesions": "belief_lesions",
    "scale": "belief_lesions",
}
"""The modules that offer several figures, by name in their `FIGURES`."""


def find_figure(name: str) -> CellFigure:
    """The figure of a name in `NAMES`."""
    module = import_module(f"evaluation.papers.cells.{MODULES.get(name, name)}")
    return module.FIGURES[name] if name in MODULES else module.FIGURE


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
