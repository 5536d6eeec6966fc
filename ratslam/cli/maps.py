"""The commands on saved maps: map (info, diff, undo, crop), localise, merge and path."""

from __future__ import annotations

import argparse
import json
import math
import sys
from functools import partial
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

from ratslam.cli.common import INTERRUPTED, CommandParser, Commands, add_set, prepare_jax
from ratslam.cli.run import add_rerun, open_target
from tactile.base.errors import InputError, tell
from tactile.base.files import require_new_file

if TYPE_CHECKING:
    from ratslam.runs.saved_map import SavedMap


def add_map(commands: Commands) -> None:
    """Registers `map` with its commands."""
    help = "show, compare, crop or correct saved maps"
    kinds = Commands(commands.add("map", None, help, "map info runs/square", "maps"))
    info = kinds.add("info", _info, "say what is in a map", "map info runs/square")
    _add_map(info)
    info.add_flag("--json", "print JSON")
    diff = kinds.add("diff", _diff, "say what differs between two maps", "map diff runs/square runs/again")
    _add_map(diff)
    diff.add_path("other", "MAP", "the map to compare with it")
    diff.add_flag("--json", "print JSON")
    undo = kinds.add(
        "undo", _undo, "remove a closure sequence from a map", "map undo runs/square 0 -o runs/undone.npz"
    )
    _add_map(undo)
    undo.add_argument(
        "sequence", type=int, metavar="SEQUENCE", help="its number, as `map info --json` and closures.csv say"
    )
    undo.add_path("-o", "MAP", "the new map file (default: replaces the map file)")
    crop = kinds.add(
        "crop", _crop, "cut out a part of a map", "map crop runs/square --box 0,0,2,1 -o runs/part.npz"
    )
    _add_map(crop)
    part = crop.add_mutually_exclusive_group(required=True)
    part.add_argument("--box", metavar="X0,Y0,X1,Y1", help="keyframes in this box, m, such as -1,-0.5,2,1")
    part.add_argument(
        "--steps", metavar="A:B", help="keyframes of the steps A to B - 1, from 0; either may be left out"
    )
    part.add_argument(
        "--piece", type=int, metavar="K", help="a piece, which nothing joins to the others, from 0"
    )
    crop.add_path("-o", "MAP", "the new map file", required=True)


def _add_map(parser: CommandParser) -> None:
    parser.add_path("map", "MAP", "a run directory or a map file")


def _read(path: Path) -> SavedMap:
    prepare_jax()
    from ratslam.runs.saved_map import read_map

    return read_map(path, tell)


def _info(arguments: argparse.Namespace) -> None:
    saved = _read(arguments.map)
    from ratslam.runs.map_care import map_info

    info = map_info(saved)
    if arguments.json:
        print(json.dumps(info, indent=2))
        return
    box = "{:.2f}, {:.2f} to {:.2f}, {:.2f} m".format(*info["box_m"]) if info["box_m"] else "empty"
    lines = [
        f"map         {info['path']}, {info['format']}, sha256 {info['digest'][:12]}",
        f"method      {info['backend']}, settings {info['settings_sha256'][:12]}",
        f"sensor      {info['sensor']}",
        f"recording   {info['source']}" + (f", sha256 {info['recording'][:12]}" if info["recording"] else ""),
        f"steps       {info['steps']}; experiences {info['experiences']}; pieces {info['pieces']}",
        f"extent      {box}",
    ]
    if "keyframes" in info:
        accepted, undone = len(info["accepted_sequences"]), info["sequences_undone"]
        calibration = (*info["heading_bias_rad_per_m"], *info["turn_error_rad_per_rad"])
        lines += [
            f"keyframes   {info['keyframes']}, {info['keyframes_not_merged']} not merged",
            f"closures    {info['closures']}, in {accepted} accepted of {info['sequences']} sequences"
            f" ({undone} undone)",
            "calibration heading bias {:.4f} ± {:.4f} rad/m, turn error {:.4f} ± {:.4f} rad/rad".format(
                *calibration
            )
            if accepted
            else "calibration none learned, for want of a closure",
        ]
    else:
        lines.append(f"closures    {info['closures']}")
    if info["doubt"] is not None:
        lines.append(f"doubt       {info['doubt']:.2f}, probability that the map is worse than odometry")
    elif info["unjudged"]:
        lines.append(f"doubt       none: {info['unjudged']}")
    print("\n".join(lines))


def _diff(arguments: argparse.Namespace) -> None:
    first, second = _read(arguments.map), _read(arguments.other)
    from ratslam.runs.map_care import map_difference

    found = map_difference(first, second)
    if arguments.json:
        print(json.dumps(found, indent=2))
        return
    if found["same"]:
        print("the same map")
        return
    lines = [
        "steps     {} and {}".format(*found["steps"]),
        "places    {common} in both, {removed} only in the first, {added} only in the second".format(**found),
        "closures  {closures_common} in both, {closures_removed} only in the first, "
        "{closures_added} only in the second".format(**found),
    ]
    if found["moved_max"] is not None:
        turned_max, turned_rms = degrees(found["turned_max"]), degrees(found["turned_rms"])
        lines.append(
            f"moved     at most {found['moved_max']:.3g} m and {turned_max:.3g} degrees, "
            f"RMS {found['moved_rms']:.3g} m and {turned_rms:.3g} degrees"
        )
    lines.append(f"sensor    {found['sensor'] or 'the same'}")
    lines += [f"setting   {key}: {one!r} and {other!r}" for key, (one, other) in found["settings"].items()]
    print("\n".join(lines))


def _undo(arguments: argparse.Namespace) -> None:
    output: Path | None = arguments.output
    prepare_jax()
    from ratslam.runs.map_care import replaced_file, undo_sequence
    from tactile.base.files import finish_change

    if output is None:
        output = arguments.map = replaced_file(arguments.map)
        finished = finish_change(output.parent)
        if finished is not None:
            print(f"{output.parent}: the undo of sequence {finished}, which had been cut off, is complete")
        if finished == str(arguments.sequence):
            return
    rewritten = undo_sequence(_read(arguments.map), arguments.sequence, output)
    print(f"{output}: the map without sequence {arguments.sequence}")
    if rewritten:
        print(f"{output.parent}: trajectory, graph, closures and map.png follow it")


def _crop(arguments: argparse.Namespace) -> None:
    prepare_jax()
    from ratslam.places.crop import keyframes_in_box, keyframes_of_piece, keyframes_of_steps
    from ratslam.runs.map_care import Choose, crop_saved

    box, steps = arguments.box, arguments.steps
    choose: Choose = partial(keyframes_of_piece, piece=arguments.piece)
    if box is not None:
        try:
            x0, y0, x1, y1 = (float(part) for part in box.split(","))
        except ValueError:
            raise InputError("--box", repr(box), "four numbers X0,Y0,X1,Y1, m") from None
        if not (x0 < x1 and y0 < y1):  # nor with NaN
            raise InputError("--box", repr(box), "X0 < X1 and Y0 < Y1, m")
        choose = partial(keyframes_in_box, box=(x0, y0, x1, y1))
    if steps is not None:
        first, colon, last = steps.partition(":")
        if not colon or not all(part.isdecimal() or not part for part in (first, last)):
            raise InputError("--steps", repr(steps), "A:B with whole numbers from 0")
        choose = partial(keyframes_of_steps, first=int(first or 0), last=int(last or sys.maxsize))
    saved = _read(arguments.map)
    count = crop_saved(saved, choose, arguments.output)
    print(f"{arguments.output}: {count} of {saved.steps} steps")


CONFIGURATIONS = (".yaml", ".yml", "")
"""Suffixes of a configuration or its name; other files, and folders, are recordings."""


def add_localise(commands: Commands) -> None:
    """Registers the command."""
    localise = commands.add(
        "localise", _localise, "find a recording's poses in a saved map",
        "localise runs/whisker_maze another_day.yaml -o runs/found", "maps",
    )  # fmt: skip
    localise.add_path("map", "MAP", "a run directory or its map.npz")
    localise.add_path(
        "recording", "RECORDING",
        "configuration with the recording or simulation to localise, or a recording of the map's sensor "
        "(the method and its settings are those of the map)",
    )  # fmt: skip
    add_set(localise)
    localise.add_path("-o", "DIR", "new run directory (default runs/RECORDING_in_MAP)")
    add_rerun(localise)


def _localise(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from evaluation.report.verdict import summarise
    from ratslam.runs.localise import check_assignments, localise, recorded_alike
    from ratslam.runs.settings.run_config import load_config
    from ratslam.service.viewer_link import open_viewer

    target, saved = open_target(arguments), _read(arguments.map)
    file: Path = arguments.recording
    if file.suffix in CONFIGURATIONS and not file.is_dir():
        config = load_config(file, arguments.set)
    else:
        config = recorded_alike(file, saved, arguments.set)
    check_assignments(arguments.set, saved)
    place = arguments.map.name.removesuffix(".npz") or "map"
    directory = arguments.output or Path("runs") / f"{arguments.recording.stem}_in_{place}"
    with open_viewer(target) as observers:
        card, summary, interrupted = localise(saved, config, directory, observers)
    print(summary)
    print(f"{directory}/localisation.csv holds the state and the probability of every step,")
    print(f"{directory}/trajectory.tum the poses, in the frame of the map where it was found")
    print(summarise(directory, card, f"localising in {arguments.map}"))
    return INTERRUPTED if interrupted else 0


def add_merge(commands: Commands) -> None:
    """Registers the command."""
    merge = commands.add(
        "merge", _merge, "make one map of the sessions in several",
        "merge runs/monday runs/tuesday -o runs/both", "maps",
    )  # fmt: skip
    merge.add_path("maps", "MAP", "run directories or map files", nargs="+")
    help = "the new map: a file that ends in .npz, or a folder for it with its trajectory and graph"
    merge.add_path("-o", "MAP", help, required=True)
    merge.add_flag("--json", "print JSON")


def _merge(arguments: argparse.Namespace) -> None:
    prepare_jax()
    from ratslam.runs.merge import describe_merge, merge_maps

    report = merge_maps(arguments.maps, arguments.output, tell)
    print(json.dumps(report, indent=2) if arguments.json else describe_merge(report))


Place = tuple[float, float] | int
"""A point x, y (m) or the number of an experience."""
NO_WAY = 1
"""Exit code where no way joins start and goal."""


def add_path(commands: Commands) -> None:
    """Registers the commands of this module."""
    path = commands.add(
        "path", _path, "find the way on a saved map", "path runs/square --from here --to -0.1,0.8", "maps"
    )
    path.add_path("map", "MAP", "run directory, or its map.npz")
    path.add_argument(
        "--from", dest="start", default="here", metavar="X,Y|EXPERIENCE|here",
        help="start: a point, m, such as -0.1,0.2, an experience, or the map's last pose (default)",
    )  # fmt: skip
    path.add_argument(
        "--to", dest="goal", required=True, metavar="X,Y|EXPERIENCE",
        help="goal: a point, m, such as -0.1,0.2, or an experience; the way ends at the first experience "
        "within 0.02 m of it, at any heading",
    )  # fmt: skip
    path.add_argument(
        "--mode", choices=("time", "temporal"), default="time",
        help="least expected time (default), or RatSLAM's goal temporal map",
    )  # fmt: skip
    path.add_path("-o", "PNG", "draw the way to a new file", check=_require_new_picture)
    path.add_flag("--json", "print JSON")


def _path(arguments: argparse.Namespace) -> int:
    start = None if arguments.start == "here" else read_place(arguments.start, "--from")
    goal = read_place(arguments.goal, "--to")
    prepare_jax()
    from ratslam.live.goal_planner import draw_map_way, find_map_way
    from ratslam.places.route import NoWay

    saved = _read(arguments.map)
    made = saved.open_session().map
    try:
        way = find_map_way(made, saved, start, goal, arguments.mode)
    except NoWay as error:
        print(f"ratslam: no way: {error}", file=sys.stderr)
        return NO_WAY
    if arguments.output is not None:
        draw_map_way(arguments.output, made, saved, way)
    if arguments.json:
        print(json.dumps(way._asdict() | {"poses": way.poses.tolist()}))
        return 0
    places = way.experiences
    lines = [
        f"{len(places)} experiences from {places[0]} to {places[-1]}: {way.length:.2f} m, {way.seconds:.0f} s"
    ]
    if not isinstance(goal, int):
        lines.append(f"ends {math.dist(way.poses[-1][:2], goal):.2f} m from {goal[0]:g},{goal[1]:g}")
    elif places[-1] != goal:
        lines.append(f"ends at {places[-1]}, which is so near to {goal} that it counts as the same place")
    lines.append(
        f"expected {way.expected:.0f} s, as a link may be blocked: one driven n times before is counted as "
        "free with probability (n + 1) / (n + 2)"
    )
    print("\n".join(lines))
    return 0


def read_place(text: str, where: str) -> Place:
    """The place of a text.

    Raises:
        InputError: it is not a place.
    """
    try:
        if "," not in text:
            return int(text)
        x, y = map(float, text.split(","))
        if math.isfinite(x) and math.isfinite(y):
            return x, y
    except ValueError:
        pass
    raise InputError(where, repr(text), "X,Y in m (finite numbers), or the number of an experience")


def _require_new_picture(path: Path) -> None:
    if path.suffix.lower() != ".png":
        raise InputError(f"-o {path}", "not the name of a picture", "a new file that ends in .png")
    require_new_file(path)
