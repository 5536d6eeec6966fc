"""The pictures of a run, drawn from its directory alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evaluation.history import draw_history
from evaluation.images import read_images
from evaluation.mappicture import NO_CLOSURES, NO_WALLS, draw_map
from evaluation.run import Run
from evaluation.rundirectory import read_card, read_closures, read_run, read_walls
from evaluation.scorecard import Scorecard
from evaluation.whiskerpicture import draw_whiskers

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save_map(
    path: str | Path,
    run: Run,
    card: Scorecard,
    walls: np.ndarray = NO_WALLS,
    closures: np.ndarray = NO_CLOSURES,
) -> None:
    """Writes `evaluation.mappicture.draw_map` to a file; the same run gives the same bytes."""
    draw_map(run, card, walls, closures).savefig(path)


def pictures(directory: Path) -> dict[str, Callable[[Path], None]]:
    """What to call with a path to have each picture of a scored run drawn, by file name.

    `map.png` of every run; of one with whiskers also `whiskers.png` and `experiences.png`. The same directory
    gives the same bytes.

    Raises:
        InputError: naming the file that is missing or malformed.
    """
    run, card = read_run(directory), read_card(directory)
    walls, closures = read_walls(directory), read_closures(directory)
    drawn: dict[str, Callable[[], Figure]] = {"map.png": lambda: draw_map(run, card, walls, closures)}
    if (directory / "views.npz").exists():
        images = read_images(directory / "views.npz")
        drawn["whiskers.png"] = lambda: draw_whiskers(run, card, images, walls)
        drawn["experiences.png"] = lambda: draw_history(run, card)

    def saver(draw: Callable[[], Figure]) -> Callable[[Path], None]:
        return lambda path: draw().savefig(path)

    return {name: saver(draw) for name, draw in drawn.items()}


def redraw(directory: Path) -> None:
    """Draws the pictures of a scored run again, over the old ones.

    Raises:
        InputError: naming the file that is missing or malformed.
    """
    for name, save in pictures(directory).items():
        save(directory / name)
