"""Rows: a whiskered Create that wakes up in a known arena, and in another one of the same size.

Sessions of a whiskered Create in random arenas, and the grid maps of them on the disk.

The map is that of 900 reports. Later sessions have random streams of their own: another start, another drive,
another error of the wheels.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from evaluation.papers.figure import Figure
from evaluation.papers.maps.localisation_metrics import RIGHT, WRONG, MapSteps
from evaluation.papers.maps.localising import Judged
from evaluation.papers.maps.operations import Localised, MapTask
from evaluation.papers.maps.pictures import at_least, draw_panels, median, spread, table
from evaluation.papers.tables.comparison import Measured, column
from evaluation.papers.tables.markdown import count
from evaluation.papers.trial_sessions import simulate_session
from evaluation.studies.machine import code_digest
from ratslam.runs.build_session import build_session, open_observations
from ratslam.runs.localise import localising
from ratslam.runs.saved_map import describe_readings, read_map, write_map
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig
from robot.touch_source import observation_of, open_touch_source
from tactile.base.files import write_atomically
from tactile.base.random_streams import stream
from tactile.base.se2 import integrate
from tactile.base.types import Observation

SOON = 300
"""Reports of a short session: about two minutes, 20 contacts."""
SMALL, LARGE = 1.25, 2.5
"""Sides of the arenas of Fox et al. 2012, m."""
REPORTS = 900
"""Reports of a session; a little more than six minutes."""
MAP_SIDE = 2.0
"""Side of the map over that of the arena: it is centred on the start."""


def _measure_arena(task: MapTask, side: float = SMALL) -> Measured:
    """One unknown start in the map of an arena; its controls have their contacts in random order, or are in
    another arena."""
    path, steps = store_arena_map(task.seed, side, task.folder)
    saved = read_map(path)
    session = build_session(localising(saved.config, saved), saved.source)

    def localise(observations: Sequence[Observation]) -> Localised:
        session.restart()
        return Localised.by(session, observations)

    seen, truth, motion = _drive_elsewhere(task.seed, side)
    known = localise(seen)
    mixed = localise(shuffled_contacts(seen, task.seed))
    other = localise(_drive_elsewhere(task.seed + 1, side)[0])
    reckoned = integrate(motion, truth[0]) - truth  # odometry that starts at the truth
    return arena_figures(
        Judged.of(steps, known, truth), Judged.of(steps, mixed, truth), other, np.hypot(*reckoned[:, :2].T)
    )


def arena_figures(session: Judged, shuffled: Judged, other: Localised, reckoned: np.ndarray) -> Measured:
    """The figures of an unknown start, of its controls, and of the errors [T] of odometry; errors in m. The
    most likely pose (`best`) may be right before it is believed."""
    best = RIGHT.holds(session.error)
    figures = {
        "missed_soon": session.whisks > SOON,
        "missed": session.whisks > REPORTS,
        "sure_and_wrong": bool(session.wrong.any()),
        "reports": session.whisks,
        "error": median(session.error[session.found, 0]),
        "odometry_error": median(reckoned),
        "best_wrong_soon": not best[SOON - 1],
        "best_wrong": not best[-1],
        "denied": bool(session.foreign[-1]),
        "found_elsewhere_soon": bool(other.found[:SOON].any()),
        "found_elsewhere": bool(other.found.any()),
        "not_said": not other.foreign[-1],
        "shuffled_sure_and_wrong": bool(shuffled.wrong.any()),
    }
    curve = np.where(session.found, session.error[:, 0], np.nan)
    return Measured(figures, {"shuffled": shuffled.whisks, "curve": curve})


def _arena_lines(found: Sequence[Measured]) -> list[str]:
    n, reports, mixed = len(found), column(found, "reports"), column(found, "shuffled")
    return table(
        *(
            f"found and right within {within} reports | {at_least(0.95, n) if within == SOON else '-'} |"
            f" {count(reports <= within)} | {count(mixed <= within)} with shuffled contacts"
            for within in (SOON, REPORTS)
        ),
        f"reports until then, median (worst) | - | {np.median(reports):.0f} ({reports.max():.0f}) | -",
        *(
            f"most likely pose right after {within} reports, believed or not | - |"
            f" {count(~column(found, name))} | -"
            for within, name in ((SOON, "best_wrong_soon"), (REPORTS, "best_wrong"))
        ),
        f"sure and wrong (> 0.18 m or 30 degrees) | 0 of {n} | {count(column(found, 'sure_and_wrong'))} |"
        f" {count(column(found, 'shuffled_sure_and_wrong'))} shuffled",
        *(
            f"found in another arena within {within} reports | 0 of {n} | {count(column(found, name))} | -"
            for within, name in ((SOON, "found_elsewhere_soon"), (REPORTS, "found_elsewhere"))
        ),
        f"says after {REPORTS} reports that this is not the map | - | {count(~column(found, 'not_said'))} in"
        f" another arena | {count(column(found, 'denied'))} in that of the map",
        f"error while found, m, median of sessions (worst) | - | {spread(column(found, 'error'), 3)} |"
        f" {spread(column(found, 'odometry_error'), 3)} odometry from the true start",
    )


def _draw_arenas(found: Sequence[Measured], png: Path) -> None:
    """Draws the error of all sessions over the reports."""
    known, other = count(~column(found, "missed")), count(column(found, "found_elsewhere"))
    line = f"Unknown start: found and right in {known}; found in another arena: {other}."
    names = "error while found, m", "reports since the start"
    curves = {"sessions": [one.shown["curve"] for one in found]}
    limits = {"right": RIGHT.distance, "wrong": WRONG.distance}
    draw_panels(png, "Waking up in a known arena", line, names, curves=curves, limits=limits)


GRID = Figure("Localise in a grid map from an unknown start", _measure_arena, _arena_lines, _draw_arenas, 20)
GRID_LARGE = Figure(
    "The same in arenas of 2.5 m", partial(_measure_arena, side=LARGE), _arena_lines, _draw_arenas, 6
)


def _arena_config(arena: int, side: float, seed: int) -> RunConfig:
    """The configuration of a session in an arena.

    Args:
        arena: its seed. side: of the arena, m. seed: of everything else.
    """
    wheels = {"noise": "bias", "level": 0.05}
    simulation = {"arena": {"side": side, "seed": arena}, "wheels": wheels, "reports": REPORTS, "seed": seed}
    method = {"backend": "grid", "session": {"precision": "float32"}, "grid": {"side": MAP_SIDE * side}}
    return RunConfig.model_validate({"create_simulation": simulation, **method})


def _drive_elsewhere(arena: int, side: float) -> tuple[list[Observation], np.ndarray, np.ndarray]:
    """A further session in an arena, from another start: T observations, and the true poses and the motions
    by odometry [T, 3]."""
    config = _arena_config(arena, side, int(stream(arena, "atlas.arena start").integers(1 << 31)))
    assert config.create_simulation is not None
    session = simulate_session(config.create_simulation)
    touch = complete(config, session.source).touch
    seen = [observation_of(sample) for sample in open_touch_source(session.source, touch)]
    motion = np.array([[float(value) for value in one.odometry[:3]] for one in seen])
    return seen, session.truth, motion


def shuffled_contacts(seen: Sequence[Observation], seed: int) -> list[Observation]:
    """Observations of a drive with what the whiskers met at another of its reports."""
    order = stream(seed, "control.shuffled").permutation(len(seen))
    names = ("contact", "alive", "point", "wall", "wall_point", "wall_sd")
    return [
        one._replace(**{name: getattr(seen[k], name) for name in names})
        for one, k in zip(seen, order.tolist(), strict=True)
    ]


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
        poses = session.map.trajectory()
        write_atomically(beside, lambda unfinished: np.savez(unfinished, trajectory=poses, truth=truth))
    with np.load(beside) as saved:
        return path, MapSteps.known(saved["trajectory"], saved["truth"])
