"""The figure of cue rotation: how far packet and cells turn with the cues in the middle of a session.

A rat walks at random in a box of 1 m; then cues turn round the middle of the box. What turns with them is
measured three ways: by the packet's heading, by its place, and by the preferred directions of cells.
Controls: no turn, and darkness instead of one.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from evaluation.cells.decoding import truth_in_sheet
from evaluation.cells.head_direction import preferred_direction
from evaluation.cells.rate_map import bin_activity, tuning_curves
from evaluation.cells.recording import CellRecording
from evaluation.papers.cells.panels import head_panel, panel_grid, shortest, spread_dots, torus_error
from evaluation.papers.cells.rat_sessions import RatSessions, rat_config, rat_source
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.plots import style
from tactile.base.se2 import wrap

RATE = 10.0
"""Steps and views per second."""
ANGLES = (0, 45, 90, 135, 180)
"""Turns of all cues, degrees counter-clockwise."""
CONFLICT = 90
"""Turn of the distal cues alone, degrees; the cards stay."""
CELLS = 512
"""Cells recorded, drawn from the whole network."""
LEAST = 0.01
"""Least activity of a cell, summed over the time of each part, s, for a preferred direction."""
USUAL = 3
"""Seeds: each is a walk and a draw of the noise of odometry, common to the turns."""
KINDS = {"heading": "packet heading", "place": "packet place", "cells": "cells"}
"""Fields of `_Rotation` with their labels."""
COLOURS = (style.BLUE, style.VERMILLION, style.GREEN)
"""Of the kinds."""
SHIFT = 5.0
"""Degrees between the dots of two kinds."""
DARK = {"dark": True}
"""Phase of the control in darkness."""
EDGES = np.array([0.0, 1.0])
"""Of the box, m."""
COLUMNS = (
    "cues",
    "turn deg",
    "heading of packet deg",
    "place of packet deg",
    "cells deg",
    "gain",
    "expected",
)


class Schedule(NamedTuple):
    """Times, s: the cues turn; the rotation is measured from `late` on; the session ends."""

    turn: float = 90.0
    late: float = 110.0
    end: float = 140.0


class _Condition(NamedTuple):
    """What happens at the turn.

    Attributes:
        name: of the cues that turn, or of the control. degrees: of the turn. phase: settings of the phase of
            the session; empty: none.
    """

    name: str
    degrees: int
    phase: Mapping[str, Any]

    @property
    def control(self) -> bool:
        """Whether no cue turns."""
        return self.degrees == 0


CONDITIONS = (
    _Condition("all", 0, {}),
    *(_Condition("all", each, {"rotate_cues_deg": each}) for each in ANGLES if each),
    _Condition("distal alone", CONFLICT, {"rotate_cues_deg": CONFLICT, "cues": "distal"}),
    _Condition("darkness", 0, DARK),
)


class _Rotation(NamedTuple):
    """Rotations in a session, rad counter-clockwise, of the late part against the part before the turn.

    Attributes:
        heading, place: of the packet's frame against the true pose. cells: of preferred directions, NaN if
            fewer than two cells were active in both parts. course: [T] of the packet's heading at each step.
    """

    heading: float
    place: float
    cells: float
    course: np.ndarray


class _RotationResult(NamedTuple):
    """The rotations of n seeds for each of `CONDITIONS`."""

    schedule: Schedule
    found: list[list[_Rotation]]

    def degrees(self, kind: str) -> np.ndarray:
        """[conditions, n] rotations of one kind, `heading`, `place` or `cells`, degrees."""
        return np.degrees([[getattr(each, kind) for each in seeds] for seeds in self.found])


def measure_rotation(task: Task, schedule: Schedule | None = None) -> _RotationResult:
    """The rotations of all conditions and seeds."""
    schedule = schedule or Schedule()
    sessions = RatSessions(
        rat_config(
            f"rat_simulation.rate_hz={RATE}",
            "rat_simulation.views.every=1",
            "rat_simulation.walk={}",
            "session.reserve=256",
            f"cells.chosen={CELLS}",
        )
    )
    found = []
    for condition in CONDITIONS:
        phases = [{"start": schedule.turn, **condition.phase}] if condition.phase else []
        sources = (
            rat_source(sessions.config, seed, seconds=schedule.end, phases=phases)
            for seed in task.seeds(USUAL)
        )
        turn = np.radians(condition.degrees)
        found.append([rotation_of(sessions.run(each), schedule, turn) for each in sources])
    return _RotationResult(schedule, found)


def rotation_of(recording: CellRecording, schedule: Schedule, turn: float) -> _Rotation:
    """The rotations in a session whose cues turn by `turn`, rad.

    Angles are known up to a whole turn; each is taken as the one nearest to half the turn of the cues.
    """
    time = recording.time
    before = (time >= schedule.turn / 2) & (time < schedule.turn)
    late = time >= schedule.late
    # A packet that follows cues turned by a reports headings lower by a.
    phase = np.exp(-1j * torus_error(recording)[:, 2])
    place = _place_phase(recording)
    cells = _preferred_turn(recording, time < schedule.turn, late)

    def angle(turned: complex) -> float:
        return float(turn / 2 + wrap(np.angle(turned) - turn / 2))

    base = phase[before].mean()
    course = turn / 2 + wrap(np.angle(phase * np.conj(base)) - turn / 2)
    return _Rotation(
        angle(phase[late].mean() * np.conj(base)),
        angle(place[late].mean() * np.conj(place[before].mean())),
        angle(cells) if np.isfinite(cells) else np.nan,
        course,
    )


def _table_rotation(result: _RotationResult) -> list[str]:
    """The lines of the table, and what it does not show."""
    kinds = [result.degrees(kind) for kind in KINDS]
    lines = [
        f"{len(result.found[0])} seeds: median (lowest to highest), from {result.schedule.late:g} s to"
        f" {result.schedule.end:g} s against {result.schedule.turn / 2:g} s to {result.schedule.turn:g} s;"
        f" cues turn at {result.schedule.turn:g} s. Gain: of the heading, 1 with the cues, 0 with odometry.",
        "",
        *markdown_header(COLUMNS).splitlines(),
    ]
    for k, condition in enumerate(CONDITIONS):
        gain = "-" if condition.control else _spread(kinds[0][k] / condition.degrees, 2)
        expected = "turn 0 (control)" if condition.control else "gain 1"
        if condition.name == "distal alone":
            expected = "gain from 0 (cards) to 1 (distal)"
        turned = [_spread(each[k], 0) for each in kinds]
        lines.append(markdown_row([condition.name, condition.degrees, *turned, gain, expected]))
    return [*lines, "", NOT_SHOWN]


NOT_SHOWN = (
    "Not shown: whether an animal would follow, which trusts cues by experience; here a matched view injects"
    " at its template and the packet may jump there, however large the conflict with odometry is."
)


def _draw_rotation(result: _RotationResult, png: Path) -> None:
    """Rotations against the turn of the cues, and the rotation of the packet's heading over time."""
    heading = result.degrees("heading")
    gains = [heading[k] / CONDITIONS[k].degrees for k in range(len(ANGLES)) if ANGLES[k]]
    line = f"Median gain over all turns and seeds {np.median(gains):.2f}; 1: with the cues, 0: with odometry."
    figure, axes = panel_grid("How far packet and cells follow turned cues", line, 1, 2, height=3.2)
    left, right = axes[0]
    together = slice(len(ANGLES))
    for number, (kind, label) in enumerate(KINDS.items()):
        values, shift = result.degrees(kind), SHIFT * (number - 1)
        turns = [each + shift for each in ANGLES]
        known = [each[np.isfinite(each)] for each in values[together]]
        middle = [np.median(each) if len(each) else np.nan for each in known]
        left.plot(turns, middle, "_", ms=12, mew=2, color=COLOURS[number], label=label)
        spread_dots(left, turns, values[together].tolist(), COLOURS[number])
    left.plot(ANGLES, ANGLES, "--", color=style.INK, lw=0.9, label="with the cues", zorder=1)
    left.plot(ANGLES, np.zeros(len(ANGLES)), ":", color=style.INK, lw=0.9, label="with odometry", zorder=1)
    left.set_xticks(ANGLES)
    head_panel(left, "all cues")
    style.name_axes(left, "turn of the cues (deg)", "rotation (deg)")
    _draw_courses(right, result)
    head_panel(right, "heading of the packet over time, median")
    style.name_axes(right, "time (s)", "rotation (deg)")
    style.add_legend(figure, left, columns=5)
    figure.savefig(png)


def _draw_courses(axes: style.Axes, result: _RotationResult) -> None:
    """Medians over the seeds, smoothed by a running median of a second."""
    marks = style.GREY, style.SKY, style.BLUE, style.GREEN, style.PURPLE, style.ORANGE, style.INK
    time = np.arange(len(result.found[0][0].course)) / RATE
    for condition, seeds, colour in zip(CONDITIONS, result.found, marks, strict=True):
        course = np.median([np.degrees(each.course) for each in seeds], axis=0)
        label = f"{condition.name} {condition.degrees}" if condition.phase != DARK else "darkness"
        axes.plot(time, median_filter(course, round(RATE)), color=colour, lw=1.3, label=label)
    axes.axvline(result.schedule.turn, color=style.LABEL_GREY, lw=0.8, ls="--")
    axes.set_yticks(ANGLES)
    axes.set_xlim(result.schedule.turn / 2, result.schedule.end)
    axes.legend(frameon=False, fontsize=8, labelcolor=style.INK, loc="upper left")


def _spread(values: np.ndarray, digits: int) -> str:
    """Median (lowest to highest) of the known values."""
    known = values[np.isfinite(values)]
    if not len(known):
        return "-"
    middle, low, high = (f"{each:.{digits}f}" for each in (np.median(known), known.min(), known.max()))
    return f"{middle} ({low} to {high})"


def _place_phase(recording: CellRecording) -> np.ndarray:
    """[T] complex products of the true place from the middle of the box with the packet's, conjugate; their
    mean has the angle by which the packet's frame is turned."""
    true = truth_in_sheet(recording)
    middle = np.full(2, EDGES.mean())
    heading = true[0, 2] - recording.truth[0, 2]
    c, s = np.cos(heading), np.sin(heading)
    centre = true[0, :2] + np.array([[c, -s], [s, c]]) @ (middle - recording.truth[0, :2])
    origin = np.array([*centre, 0.0])
    packet, there = shortest(recording, recording.packet_pose - origin), true - origin
    return (there[:, 0] + 1j * there[:, 1]) * np.conj(packet[:, 0] + 1j * packet[:, 1])


def _preferred_turn(recording: CellRecording, before: np.ndarray, late: np.ndarray) -> complex:
    """Mean over cells of exp(i turn of the preferred direction), NaN for fewer than two cells."""
    directions, active = [], np.ones(len(recording.cell), bool)
    for part in (before, late):
        rows = recording.time[part], recording.truth[part], recording.activity[part]
        sums = bin_activity(*rows, EDGES, EDGES)
        enough = sums.heading.sum(axis=1) >= LEAST
        curves = np.where(enough[:, None], tuning_curves(sums), 1.0)
        directions.append(preferred_direction(curves, sums.heading_seconds))
        active &= enough
    if active.sum() < 2:
        return complex(np.nan)
    return complex(np.exp(1j * (directions[1] - directions[0])[active]).mean())


FIGURE = Figure("How far cue rotation is followed", measure_rotation, _table_rotation, _draw_rotation)
