"""Phases of a session: darkness, turned cues, kidnaps, stretched and other boxes, row by row."""

from __future__ import annotations

from typing import Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from robot.simulation.rat.box import BoxConfig
from tactile.base.errors import InputError
from tactile.base.settings import Settings

KEY = "rat_simulation.phases"
NEAR = 0.1
"""Largest distance of a kidnapped rat from the place that was asked for, m."""
Stretch = tuple[PositiveFloat, PositiveFloat]


class PhaseConfig(Settings):
    """What differs in an interval of a session. Phases may overlap: turns of cues add up."""

    start: NonNegativeFloat
    """First time, s."""
    end: PositiveFloat | None = None
    """Time of the first row after it, s; null: it lasts to the end of the session."""
    dark: bool = False
    """Views are masked."""
    rotate_cues_deg: float = 0.0
    """Turn of cues around the middle of the box, degrees counter-clockwise."""
    cues: Literal["all", "local", "distal"] = "all"
    """Cues that turn: cards on the walls are local, those outside the box distal. Two phases that turn them
    differently are a cue conflict."""
    kidnap: tuple[float, float] | None = None
    """Where the rat is set down at the start, m. It goes on along its path from the time that passes nearest,
    with the heading it has there. Odometry does not tell."""
    stretch: Stretch | None = None
    """Factors of the width and height of the box, with its cards and the path. Odometry is of the way run;
    the jump to the stretched place is not in it."""
    box: BoxConfig | None = Field(default=None)
    """Another box. The path is scaled to its size, as by `stretch`."""

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end: {self.end:g} s is not after the start, {self.start:g} s")
        lasting = self.dark or self.rotate_cues_deg or self.stretch or self.box
        if not lasting and self.kidnap is None:
            raise ValueError("a phase without dark, rotate_cues_deg, kidnap, stretch or box changes nothing")
        if not lasting and self.end is not None:
            raise ValueError("end: a kidnap is at the start of its phase and has no end")
        if self.cues != "all" and not self.rotate_cues_deg:
            raise ValueError("cues: no rotate_cues_deg by which they turn")
        if self.stretch and self.box:
            raise ValueError("stretch: a phase with another box; give that the size you want")
        return self


class Timeline(NamedTuple):
    """The N rows of a session.

    Attributes:
        source: [N] rows of the path. scale: [N, 2] factors of its positions. box: [N] number of the box, 0
            for the first. stretch: [N, 2] factors of that box. dark: [N] bool. card_turn, distal_turn:
            [N] rad.
    """

    source: np.ndarray
    scale: np.ndarray
    box: np.ndarray
    stretch: np.ndarray
    dark: np.ndarray
    card_turn: np.ndarray
    distal_turn: np.ndarray


def lay_out_phases(
    phases: tuple[PhaseConfig, ...], box: BoxConfig, position: np.ndarray, rows: int, rate_hz: float
) -> Timeline:
    """The rows of a session with phases.

    Args:
        position: [L, 2] of the path, m, at the session's rate; L >= `rows`.

    Raises:
        InputError: a phase begins after the session, two of them change the box at once, or the path does
            not pass where a kidnapped rat is set down.
    """
    timeline = Timeline(
        source=np.arange(rows),
        scale=np.ones((rows, 2)),
        box=np.zeros(rows, np.int64),
        stretch=np.ones((rows, 2)),
        dark=np.zeros(rows, bool),
        card_turn=np.zeros(rows),
        distal_turn=np.zeros(rows),
    )
    changed, swaps = np.zeros(rows, bool), 0
    for number, phase in enumerate(phases):
        first = _first_row(phase.start, rate_hz)
        if first >= rows:
            found, expected = f"{phase.start:g} s", f"a time within the session of {rows / rate_hz:g} s"
            raise InputError(f"{KEY}.{number}.start", found, expected)
        part = slice(first, rows if phase.end is None else min(_first_row(phase.end, rate_hz), rows))
        timeline.dark[part] |= phase.dark
        turn = np.radians(phase.rotate_cues_deg)
        timeline.card_turn[part] += turn * (phase.cues != "distal")
        timeline.distal_turn[part] += turn * (phase.cues != "local")
        if phase.stretch is None and phase.box is None:
            continue
        if changed[part].any():
            found, cure = "the box is changed by an earlier phase too", "let that one end before"
            raise InputError(f"{KEY}.{number}.start", found, "one box at a time", cure)
        changed[part] = True
        if phase.box is not None:
            swaps += 1
            timeline.box[part] = swaps
            timeline.scale[part] = [phase.box.width / box.width, phase.box.height / box.height]
        else:
            timeline.scale[part] = timeline.stretch[part] = phase.stretch
    _kidnap(phases, timeline, position, rate_hz)
    return timeline


def _first_row(time: float, rate_hz: float) -> int:
    return int(np.ceil(time * rate_hz - 1e-6))


def _kidnap(
    phases: tuple[PhaseConfig, ...], timeline: Timeline, position: np.ndarray, rate_hz: float
) -> None:
    """Moves the rows of the path from each kidnap on, in the order of their times."""
    rows = len(timeline.source)
    kidnaps = [(p.start, p.kidnap, f"{KEY}.{k}.kidnap") for k, p in enumerate(phases) if p.kidnap is not None]
    for start, place, key in sorted(kidnaps):
        row = _first_row(start, rate_hz)
        left = rows - row
        there = position[: len(position) - left + 1] * timeline.scale[row]
        distance = np.hypot(*(there - np.asarray(place)).T)
        nearest = int(distance.argmin())
        if distance[nearest] > NEAR:
            found = f"the path comes no nearer to ({place[0]:g}, {place[1]:g}) than {distance[nearest]:.2g} m"
            expected = f"{NEAR:g} m, with {left / rate_hz:g} s of the path left"
            raise InputError(key, found, expected, "set it down where it has been, or give a longer path")
        timeline.source[row:] = nearest + np.arange(left)
