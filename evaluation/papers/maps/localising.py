"""Figures: a robot that wakes up somewhere in a known maze, and in a maze that it does not know."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.trajectory import align
from evaluation.papers.figure import Figure
from evaluation.papers.maps.localisation_metrics import (
    RIGHT,
    WRONG,
    MapSteps,
    aligned_errors,
    exceeds,
    is_within,
    localisation_errors,
)
from evaluation.papers.maps.operations import Localised, MapTask
from evaluation.papers.maps.pictures import (
    HEADER,
    Panel,
    PathPanel,
    count,
    draw_panels,
    median,
    spread,
    table_line,
)
from evaluation.papers.maps.scenarios import (
    FOREIGN,
    LOCALISED,
    Recorded,
    open_world,
    other_maze,
    record,
    ten_circuits,
    unknown_start,
)
from evaluation.papers.tables.comparison import Record
from evaluation.papers.trial_sessions import apply_control
from tactile.base.se2 import compose, integrate


class Judged(NamedTuple):
    """A localised session of T steps beside the truth.

    Attributes:
        found, foreign: [T] bool, as said. right, wrong: [T] bool, found and within `RIGHT`, found and beyond
            `WRONG`. error: [T, 2] m and rad, against the nearest step of the map. aligned: [T, 2] after the
            alignment of the map to the truth.
    """

    found: np.ndarray
    foreign: np.ndarray
    right: np.ndarray
    wrong: np.ndarray
    error: np.ndarray
    aligned: np.ndarray

    @property
    def whisks(self) -> float:
        """Whisks until the robot was found and right; infinite if it never was."""
        return int(np.argmax(self.right)) + 1 if self.right.any() else np.inf


class _StartFigures(NamedTuple):
    """One unknown start.

    Attributes:
        seed: of the maze. session: as localised. shuffled: with its images in random order. reckoned: [T]
            error of odometry that starts at the truth, m. paths: true path of the map, of the session, and
            where the robot said it was, all [.., 2] in the frame of the truth.
    """

    seed: int
    session: Judged
    shuffled: Judged
    reckoned: np.ndarray
    paths: tuple[np.ndarray, np.ndarray, np.ndarray]

    def record(self) -> Record:
        """The figures of an unknown start by name; errors in m, while found."""
        found = self.session.found
        return {
            "missed": self.session.whisks > LOCALISED,
            "sure_and_wrong": bool(self.session.wrong.any()),
            "whisks": self.session.whisks,
            "error": median(self.session.error[found, 0]),
            "error_aligned": median(self.session.aligned[found, 0]),
            "odometry_error": median(self.reckoned),
            "shuffled_found": self.shuffled.whisks <= LOCALISED,
            "shuffled_sure_and_wrong": bool(self.shuffled.wrong.any()),
        }


class _ForeignFigures(NamedTuple):
    """One session in another maze, and one in the maze of the map.

    Attributes:
        seed: of the maze of the map. found: steps at which the robot was found. said: whether it said at the
            end that this is not the map. known_found, known_said: the same of a session in the map.
    """

    seed: int
    found: int
    said: bool
    known_found: int
    known_said: bool

    def record(self) -> Record:
        """The figures of a session in another maze by name."""
        return {
            "found_elsewhere": self.found > 0,
            "not_said": not self.said,
            "known_missed": self.known_found == 0,
            "known_denied": self.known_said,
        }


def judge(steps: MapSteps, localised: Localised, truth: np.ndarray) -> Judged:
    """A session beside its true poses [T, 3]."""
    error = localisation_errors(steps, localised.pose, truth, RIGHT.distance)
    return Judged(
        found=localised.found,
        foreign=localised.foreign,
        right=localised.found & is_within(error, RIGHT),
        wrong=localised.found & exceeds(error, WRONG),
        error=error,
        aligned=aligned_errors(steps, localised.pose, truth),
    )


def _measure_start(task: MapTask) -> _StartFigures:
    """One unknown start in the map of ten circuits."""
    made, recorded = task.map_of(ten_circuits(task.seed)), record(unknown_start(task.seed))
    steps, truth = made.arrays.steps, recorded.truth
    localised = task.methods.localise(made, recorded)
    mixed = Recorded(recorded.config, apply_control(recorded.log, "shuffled", task.seed))
    reckoned = integrate(recorded.log.motion[:, :3], truth[0])
    said = compose(align(steps.pose, steps.truth), localised.pose)
    return _StartFigures(
        seed=task.seed,
        session=judge(steps, localised, truth),
        shuffled=judge(steps, task.methods.localise(made, mixed), truth),
        reckoned=np.hypot(*(reckoned - truth)[:, :2].T),
        paths=(steps.truth[:, :2], truth[:, :2], np.where(localised.found[:, None], said[:, :2], np.nan)),
    )


def _measure_foreign(task: MapTask) -> _ForeignFigures:
    """One session in another maze."""
    made = task.map_of(ten_circuits(task.seed))
    other = task.methods.localise(made, record(other_maze(task.seed)))
    known = task.methods.localise(made, record(unknown_start(task.seed)))
    return _ForeignFigures(
        task.seed,
        int(other.found.sum()),
        bool(other.foreign[-1]),
        int(known.found.sum()),
        bool(known.foreign[-1]),
    )


def _start_lines(found: Sequence[_StartFigures]) -> Iterator[str]:
    """The lines of unknown starts."""
    yield HEADER
    n = len(found)
    whisks = np.array([one.session.whisks for one in found])
    mixed = np.array([one.shuffled.whisks for one in found])
    yield table_line(
        f"found and right within {LOCALISED} whisks",
        f"{int(np.ceil(0.95 * n))} of {n}",
        count(whisks <= LOCALISED),
        f"{count(mixed <= LOCALISED)} with shuffled images",
    )
    median = np.median(whisks)
    yield table_line("whisks until then, median (worst)", "25", f"{median:.0f} ({whisks.max():.0f})", "-")
    yield table_line(
        "sure and wrong (> 0.18 m or 30 degrees)",
        f"0 of {n}",
        count([bool(one.session.wrong.any()) for one in found]),
        f"{count([bool(one.shuffled.wrong.any()) for one in found])} with shuffled images",
    )
    errors = [np.median(one.session.error[one.session.found, 0]) for one in found if one.session.found.any()]
    yield table_line(
        "error while found, m, median of sessions (worst)",
        "-",
        spread(errors, 3),
        f"{spread([float(np.median(one.reckoned)) for one in found], 3)} odometry from the true start",
    )
    aligned = [
        np.median(one.session.aligned[one.session.found, 0]) for one in found if one.session.found.any()
    ]
    yield table_line("the same after the alignment of the map", "-", spread(aligned, 3), "-")


def _foreign_lines(found: Sequence[_ForeignFigures]) -> Iterator[str]:
    """The lines of sessions in other mazes."""
    yield HEADER
    n = len(found)
    yield table_line(
        f"found in another maze, {FOREIGN} whisks",
        f"0 of {n}",
        count([one.found > 0 for one in found]),
        f"{count([one.known_found > 0 for one in found])} in the maze of the map, {LOCALISED} whisks",
    )
    yield table_line(
        "says at the end that this is not the map",
        "-",
        count([one.said for one in found]),
        f"{count([one.known_said for one in found])} in the maze of the map",
    )


def _draw_start(found: Sequence[_StartFigures], png: Path) -> None:
    """Draws one session in its maze, and the error of all over the whisks."""
    one = found[0]
    paths = PathPanel(
        "where the robot was, and where it says it is",
        open_world(one.seed).maze,
        {"map": one.paths[0], "true path": one.paths[1], "found": one.paths[2]},
    )
    curves = {"sessions": [np.where(each.session.found, each.session.error[:, 0], np.nan) for each in found]}
    whisks = [each.session.whisks for each in found]
    panel = Panel(
        "error while found, m",
        "whisks since the start",
        curves=curves,
        limits={"right": RIGHT.distance, "wrong": WRONG.distance},
    )
    known = count([value <= LOCALISED for value in whisks])
    draw_panels(
        png,
        "Waking up in a known maze",
        f"Unknown start: found and right in {known}, in the median after {np.median(whisks):.0f} whisks.",
        paths,
        panel,
    )


def _draw_foreign(found: Sequence[_ForeignFigures], png: Path) -> None:
    """Draws how long robots believed that they were found, in another maze and in that of the map."""
    dots = {
        "another maze": [100 * one.found / FOREIGN for one in found],
        "maze of the map": [100 * one.known_found / LOCALISED for one in found],
    }
    panel = Panel("whisks at which the robot is found, %", "", dots=dots)
    wrong = count([one.found > 0 for one in found])
    line = f"One dot a session. Found in another maze: {wrong}."
    draw_panels(png, "A maze that is not in the map", line, None, panel)


START = Figure("Localise from an unknown start", _measure_start, _start_lines, _draw_start, 20)
FOREIGN_ROW = Figure("Localise in another maze", _measure_foreign, _foreign_lines, _draw_foreign, 20)
