"""The geometry of a whisker head from a record with arm poses, in a maze or beside a post."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ratslam.config.run_config import RunConfig
from ratslam.fit.rig import Quantity, Rig
from robot.sources.source import Sample
from robot.sources.source_info import SourceInfo
from robot.world.maze import parse_maze, wall_boxes
from robot.world.walls import Surroundings, Walls
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.fit.head import HeadFit, fit_head, head_with
from tactile.frontend import Frontend
from tactile.whiskers.head_geometry import HeadConfig, ur10_head

DELAY = (
    "head: the rest angle holds the delay of contact detection, which no contact tells apart from it "
    "(0.9 degrees for 15 mrad)"
)

STEEPEST_REST = 90.0
"""Largest rest angle of a head, degrees."""


def fit_head_of(config: RunConfig, samples: list[Sample], info: SourceInfo) -> Rig:
    """Rest angle and base radii of the head.

    Args:
        config: completed for the source.
    """
    rows = [sample for sample in samples if sample.truth is not None]
    if info.maze is None or not rows:
        lacking = "walls or posts of known place" if info.maze is None else "arm poses"
        return Rig(unknown=(f"rest angle, base radii: the record has no {lacking}",))
    assumed = config.touch.head
    frontend = Frontend(config.touch, info.calibration)
    whisks = [frontend.features(sample.reading) for sample in rows]
    walls = walls_of(info)
    pose = np.array([sample.truth for sample in rows])

    def predict(head: HeadConfig) -> np.ndarray:
        return Surroundings(walls, ur10_head(head)).contact(pose).angle

    contact, angle = (np.array([getattr(whisk, name) for whisk in whisks]) for name in ("contact", "touched"))
    try:
        fit = fit_head(assumed, contact, angle, predict)
    except InputError as error:
        return Rig(unknown=(f"rest angle, base radii: {error.found}; {error.expected} are needed",))
    return head_rig(assumed, fit)


def walls_of(info: SourceInfo) -> Walls:
    """The walls of the maze of a source."""
    assert info.maze is not None
    maze = parse_maze(info.maze.text, Path("maze of the recording"))
    return wall_boxes(maze, stream(info.maze.seed, "maze.heights"), info.maze.heights)


def head_rig(assumed: HeadConfig, fit: HeadFit) -> Rig:
    """The geometry as a rig; rings whose radius is unknown keep theirs."""
    rest, sd = min(fit.rest_deg[0], STEEPEST_REST), fit.rest_deg[1]
    quantities = [Quantity("rest angle", assumed.rest_deg, rest, sd, "degrees", "touch.head.rest_deg")]
    unknown, radii = [], []
    for number, (ring, radius) in enumerate(zip(assumed.rings, fit.radius, strict=True)):
        radii.append(ring.radius if radius is None else radius[0])
        if radius is None:
            unknown.append(f"radius of ring {number}: too few of its contacts are against edges")
        else:
            quantities.append(Quantity(f"radius of ring {number}", ring.radius, *radius, "m"))
    found = head_with(assumed, np.array([rest, *radii]))
    rings = [{key: float(f"{value:.6g}") for key, value in ring.model_dump().items()} for ring in found.rings]
    note = (
        f"head: {fit.contacts} contacts; their protractions err by {1e3 * fit.error[0]:.1f} mrad, "
        f"{1e3 * fit.error[1]:.1f} with the head assumed; the radii are set in touch.head.rings"
    )
    settings = {"touch": {"head": {"rings": rings}}}
    return Rig(tuple(quantities), settings, (note, DELAY), tuple(unknown))
