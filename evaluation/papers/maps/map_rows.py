"""The rows of saved maps by name. A row's module is loaded when the row is read, the names load nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evaluation.papers.maps.row import MapRow


class Rows(Mapping[str, "MapRow"]):
    """Rows by name.

    Args:
        places: of each row, its module in this room and its variable there: `module.VARIABLE`.
    """

    def __init__(self, places: Mapping[str, str]) -> None:
        self._places = places

    def __getitem__(self, name: str) -> MapRow:
        module, variable = self._places[name].split(".")
        return getattr(import_module(f"evaluation.papers.maps.{module}"), variable)

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


ROWS = Rows(
    {
        "start": "localising.START",
        "other maze": "localising.FOREIGN_ROW",
        "carried": "continuing.CARRIED",
        "kidnaps": "continuing.KIDNAPS_ROW",
        "merge": "merged_mazes.OVERLAP",
        "merge mazes": "merged_mazes.DIFFERENT",
        "ten sessions": "merged_mazes.TEN",
        "goals": "goals.GOALS",
        "wall moved": "changing.WALL",
        "door closed": "changing.DOOR",
        "buildings": "halves.HALVES",
        "grid": "arenas.GRID",
        "grid large": "arenas.GRID_LARGE",
    }
)
"""The rows, in the order of the page."""
