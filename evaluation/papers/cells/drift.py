"""The figure of drift: the packet's error by path integration alone, against the noise of odometry.

Rats walk at random in a box of 1 m without views; networks differ in the noise on their odometry alone. The
control is that odometry integrated without a network: the packet should add little to its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.papers.cells.figure import CellFigure, CellTask
from evaluation.papers.cells.packet_error import error_size
from evaluation.papers.cells.panel_grid import head_panel, panel_grid, spread_dots
from evaluation.papers.cells.rat_sessions import rat_config
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.plots import style
from evaluation.studies.study_course import StudyCourse, expected_poses, read_course
from ratslam.classic.batch import Network
from ratslam.classic.cell_batch import CellSets, walk
from ratslam.classic.pose_cell_config import rings, units
from ratslam.core.precision import prepare_precision
from tactile.base.se2 import integrate

RATE = 10.0
"""Steps per second."""
TIMES = (60, 300, 600)
"""Times at which errors are read, s."""
SPEED = (0.05, 0.1, 0.2, 0.4)
"""Levels of white noise of the speed, as a share of it over one second, sqrt(s); the heading is exact."""
HEADING = (0.01, 0.02, 0.05)
"""Levels of white noise of the heading, rad / sqrt(s); the speed is exact."""
USUAL = 5
"""Seeds: each is a path and a draw of the noise, common to all levels."""
LEAST = 0.1
"""Least upper end of the axes of errors, m and rad: smaller errors are those of the lattice of cells."""
COLOURS = (style.SKY, style.BLUE, style.VERMILLION)
"""Of the times."""
COLUMNS = (
    "noise", "after s", "packet m", "odometry m (control)", "packet - odometry m", "packet rad",
    "expected rad", "odometry rad (control)", "packet - odometry rad",
)  # fmt: skip


class Noise(NamedTuple):
    """Noise of odometry. speed: sqrt(s). heading: rad / sqrt(s)."""

    speed: float
    heading: float

    def __str__(self) -> str:
        if self.speed:
            return f"speed {self.speed:g} sqrt(s)"
        return f"heading {self.heading:g} rad / sqrt(s)" if self.heading else "none"


LEVELS = (Noise(0.0, 0.0), *(Noise(each, 0.0) for each in SPEED), *(Noise(0.0, each) for each in HEADING))
"""One block of networks."""


class DriftResult(NamedTuple):
    """Errors of n seeds at L levels of noise and at M times.

    Attributes:
        times: [M] s. packet, odometry: [n, L, M, 2] size of the error against the true pose, m and rad.
            added: [n, L, M, 2] of the packet against integrated odometry.
    """

    times: tuple[int, ...]
    packet: np.ndarray
    odometry: np.ndarray
    added: np.ndarray


def measure_drift(task: CellTask, times: tuple[int, ...] = TIMES) -> DriftResult:
    """The errors of all seeds after the given times, s."""
    prepare_precision("float64")
    found = [_errors_of(seed, times) for seed in task.seeds(USUAL)]
    return DriftResult(times, *(np.array(each) for each in zip(*found, strict=True)))


def rms(errors: np.ndarray) -> np.ndarray:
    """[L, M, 2] root mean square over the seeds of errors [n, L, M, 2]."""
    return np.sqrt((errors**2).mean(axis=0))


def table_drift(result: DriftResult) -> list[str]:
    """The lines of the table, and what it does not show."""
    packet, odometry, added = rms(result.packet), rms(result.odometry), rms(result.added)
    lines = [
        f"Root mean square over {len(result.packet)} seeds; a cell is 0.05 m and {np.radians(10):.2f} rad.",
        "Goal: the packet adds little to the error of odometry; heading: noise times the root of the time.",
        "",
        *markdown_header(COLUMNS).splitlines(),
    ]
    for k, level in enumerate(LEVELS):
        for j, time in enumerate(result.times):
            (m, rad), (m_o, rad_o), (m_a, rad_a) = packet[k, j], odometry[k, j], added[k, j]
            expected = level.heading * np.sqrt(time)
            cells = [m, m_o, m_a, rad, expected, rad_o, rad_a]
            lines.append(markdown_row([str(level), str(time), *(f"{each:.3f}" for each in cells)]))
    return [*lines, "", NOT_SHOWN]


NOT_SHOWN = (
    "Not shown: noise inside the network, which has none; the packet drifts because odometry does, and with a"
    " few seeds a root mean square is uncertain by a third."
)


def draw_drift(result: DriftResult, png: Path) -> None:
    """Errors of position and heading against the noise of speed and of heading."""
    most = float(result.added[..., 0].max()), float(result.added[..., 1].max())
    line = (
        f"Dots: {len(result.packet)} seeds, lines: root mean square. "
        f"The packet adds at most {most[0]:.3f} m, {most[1]:.3f} rad to odometry."
    )
    figure, axes = panel_grid("Path integration drift against noise of odometry", line, 2, 2)
    speed = [0, *range(1, 1 + len(SPEED))]
    heading = [0, *range(1 + len(SPEED), len(LEVELS))]
    columns = (
        (speed, [each.speed for each in LEVELS], "noise of the speed (sqrt(s))"),
        (heading, [each.heading for each in LEVELS], "noise of the heading (rad / sqrt(s))"),
    )
    for column, (rows, levels, across) in enumerate(columns):
        for quantity, up in enumerate(("error of position (m)", "error of heading (rad)")):
            panel = axes[quantity][column]
            _draw_curves(panel, result, rows, [levels[k] for k in rows], quantity)
            style.name_axes(panel, across, up)
    head_panel(axes[0][0], "heading exact")
    head_panel(axes[0][1], "speed exact")
    style.add_legend(figure, axes[0][0], columns=6)
    figure.savefig(png)


def _draw_curves(
    axes: style.Axes, result: DriftResult, rows: Sequence[int], levels: Sequence[float], quantity: int
) -> None:
    packet, odometry = rms(result.packet)[rows, :, quantity], rms(result.odometry)[rows, :, quantity]
    for j, time in enumerate(result.times):
        colour = COLOURS[j % len(COLOURS)]
        axes.plot(levels, packet[:, j], "-", color=colour, lw=1.6, label=f"packet after {time} s")
        axes.plot(levels, odometry[:, j], "--", color=style.INK, lw=0.9, zorder=3)
        spread_dots(axes, levels, result.packet[:, rows, j, quantity].T.tolist(), colour)
    axes.plot([], [], "--", color=style.INK, lw=0.9, label="odometry (control)")
    axes.set_ylim(0, max(axes.get_ylim()[1], LEAST))


def _errors_of(seed: int, times: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[L, M, 2] errors of packets, of odometry, and of packets against odometry."""
    study = _course(seed, times[-1])
    at = np.round(np.array(times) * RATE).astype(int)
    packets, odometry = _packets(study)[:, at], _odometry(study)[:, at]
    true = study.expected[at]
    unit = units(study.config, np.dtype(float))
    pairs = (packets, true), (odometry, true), (packets, odometry)
    packet, alone, added = (error_size((a - b) * unit) for a, b in pairs)
    return packet, alone, added


def _course(seed: int, seconds: int) -> StudyCourse:
    config = rat_config(
        f"rat_simulation.seconds={seconds + 1}",
        f"rat_simulation.rate_hz={RATE}",
        f"rat_simulation.seed={seed}",
        "rat_simulation.walk={}",
        "rat_simulation.odometry={speed_white: 0.0, heading_white: 0.0}",
        "rat_simulation.views.every=1000",
    )
    return read_course(config, round((seconds + 1) * RATE), False, 2, (0,), seed)


def _packets(study: StudyCourse) -> np.ndarray:
    """[L, T, 3] packets in cells, followed round the torus."""
    count, ring = len(LEVELS), rings(study.config, np.dtype(float))
    network = study.config.excite_sigma, study.config.inhibit_sigma, study.config.global_inhibition, 1.0
    speed, heading = np.array(LEVELS).T
    # `CellSets` scales the noise of a step; over a step the white noise of a second is larger.
    sets = CellSets(Network(*(np.full(count, each) for each in network)), speed * np.sqrt(RATE), heading)
    tracks = walk(study.config, sets, study.course, study.chosen)
    wrapped = np.concatenate([track.pose for track in tracks], axis=1)
    start = np.broadcast_to(ring // 2, (count, 1, 3))
    gone = np.diff(wrapped, axis=1, prepend=start)
    return start + np.cumsum(gone - ring * np.round(gone / ring), axis=1)


def _odometry(study: StudyCourse) -> np.ndarray:
    """[L, T, 3] poses in cells of the noisy odometry integrated without a network."""
    motion, noise = study.course.motion, study.course.noise
    poses = []
    for level in LEVELS:
        faster = 1 + level.speed * np.sqrt(RATE) * noise[:, :1]
        turn = motion[:, 2] + level.heading * noise[:, 1]
        poses.append(expected_poses(study.config, integrate(np.column_stack([motion[:, :2] * faster, turn]))))
    return np.array(poses)


FIGURE = CellFigure("Path integration drift against noise", measure_drift, table_drift, draw_drift)
