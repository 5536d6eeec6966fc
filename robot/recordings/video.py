"""A camera as a recording: frames of video files, their views, and visual odometry where there is no other.

A view is a crop of the grey image, reduced by block means to a few values in 0..1: the first step of a view
template (Ball et al. 2013, section 3). The second, normalisation, is done by `templates` of a run.

Visual odometry (Milford & Wyeth 2008) compares two intensity profiles: the mean of each column of a crop,
divided by the profile's mean, so that exposure cancels out. The shift between consecutive profiles is the
turn; what differs after the best shift is the distance. Nothing fixes the scale of distances: they are in VO
metres, `scaling` of them for a difference of 1.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from robot.recordings.csv_file import CsvFile
from robot.sources.input_files import require_file
from robot.sources.odometry import from_motions
from robot.sources.source import Warn
from tactile.base.errors import InputError
from tactile.base.settings import Settings, Side


class Crop(Settings):
    """A part of an image, in pixels from the upper left corner."""

    x_min: NonNegativeInt = 0
    """First column."""
    x_max: PositiveInt | None = None
    """Column after the last one; null: the width."""
    y_min: NonNegativeInt = 0
    """First row."""
    y_max: PositiveInt | None = None
    """Row after the last one; null: the height."""


class ImageViewConfig(Settings):
    """How an image becomes a view; its exposure is normalised by `templates`, as that of every view."""

    crop: Crop = Crop()
    """The part of the image that is seen; leave out the robot itself and featureless floor and sky."""
    rows: Side = 12
    """R, rows of a view."""
    columns: Side = 60
    """C, columns of a view."""


def _cropped(crop: Crop, grey: np.ndarray, where: str, key: str) -> np.ndarray:
    """The part of an image [H, W] as a view [h, w] of the same memory.

    Args:
        where: the image, for errors. key: configuration key of the crop, for errors.
    """
    height, width = grey.shape
    x_max, y_max = crop.x_max or width, crop.y_max or height
    if not (crop.x_min < x_max <= width and crop.y_min < y_max <= height):
        found = f"{key} is x {crop.x_min} to {x_max}, y {crop.y_min} to {y_max}"
        raise InputError(where, found, f"a part of the image of {width} x {height} pixels")
    return grey[crop.y_min : y_max, crop.x_min : x_max]


def image_view(config: ImageViewConfig, grey: np.ndarray, where: str = "image") -> np.ndarray:
    """The view [R, C, 1] of an image [H, W] uint8: block means of the crop, 0 black to 1 white.

    Where rows or columns do not divide the crop, blocks differ by one pixel; every pixel counts once. Sums
    are of integers, hence exact.

    Raises:
        InputError: the crop is not a part of the image, or has fewer pixels than the view along one axis.
    """
    part = _cropped(config.crop, grey, where, "image.crop")
    height, width = part.shape
    if height < config.rows or width < config.columns:
        found = f"the crop has {width} x {height} pixels"
        expected = f"at least image.columns {config.columns} x image.rows {config.rows}"
        raise InputError(where, found, expected)
    tops, lefts = _block_edges(height, config.rows), _block_edges(width, config.columns)
    sums = np.add.reduceat(part, tops[:-1], axis=0, dtype=np.int64)
    sums = np.add.reduceat(sums, lefts[:-1], axis=1)
    return (sums / (np.outer(np.diff(tops), np.diff(lefts)) * 255.0))[..., None]


def _block_edges(size: int, blocks: int) -> np.ndarray:
    """[blocks + 1] edges of nearly equal blocks of `size` pixels."""
    return np.arange(blocks + 1) * size // blocks


class VisualOdometryConfig(Settings):
    """Visual odometry, for recordings with images and without odometry. Its distances are in VO metres, of
    unknown length unless `scaling` was calibrated."""

    fov_deg: float = Field(gt=0, le=360)
    """Horizontal field of view of the whole image, degrees, taken as equal angles for all columns; 360: a
    panorama, whose columns form a ring."""
    rotation: Crop = Crop()
    """The part of the image from which turns are found. Best are far things straight ahead: what passes at
    the sides moves against the turn or with it."""
    translation: Crop = Crop()
    """The part of the image from which distances are found: near things, at the sides and on the ground."""
    scaling: PositiveFloat = 1.0
    """Distance for a mean profile difference of 1, VO metres."""
    max_speed: PositiveFloat = 5.0
    """Largest speed, VO metres/s."""
    max_turn_rate_deg: PositiveFloat = 120.0
    """Largest turn rate, degrees/s: shifts between frames are searched up to this rate."""


Profile = tuple[np.ndarray, bool]
"""Intensities [w] with mean 1 of the columns of a crop, and whether the columns form a ring."""


def _motion_between(
    config: VisualOdometryConfig,
    before: tuple[Profile, Profile],
    after: tuple[Profile, Profile],
    pixel_angle: float,
    dt: float,
) -> tuple[float, float]:
    """Distance (VO metres) and turn (rad, counter-clockwise) between two frames that lie `dt` s apart.

    Args:
        before, after: the profiles of each for turns and for distances. pixel_angle: of one column, rad.
    """
    dt = max(dt, 0.0)  # of stamps that go back, which the reader reports
    reach = int(np.ceil(np.deg2rad(config.max_turn_rate_deg) * dt / pixel_angle))
    shift, _ = _best_shift(before[0], after[0], reach)
    _, change = _best_shift(before[1], after[1], reach)
    return min(config.scaling * change, config.max_speed * dt), shift * pixel_angle


def _profile(config: VisualOdometryConfig, name: str, grey: np.ndarray, where: str) -> Profile:
    part = _cropped(getattr(config, name), grey, where, f"visual_odometry.{name}")
    sums = part.sum(axis=0, dtype=np.int64)
    total = int(sums.sum())
    values = sums * (len(sums) / total) if total else np.ones(len(sums))
    return values, config.fov_deg == 360 and len(sums) == grey.shape[1]


def _best_shift(before: Profile, after: Profile, reach: int) -> tuple[float, float]:
    """The shift of the least mean absolute difference, in columns to the right, and that difference.

    Things move to the right in the image where the camera turns counter-clockwise.
    """
    (old, _), (new, ring) = before, after
    width = len(new)
    reach = min(reach, width // 2)
    shifts = np.arange(-reach, reach + 1)
    columns = np.arange(width)[None, :] - shifts[:, None]  # where each column was before
    inside = (columns >= 0) & (columns < width) | ring
    difference = np.abs(new - old[columns % width])
    errors = np.sum(difference, axis=1, where=inside) / inside.sum(axis=1)
    best = int(np.lexsort((np.abs(shifts), errors))[0])  # of equal errors the smallest shift
    return float(shifts[best]) + _vertex(errors, best), float(errors[best])


def _vertex(errors: np.ndarray, best: int) -> float:
    """Position of the minimum between columns, -0.5 to 0.5 from `best`.

    An absolute difference rises on both sides of its minimum with equal slope: the vertex of that V,
    through the least error and its neighbours.
    """
    if not 0 < best < len(errors) - 1:
        return 0.0
    left, least, right = errors[best - 1 : best + 2].tolist()
    rise = max(left, right) - least
    return (left - right) / (2 * rise) if rise > 0 else 0.0


Frame = tuple[float, np.ndarray]
"""The time of an image, s, on the clock of the recording, and the image in grey, [H, W] uint8."""


def camera_rows(
    frames: Iterable[Frame], views: ImageViewConfig, odometry: VisualOdometryConfig | None, where: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Reads frames one by one; of each only its view, and of the last one its profiles are kept.

    Args:
        odometry: visual odometry, or None if the recording has another.
        where: the file or topic of the frames, for errors.

    Returns:
        time: [N] s, as in the frames; not checked. view: [N, R, C, 1] in 0..1.
        motion: [N, 4] (dx VO metres, dy, dtheta rad, dt s) since the previous frame, the first zero; None
            without visual odometry.

    Raises:
        InputError: there are no frames, their size changes, or a crop does not fit them.
    """
    time, pictures, moves = list[float](), list[np.ndarray](), list[tuple[float, float]]()
    size: tuple[int, ...] | None = None
    before: tuple[Profile, Profile] | None = None
    for number, (moment, grey) in enumerate(frames):
        place = f"{where}, frame {number}"
        size = size or grey.shape
        if grey.shape != size:
            found = f"{grey.shape[1]} x {grey.shape[0]} pixels"
            raise InputError(place, found, f"{size[1]} x {size[0]}, as in frame 0")
        pictures.append(image_view(views, grey, place))
        if odometry is not None:
            after = (
                _profile(odometry, "rotation", grey, place),
                _profile(odometry, "translation", grey, place),
            )
            pixel_angle = float(np.deg2rad(odometry.fov_deg)) / size[1]
            step = 0.0, 0.0
            if before is not None:
                step = _motion_between(odometry, before, after, pixel_angle, moment - time[-1])
            moves.append(step)
            before = after
        time.append(moment)
    if not time:
        raise InputError(where, "no frames", "at least one image")
    clock = np.array(time)
    motion = None
    if odometry is not None:
        distance, turn = np.array(moves).T
        motion = from_motions(clock, distance, 0.0, turn)
    return clock, np.stack(pictures), motion


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


def video_frames(
    path: Path, config: VideoConfig, stamps: CsvFile | None, warn: Warn = None
) -> Iterator[Frame]:
    """The frames of a video, decoded one by one. Colours become grey as in JPEG, 0.299 R + 0.587 G + 0.114 B.

    Args:
        stamps: the file `config.stamps`, whose times increase; None: times follow from `config.rate`.
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
                good, picture = video.retrieve()
                if not good:
                    cure = "was the file copied completely?"
                    raise InputError(f"{path}, frame {count}", "cannot be decoded", "an image", cure)
                yield time, np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
            count += 1
    if warn is not None and count < announced:
        warn(f"{path}: only {count} of {announced} frames can be read")
    if stamps is not None and count != len(stamps.lines):
        expected = f"{count}, one for each frame of {path}"
        raise InputError(str(stamps.path), f"{len(stamps.lines)} times", expected)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[ModuleType, Any]]:
    """OpenCV, and the opened video."""
    require_file(path)
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # or it prints its own errors beside ours
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    try:
        import cv2
    except ModuleNotFoundError:
        found = "opencv is not installed"
        raise InputError("video", found, "", "pip install 'ratslam[video]'") from None
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
