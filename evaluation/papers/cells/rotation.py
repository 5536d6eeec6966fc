"""The figure of cue rotation: how far packet and cells turn with the cues in the middle of a session.

A rat walks at random in a box of 1 m; then cues turn round the middle of the box. What turns with them is
measured three ways: by the packet's heading, by its place, and by the preferred directions of cells.
Controls: no turn, and darkness instead of one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from evaluation.cells.decoding import truth_in_sheet
from evaluation.cells.head_direction import preferred_direction
from evaluation.cells.rate_map import bin_activity, tuning_curves
from evaluation.cells.recording import CellRecording
from evaluation.papers.cells.panels import name_panel, panel_grid, shortest, spread_dots, torus_error
from evaluation.papers.cells.rat_sessions import RatSessions, rat_config
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import table_lines
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
KINDS = ("packet heading", "packet place", "cells")
"""What turns: the packet's frame against the true pose, and preferred directions."""
COLOURS = (style.BLUE, style.VERMILLION, style.GREEN)
"""Of the kinds."""
SHIFT = 5.0
"""Degrees between the dots of two kinds."""
DARK = {"dark": True}
"""Phase of the control in darkness."""
EDGES = np.array([0.0, 1.0])
"""Of the box, m."""
COLUMNS = (
    "cues", "turn deg", "heading of packet deg", "place of packet deg", "cells deg", "gain", "expected",
)  # fmt: skip


SCHEDULE = (90.0, 110.0, 140.0)
"""Times, s: the cues turn; the rotation is measured from then on; the session ends."""
_Schedule = tuple[float, float, float]
CONDITIONS: Sequence[tuple[str, int, Mapping[str, Any]]] = (
    ("all", 0, {}),
    *(("all", each, {"rotate_cues_deg": each}) for each in ANGLES if each),
    ("distal alone", CONFLICT, {"rotate_cues_deg": CONFLICT, "cues": "distal"}),
    ("darkness", 0, DARK),
)
"""The cues that turn, or the control; by how many degrees (0: a control); settings of the phase of the
session, if any."""
_Rotations = tuple[_Schedule, np.ndarray, np.ndarray]
"""Of C conditions and n seeds, degrees: [3, C, n] rotation of each of `KINDS`, [C, n, T] that of the packet's
heading at each step."""


def measure_rotation(task: Task, schedule: _Schedule = SCHEDULE) -> _Rotations:
    """The rotations of all conditions and seeds."""
    turned_at, _, end = schedule
    rat = f"rat_simulation.rate_hz={RATE}", "rat_simulation.views.every=1", "rat_simulation.walk={}"
    sessions = RatSessions(rat_config(*rat, "session.reserve=256", f"cells.chosen={CELLS}"))
    found, courses = [], []
    for _, degrees, phase in CONDITIONS:
        phases = [{"start": turned_at, **phase}] if phase else []
        sources = (sessions.rat(seed, seconds=end, phases=phases) for seed in task.seeds(USUAL))
        turns, course = zip(
            *(rotation_of(sessions.run(each), schedule, np.radians(degrees)) for each in sources), strict=True
        )
        found.append(turns)
        courses.append(course)
    return schedule, np.degrees(np.moveaxis(np.array(found), 2, 0)), np.degrees(courses)


def rotation_of(
    recording: CellRecording, schedule: _Schedule, turn: float
) -> tuple[tuple[float, float, float], np.ndarray]:
    """The rotations (`KINDS`) in a session whose cues turn by `turn`, rad counter-clockwise, of the late part
    against the part before; and [T] that of the packet's heading at each step.

    Angles are known up to a whole turn; each is taken as the one nearest to half the turn of the cues. That
    of cells is NaN if fewer than two were active in both parts.
    """
    time, (turned_at, late_from, _) = recording.time, schedule
    before = (time >= turned_at / 2) & (time < turned_at)
    late = time >= late_from
    # A packet that follows cues turned by a reports headings lower by a.
    phase = np.exp(-1j * torus_error(recording)[:, 2])
    place = _place_phase(recording)
    cells = _preferred_turn(recording, time < turned_at, late)

    def angle(turned: complex) -> float:
        return float(turn / 2 + wrap(np.angle(turned) - turn / 2))

    base = phase[before].mean()
    course = turn / 2 + wrap(np.angle(phase * np.conj(base)) - turn / 2)
    heading = angle(phase[late].mean() * np.conj(base))
    where = angle(place[late].mean() * np.conj(place[before].mean()))
    return (heading, where, angle(cells) if np.isfinite(cells) else np.nan), course


def _table_rotation(result: _Rotations) -> list[str]:
    (turned_at, late, end), kinds, _ = result
    above = (
        f"{kinds.shape[2]} seeds: median (lowest to highest), from {late:g} s to"
        f" {end:g} s against {turned_at / 2:g} s to {turned_at:g} s;"
        f" cues turn at {turned_at:g} s. Gain: of the heading, 1 with the cues, 0 with odometry."
    )
    rows = []
    for k, (name, degrees, _) in enumerate(CONDITIONS):
        gain = _spread(kinds[0][k] / degrees, 2) if degrees else "-"
        expected = "gain 1" if degrees else "turn 0 (control)"
        if name == "distal alone":
            expected = "gain from 0 (cards) to 1 (distal)"
        rows.append([name, degrees, *(_spread(each[k], 0) for each in kinds), gain, expected])
    below = (
        "Not shown: whether an animal would follow, which trusts cues by experience; here a matched view"
        " injects at its template and the packet may jump there, however large the conflict with odometry is."
    )
    return table_lines([above], COLUMNS, rows, [below])


def _draw_rotation(result: _Rotations, png: Path) -> None:
    """Rotations against the turn of the cues, and that of the packet's heading over time: medians over the
    seeds, smoothed by a running median of a second."""
    (turned_at, _, end), kinds, courses = result
    gains = [kinds[0][k] / ANGLES[k] for k in range(len(ANGLES)) if ANGLES[k]]
    line = f"Median gain over all turns and seeds {np.median(gains):.2f}; 1: with the cues, 0: with odometry."
    figure, ((left, right),) = panel_grid(
        "How far packet and cells follow turned cues", line, 1, 2, height=3.2
    )
    for number, (label, values) in enumerate(zip(KINDS, kinds[:, : len(ANGLES)], strict=True)):
        turns = [each + SHIFT * (number - 1) for each in ANGLES]
        known = [each[np.isfinite(each)] for each in values]
        middle = [np.median(each) if len(each) else np.nan for each in known]
        left.plot(turns, middle, "_", ms=12, mew=2, color=COLOURS[number], label=label)
        spread_dots(left, turns, values.tolist(), COLOURS[number])
    left.plot(ANGLES, ANGLES, "--", color=style.INK, lw=0.9, label="with the cues", zorder=1)
    left.plot(ANGLES, np.zeros(len(ANGLES)), ":", color=style.INK, lw=0.9, label="with odometry", zorder=1)
    left.set_xticks(ANGLES)
    name_panel(left, "all cues", "turn of the cues (deg)", "rotation (deg)")
    marks = style.GREY, style.SKY, style.BLUE, style.GREEN, style.PURPLE, style.ORANGE, style.INK
    time = np.arange(courses.shape[2]) / RATE
    for (name, degrees, phase), seeds, colour in zip(CONDITIONS, courses, marks, strict=True):
        course = median_filter(np.median(seeds, axis=0), round(RATE))
        label = f"{name} {degrees}" if phase != DARK else "darkness"
        right.plot(time, course, color=colour, lw=1.3, label=label)
    right.axvline(turned_at, color=style.LABEL_GREY, lw=0.8, ls="--")
    right.set_yticks(ANGLES)
    right.set_xlim(turned_at / 2, end)
    right.legend(frameon=False, fontsize=8, labelcolor=style.INK, loc="upper left")
    name_panel(right, "heading of the packet over time, median", "time (s)", "rotation (deg)")
    style.add_legend(figure, left, columns=5).savefig(png)


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
