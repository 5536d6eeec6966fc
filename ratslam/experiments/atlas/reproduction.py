"""Measures the rows of saved maps and writes them as one page with pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from ratslam.experiments.atlas.registry import ROWS
from ratslam.experiments.atlas.row import MapTask, Methods
from ratslam.experiments.studies.executor import run_tasks
from tactile.base.atomic_write import write_text_atomically

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
) -> Iterator[str]:
    """The lines of the page, each table as soon as it is measured; writes `maps.md` and a PNG per row.

    Args:
        names: keys of `ROWS`. output: folder for the page, and for the maps in `maps`, which later calls use
            again. first: seed of the first maze; each session has the next one. sessions: of each row; None:
            the row's own number. workers: processes.

    Raises:
        InputError: a session cannot be recorded.
    """
    page: list[str] = []
    output.mkdir(parents=True, exist_ok=True)
    for name in names:
        row = ROWS[name]
        seeds = row.seeds(first, sessions)
        tasks = [MapTask(seed, output / "maps", methods) for seed in seeds]
        found = list(run_tasks(row.measure, tasks, workers=workers))
        picture = output / f"{name.replace(' ', '_')}.png"
        row.draw(found, picture)
        used = [row.recordings[seed] for seed in seeds] if row.recordings else seeds
        named = ", ".join(map(str, used if len(used) < 3 else (used[0], "...", used[-1])))
        lines = [f"## {row.title}", "", f"{len(tasks)} sessions: {named}.", "", *row.table(found), ""]
        lines += [f"![{row.title}]({picture.name})", ""]
        yield from lines
        page += lines
        write_text_atomically(output / "maps.md", "\n".join(page))
