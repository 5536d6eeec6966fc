"""A map from real whisker images on a simulated walk, beside odometry, simulated whiskers and shuffled ones.

The walk is that of `walk_source`: poses and odometry are simulated, every image is a recorded one. Its fourth
circuit goes the other way round, so that the robot faces places that it has not faced before: nothing there
can be recognised, unless by whiskers that compare both directions. So the walk has two more controls:
simulated whiskers that compare one direction only, and odometry alone from the reversal on
(`walk_odometry`), for the session's own noise and for noise drawn anew.
"""

from __future__ import annotations

from itertools import count
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.trajectory import align
from evaluation.papers.figure import Figure
from evaluation.papers.tables.markdown import table_lines
from evaluation.papers.tables.recordings import require_recordings
from evaluation.papers.trial_sessions import collect_session, run_session
from evaluation.papers.whiskers.likeness import OBJECTS
from evaluation.papers.whiskers.walk_source import (
    WalkConfig,
    most_needed,
    open_walk,
    plan_visits,
    walk_simulation,
)
from evaluation.studies.metrics import FALSE_CLOSURE_DISTANCE, SessionResult, closure_errors
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig
from robot.simulation.head.odometry_errors import OdometryConfig, simulate_odometry
from robot.simulation.head.simulated_session import HeadSimulation
from robot.sources.in_memory import InMemorySource
from tactile.base.random_streams import stream
from tactile.base.se2 import compose, integrate, wrap

FIRST_MAZE = 31100
"""The first maze; no maze from here on was used to choose anything about real images."""
WALKS = 5
THINGS, ROWS = 10, 90
"""Recorded objects, and rows of each for first visits and for later ones."""
GOAL = 0.1
DRAWS = 200
"""Number of draws of the noise of odometry after the reversal."""


class _WalkResult(NamedTuple):
    """One walk.

    Attributes:
        maze: its number. real, shuffled: the session with recorded images, and with rows of any object.
            simulated, one_way: with simulated whiskers, and with such that compare one direction only.
        turned: number of whisks before the robot turns round for the fourth circuit. The others are what
            odometry alone makes of that circuit. reckoned: Energy Metric of the true path up to there and
            raw odometry onwards. drawn: [2, DRAWS] the same of the true path and of the map, with noise of
            odometry drawn anew. heading: error of the map's heading before the robot turns, aligned by the
            three circuits, rad.
    """

    maze: int
    real: SessionResult
    shuffled: SessionResult
    simulated: SessionResult
    one_way: SessionResult
    turned: int
    reckoned: float
    drawn: np.ndarray
    heading: float


def _measure(folder: Path) -> list[_WalkResult]:
    """Five walks."""
    (objects,) = require_recordings(folder, OBJECTS)
    # The first mazes in which no object is needed more often than half of its rows.
    mazes: list[int] = []
    for maze in count(FIRST_MAZE):
        if len(mazes) == WALKS:
            break
        truth = HeadSimulation(walk_simulation(maze)).truth
        if most_needed(plan_visits(truth, THINGS, maze)) <= ROWS:
            mazes.append(maze)
    # One kind of session after the other, because each has a kernel of its own.
    walks = [
        WalkConfig(folder=objects, simulation=walk_simulation(maze), seed=maze, shuffled=shuffled)
        for shuffled in (False, True)
        for maze in mazes
    ]
    logs = [open_walk(walk) for walk in walks]
    source = RunConfig.model_validate({"source": {"plugin": "whisker_walk"}})
    recorded = [run_session(complete(source, log), log) for log in logs]
    given = [{"simulation": walk_simulation(maze).model_dump(exclude_unset=True)} for maze in mazes]
    sessions = [collect_session(RunConfig.model_validate(parts)) for parts in given]
    simulated = [run_session(*session) for session in sessions]
    # Views are compared only as seen in the same direction.
    one_way = []
    for config, log in sessions:
        recall = config.recall.model_copy(update={"shifts": 0})
        one_way.append(run_session(config.model_copy(update={"recall": recall}), log))
    real, shuffled = recorded[: len(mazes)], recorded[len(mazes) :]
    ends = [_continue_walk(*row) for row in zip(mazes, real, logs[: len(mazes)], strict=True)]
    rows = zip(mazes, real, shuffled, simulated, one_way, strict=True)
    return [_WalkResult(*row, *end) for row, end in zip(rows, ends, strict=True)]


def _continue_walk(
    maze: int, real: SessionResult, log: InMemorySource
) -> tuple[int, float, np.ndarray, float]:
    """The last four fields of a `_WalkResult`: the walk continued by odometry alone from the reversal on."""
    truth, last = real.truth, last_before_reversal(real.truth)
    reckoned = energy_all_pairs(continue_path(truth, log.motion[:, :3], last), truth).total
    odometry = walk_simulation(maze).odometry
    drawn = draw_energies((truth, real.trajectory), truth, log.time, last, odometry, seed=maze, draws=DRAWS)
    before = slice(last + 1)
    turn = align(real.trajectory[before], truth[before])[2]
    heading = float(wrap(real.trajectory[last, 2] + turn - truth[last, 2]))
    return last + 1, reckoned, drawn, heading


def _energy(result: SessionResult, steps: int | None = None, *, odometry: bool = False) -> float:
    """Energy Metric of the map or of odometry over the first steps."""
    path = result.odometry if odometry else result.trajectory
    return float(energy_all_pairs(path[:steps], result.truth[:steps]).total)


def _table(walks: list[_WalkResult]) -> list[str]:
    """The lines of the table."""
    columns = (
        "maze", "whisks", "EM", "odometry", "simulated whiskers", "one direction only", "shuffled (closures)",
        "true path, odometry after the reversal", "median of draws (share that reaches the goal)",
        "the same from the map", "first three circuits", "odometry there",
        "false / closures (after the reversal)",
    )  # fmt: skip
    reached, three = (
        sum(_energy(walk.real, steps) <= GOAL for walk, steps in zip(walks, ends, strict=True))
        for ends in ([None] * len(walks), [walk.turned for walk in walks])
    )
    heading = np.sqrt(np.mean([walk.heading**2 for walk in walks]))
    bound, from_map = np.mean([(walk.drawn <= GOAL).mean(axis=1) for walk in walks], axis=0)
    below = (
        f"EM (m^2 + rad^2) is at most {GOAL} in {reached} of {len(walks)} walks, over the first three "
        f"circuits in {three}. {NOTE} The draws are {DRAWS} of the noise of odometry after the reversal: a "
        f"perfect map of three circuits reaches the goal in {bound:.0%} of them, this map in {from_map:.0%}: "
        f"its heading at the reversal, which turns all that follows, errs by {heading:.2f} rad (rms)."
    )
    return table_lines([], columns, map(_cells, walks), [below])


def _cells(walk: _WalkResult) -> list[str]:
    """The row of a walk."""
    real, three = walk.real, walk.turned
    false = closure_errors(real.truth, real.closures) > FALSE_CLOSURE_DISTANCE
    late = real.closures[:, 0] >= three if len(real.closures) else false
    cells = [str(walk.maze), str(len(real.truth))]
    cells += [f"{_energy(real):.3f}", f"{_energy(real, odometry=True):.3f}"]
    cells += [f"{_energy(walk.simulated):.3f}", f"{_energy(walk.one_way):.3f}"]
    cells += [f"{_energy(walk.shuffled):.3f} ({len(walk.shuffled.closures)})", f"{walk.reckoned:.3f}"]
    cells += [f"{np.median(drawn):.3f} ({(drawn <= GOAL).mean():.0%})" for drawn in walk.drawn]
    cells += [f"{_energy(real, three):.3f}", f"{_energy(real, three, odometry=True):.3f}"]
    return [*cells, f"{false.sum()} / {len(false)} ({false[late].sum()} / {late.sum()})"]


NOTE = (
    "Poses and odometry are simulated; the images are recorded, but the robot that moves did not feel them "
    "where it is, and images within a cell do not vary with the position. The fourth circuit is driven in "
    "the opposite direction, and each facing of a cell has an object of its own, so that nothing in it can "
    "be recognised: odometry alone carries it. Simulated whiskers compare both directions; those that "
    "compare one direction only have the same task as the recorded images."
)


def _draw(walks: list[_WalkResult], png: Path) -> None:
    """Draws the maps of all walks above those of odometry, aligned with the true path by three circuits."""
    figure, axes = plt.subplots(2, len(walks), figsize=(3.1 * len(walks), 5.6), layout="constrained")
    for column, walk in zip(axes.T, walks, strict=True):
        paths = {"recorded images": walk.real.trajectory, "odometry": walk.real.odometry}
        for axis, (name, path) in zip(column, paths.items(), strict=True):
            aligned = compose(align(path[: walk.turned], walk.real.truth[: walk.turned]), path)
            axis.plot(*walk.real.truth[:, :2].T, color="0.75", lw=3, label="truth")
            three, fourth = slice(walk.turned), slice(walk.turned - 1, None)
            for part, color, label in ((three, "C0", "three circuits"), (fourth, "C1", "fourth")):
                axis.plot(*aligned[part, :2].T, color=color, lw=1, label=label)
            error = energy_all_pairs(path, walk.real.truth).total
            axis.set(title=f"{name}, EM {error:.3f}", xticks=[], yticks=[])
            axis.set_aspect("equal")
        column[1].set_xlabel(f"maze {walk.maze}")
    axes[0, 0].legend(fontsize=7)
    figure.savefig(png, dpi=150)
    plt.close(figure)


FIGURE = Figure("A map from real whisker images on a simulated walk", _measure, _table, _draw)


TURNS = 0.05
"""Turn between two whisks above which the robot turns, rad."""


def last_before_reversal(truth: np.ndarray) -> int:
    """The row of true poses [N, 3] before the largest turn that is made without a pause.

    Raises:
        ValueError: the robot never turns.
    """
    turn = wrap(np.diff(truth[:, 2]))
    turns = np.abs(turn) > TURNS
    begins = np.flatnonzero(turns & ~np.concatenate([[False], turns[:-1]]))
    total = np.add.reduceat(np.where(turns, turn, 0.0), begins)
    return int(begins[np.argmax(np.abs(total))])


def continue_path(path: np.ndarray, motion: np.ndarray, last: int) -> np.ndarray:
    """[N, 3] the path [N, 3] up to row `last`, continued by motions into each row [N, 3]."""
    continued = path.copy()
    continued[last + 1 :] = integrate(motion[last + 1 :], path[last])
    return continued


def draw_energies(
    paths: tuple[np.ndarray, ...],
    truth: np.ndarray,
    time: np.ndarray,
    last: int,
    config: OdometryConfig,
    *,
    seed: int,
    draws: int,
) -> np.ndarray:
    """[P, draws] Energy Metric of P paths [N, 3] up to row `last`, continued by odometry whose noise is drawn
    anew; all paths have the same draws.

    Args:
        truth: [N, 3] true poses. time: [N] s. config: errors of the odometry. seed: of the draws.
    """
    random = stream(seed, "odometry after the reversal")
    pose = np.column_stack([truth[:, :2], np.unwrap(truth[:, 2])])
    placed = [compose(align(path[: last + 1], truth[: last + 1]), path) for path in paths]
    energies = np.zeros((len(paths), draws))
    for k in range(draws):
        motion = np.zeros_like(truth)
        motion[last:] = simulate_odometry(config, time[last:], pose[last:], random)[:, :3]
        for row, path in zip(energies, placed, strict=True):
            row[k] = energy_all_pairs(continue_path(path, motion, last), truth).total
    return energies
