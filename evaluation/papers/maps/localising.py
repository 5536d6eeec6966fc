"""Figures: a robot that wakes up somewhere in a known maze, and in a maze that it does not know."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from evaluation.papers.figure import Figure
from evaluation.papers.maps import scenarios
from evaluation.papers.maps.localisation_metrics import RIGHT, WRONG, MapSteps, pose_errors
from evaluation.papers.maps.operations import Localised, MapTask
from evaluation.papers.maps.pictures import PathPanel, at_least, draw_panels, median, spread, table
from evaluation.papers.maps.scenarios import FOREIGN, LOCALISED, record
from evaluation.papers.tables.comparison import Measured, column
from evaluation.papers.tables.markdown import count
from evaluation.papers.trial_sessions import apply_control
from tactile.base.se2 import integrate


class Judged(NamedTuple):
    """A localised session of T steps beside the truth.

    Attributes:
        found, foreign: [T] bool, as said. right, wrong: [T] bool, found and within `RIGHT`, found and beyond
            `WRONG`. error: [T, 2] m and rad, against the nearest step of the map.
    """

    found: np.ndarray
    foreign: np.ndarray
    right: np.ndarray
    wrong: np.ndarray
    error: np.ndarray

    @classmethod
    def of(cls, steps: MapSteps, localised: Localised, truth: np.ndarray) -> Self:
        """A session beside its true poses [T, 3]."""
        found, error = localised.found, steps.errors(localised.pose, truth, RIGHT.distance)
        right, wrong = found & RIGHT.holds(error), found & WRONG.exceeded(error)
        return cls(found, localised.foreign, right, wrong, error)

    @property
    def whisks(self) -> float:
        """Whisks until the robot was found and right; infinite if it never was."""
        return int(np.argmax(self.right)) + 1 if self.right.any() else np.inf


def _measure_start(task: MapTask) -> Measured:
    """One unknown start in the map of ten circuits; errors in m, while found."""
    made = task.map_of(scenarios.ten_circuits(task.seed))
    recorded = record(scenarios.unknown_start(task.seed))
    steps, truth = made.arrays.steps, recorded.truth
    localised = task.methods.localise(made, recorded)
    mixed = scenarios.Recorded(recorded.config, apply_control(recorded.log, "shuffled", task.seed))
    session = Judged.of(steps, localised, truth)
    shuffled = Judged.of(steps, task.methods.localise(made, mixed), truth)
    reckoned = integrate(recorded.log.motion[:, :3], truth[0])  # odometry that starts at the truth
    found, said = localised.found, steps.align(localised.pose)
    figures = {
        "missed": session.whisks > LOCALISED,
        "sure_and_wrong": bool(session.wrong.any()),
        "whisks": session.whisks,
        "error": median(session.error[found, 0]),
        "error_aligned": median(pose_errors(said, truth)[found, 0]),
        "odometry_error": median(np.hypot(*(reckoned - truth)[:, :2].T)),
        "shuffled_found": shuffled.whisks <= LOCALISED,
        "shuffled_sure_and_wrong": bool(shuffled.wrong.any()),
    }
    paths = {
        "map": steps.truth[:, :2],
        "true path": truth[:, :2],
        "found": np.where(found[:, None], said[:, :2], np.nan),
    }
    curve = np.where(found, session.error[:, 0], np.nan)
    return Measured(figures, {"maze": scenarios.open_world(task.seed)[0], "paths": paths, "curve": curve})


def _measure_foreign(task: MapTask) -> Measured:
    """One session in another maze, and one in the maze of the map."""
    made = task.map_of(scenarios.ten_circuits(task.seed))
    other = task.methods.localise(made, record(scenarios.unknown_start(task.seed + 1, FOREIGN, "foreign")))
    known = task.methods.localise(made, record(scenarios.unknown_start(task.seed)))
    figures = {
        "found_elsewhere": bool(other.found.any()),
        "not_said": not other.foreign[-1],
        "known_missed": not known.found.any(),
        "known_denied": bool(known.foreign[-1]),
    }
    return Measured(figures, {"other": int(other.found.sum()), "known": int(known.found.sum())})


def _start_lines(found: Sequence[Measured]) -> list[str]:
    n, whisks = len(found), column(found, "whisks")
    return table(
        f"found and right within {LOCALISED} whisks | {at_least(0.95, n)} | {count(whisks <= LOCALISED)} |"
        f" {count(column(found, 'shuffled_found'))} with shuffled images",
        f"whisks until then, median (worst) | 25 | {np.median(whisks):.0f} ({whisks.max():.0f}) | -",
        f"sure and wrong (> 0.18 m or 30 degrees) | 0 of {n} | {count(column(found, 'sure_and_wrong'))} |"
        f" {count(column(found, 'shuffled_sure_and_wrong'))} with shuffled images",
        f"error while found, m, median of sessions (worst) | - | {spread(column(found, 'error'), 3)} |"
        f" {spread(column(found, 'odometry_error'), 3)} odometry from the true start",
        f"the same after the alignment of the map | - | {spread(column(found, 'error_aligned'), 3)} | -",
    )


def _foreign_lines(found: Sequence[Measured]) -> list[str]:
    return table(
        f"found in another maze, {FOREIGN} whisks | 0 of {len(found)} |"
        f" {count(column(found, 'found_elsewhere'))} | {count(~column(found, 'known_missed'))} in the maze"
        f" of the map, {LOCALISED} whisks",
        f"says at the end that this is not the map | - | {count(~column(found, 'not_said'))} |"
        f" {count(column(found, 'known_denied'))} in the maze of the map",
    )


def _draw_start(found: Sequence[Measured], png: Path) -> None:
    """Draws one session in its maze, and the error of all over the whisks."""
    one, whisks = found[0].shown, column(found, "whisks")
    known = count(whisks <= LOCALISED)
    line = f"Unknown start: found and right in {known}, in the median after {np.median(whisks):.0f} whisks."
    names = "error while found, m", "whisks since the start"
    curves = {"sessions": [each.shown["curve"] for each in found]}
    limits = {"right": RIGHT.distance, "wrong": WRONG.distance}
    paths = PathPanel("where the robot was, and where it says it is", one["maze"], one["paths"])
    draw_panels(png, "Waking up in a known maze", line, names, curves=curves, limits=limits, paths=paths)


def _draw_foreign(found: Sequence[Measured], png: Path) -> None:
    """Draws how long robots believed that they were found, in another maze and in that of the map."""
    dots = {
        "another maze": [100 * one.shown["other"] / FOREIGN for one in found],
        "maze of the map": [100 * one.shown["known"] / LOCALISED for one in found],
    }
    line = f"One dot a session. Found in another maze: {count(column(found, 'found_elsewhere'))}."
    names = "whisks at which the robot is found, %", ""
    draw_panels(png, "A maze that is not in the map", line, names, dots=dots)


START = Figure("Localise from an unknown start", _measure_start, _start_lines, _draw_start, 20)
FOREIGN_ROW = Figure("Localise in another maze", _measure_foreign, _foreign_lines, _draw_foreign, 20)
