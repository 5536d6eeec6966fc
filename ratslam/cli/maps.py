"""The command map: what is in a saved map, what differs between two, undoing a closure sequence, cropping."""

from __future__ import annotations

import argparse
import json
import sys
from functools import partial
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

from ratslam.cli.common import Commands, prepare_jax
from tactile.base.errors import InputError, tell

if TYPE_CHECKING:
    from ratslam.runs.saved_map import SavedMap


def add_commands(commands: Commands) -> None:
    """Registers `map` with its commands."""
    help = "show, compare, crop or correct saved maps"
    kinds = Commands(commands.add("map", None, help, "map info runs/square", "maps"))
    info = kinds.add("info", _info, "say what is in a map", "map info runs/square")
    _add_map(info)
    _add_json(info)
    diff = kinds.add("diff", _diff, "say what differs between two maps", "map diff runs/square runs/again")
    _add_map(diff)
    diff.add_argument("other", type=Path, metavar="MAP", help="the map to compare with it")
    _add_json(diff)
    undo = kinds.add(
        "undo", _undo, "remove a closure sequence from a map", "map undo runs/square 0 -o runs/undone.npz"
    )
    _add_map(undo)
    undo.add_argument(
        "sequence", type=int, metavar="SEQUENCE", help="its number, as `map info --json` and closures.csv say"
    )
    undo.add_argument(
        "-o", "--output", type=Path, metavar="MAP", help="the new map file (default: replaces the map file)"
    )
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
    crop.add_argument("-o", "--output", type=Path, required=True, metavar="MAP", help="the new map file")


def _add_map(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", type=Path, metavar="MAP", help="a run directory or a map file")


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")


def _read(path: Path) -> SavedMap:
    prepare_jax()
    from ratslam.runs.saved_map import read_map

    return read_map(path, tell)


def _info(arguments: argparse.Namespace) -> int:
    saved = _read(arguments.map)
    from ratslam.runs.map_care import map_info

    info = map_info(saved)
    print(json.dumps(info, indent=2) if arguments.json else render_info(info))
    return 0


def _diff(arguments: argparse.Namespace) -> int:
    first, second = _read(arguments.map), _read(arguments.other)
    from ratslam.runs.map_care import map_difference

    found = map_difference(first, second)
    print(json.dumps(found, indent=2) if arguments.json else render_difference(found))
    return 0


def _undo(arguments: argparse.Namespace) -> int:
    output: Path | None = arguments.output
    prepare_jax()
    from ratslam.runs.map_care import finish_undo, replaced_file, undo_sequence

    if output is None:
        output = arguments.map = replaced_file(arguments.map)
        finished = finish_undo(output)
        if finished is not None:
            folder = output.parent
            print(f"{folder}: the undo of sequence {finished}, which had been cut off, is complete")
        if finished == arguments.sequence:
            return 0
    saved = _read(arguments.map)
    rewritten = undo_sequence(saved, arguments.sequence, output)
    print(f"{output}: the map without sequence {arguments.sequence}")
    if rewritten:
        print(f"{output.parent}: trajectory, graph, closures and map.png follow it")
    return 0


def _crop(arguments: argparse.Namespace) -> int:
    box = None if arguments.box is None else read_box(arguments.box)
    steps = None if arguments.steps is None else read_steps(arguments.steps)
    saved = _read(arguments.map)
    from ratslam.places.crop import keyframes_in_box, keyframes_of_piece, keyframes_of_steps
    from ratslam.runs.map_care import Choose, crop_saved

    choose: Choose
    if box is not None:
        choose = partial(keyframes_in_box, box=box)
    elif steps is not None:
        choose = partial(keyframes_of_steps, first=steps[0], last=steps[1])
    else:
        choose = partial(keyframes_of_piece, piece=arguments.piece)
    count = crop_saved(saved, choose, arguments.output)
    print(f"{arguments.output}: {count} of {saved.steps} steps")
    return 0


def read_box(text: str) -> tuple[float, float, float, float]:
    """The box of a text `X0,Y0,X1,Y1`, m.

    Raises:
        InputError: it is not a box.
    """
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError("--box", repr(text), "four numbers X0,Y0,X1,Y1, m") from None
    if not (x0 < x1 and y0 < y1):  # nor with NaN
        raise InputError("--box", repr(text), "X0 < X1 and Y0 < Y1, m")
    return x0, y0, x1, y1


def read_steps(text: str) -> tuple[int, int]:
    """The steps A to B - 1 of a text `A:B`; without A from the first, without B to the last.

    Raises:
        InputError: they are not steps.
    """
    first, colon, last = text.partition(":")
    if not colon or not all(part.isdecimal() or not part for part in (first, last)):
        raise InputError("--steps", repr(text), "A:B with whole numbers from 0")
    return int(first or 0), int(last) if last else sys.maxsize


def render_info(info: dict) -> str:
    """The text of `map_info`."""
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
    return "\n".join(lines)


def render_difference(found: dict) -> str:
    """The text of `map_difference`."""
    if found["same"]:
        return "the same map"
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
    return "\n".join(lines)
