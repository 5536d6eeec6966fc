"""Figures and tables of `reproduce cells`, `real` and `maps`: their names, what each offers, their page.

A module of `cells`, `whiskers` or `maps` declares a `Figure`; the tables of names say where. The module is
loaded when the figure is asked for, so that the help of the program lists names without it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from tactile.base.files import write_text_atomically

CELLS = {
    "drift": "cells.packet_figures.DRIFT",
    "anchoring": "cells.packet_figures.ANCHORING",
    "rotation": "cells.rotation.FIGURE",
    "boxes": "cells.boxes.FIGURE",
    "torus": "cells.torus.FIGURE",
    "analysis_cost": "cells.costs.ANALYSIS",
    "agreement": "cells.agreement.FIGURE",
    "shuffles": "cells.shuffles.FIGURE",
    "networks": "cells.costs.NETWORKS",
    "own_cells": "cells.own_data.AGREEMENT",
    "decoding": "cells.own_data.DECODING",
    "comparison": "cells.own_data.COMPARISON",
    "own_cost": "cells.own_data.SCORING",
    "posterior": "cells.belief_rows.POSTERIOR_FIGURE",
    "alike_rooms": "cells.belief_rows.ROOMS_FIGURE",
    "kidnap": "cells.belief_rows.KIDNAP_FIGURE",
    "cue_conflict": "cells.belief_rows.CONFLICT_FIGURE",
    "theta": "cells.theta.FIGURE",
    "sheets": "cells.sheets.FIGURE",
    "lesions": "cells.belief_lesions.LESIONS_FIGURE",
    "scale": "cells.belief_lesions.SCALE_FIGURE",
}
"""Pose cells: the first nine are measured on `backend: classic`, four on simulated cells of an animal, the
others on `backend: recall`."""
REAL = {
    name: f"whiskers.{name}.FIGURE"
    for name in ("contact", "drift", "fit", "likeness", "walk", "create", "bumps")
}
"""Recordings of real whiskers and wheels."""
MAPS = {
    "start": "maps.localising.START",
    "other maze": "maps.localising.FOREIGN_ROW",
    "carried": "maps.changing.CARRIED",
    "kidnaps": "maps.changing.KIDNAPS_ROW",
    "merge": "maps.merged_maps.OVERLAP",
    "merge mazes": "maps.merged_maps.DIFFERENT",
    "ten sessions": "maps.merged_maps.TEN",
    "goals": "maps.goals.GOALS",
    "wall moved": "maps.changing.WALL",
    "door closed": "maps.changing.DOOR",
    "buildings": "maps.merged_maps.HALVES",
    "grid": "maps.arenas.GRID",
    "grid large": "maps.arenas.GRID_LARGE",
}
"""Saved maps."""


class Task(NamedTuple):
    """What a figure of pose cells measures.

    Attributes:
        first: seed of the first session; each session has the next one. sessions: their number, or that of
            repeats; None: the usual number of the figure. workers: processes.
    """

    first: int
    sessions: int | None = None
    workers: int = 1

    def seeds(self, usual: int) -> range:
        """The seeds of the sessions; `usual` of them unless the task says otherwise."""
        return range(self.first, self.first + (self.sessions or usual))


class Figure(NamedTuple):
    """A figure or a table.

    Attributes:
        title: one line. measure: the result: of a `Task` (pose cells), of the folder of the real recordings
            (real whiskers; an `InputError` if one is missing or damaged), of one session (saved maps). table:
            the lines of a Markdown table of the result, or of the results of all sessions, each figure beside
            its control, and sentences about what it does not show. draw: draws the same into a new PNG file;
            None: without a picture. sessions: of saved maps: their usual number, or the names of the
            recordings that are used instead of mazes.
    """

    title: str
    measure: Callable[[Any], Any]
    table: Callable[[Any], Iterable[str]]
    draw: Callable[[Any, Path], None] | None
    sessions: int | tuple[str, ...] = ()


def find_figure(place: str) -> Figure:
    """The figure at `room.module.VARIABLE` in this package."""
    module, variable = place.rsplit(".", 1)
    return getattr(import_module(f"evaluation.papers.{module}"), variable)


def write_page(
    page: Path,
    places: Mapping[str, str],
    names: Iterable[str],
    measure: Callable[[str, Figure], tuple[Sequence[str], Any]],
    ending: Sequence[str] = (),
) -> Iterator[str]:
    """Measures figures, and writes a page of them, again after each one, and a PNG file for each beside it.

    Args:
        page: its folder is made once the first figure is measured. places: of the figures by name. measure:
            the lines above a figure's table, and its result. ending: last lines of the page.

    Yields:
        The lines of the page; each table as soon as it is measured.
    """
    written: list[str] = []
    for name in names:
        figure = find_figure(places[name])
        above, result = measure(name, figure)
        page.parent.mkdir(parents=True, exist_ok=True)
        lines = [f"## {figure.title}", "", *above, *figure.table(result), ""]
        yield from lines
        if figure.draw is not None:
            picture = page.with_name(f"{name.replace(' ', '_')}.png")
            figure.draw(result, picture)
            shown = [f"![{figure.title}]({picture.name})", ""]
            yield from shown
            lines += shown
        written += lines
        write_text_atomically(page, "\n".join([*written, *ending]))
    yield from ending
