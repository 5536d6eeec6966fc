"""Measures figures on real recordings and writes them as one page with pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path

from evaluation.papers.whiskers.figure import RealFigure
from tactile.base.files import write_text_atomically

NAMES: tuple[str, ...] = ("contact", "drift", "fit", "tangent", "likeness", "walk", "create", "bumps")
"""The figures: names of modules of this room."""
UNPROVEN = """\
## What these recordings do not show
- No public recording has whiskers, revisits and true positions together. So no map here is made by real
  whiskers: the images of the walk were recorded, its poses and odometry are simulated.
- No real head was whisking. Contact was measured on passive magnetic whiskers of one arm, in a reach of 12 s;
  the rest angle and the radii of a head were fitted on simulated heads only.
- No whisker of these recordings is known to be bent for good, and no touch recording is longer than a minute:
  hours of drift are made of the drift of that one reach.
- The Create is one drive of nine minutes in one room.
- No live session ran on real hardware: arm, head and Create were emulators.
"""


def find_figure(name: str) -> RealFigure:
    """The figure of a name in `NAMES`."""
    return import_module(f"evaluation.papers.whiskers.{name}").FIGURE


def reproduce_real(names: Sequence[str], data: Path, output: Path) -> Iterator[str]:
    """The lines of the page, each table as soon as it is measured; writes `real.md` and a PNG per figure.

    Args:
        data: folder of the real recordings. output: folder for the page, made if it does not exist.

    Raises:
        InputError: a recording is missing or damaged.
    """
    page = []
    for name in names:
        figure = find_figure(name)
        result = figure.measure(data)
        output.mkdir(parents=True, exist_ok=True)
        picture = output / f"{name}.png"
        figure.draw(result, picture)
        shown = f"![{figure.title}]({picture.name})"
        lines = [f"## {figure.title}", "", *figure.table(result), "", shown, ""]
        yield from lines
        page += lines
        write_text_atomically(output / "real.md", "\n".join([*page, UNPROVEN]))
    yield UNPROVEN
