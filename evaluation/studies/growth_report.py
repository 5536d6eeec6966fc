"""Runs a growth study, each session in a process of its own, and writes its table and picture."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING

import numpy as np

from evaluation.studies.executor import Executor
from evaluation.studies.growth import GrowthStudy, GrowthTask
from evaluation.studies.growth_plot import GrowthCurve, draw_growth
from evaluation.studies.growth_session import GrowthRow, measure_growth
from evaluation.studies.study_report import (
    describe_machines,
    find_disturbances,
    format_number,
    render_table,
)
from evaluation.studies.study_runner import KILLED
from tactile.base.atomic_write import write_atomically, write_text_atomically
from tactile.base.errors import InputError, os_errors_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FILE = "growth.jsonl"  # name of the file of rows in a study's folder
COLUMNS = {
    "": "ground", "steps": "steps", "keyframes": "keyframes", "mean us": "mean",
    "all threads us": "process_mean", "median us": "median", "99 % us": "p99", "largest us": "largest",
    "longest us": "longest", "memory MiB": "memory", "EM m^2 + rad^2": "energy", "ATE m": "ate",
    "odometry EM": "energy_odometry", "end s": "end", "final EM": "energy_final",
    "final ATE m": "ate_final", "closures": "closures", "false": "false_closures",
}  # fmt: skip
"""Fields of a row by their column in the table."""
NOTE = """\
mean, median, 99 %, largest: processor time of a step on the session's thread, over the steps since the length
before or the window, without those that compiled code. all threads: the mean with other threads. longest:
wall time of a step, with waits for the selection of closures, as steps follow one another without pause.
memory: peak since the length before. EM and ATE: of the online map so far. end: processor time of the final
optimisation if the session ended here. final, closures, false: of the map after it; closures of places more
than 0.1 m apart."""


def run_growth(study: GrowthStudy, folder: Path) -> None:
    """Runs the sessions of a study one after another; each row is in `folder/FILE` as soon as it is measured.

    Raises:
        InputError: the folder cannot be made, a session cannot be simulated, or its process was killed.
    """
    with os_errors_of(folder, "cannot be written to", "a folder to write to"):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / FILE).write_bytes(b"")
    with Executor(fresh=True) as executor:
        for _ in executor.completed(partial(_append_rows, folder / FILE), study.tasks, _killed):
            pass


def read_rows(folder: Path) -> list[GrowthRow]:
    """The rows measured so far."""
    path, found = folder / FILE, []
    for line in path.read_bytes().splitlines() if path.exists() else []:
        try:
            found.append(GrowthRow.model_validate_json(line))
        except ValueError:  # cut off by a kill
            continue
    return found


def render_growth(rows: Sequence[GrowthRow]) -> str:
    """The table and its notes as Markdown."""
    table = [list(COLUMNS)]
    table += [[_cell(getattr(row, name)) for name in COLUMNS.values()] for row in rows]
    machines = [row.machine for row in rows]
    remarks = [f"{each[0].upper()}{each[1:]}." for each in find_disturbances(machines)]
    measured = describe_machines(machines, 1)
    return "\n".join([render_table(table), "", NOTE, "; ".join(measured.values()) + ".", *remarks])


def draw(name: str, rows: Sequence[GrowthRow]) -> Figure | None:
    """Cost of a step against length; None without a step that compiled nothing."""
    timed = [row for row in rows if row.largest]
    curves = []
    for ground in dict.fromkeys(row.ground for row in timed):
        these = [row for row in timed if row.ground == ground]
        cost = np.array([[row.mean, row.p99, row.largest] for row in these], float) / 1e3
        curves.append(GrowthCurve(ground, np.array([row.steps for row in these]), cost))
    if not curves:
        return None
    measured = describe_machines([row.machine for row in rows], 1)
    line = "  ·  ".join(measured[part] for part in ("machine", "build"))
    return draw_growth(
        f"Cost of a step against length: {name}", line, curves, "processor time of a step (ms), own thread"
    )


def save_growth(name: str, rows: Sequence[GrowthRow], folder: Path) -> list[Path]:
    """Writes table.csv, table.md and, if there is something to draw, growth.png."""
    write_text_atomically(folder / "table.csv", _csv(rows))
    write_text_atomically(folder / "table.md", f"{render_growth(rows)}\n")
    paths, picture = [folder / "table.csv", folder / "table.md"], folder / "growth.png"
    figure = draw(name, rows)
    if figure is None:
        picture.unlink(missing_ok=True)  # of an earlier call
        return paths
    write_atomically(picture, figure.savefig)
    return [*paths, picture]


def _cell(value: str | float | None) -> str:
    if value is None:
        return "-"
    return format_number(value) if isinstance(value, float) else str(value)


def _csv(rows: Sequence[GrowthRow]) -> str:
    lines = [row.model_dump(exclude={"machine"}) | {"other_load": row.machine.other_load} for row in rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(lines[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def _append_rows(path: Path, task: GrowthTask) -> None:
    """Measures a session, with a progress bar; appends its rows to a file."""
    from tqdm import tqdm

    tqdm.set_lock(RLock())  # the default is a semaphore, which is left over when this process is ended
    with (
        tqdm(total=task.lengths[-1], desc=task.ground, unit="step", file=sys.stderr, mininterval=0.5) as bar,
        path.open("a", encoding="utf-8") as file,
    ):
        for row in measure_growth(task, bar.update):
            file.write(row.model_dump_json() + "\n")
            file.flush()


def _killed(task: GrowthTask) -> None:
    """Raises an `InputError` for a session whose process was killed."""
    raise InputError(task.ground, KILLED, "memory for the whole session", "measure a shorter one")
