"""The files of a keyframe map in a run directory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ratslam.mapping.calibration import write_calibration
from ratslam.mapping.io import write_g2o, write_json
from ratslam.mapping.loop_closures import write_closures

if TYPE_CHECKING:
    from ratslam.mapping.map import KeyframeMap


def map_files(map: KeyframeMap, *, calibrated: bool) -> dict[str, Callable[[Path], None]]:
    """Experiences as node-link JSON, keyframes as a g2o graph, the closures with their evidence, and, where
    `calibrated`, the calibration of the odometry: functions that write them, by name."""
    calibration = {"calibration.yaml": lambda path: _write_calibration(path, map)} if calibrated else {}
    return calibration | {
        "map.json": lambda path: write_json(path, map.graph()),
        "map.g2o": lambda path: _write_g2o(path, map),
        "closures.csv": lambda path: write_closures(path, map.candidates(), map.keyframe_steps()),
    }


def _write_g2o(path: Path, map: KeyframeMap) -> None:
    """Of several pieces, the first keyframe of each is fixed: nothing else determines where it lies."""
    taken, fit = map.kept_keyframes().taken.rows, map.kept_solution().fit
    pieces, first = np.unique(map.keyframe_pieces()[taken], return_index=True)
    write_g2o(path, fit.poses, map.edges(), fixed=first.tolist() if len(pieces) > 1 else ())


def _write_calibration(path: Path, map: KeyframeMap) -> None:
    graph = map.kept_keyframes()
    noise = graph.heading_noise if map.config.select_every else None
    write_calibration(path, graph.calibration(*map.kept_solution()), noise)
