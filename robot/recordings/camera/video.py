"""Video files: frames as grey images with a time each."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from robot.recordings.camera.rows import Frame
from robot.recordings.csv_file import CsvFile
from robot.recordings.sanity_checks import clock_errors
from robot.sources.input_files import require_file
from robot.sources.source_registry import Warn
from tactile.base.errors import InputError
from tactile.base.settings import Settings

SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".webm")


class VideoConfig(Settings):
    """Times of the frames of a video, and odometry recorded beside it."""

    rate: PositiveFloat | None = None
    """Frames per second, the first at time 0; or give `stamps`."""
    stamps: Path | None = None
    """CSV file with the time of each frame of the video, one row a frame."""
    time: str = "t"
    """Column of the time in `stamps`, s."""
    every: PositiveInt = 1
    """Use each n-th frame, for a camera much faster than it need be."""
    odometry: Path | None = None
    """CSV file of wheel odometry, on the clock of the frames, with columns as `table` describes them; null:
    visual odometry."""
    tolerance: float | None = Field(default=None, ge=0)
    """Largest time between a frame and its nearest odometry row, s; null: the median step."""


def describe_video(path: Path) -> tuple[int, float, int, int]:
    """What a video file says about itself: frames, their rate (0 if it does not say), width and height.

    Raises:
        InputError: it is no video, or opencv is missing.
    """
    with _opened(path) as (cv2, video):
        names = ("FRAME_COUNT", "FPS", "FRAME_WIDTH", "FRAME_HEIGHT")
        frames, rate, width, height = (float(video.get(getattr(cv2, f"CAP_PROP_{name}"))) for name in names)
    return int(frames), rate, int(width), int(height)


def stamp_errors(file: CsvFile, column: str) -> list[InputError]:
    """Errors of a file of stamps: no such column, numbers that are not finite, times that do not increase."""
    errors = file.absences([(column, "video.time")])
    return errors or file.judge([column])[1] + clock_errors(file.column(column, "time"), column, file.place)


def video_frames(
    path: Path, config: VideoConfig, stamps: CsvFile | None, warn: Warn = None
) -> Iterator[Frame]:
    """The frames of a video, decoded one by one. Colours become grey as in JPEG, 0.299 R + 0.587 G + 0.114 B.

    Args:
        stamps: the file `config.stamps`, checked by `stamp_errors`; None: times follow from `config.rate`.
        warn: called with one sentence if the file ends before the frames that it announces.

    Raises:
        InputError: the file is no video, opencv is missing, there is no rate, or the numbers of frames and
            stamps differ.
    """
    with _opened(path) as (cv2, video):
        times = _times(path, config, stamps, float(video.get(cv2.CAP_PROP_FPS)))
        announced, count = int(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0
        while video.grab():
            time = next(times, None)
            if time is not None and count % config.every == 0:
                yield Frame(time, _grey(cv2, video, f"{path}, frame {count}"))
            count += 1
    if warn is not None and count < announced:
        warn(f"{path}: only {count} of {announced} frames can be read")
    if stamps is not None and count != len(stamps.lines):
        raise InputError(
            str(stamps.path), f"{len(stamps.lines)} times", f"{count}, one for each frame of {path}"
        )


@contextmanager
def _opened(path: Path) -> Iterator[tuple[ModuleType, Any]]:
    """OpenCV, and the opened video."""
    require_file(path)
    cv2 = _opencv()
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not video.isOpened():
            raise InputError(str(path), "cannot be decoded", "a video", "was it copied completely?")
        yield cv2, video
    finally:
        video.release()


def _times(path: Path, config: VideoConfig, stamps: CsvFile | None, announced: float) -> Iterator[float]:
    """The time of each frame, s; `announced` is the rate that the file states."""
    if stamps is not None:
        return iter(stamps.column(config.time, "time").tolist())
    if config.rate is None:
        hint = f", rate: {announced:g} if the file is right" if announced > 0 else ""
        cure = f"set recording.video.rate or stamps{hint}"
        raise InputError(str(path), "no times of its frames", "a frame rate, or a file of stamps", cure)
    rate = config.rate
    return (number / rate for number in itertools.count())


def _grey(cv2: ModuleType, video: Any, where: str) -> np.ndarray:
    """[H, W] uint8: the frame that was last grabbed."""
    good, picture = video.retrieve()
    if not good:
        raise InputError(where, "cannot be decoded", "an image", "was the file copied completely?")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))


def _opencv() -> ModuleType:
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # or it prints its own errors beside ours
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    try:
        import cv2
    except ModuleNotFoundError:
        found = "opencv is not installed"
        raise InputError("video", found, "", "pip install 'ratslam[video]'") from None
    return cv2
