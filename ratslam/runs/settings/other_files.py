"""Files that are given for a configuration and are none: what they are, and the command that reads them."""

from __future__ import annotations

import zipfile
from collections.abc import Container
from pathlib import Path

from robot.recordings.camera.video import SUFFIXES as VIDEOS
from tactile.base.errors import InputError

RECORDING, MAP, RUN = "a recording", "a map", "a run directory"
FOLDER, BAG_PART, PAGE, DEVICE = "a folder", "the description of a bag", "a page (HTML)", "a FIFO or a device"
CURES = {
    RECORDING: "`python -m ratslam doctor {0} -o mine.yaml` writes one that reads it, then `run mine.yaml`",
    MAP: "`map info {0}` says what is in it, `localise {0} RECORDING` and `run CONFIG --continue {0}` use it",
    RUN: "`doctor {0}`, `score {0}` and `report {0}` tell of it, `run {0}/config.yaml` repeats it",
    BAG_PART: "`python -m ratslam doctor {1} -o mine.yaml` writes one that reads the bag",
    PAGE: "open it in a browser",
}
"""What to do with each kind; {0} is the path, {1} its folder."""
BAGS = (".bag", ".db3", ".mcap")
BEGINNINGS = (  # in lower case
    (b"\x89mcap0", RECORDING), (b"#rosbag", RECORDING), (b"sqlite format 3", RECORDING),
    (b"rosbag2_bagfile", BAG_PART), (b"<!doctype html", PAGE), (b"<html", PAGE),
)  # fmt: skip


def refuse_other_files(
    path: Path, expected: str = "a configuration (YAML)", allowed: Container[str | None] = ()
) -> None:
    """Refuses what cannot be what was expected.

    Args:
        allowed: kinds that may be given too.

    Raises:
        InputError: it is of another kind, which is named with the command that reads it.
    """
    kind = kind_of(path)
    if kind is not None and kind not in allowed:
        raise InputError(str(path), kind, expected, CURES.get(kind, "").format(path, path.parent))


def kind_of(path: Path) -> str | None:
    """What a file or folder is, by its names and first bytes; None if it may be a configuration, or is none
    of ours."""
    try:
        if path.is_dir():
            names = {file.name for file in path.iterdir()}
            bag = "metadata.yaml" in names or any(name.endswith(BAGS) for name in names)
            run = names & {"manifest.json", "steps.csv"}
            return RUN if run else MAP if "map.npz" in names else RECORDING if bag else FOLDER
        if not path.is_file():
            return DEVICE if path.exists() else None
        with path.open("rb") as file:
            begins = file.read(16).lower()
        if begins.startswith(b"pk\3\4"):
            with zipfile.ZipFile(path) as archive:
                return MAP if {"steps.npy", "config.npy"} <= set(archive.namelist()) else RECORDING
    except zipfile.BadZipFile:
        return RECORDING
    except (OSError, ValueError):  # whoever reads it says so
        return None
    if path.suffix.lower() in (".csv", *BAGS, *VIDEOS):
        return RECORDING
    return next((kind for beginning, kind in BEGINNINGS if begins.startswith(beginning)), None)
