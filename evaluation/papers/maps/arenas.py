"""Rows: a whiskered Create that wakes up in a known arena, and in another one of the same size.

Sessions of a whiskered Create in random arenas, and the grid maps of them on the disk.

The map is that of 900 reports. Later sessions have random streams of their own: another start, another drive,
another error of the wheels.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.papers.figure import Figure
from evaluation.papers.maps.localisation_metrics import RIGHT, WRONG, MapSteps, is_within, known_steps
from evaluation.papers.maps.localising import Judged, judge
from evaluation.papers.maps.operations import Localised, MapTask
from evaluation.papers.maps.pictures import HEADER, Panel, count, draw_panels, median, spread, table_line
from evaluation.papers.maps.scenarios import draw_seed
from evaluation.papers.tables.comparison import Record
from evaluation.papers.trial_sessions import simulate_session
from evaluation.studies.machine import code_digest
from ratslam.core.estimates import Localisation
from ratslam.core.session import Session
from ratslam.grid.localiser import GridLocaliser
from ratslam.runs.build_session import build_session, open_observations
from ratslam.runs.localise import localising
from ratslam.runs.saved_map import describe_readings, read_map, write_map
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig
from robot.touch_source import observation_of, open_touch_source
from tactile.base.random_streams import stream
from tactile.base.se2 import integrate
from tactile.base.types import Observation

SOON = 300
"""Reports of a short session: about two minutes, 20 contacts."""
SMALL, LARGE = 1.25, 2.5
"""Sides of the arenas of Fox et al. 2012, m."""


class ArenaFigures(NamedTuple):
    """One unknown start.

    Attributes:
        arena: its seed. session: as localised. shuffled: with its contacts in random order. other: [T] bool,
            a session in another arena is found. foreign: whether that one says at the end that this is not
            the map. best: whether the most likely pose is right after `SOON` reports and at the end, believed
            or not. reckoned: [T] error of odometry that starts at the truth, m.
    """

    arena: int
    session: Judged
    shuffled: Judged
    other: np.ndarray
    foreign: bool
    best: tuple[bool, bool]
    reckoned: np.ndarray

    def record(self) -> Record:
        """The figures of an unknown start by name; errors in m."""
        return {
            "missed_soon": self.session.whisks > SOON,
            "missed": self.session.whisks > REPORTS,
            "sure_and_wrong": bool(self.session.wrong.any()),
            "reports": self.session.whisks,
            "error": median(self.session.error[self.session.found, 0]),
            "odometry_error": median(self.reckoned),
            "best_wrong_soon": not self.best[0],
            "best_wrong": not self.best[1],
            "denied": bool(self.session.foreign[-1]),
            "found_elsewhere_soon": bool(self.other[:SOON].any()),
            "found_elsewhere": bool(self.other.any()),
            "not_said": not self.foreign,
            "shuffled_sure_and_wrong": bool(self.shuffled.wrong.any()),
        }


def _measure_arena(task: MapTask, side: float = SMALL) -> ArenaFigures:
    """One unknown start in the map of an arena."""
    (path, steps), drive = store_arena_map(task.seed, side, task.folder), _drive_elsewhere(task.seed, side)
    saved = read_map(path)
    session = build_session(localising(saved.config, saved), saved.source)
    known = _localise(session, drive)
    mixed = _localise(session, shuffled_contacts(drive, task.seed))
    other = _localise(session, _drive_elsewhere(task.seed + 1, side))
    judged = judge(steps, known, drive.truth)
    right = is_within(judged.error, RIGHT)
    reckoned = integrate(drive.motion, drive.truth[0]) - drive.truth
    return ArenaFigures(
        arena=task.seed,
        session=judged,
        shuffled=judge(steps, mixed, drive.truth),
        other=other.found,
        foreign=bool(other.foreign[-1]),
        best=(bool(right[SOON - 1]), bool(right[-1])),
        reckoned=np.hypot(*reckoned[:, :2].T),
    )


def _arena_lines(found: Sequence[ArenaFigures]) -> Iterator[str]:
    """The lines of unknown starts."""
    yield HEADER
    n = len(found)
    reports = np.array([one.session.whisks for one in found])
    mixed = np.array([one.shuffled.whisks for one in found])
    for within in (SOON, REPORTS):
        goal = f"{int(np.ceil(0.95 * n))} of {n}" if within == SOON else "-"
        control = f"{count(mixed <= within)} with shuffled contacts"
        yield table_line(f"found and right within {within} reports", goal, count(reports <= within), control)
    median = f"{np.median(reports):.0f} ({reports.max():.0f})"
    yield table_line("reports until then, median (worst)", "-", median, "-")
    for k, within in enumerate((SOON, REPORTS)):
        right = count([one.best[k] for one in found])
        yield table_line(f"most likely pose right after {within} reports, believed or not", "-", right, "-")
    wrong, control = (
        count([bool(getattr(one, name).wrong.any()) for one in found]) for name in ("session", "shuffled")
    )
    yield table_line("sure and wrong (> 0.18 m or 30 degrees)", f"0 of {n}", wrong, f"{control} shuffled")
    for within in (SOON, REPORTS):
        other = count([bool(one.other[:within].any()) for one in found])
        yield table_line(f"found in another arena within {within} reports", f"0 of {n}", other, "-")
    yield table_line(
        f"says after {REPORTS} reports that this is not the map",
        "-",
        f"{count([one.foreign for one in found])} in another arena",
        f"{count([bool(one.session.foreign[-1]) for one in found])} in that of the map",
    )
    errors = [np.median(one.session.error[one.session.found, 0]) for one in found if one.session.found.any()]
    reckoned = spread([float(np.median(one.reckoned)) for one in found], 3)
    yield table_line(
        "error while found, m, median of sessions (worst)",
        "-",
        spread(errors, 3),
        f"{reckoned} odometry from the true start",
    )


def _draw_arenas(found: Sequence[ArenaFigures], png: Path) -> None:
    """Draws the error of all sessions over the reports."""
    curves = {"sessions": [np.where(one.session.found, one.session.error[:, 0], np.nan) for one in found]}
    limits = {"right": RIGHT.distance, "wrong": WRONG.distance}
    panel = Panel("error while found, m", "reports since the start", curves=curves, limits=limits)
    known = count([one.session.whisks <= REPORTS for one in found])
    other = count([bool(one.other.any()) for one in found])
    line = f"Unknown start: found and right in {known}; found in another arena: {other}."
    draw_panels(png, "Waking up in a known arena", line, None, panel)


def _localise(session: Session, drive: ArenaDrive) -> Localised:
    session.restart()
    steps = list(session.replay(drive.observations))
    localiser = session.map
    assert isinstance(localiser, GridLocaliser)
    states = localiser.states()
    pose = np.array([step.pose for step in steps])
    return Localised(states == Localisation.FOUND, states == Localisation.NOT_THIS_MAP, pose)


GRID = Figure("Localise in a grid map from an unknown start", _measure_arena, _arena_lines, _draw_arenas, 20)
GRID_LARGE = Figure(
    "The same in arenas of 2.5 m", partial(_measure_arena, side=LARGE), _arena_lines, _draw_arenas, 6
)


REPORTS = 900
"""Reports of a session; a little more than six minutes."""
MAP_SIDE = 2.0
"""Side of the map over that of the arena: it is centred on the start."""


class ArenaDrive(NamedTuple):
    """A session of T reports: the observations, the true poses [T, 3], and the motions by odometry [T, 3]."""

    observations: list[Observation]
    truth: np.ndarray
    motion: np.ndarray


def _arena_config(arena: int, side: float, seed: int) -> RunConfig:
    """The configuration of a session in an arena.

    Args:
        arena: its seed. side: of the arena, m. seed: of everything else.
    """
    wheels = {"noise": "bias", "level": 0.05}
    simulation = {"arena": {"side": side, "seed": arena}, "wheels": wheels, "reports": REPORTS, "seed": seed}
    return RunConfig.model_validate(
        {
            "create_simulation": simulation,
            "backend": "grid",
            "session": {"precision": "float32"},
            "grid": {"side": MAP_SIDE * side},
        }
    )


def _drive_elsewhere(arena: int, side: float) -> ArenaDrive:
    """A further session in an arena, from another start."""
    config = _arena_config(arena, side, draw_seed(arena, "arena start"))
    assert config.create_simulation is not None
    session = simulate_session(config.create_simulation)
    touch = complete(config, session.source).touch
    seen = [observation_of(sample) for sample in open_touch_source(session.source, touch)]
    motion = np.array([[float(value) for value in one.odometry[:3]] for one in seen])
    return ArenaDrive(seen, session.truth, motion)


def shuffled_contacts(drive: ArenaDrive, seed: int) -> ArenaDrive:
    """The same drive with what the whiskers met at another of its reports."""
    order = stream(seed, "control.shuffled").permutation(len(drive.observations))
    names = ("contact", "alive", "point", "wall", "wall_point", "wall_sd")
    mixed = [
        one._replace(**{name: getattr(drive.observations[k], name) for name in names})
        for one, k in zip(drive.observations, order.tolist(), strict=True)
    ]
    return drive._replace(observations=mixed)


def store_arena_map(arena: int, side: float, folder: Path) -> tuple[Path, MapSteps]:
    """The file of the map of an arena, and its steps; made in `folder` unless the same code has done that."""
    path = folder / f"arena_{arena}_{side:g}-{code_digest()}.npz"
    beside = path.with_suffix(".steps.npz")
    if not (path.exists() and beside.exists()):
        folder.mkdir(parents=True, exist_ok=True)
        with open_observations(_arena_config(arena, side, arena)) as (config, source):
            samples = list(source)
            session = build_session(config, source)
            for _ in session.replay(observation_of(sample) for sample in samples):
                pass
            write_map(path, session, config, describe_readings(source), recording=source.digest)
        truth = np.array([sample.truth for sample in samples])
        unfinished = beside.with_name(f".{os.getpid()}.npz")
        np.savez(unfinished, trajectory=session.map.trajectory(), truth=truth)
        unfinished.replace(beside)
    with np.load(beside) as saved:
        return path, known_steps(saved["trajectory"], saved["truth"])
