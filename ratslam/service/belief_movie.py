"""An animation (GIF) of a belief: the packets that compete on the map, and how certain they are.

`BeliefMovie` is an observer of a run that keeps the frames, `write_movie` draws them with the Pillow that
matplotlib needs anyway. No video program is needed, and a page or a notebook shows the file as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evaluation.plots import style
from ratslam.core.estimates import PoseCellActivity
from ratslam.runs.runner import MapReport, RunDescription
from tactile.base.errors import InputError
from tactile.base.files import make_new_file

MOST, RATE = 60, 6
"""Most frames of an animation, evenly spread over all; frames per second."""
DPI = 65
LEAST = 0.02
"""Smallest mass of a packet that is drawn."""
ROOM = 0.08
"""Free around the packets, share of the longer side."""


class Frame(NamedTuple):
    """A moment. time: s. pose: [3] of the map, m, m, rad. packets: [n, 4] pose and mass, heaviest first.
    novelty: what is missing to 1."""

    time: float
    pose: np.ndarray
    packets: np.ndarray
    novelty: float


def frame_of(time: float, pose: np.ndarray, activity: PoseCellActivity | None) -> Frame:
    """The frame of the activity of pose cells.

    Raises:
        InputError: it is no posterior.
    """
    if activity is None or activity.packets is None:
        raise InputError("movie", "a method whose pose cells hold no belief", "`backend: recall`")
    return Frame(time, pose, activity.packets, max(0.0, 1.0 - float(activity.heading.sum())))


class BeliefMovie:
    """An observer of a run of `backend: recall`; `frames` has one for each chunk of steps.

    Args:
        path: of the GIF that `write_movie` will make. backend: of the run.

    Raises:
        InputError: the path is no .gif, or the method has no belief.
    """

    def __init__(self, path: Path, backend: str) -> None:
        if path.suffix.lower() != ".gif":
            raise InputError("--movie", str(path), "a new file whose name ends with .gif")
        if backend != "recall":
            raise InputError(
                "--movie", f"`backend: {backend}`, whose cells hold no belief", "`backend: recall`"
            )
        self.frames: list[Frame] = []

    def __call__(self, message: Any) -> None:
        if isinstance(message, RunDescription | MapReport):
            return
        steps, map = message
        if map is not None:
            self.frames.append(frame_of(steps[-1].time, steps[-1].pose, map.activity))


def write_movie(path: Path, title: str, frames: Sequence[Frame]) -> None:
    """Draws frames into a new GIF.

    Raises:
        InputError: there are no frames, or the file cannot be new.
    """
    from matplotlib.animation import PillowWriter

    if not frames:
        raise InputError(str(path), "no frame", "a run of 16 steps or more")
    shown = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, MOST).astype(int))]
    figure, draw = _moving_figure(title, frames)
    writer = PillowWriter(fps=RATE)

    def write(file: Path) -> None:
        writer.setup(figure, str(file), DPI)
        for frame in shown:
            draw(frame)
            writer.grab_frame()
        writer.finish()

    make_new_file(path, write)


def _moving_figure(title: str, frames: Sequence[Frame]) -> tuple[style.Figure, Any]:
    """A figure of all frames, and a function that draws one of them into it."""
    places = np.concatenate([each.packets[each.packets[:, 3] > LEAST, :2] for each in frames])
    poses = np.array([each.pose for each in frames])
    box = style.frame(places if len(places) else poses[:, :2])
    box += ROOM * np.max(box[1] - box[0]) * np.array([[-1], [1]])
    time = np.array([each.time for each in frames]) - frames[0].time
    heaviest, second = (
        np.array([each.packets[k, 3] if len(each.packets) > k else 0.0 for each in frames]) for k in (0, 1)
    )
    line = "left: packets on the map, larger for more probability; right: over time"
    figure = style.new_figure(4.6, title, line)
    axes = style.add_axes(figure, 0.62, 0.85, 3.0, 2.75)
    axes.set(xlim=box[:, 0], ylim=box[:, 1], aspect="equal")
    style.metre_grid(axes)
    (way,) = axes.plot([], [], color=style.GREY, lw=0.8)
    course = style.add_axes(figure, 4.35, 0.85, 3.4, 2.75)
    novelty = [each.novelty for each in frames]
    for values, name, colour in (
        (heaviest, "heaviest packet", style.BLUE),
        (second, "packet that competes", style.ORANGE),
        (novelty, "novelty", style.GREY),
    ):
        course.plot(time, values, color=colour, lw=1.1, label=name)
    course.set_ylim(-0.02, 1.02)
    style.name_axes(course, "time (s)", "probability")
    style.add_legend(figure, course, columns=3)
    now = course.axvline(0.0, color=style.INK, lw=0.8)
    drawn: list[Any] = []

    def draw(frame: Frame) -> None:
        while drawn:
            drawn.pop().remove()
        until = frame.time - frames[0].time
        way.set_data(*poses[time <= until, :2].T)
        now.set_xdata([until, until])
        for x, y, heading, mass in frame.packets[frame.packets[:, 3] > LEAST].tolist():
            colour = style.BLUE if mass == frame.packets[0, 3] else style.ORANGE
            drawn.append(axes.scatter([x], [y], s=900 * mass, color=colour, alpha=0.55, lw=0, zorder=3))
            tip = 0.05 * np.max(box[1] - box[0])
            drawn.extend(axes.plot(
                [x, x + tip * np.cos(heading)], [y, y + tip * np.sin(heading)], color=colour, lw=1.5, zorder=4
            ))  # fmt: skip

    return figure, draw
