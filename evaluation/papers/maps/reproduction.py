"""Measures the rows of saved maps and writes them as one page with pictures.

The rows of saved maps by name. A row's module is loaded when the row is read, the names load nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from evaluation.papers.maps.row import MapTask, Methods
from evaluation.papers.tables.comparison import Files, SessionLog, compare_figures
from evaluation.studies.executor import run_tasks
from tactile.base.files import write_text_atomically

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
        "carried": "changing.CARRIED",
        "kidnaps": "changing.KIDNAPS_ROW",
        "merge": "merged_maps.OVERLAP",
        "merge mazes": "merged_maps.DIFFERENT",
        "ten sessions": "merged_maps.TEN",
        "goals": "goals.GOALS",
        "wall moved": "changing.WALL",
        "door closed": "changing.DOOR",
        "buildings": "merged_maps.HALVES",
        "grid": "arenas.GRID",
        "grid large": "arenas.GRID_LARGE",
    }
)
"""The rows, in the order of the page."""


FIRST = 32000
"""Seed of the first maze. Those used to choose settings are 31000 to 31030, 32700 to 32707 and 33000 to
33059."""


def reproduce_maps(
    names: Sequence[str],
    methods: Methods,
    output: Path,
    first: int = FIRST,
    sessions: int | None = None,
    workers: int = 1,
    against: Path | None = None,
) -> Iterator[str]:
    """The lines of the page, each table as soon as it is measured; writes `maps.md`, a PNG per row, and
    `maps.csv`, a session as soon as it is measured.

    Args:
        names: keys of `ROWS`. output: folder for the page, and for the maps in `maps`, which later calls use
            again. first: seed of the first maze; each session has the next one. sessions: of each row; None:
            the row's own number. workers: processes. against: folder of an earlier run; the same sessions
            are compared below the last table.

    Raises:
        InputError: a session cannot be recorded, or a file of the sessions cannot be used.
    """
    seeds = {name: ROWS[name].seeds(first, sessions) for name in names}
    labels = {name: ROWS[name].recordings or {seed: str(seed) for seed in seeds[name]} for name in names}
    planned = [(name, labels[name][seed]) for name in names for seed in seeds[name]]
    log = SessionLog("maps", Files(output, against), planned)
    page: list[str] = []
    output.mkdir(parents=True, exist_ok=True)
    for name in names:
        row = ROWS[name]
        tasks = [MapTask(seed, output / "maps", methods) for seed in seeds[name]]
        found = []
        for task, figures in zip(tasks, run_tasks(row.measure, tasks, workers=workers), strict=True):
            log.add(name, labels[name][task.seed], row.record(figures))
            found.append(figures)
        picture = output / f"{name.replace(' ', '_')}.png"
        row.draw(found, picture)
        used = [labels[name][task.seed] for task in tasks]
        named = ", ".join(used if len(used) < 3 else (used[0], "...", used[-1]))
        lines = [f"## {row.title}", "", f"{len(tasks)} sessions: {named}.", "", *row.table(found), ""]
        lines += [f"![{row.title}]({picture.name})", ""]
        yield from lines
        page += lines
        write_text_atomically(output / "maps.md", "\n".join(page))
    yield from compare_figures(log, names)
