"""Configurations, presets and the citation that come with the program, in a checkout and in a wheel."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, Literal

from tactile.base.errors import InputError, did_you_mean

_PACKAGE = Path(__file__).resolve().parents[2]
FOLDERS = (_PACKAGE / "packaged" / "configs", _PACKAGE.parent / "configs")
"""Where they are: in a wheel (`setup.py` puts them there), in a checkout."""


def packaged_configs() -> dict[str, str]:
    """Name and one line of each packaged configuration, by name.

    The line is the first comment of the file, and the environment variables that must be set for it.
    """
    lines = {}
    for path in _files():
        text = path.read_text(encoding="utf-8")
        line = text.partition("\n")[0].removeprefix("#").strip()
        variables = sorted(set(re.findall(r"\$\{(\w+)\}", text)))
        lines[path.stem] = f"{line} Needs {' and '.join(variables)}." if variables else line
    return lines


def find_config(text: str | os.PathLike[str], folder: Path = Path()) -> Path:
    """The file of a configuration, given by its path or by the name of a packaged one.

    Args:
        text: the path or the name; a file of that path comes before a packaged configuration of that name.
        folder: start of a relative path.

    Raises:
        InputError: there is neither, with a similar name and all names.
    """
    name = os.fspath(text)
    path, files = folder / name, {file.stem: file for file in _files()}
    if os.path.exists(path) and not (name in files and os.path.isdir(path)):
        return path
    if name in files:
        return files[name]
    cure = did_you_mean(Path(name).stem.lower(), files)
    raise InputError(str(path), "no such file or packaged configuration", f"one of {', '.join(files)}", cure)


def read_citation() -> str:
    """The content of CITATION.cff: how to cite the program."""
    places = [folder.parent / "CITATION.cff" for folder in FOLDERS]
    return next(path for path in places if path.exists()).read_text(encoding="utf-8")


def _files() -> list[Path]:
    folder = next((folder for folder in FOLDERS if folder.is_dir()), FOLDERS[0])
    return sorted(folder.glob("*.yaml"))


PresetName = Literal["touch", "arm", "create", "visual_odometry"]

PRESETS: dict[PresetName, dict[str, dict[str, Any]]] = {
    # Salman & Pearson 2016, III-C: the odometry of their arm, in pose cells of 5 cm; many whisker images look
    # alike, so a closure needs more evidence and all closure sequences are compared with each other. Weak
    # sequences are selected from too, and novelty gives way to recall fast: else a robot that lost its place
    # stays lost, because all that recall finds then is weak.
    "touch": {
        "pose_cells": {"cell_size": 0.05, "cells_xy": 21},
        "recall": {"sector_fov": "whiskers", "enter": 0.2},
        "keyframes": {
            "noise": {"per_cell": 0.22, "heading_per_cell": 0.063, "heading_per_radian": 0.126},
            "bias_sd": 0.001,
            "turn_error_sd": 0.0,
            "min_score": 12.0,
            "max_distance": 60.0,
            "sequence_agreement": 0.2,
            "select_every": 50,
            "merge_stood": 4,
            "select_score": 5.0,
            "select_length": 2,
            "sequence_cost": 3.0,
            "max_turn": 0.6,
            "place_radius": 1.3,
            "place_heading": 0.17,
        },
    },
    # Salman & Pearson 2016, III-C: an arm has no body on the floor, its odometry errors are independent in
    # each sample, and the walls are 12 mm thick.
    "arm": {
        "grid": {
            "particles": 300,
            "cell": 0.02,
            "body": 0.0,
            "drift": {"session": 0.0, "move": 0.0, "step": 0.27, "heading": 2e-3},
            "footprint": {"blob_sd": 0.015, "along": 0.05, "across": 0.015},
        }
    },
    # Distances from images vary with what is near: in a rendered corridor by a third from frame to frame
    # (robot/recordings/README.md). Patch normalisation is that of RatSLAM (Ball et al. 2013).
    "visual_odometry": {
        "templates": {"patch": 2},
        "keyframes": {"noise": {"per_cell": 0.15, "heading_per_cell": 0.03, "heading_per_radian": 0.1}},
    },
    # Fox et al. 2012, II and III: the defaults of `grid` are those of their Create. Before `touch`: wheels
    # keep the heading on a straight (0.027 rad after a metre; that arm 0.28), and turn by some per cent too
    # far or too little (`robot/simulation/create/wheel_odometry.py`). With the arm's noise, rooms that are
    # alike after half a turn are closed by half a turn.
    "create": {"keyframes": {"noise": {"heading_per_cell": 0.006}, "turn_error_sd": 0.05}},
}
"""Values of settings that a configuration leaves open, nested as in a configuration."""
