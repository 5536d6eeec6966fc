"""The command path."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from ratslam.cli.common import Commands, prepare_jax
from tactile.base.errors import InputError

NO_WAY = 1
"""Exit code where no way joins start and goal."""


def add_commands(commands: Commands) -> None:
    """Registers the commands of this module."""
    path = commands.add(
        "path", _path, "find the way on a saved map", "path runs/maze --from here --to 0.5,0.2", "maps"
    )
    path.add_argument("map", type=Path, metavar="MAP", help="run directory, or its map.npz")
    path.add_argument(
        "--from", dest="start", default="here", metavar="X,Y|EXPERIENCE|here",
        help="start: a point of the map, m, an experience, or the map's last pose (default)",
    )  # fmt: skip
    path.add_argument(
        "--to",
        dest="goal",
        required=True,
        metavar="X,Y|EXPERIENCE",
        help="goal: a point, m, or an experience",
    )
    path.add_argument(
        "--mode", choices=("time", "temporal"), default="time",
        help="least expected time (default), or RatSLAM's goal temporal map",
    )  # fmt: skip
    path.add_argument("-o", "--output", type=Path, metavar="PNG", help="draw the way")
    path.add_argument("--json", action="store_true", help="print JSON")


def _path(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from ratslam.atlas.route import NoWay
    from ratslam.pipeline.map_way import draw_map_way, find_map_way
    from ratslam.pipeline.saved_map import read_map

    saved = read_map(arguments.map, lambda line: print(f"ratslam: {line}", file=sys.stderr))
    made = saved.open_session().map
    start = None if arguments.start == "here" else _place(arguments.start, "--from")
    try:
        way = find_map_way(made, saved, start, _place(arguments.goal, "--to"), arguments.mode)
    except NoWay as error:
        print(f"ratslam: no way: {error}", file=sys.stderr)
        return NO_WAY
    if arguments.output is not None:
        draw_map_way(arguments.output, made, saved, way)
    content = way._asdict() | {"poses": way.poses.tolist()}
    if arguments.json:
        print(json.dumps(content))
        return 0
    places = way.experiences
    print(
        f"{len(places)} experiences from {places[0]} to {places[-1]}: {way.length:.2f} m, {way.seconds:.0f} s"
    )
    print(f"expected {way.expected:.0f} s by the number of traversals of each link")
    return 0


def _place(text: str, where: str) -> tuple[float, float] | int:
    """A point x, y (m) or the number of an experience."""
    try:
        if "," not in text:
            return int(text)
        x, y = map(float, text.split(","))
    except ValueError:
        raise InputError(where, repr(text), "X,Y in m, or the number of an experience") from None
    return x, y
