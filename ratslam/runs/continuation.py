"""A session that goes on from a saved map: with the recording that it ends with, or with another one."""

from __future__ import annotations

from pathlib import Path

from evaluation.artifacts.run_reader import read_manifest
from ratslam.core.session import Session
from ratslam.methods.map_file import NAME, map_file
from ratslam.methods.method_registry import LOCALISING
from ratslam.runs.estimate import START, PoseEstimate
from ratslam.runs.map_settings import Sensor, check_same_method
from ratslam.runs.saved_map import read_map
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.source import Source
from tactile.base.errors import InputError, tell


def checkpoint_of(path: Path) -> Path | None:
    """The map to continue: `path`, or None for a run that was killed before its first checkpoint.

    Remains of a checkpoint that a killed process was writing are removed.

    Raises:
        InputError: that run went on from another map.
    """
    folder = path if path.is_dir() else path.parent
    if map_file(path) != folder / NAME or not (folder / "manifest.json").is_file():
        return path
    manifest = read_manifest(folder)
    if manifest.killed:
        for file in folder.glob(f".*.{NAME}"):
            file.unlink()
    if not manifest.killed or (folder / NAME).exists():
        return path
    found = "killed before its first checkpoint"
    if manifest.continued:
        raise InputError(str(folder), found, "a run with a map", "continue the map that it went on from")
    tell(f"{folder}: {found}; the recording is mapped from its beginning")
    return None


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

    A killed run that has mapped the whole recording, without its results, begins anew.

    Raises:
        InputError: there is no map, or it holds the whole recording; it was made with another sensor, method
            or settings; or another recording cannot go on from it, because it is one piece.
    """
    saved = read_map(path, tell)
    saved.sensor.check_same(str(saved.path), Sensor.of(config, source))
    check_same_method(str(saved.path), saved.config, config)
    samples = saved.samples_of(source.digest)
    if samples is None:  # before settings that follow from the source are compared
        try:
            session.map.begin_piece()
        except InputError:
            method = saved.config.backend
            found = (
                f"a map of `backend: {method}`, which is one piece; {source.name} is not the recording that "
                "was mapped last, and the robot may stand anywhere when it begins"
            )
            localised = f"find the robot in this map with `ratslam localise {saved.path}`"
            other = localised if method in LOCALISING else "map both with `backend: recall`"
            expected = "that recording, which goes on after the last sample mapped"
            raise InputError(str(saved.path), found, expected, f"map it by itself, or {other}") from None
    saved.restore(session, config)
    if samples is None:
        session.begin_recording()
        session.begin_piece()  # the robot may have been carried since
    elif source.length is not None and samples >= source.length:
        if session.earlier or not read_manifest(saved.path.parent).killed:
            found = f"already holds all {samples} samples of {source.name}"
            raise InputError(str(path), found, "that of an unfinished run")
        tell(f"{path}: killed after its last sample; the recording is mapped from its beginning")
        session.restart(config.session.seed)
        return 0, START
    return samples or 0, saved.estimate
