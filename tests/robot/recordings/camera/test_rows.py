"""Images become views by exact block means, and turns and distances by the change of profiles."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.recordings.video import Crop, Frame, ImageViewConfig, VisualOdometryConfig, camera_rows, image_view
from tactile.base.errors import InputError

PANORAMA = VisualOdometryConfig(fov_deg=360)
NARROW = VisualOdometryConfig(fov_deg=60)
VIEW = ImageViewConfig(rows=2, columns=8)


def texture(width: int = 320, height: int = 24, seed: int = 0) -> np.ndarray:
    """A smooth random image [H, W] uint8 whose columns form a ring."""
    random = np.random.default_rng(seed)
    spectrum = np.fft.rfft(random.standard_normal((height, width)), axis=1)
    spectrum[:, width // 16 :] = 0.0
    picture = np.fft.irfft(spectrum, width, axis=1)
    return np.round(128 + 100 * picture / np.abs(picture).max()).astype(np.uint8)


def turning(shifts: list[int], step: float = 0.1) -> list[Frame]:
    """Frames of a panorama that turns by columns."""
    image = texture()
    return [(step * i, np.roll(image, total, axis=1)) for i, total in enumerate(np.cumsum(shifts).tolist())]


@given(st.integers(1, 7), st.integers(1, 9), st.integers(0, 3), st.integers(0, 5))
def test_a_view_is_the_mean_of_every_pixel_once(rows: int, columns: int, top: int, left: int) -> None:
    random = np.random.default_rng([rows, columns, top, left])
    grey = random.integers(0, 256, (12, 15), dtype=np.uint8)
    config = ImageViewConfig(crop=Crop(y_min=top, x_min=left), rows=rows, columns=columns)
    view = image_view(config, grey)
    part = grey[top:, left:] / 255
    down = np.arange(rows + 1) * part.shape[0] // rows
    across = np.arange(columns + 1) * part.shape[1] // columns
    expected = [[part[a:b, c:d].mean() for c, d in pairwise(across)] for a, b in pairwise(down)]
    np.testing.assert_allclose(view[..., 0], expected, rtol=1e-14)


def test_black_is_zero_and_white_is_one() -> None:
    for value, expected in ((0, 0.0), (255, 1.0)):
        view = image_view(VIEW, np.full((24, 32), value, np.uint8))
        assert (view == expected).all()


def test_a_panorama_turns_by_whole_columns_exactly() -> None:
    shifts = [0, 3, -5, 0, 9]  # things move to the right: the camera turns counter-clockwise
    _, _, motion = camera_rows(turning(shifts), VIEW, PANORAMA, "turn")
    assert motion is not None
    np.testing.assert_allclose(motion[:, 2], np.array(shifts) * 2 * np.pi / 320, atol=1e-12)
    np.testing.assert_allclose(motion[:, :2], 0.0, atol=1e-12)


def test_turns_are_found_between_columns() -> None:
    coarse = [
        (time, grey.reshape(24, 80, 4).mean(axis=2).round().astype(np.uint8))
        for time, grey in turning([0, 1, 2, 5])
    ]
    _, _, motion = camera_rows(coarse, VIEW, PANORAMA, "turn")
    assert motion is not None
    error = motion[1:, 2] / (2 * np.pi / 80) - [0.25, 0.5, 1.25]
    assert np.abs(error).max() < 0.08  # columns; whole ones would be off by 0.25 and 0.5


def test_a_camera_with_edges_turns_by_its_field_of_view() -> None:
    frames = [(time, grey[:, :200]) for time, grey in turning([0, 4, 4, -6])]
    _, _, motion = camera_rows(frames, VIEW, NARROW, "turn")
    assert motion is not None
    np.testing.assert_allclose(np.rad2deg(motion[:, 2]), np.array([0, 4, 4, -6]) * 60 / 200, atol=0.01)


@pytest.mark.parametrize("gain", [0.3, 0.6])
def test_exposure_cancels_out(gain: float) -> None:
    frames = turning([0, 4, 4])
    dark = [(time, np.round(grey * gain).astype(np.uint8)) for time, grey in frames]
    full, less = (camera_rows(part, VIEW, PANORAMA, "turn")[2] for part in (frames, dark))
    assert full is not None
    assert less is not None
    np.testing.assert_allclose(full, less, atol=2e-3)


def test_the_first_frame_is_silent_and_steps_follow_the_stamps() -> None:
    random = np.random.default_rng(3)
    noise = [random.integers(0, 256, (24, 320), dtype=np.uint8) for _ in range(3)]
    config = VisualOdometryConfig(fov_deg=60, max_speed=0.01)  # the limit counts here: distance is 0.01 dt
    motion = camera_rows(zip((5.0, 5.1, 5.4), noise, strict=True), VIEW, config, "noise")[2]
    assert motion is not None
    assert (motion[0] == 0).all()
    np.testing.assert_allclose(np.hypot(motion[:, 0], motion[:, 1]), [0, 0.001, 0.003], rtol=1e-9)
    np.testing.assert_allclose(motion[:, 3], [0, 0.1, 0.3])


def test_turns_beyond_the_largest_rate_are_not_looked_for() -> None:
    config = VisualOdometryConfig(fov_deg=360, max_turn_rate_deg=30)  # 3 degrees, 2.7 columns, in 0.1 s
    motion = camera_rows(turning([0, 40]), VIEW, config, "turn")[2]
    assert motion is not None
    assert abs(np.rad2deg(motion[1, 2])) <= 3.4


def test_black_frames_and_repeated_stamps_move_nothing() -> None:
    frames = [(time, np.zeros((24, 32), np.uint8)) for time in (0.0, 0.1, 0.1)]
    motion = camera_rows(frames, VIEW, NARROW, "night")[2]
    assert motion is not None
    assert np.isfinite(motion).all()
    assert (motion[:, :3] == 0).all()


def test_frames_are_not_kept() -> None:
    alive: list[weakref.ref[np.ndarray]] = []
    most = 0

    def frames() -> Iterator[Frame]:
        nonlocal most
        for i in range(20):
            grey = texture(64, 8, i)
            alive.append(weakref.ref(grey))
            gc.collect()
            most = max(most, sum(reference() is not None for reference in alive))
            yield 0.1 * i, grey

    gc.freeze()  # so that a collection goes through the frames alone
    try:
        camera_rows(frames(), VIEW, NARROW, "many")
    finally:
        gc.unfreeze()
    assert most <= 3  # the one made, the one that the loop holds, the one in the generator


FAULTS = {
    "none": ([], {}, "no frames"),
    "size": ([(24, 32), (24, 30)], {}, "frame 1: 30 x 24 pixels; expected 32 x 24, as in frame 0"),
    "crop": ([(24, 32)], {"crop": Crop(x_max=40)}, "image.crop is x 0 to 40, y 0 to 24; expected a part of"),
    "empty crop": ([(24, 32)], {"crop": Crop(y_min=9, y_max=9)}, "y 9 to 9"),
    "small": ([(1, 32)], {}, "the crop has 32 x 1 pixels; expected at least"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faulty_frames_are_refused(case: str) -> None:
    shapes, settings, expected = FAULTS[case]
    frames = [(float(i), np.zeros(shape, np.uint8)) for i, shape in enumerate(shapes)]
    with pytest.raises(InputError, match=expected):
        camera_rows(frames, VIEW.model_copy(update=settings), None, "frames")


def test_without_visual_odometry_there_is_no_motion() -> None:
    assert camera_rows(turning([0, 1]), VIEW, None, "turn")[2] is None
