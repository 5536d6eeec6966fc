"""A real Create that knows walls by its bumpers only: the grid filter against overhead truth.

A bumper tells two things: that there is a wall, and that the wheels turn while the robot stands still. Errors
are ATE, m. The pose is that of the final map and, in brackets, as estimated at the time. Beside them stands
the distance from the robot to the nearest wall when its bumper is pressed.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.trajectory import align
from evaluation.papers.figure import Figure
from evaluation.papers.tables.markdown import table_lines
from evaluation.papers.tables.recordings import require_recordings
from evaluation.papers.trial_sessions import known_ate
from evaluation.plots import style
from ratslam.core.estimates import GridDrawing
from ratslam.core.session import Session
from ratslam.runs.build_session import build_session, open_observations
from ratslam.runs.settings.run_config import load_config
from robot.simulation.create.wheel_odometry import HEADING_DRIFT, MEAN_ERRORS
from robot.sources.odometry import correct_observations
from robot.touch_source import observation_of
from robot.world.walls import segment_distance
from tactile.base.random_streams import stream
from tactile.base.se2 import between, compose, integrate
from tactile.base.types import Observation


def wall_distances(
    position: np.ndarray, pressed: np.ndarray, walls: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances along a true path to the nearest wall, m: [E] at the first reading of each contact, and [T]
    at all readings.

    Args:
        position: [T, 2], m. pressed: [T] bool, a bumper is pressed. walls: [W, 4] ends x1, y1, x2, y2, m.
    """
    distance = segment_distance(walls, position).min(axis=1)
    begins = pressed & ~np.concatenate([[False], pressed[:-1]])
    return distance[begins], distance


CONFIG = Path("configs/create_bumps.yaml")
FILES = ("odometry", "bumps", "truth", "walls")
SEEDS = range(10)
OTHER_SPEED = 0.055
"""Mean speed of the Creates whose errors are assumed, m/s. Published is their drift by the minute; that it is
one by the metre is an assumption, and a drift by the minute corrects this faster drive by less."""
OTHER_CREATES = MEAN_ERRORS.model_copy(update={"heading_bias": float(np.mean(HEADING_DRIFT)) / OTHER_SPEED})
"""The mean errors of the Creates of `wheel_odometry.py`, which are others."""
OTHERS = "errors of other Creates taken out"
VARIANTS: dict[str, tuple[str, ...]] = {
    "grid filter": (),
    "30 particles": ("grid.particles=30",),
    "300 particles, cells of 0.1 m": ("grid.particles=300", "grid.cell=0.1"),
    "no slip at walls": ("grid.drift.slip=0.0",),
    "slip, no map": ("grid.likelihood.contact=0.0", "grid.likelihood.free=0.0"),
    "bumps shuffled in time": (),
    OTHERS: (),
}
"""Settings of the rows."""


class BumpsResult(NamedTuple):
    """The result.

    Attributes:
        final, online: of each variant the ATE of each seed, m. odometry: ATE of odometry by its treatment, m.
        advance: true advance over odometry in steps that begin in contact and drive forward, and in others.
        distance: [n] from the robot to the nearest wall at contacts, m. truth, raw, path: [T, 3] true poses,
            and those of odometry and of the filter, aligned. grid: the map of that path, with its pose [3] in
            the frame of the truth. walls: [S, 4].
    """

    final: dict[str, np.ndarray]
    online: dict[str, np.ndarray]
    odometry: dict[str, float]
    advance: tuple[float, float]
    distance: np.ndarray
    truth: np.ndarray
    raw: np.ndarray
    path: np.ndarray
    grid: tuple[GridDrawing, np.ndarray]
    walls: np.ndarray


def _measure(folder: Path) -> BumpsResult:
    """Maps the drive with every variant and seed."""
    walls = require_recordings(folder, *(f"data/create_lab_{name}.csv" for name in FILES))[-1]
    with open_observations(load_config(CONFIG)) as (_, source):
        samples = list(source)
    unknown = np.full(3, np.nan)
    truth = np.array([unknown if sample.truth is None else sample.truth for sample in samples])
    segments = np.loadtxt(walls, delimiter=",", skiprows=1, ndmin=2)
    observations = [observation_of(sample) for sample in samples]
    final, online = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for name, settings in VARIANTS.items():
        with open_observations(load_config(CONFIG, settings)) as (config, source):
            session = build_session(config, source)
        runs = [_run(session, _treat(name, observations, seed), truth, seed) for seed in SEEDS]
        final[name], online[name] = (np.array([run[part] for run in runs]) for part in range(2))
        if name == "grid filter":
            middle = runs[int(np.argsort(final[name])[len(runs) // 2])]
    # Least-squares ratio of the true advance to that of the odometry, in pressed steps and in others.
    odometry = np.array([each.odometry.dx for each in observations])[1:]
    true = between(truth[:-1], truth[1:])[:, 0]
    known, pressed = np.isfinite(true), _pressed_steps(observations)[1:]
    first, second = (
        float(true[rows] @ odometry[rows] / (odometry[rows] @ odometry[rows]))
        for rows in (known & pressed, known & ~pressed)
    )
    touching, known = np.array([each.contact.any() for each in observations]), _known(truth)
    return BumpsResult(
        final, online, _odometry_errors(observations, truth), (first, second),
        wall_distances(truth[known, :2], touching[known], segments)[0],
        truth, _aligned(_dead_reckoning(observations), truth), _aligned(middle[2], truth),
        (middle[3], align(middle[2][known], truth[known])), segments,
    )  # fmt: skip


def _table(result: BumpsResult) -> list[str]:
    """The lines of the table: odometry, then the variants of the filter."""
    rows = [[name, f"{value:.2f}", "", ""] for name, value in result.odometry.items()]
    for name, final in result.final.items():
        online = result.online[name]
        control = result.odometry[f"odometry, {OTHERS}" if name == OTHERS else "odometry"]
        cells = (f"{np.median(each):.2f} ({each.max():.2f})" for each in (final, online))
        rows.append([name, *cells, f"{(final > control).sum()} of {len(final)}"])
    low, middle, high = np.percentile(result.distance, (10, 50, 90))
    below = (
        f"{len(result.distance)} contacts; the true distance to the nearest wall is {middle:.3f} m "
        f"({low:.3f} to {high:.3f}, 10-90 %); assumed are 0.17 m. Fits use the truth: bounds, not results. "
        f"In steps that begin in contact the robot advances by {result.advance[0]:.2f} of its odometry, "
        f"in others by {result.advance[1]:.2f}. `slip, no map` leaves out what the map says. The slip was "
        "found, and the correction by other Creates chosen, on this drive: neither is held out. "
        "Where bumps at random times reach the same median, the ATE of one drive does not "
        "show that bumps help."
    )
    columns = "real Create, bumpers", "ATE, median (worst) m", "live", "worse than odometry"
    return table_lines([], columns, rows, [below])


def _draw(result: BumpsResult, file: Path) -> None:
    """Draws paths and map over the true walls into a PNG file."""
    final, odometry = np.median(result.final["grid filter"]), result.odometry["odometry"]
    line = f"ATE {final:.2f} m, odometry {odometry:.2f} m; shades: map of the filter; black: true walls"
    figure = style.new_figure(6.9, "A real Create that has bumpers only", line)
    axes = style.add_axes(figure, style.LEFT, 0.6, style.WIDTH - style.LEFT - style.RIGHT, 5.2)
    drawing, pose = result.grid
    height, width = drawing.probability.shape
    rows, columns = np.indices((height + 1, width + 1))
    corner = np.stack([columns, rows, 0 * rows], axis=-1) * drawing.cell + [*drawing.origin, 0.0]
    corner = compose(pose, corner.reshape(-1, 3)).reshape(corner.shape)
    axes.pcolormesh(
        *np.moveaxis(corner[..., :2], -1, 0), drawing.probability, cmap="Greys", vmin=0.0, vmax=1.0
    )
    for x1, y1, x2, y2 in result.walls:
        axes.plot([x1, x2], [y1, y2], color=style.INK, lw=1.4, zorder=3)
    paths = {"odometry": result.raw, "grid filter": result.path, "truth": result.truth}
    colours = style.GREEN, style.BLUE, style.VERMILLION
    for (name, path), colour in zip(paths.items(), colours, strict=True):
        axes.plot(*path[:, :2].T, color=colour, lw=1.1, label=name)
    axes.legend(frameon=False, fontsize=9, loc="upper left")
    axes.set(aspect="equal", xlim=(-4.4, 3.6), ylim=(-2.9, 2.9), facecolor="#cdcdcd")
    style.name_axes(axes, "x, m", "y, m")
    figure.savefig(file)


def _treat(name: str, observations: list[Observation], seed: int) -> list[Observation]:
    """The observations of a row."""
    if name == OTHERS:
        return correct_observations(OTHER_CREATES, observations)
    if name != "bumps shuffled in time":
        return observations
    bumps = [observations[k] for k in stream(seed, "shuffle").permutation(len(observations))]
    pairs = zip(observations, bumps, strict=True)
    return [each._replace(contact=bump.contact, point=bump.point) for each, bump in pairs]


def _run(
    session: Session, observations: list[Observation], truth: np.ndarray, seed: int
) -> tuple[float, float, np.ndarray, GridDrawing]:
    """ATE of the final path and of the live pose, the path and the map of one seed."""
    session.restart(seed)
    online = np.array([step.pose for step in session.replay(observations)])
    path, grid = session.map.trajectory(), session.map.grid()
    assert grid is not None
    return known_ate(path, truth), known_ate(online, truth), path, grid


def _odometry_errors(observations: list[Observation], truth: np.ndarray) -> dict[str, float]:
    """ATE of dead reckoning: as it is, with one error fitted to the truth, with known errors taken out."""
    moves = np.array([each.odometry for each in observations])
    pressed = _pressed_steps(observations)

    def error(turn: float = 1.0, drift: float = 0.0, slip: float = 0.0) -> float:
        motion = moves[:, :3] * [1, 1, turn] + drift * moves[:, 3:] * [0, 0, 1]
        motion[pressed] *= [1 - slip, 1 - slip, 1 - slip / 2]
        return known_ate(integrate(motion), truth)

    corrected, drifts = correct_observations(OTHER_CREATES, observations), np.arange(-0.5, 0.5, 0.02)
    return {
        "odometry": error(),
        "odometry, turn scale fitted to the truth": min(error(turn=s) for s in np.arange(0.8, 1.3, 0.01)),
        "odometry, heading drift fitted to the truth": min(error(drift=d / 60) for d in drifts),
        "odometry without forward motion and half of the turn in pressed steps": error(slip=1.0),
        f"odometry, {OTHERS}": known_ate(_dead_reckoning(corrected), truth),
    }


def _pressed_steps(observations: list[Observation]) -> np.ndarray:
    """[T] bool, steps that begin in contact and drive forward."""
    touching = [False, *(each.contact.any() for each in observations[:-1])]
    return np.array([t and each.odometry.dx > 0 for t, each in zip(touching, observations, strict=True)])


def _dead_reckoning(observations: list[Observation]) -> np.ndarray:
    return integrate(np.array([each.odometry[:3] for each in observations]))


def _known(truth: np.ndarray) -> np.ndarray:
    return np.isfinite(truth).all(axis=1)


def _aligned(path: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return compose(align(path[_known(truth)], truth[_known(truth)]), path)


FIGURE = Figure("A real Create and its bumpers", _measure, _table, _draw)
