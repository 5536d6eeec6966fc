"""Frames of a camera to rows of a recording: views, and visual odometry where there is no other."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from robot.recordings.camera.image_view import ImageViewConfig, image_view
from robot.recordings.camera.visual_odometry import (
    Profiles,
    VisualOdometryConfig,
    motion_between,
    profiles,
)
from robot.sources.odometry import from_motions
from tactile.base.errors import InputError


class Frame(NamedTuple):
    """One image.

    Attributes:
        time: s, on the clock of the recording. grey: [H, W] uint8.
    """

    time: float
    grey: np.ndarray


class CameraRows(NamedTuple):
    """What a recording keeps of N frames.

    Attributes:
        time: [N] s, as in the frames; not checked. view: [N, R, C, 1] in 0..1.
        motion: [N, 4] (dx VO metres, dy, dtheta rad, dt s) since the previous frame, the first zero; None
            without visual odometry.
    """

    time: np.ndarray
    view: np.ndarray
    motion: np.ndarray | None


def camera_rows(
    frames: Iterable[Frame], views: ImageViewConfig, odometry: VisualOdometryConfig | None, where: str
) -> CameraRows:
    """Reads frames one by one; of each only its view, and of the last one its profiles are kept.

    Args:
        odometry: visual odometry, or None if the recording has another.
        where: the file or topic of the frames, for errors.

    Raises:
        InputError: there are no frames, their size changes, or a crop does not fit them.
    """
    time, pictures, moves = list[float](), list[np.ndarray](), list[tuple[float, float]]()
    size: tuple[int, ...] | None = None
    before: Profiles | None = None
    for number, frame in enumerate(frames):
        place = f"{where}, frame {number}"
        size = size or frame.grey.shape
        if frame.grey.shape != size:
            found = f"{frame.grey.shape[1]} x {frame.grey.shape[0]} pixels"
            raise InputError(place, found, f"{size[1]} x {size[0]}, as in frame 0")
        pictures.append(image_view(views, frame.grey, place))
        if odometry is not None:
            after = profiles(odometry, frame.grey, place)
            step = 0.0, 0.0
            if before is not None:
                step = motion_between(odometry, before, after, frame.time - time[-1])
            moves.append(step)
            before = after
        time.append(frame.time)
    if not time:
        raise InputError(where, "no frames", "at least one image")
    clock = np.array(time)
    motion = None
    if odometry is not None:
        distance, turn = np.array(moves).T
        motion = from_motions(clock, distance, 0.0, turn)
    return CameraRows(clock, np.stack(pictures), motion)
