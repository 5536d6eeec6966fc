"""The table of many networks: time and memory of 1,000 parameter sets over 30,000 steps."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from evaluation.papers.cells.panels import on_one_core, time_call
from evaluation.papers.figure import Figure
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.studies.cell_study import cell_study, score_task, tasks_of
from evaluation.studies.machine import peak_memory, reset_peak_memory

SETS, MEASURED, STEPS = 1000, 16, 30_000
"""Sets of the goal, sets measured unless the task says otherwise, and steps."""
GOALS = {"path integration": 20, "with views": 45}
"""Minutes."""
COLUMNS = (
    "networks", "sets measured", "us a step and set", "wall us", "1,000 sets x 30,000 steps, min", "wall min",
    "goal min", "memory MB",
)  # fmt: skip


def measure_networks(sets: int = MEASURED, steps: int = STEPS) -> tuple[str, int, dict[str, list[float]]]:
    """Measures a study in float32 on a random walk in a box of 1 m, without its compiling.

    Args:
        sets: parameter sets. steps: at 50 Hz.

    Returns:
        what is measured, as sentences; sets; by row processor and wall time of a step and set, us, of the
        goal, min, and the most memory of the process meanwhile, MB.
    """
    rows: dict[str, list[float]] = {}
    count = sets * steps
    with on_one_core() as found:
        for name in GOALS:
            own = [f"views={str(name == 'with views').lower()}", f"steps={steps}", f"sets={sets}"]
            own += [f"rat_simulation.seconds={steps / 50}", "rat_simulation.rate_hz=50", "seed=0"]
            own += ["rat_simulation.walk={}", "rat_simulation.views.every=5", "session.reserve=2048"]
            tasks = tasks_of(cell_study(Path("rat_box"), own))
            score_task(_whole(tasks[0]._replace(parameters=tasks[0].parameters[:1])))
            reset_peak_memory()
            each = [time_call(partial(score_task, _whole(task))) for task in tasks]
            times = [sum(column) for column in zip(*each, strict=True)]
            rows[name] = [
                *(1e6 * time / count for time in times),
                *(time / count * SETS * STEPS / 60 for time in times),
                peak_memory() * 2**20 / 1e6,
            ]
    how = "measured" if sets >= SETS else f"extrapolated from {sets} sets"
    note = (
        f"The study `--preset cells` in float32 on a random walk, {steps} steps at 50 Hz; views "
        f"at 10 Hz. Compiling is not included. Minutes are {how}. {found[0]}\n"
    )
    return note, sets, rows


def _whole(task: Any) -> Any:
    """A chunk that is not filled up."""
    return task._replace(plan=task.plan.model_copy(update={"chunk": len(task.parameters)}))


def network_table(result: tuple[str, int, dict[str, list[float]]]) -> Iterator[str]:
    """The lines of the table."""
    note, sets, rows = result
    yield note
    yield markdown_header(COLUMNS)
    for name, (*times, memory) in rows.items():
        yield markdown_row([name, sets, *(f"{time:.1f}" for time in times), GOALS[name], f"{memory:.0f}"])


FIGURE = Figure(
    "Many networks",
    lambda task: measure_networks(task.sessions or MEASURED),
    network_table,
    None,
)
