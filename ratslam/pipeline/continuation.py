"""A session that goes on from a saved map: with the recording that it ends with, or with another one."""

from __future__ import annotations

import sys
from pathlib import Path

from ratslam.backends.registry import LOCALISING
from ratslam.config.run_config import RunConfig
from ratslam.core.backend import Map
from ratslam.core.session import Session
from ratslam.pipeline.estimate import PoseEstimate
from ratslam.pipeline.map_settings import check_same_method
from ratslam.pipeline.saved_map import SavedMap, read_map
from ratslam.pipeline.sensor import check_same_sensor, sensor_of
from robot.sources.source import Source
from tactile.base.errors import InputError, printable


def resume_session(
    session: Session, path: Path, config: RunConfig, source: Source
) -> tuple[int, PoseEstimate]:
    """Restores a session from a map. The recording that the map ends with goes on after its last sample
    mapped; another begins with its first sample, in a piece of its own.

    Args:
        session: empty. path: of the map, a run directory or a file. config: of the session, completed.
        source: of its observations.

    Returns:
        how many samples of the source are in the map, and the estimate of its last step.

    Raises:
        InputError: there is no map; it was made with another sensor, method or settings; or another recording
            cannot go on from it, because it is one piece.
    """
    saved = read_map(path, lambda sentence: print(f"ratslam: {printable(sentence)}", file=sys.stderr))
    check_same_sensor(str(saved.path), saved.sensor, sensor_of(config, source))
    check_same_method(str(saved.path), saved.config, config)
    samples = saved.samples_of(source.digest)
    if samples is None:  # before settings that follow from the source are compared
        _require_pieces(session.map, saved, source)
    saved.restore(session, config)
    if samples is None:
        session.begin_recording()
        session.begin_piece()  # the robot may have been carried since
    return samples or 0, saved.estimate


def _require_pieces(empty: Map, saved: SavedMap, source: Source) -> None:
    """Raises `InputError` if another recording cannot go on from a map, because it is one piece.

    Args:
        empty: a map of that method.
    """
    try:
        empty.begin_piece()
    except InputError:
        method = saved.config.backend
        found = (
            f"a map of `backend: {method}`, which is one piece; {source.name} is not the recording that was "
            "mapped last, and the robot may stand anywhere when it begins"
        )
        localised = f"find the robot in this map with `ratslam localise {saved.path}`"
        other = localised if method in LOCALISING else "map both with `backend: recall`"
        raise InputError(
            str(saved.path), found, "that recording, which goes on after the last sample mapped",
            f"map it by itself, or {other}",
        ) from None  # fmt: skip
