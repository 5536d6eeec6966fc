"""The table of many networks: time and memory of 1,000 parameter sets over 30,000 steps."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from evaluation.papers.cells.panels import Taken, on_one_core, time_call
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


class NetworkCost(NamedTuple):
    """sets, steps: measured. taken: time by row. memory: most of the process meanwhile, MB. circumstances:
    machine and load."""

    sets: int
    steps: int
    taken: dict[str, Taken]
    memory: dict[str, float]
    circumstances: str


def measure_networks(sets: int = MEASURED, steps: int = STEPS) -> NetworkCost:
    """Measures a study in float32 on a random walk in a box of 1 m, without its compiling.

    Args:
        sets: parameter sets. steps: at 50 Hz.
    """
    taken, memory = {}, {}
    with on_one_core() as found:
        for name in GOALS:
            own = [f"views={str(name == 'with views').lower()}", f"steps={steps}", f"sets={sets}"]
            own += [f"rat_simulation.seconds={steps / 50}", "rat_simulation.rate_hz=50", "seed=0"]
            own += ["rat_simulation.walk={}", "rat_simulation.views.every=5", "session.reserve=2048"]
            tasks = tasks_of(cell_study(Path("rat_box"), own))
            first = tasks[0]._replace(parameters=tasks[0].parameters[:1], size=1)
            score_task(first)
            reset_peak_memory()
            each = [
                time_call(partial(score_task, task._replace(size=len(task.parameters)))) for task in tasks
            ]
            taken[name] = Taken(*map(sum, zip(*each, strict=True)))
            memory[name] = peak_memory() * 2**20 / 1e6
    return NetworkCost(sets, steps, taken, memory, found.text)


def network_table(result: NetworkCost) -> Iterator[str]:
    """The lines of the table."""
    count = result.sets * result.steps
    how = "measured" if result.sets >= SETS else f"extrapolated from {result.sets} sets"
    yield (
        f"The study `--preset cells` in float32 on a random walk, {result.steps} steps at 50 Hz; views "
        f"at 10 Hz. Compiling is not included. Minutes are {how}. {result.circumstances}\n"
    )
    yield markdown_header(COLUMNS)
    for name, taken in result.taken.items():
        each = [1e6 * time / count for time in taken]
        minutes = [time / count * SETS * STEPS / 60 for time in taken]
        row = [name, result.sets, *(f"{time:.1f}" for time in (*each, *minutes)), GOALS[name]]
        yield markdown_row([*row, f"{result.memory[name]:.0f}"])


FIGURE = Figure(
    "Many networks",
    lambda task: measure_networks(task.sessions or MEASURED),
    network_table,
    None,
)
