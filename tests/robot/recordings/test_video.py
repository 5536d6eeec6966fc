"""Cameras: views by block means, turns and distances by profiles; videos with their times and odometry."""

from __future__ import annotations

import builtins
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.recordings.video import Crop, Frame, ImageViewConfig, VisualOdometryConfig, camera_rows, image_view
from robot.sources.in_memory import InMemorySource
from tactile.base.errors import InputError
from tests.helpers.corridor_camera import Camera, CorridorLoop, write_csv, write_video

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


def moved(frames: list[Frame], config: VisualOdometryConfig) -> np.ndarray:
    motion = camera_rows(frames, VIEW, config, "turn")[2]
    return motion


@given(st.integers(1, 7), st.integers(1, 9), st.integers(0, 3), st.integers(0, 5))
def test_a_view_is_the_mean_of_every_pixel_once(rows: int, columns: int, top: int, left: int) -> None:
    random = np.random.default_rng([rows, columns, top, left])
    grey = random.integers(0, 256, (12, 15), dtype=np.uint8)
    config = ImageViewConfig(crop=Crop(y_min=top, x_min=left), rows=rows, columns=columns)
    part = grey[top:, left:] / 255
    down = np.arange(rows + 1) * part.shape[0] // rows
    across = np.arange(columns + 1) * part.shape[1] // columns
    expected = [[part[a:b, c:d].mean() for c, d in pairwise(across)] for a, b in pairwise(down)]
    np.testing.assert_allclose(image_view(config, grey)[..., 0], expected, rtol=1e-14)


def test_a_panorama_turns_by_whole_columns_exactly() -> None:
    shifts = [0, 3, -5, 0, 9]  # things move to the right: the camera turns counter-clockwise
    motion = moved(turning(shifts), PANORAMA)
    np.testing.assert_allclose(motion[:, 2], np.array(shifts) * 2 * np.pi / 320, atol=1e-12)
    np.testing.assert_allclose(motion[:, :2], 0.0, atol=1e-12)


def test_turns_are_found_between_columns() -> None:
    coarse = [
        (time, grey.reshape(24, 80, 4).mean(axis=2).round().astype(np.uint8))
        for time, grey in turning([0, 1, 2, 5])
    ]
    error = moved(coarse, PANORAMA)[1:, 2] / (2 * np.pi / 80) - [0.25, 0.5, 1.25]
    assert np.abs(error).max() < 0.08  # columns; whole ones would be off by 0.25 and 0.5


def test_a_camera_with_edges_turns_by_its_field_of_view() -> None:
    motion = moved([(time, grey[:, :200]) for time, grey in turning([0, 4, 4, -6])], NARROW)
    np.testing.assert_allclose(np.rad2deg(motion[:, 2]), np.array([0, 4, 4, -6]) * 60 / 200, atol=0.01)


def test_exposure_cancels_out() -> None:
    frames = turning([0, 4, 4])
    dark = [(time, np.round(grey * 0.3).astype(np.uint8)) for time, grey in frames]
    np.testing.assert_allclose(moved(frames, PANORAMA), moved(dark, PANORAMA), atol=2e-3)


def test_the_first_frame_is_silent_and_steps_follow_the_stamps() -> None:
    random = np.random.default_rng(3)
    noise = [(time, random.integers(0, 256, (24, 320), dtype=np.uint8)) for time in (5.0, 5.1, 5.4)]
    # The limit counts here: the distance is 0.01 dt.
    motion = moved(noise, VisualOdometryConfig(fov_deg=60, max_speed=0.01))
    assert (motion[0] == 0).all()
    np.testing.assert_allclose(np.hypot(motion[:, 0], motion[:, 1]), [0, 0.001, 0.003], rtol=1e-9)
    np.testing.assert_allclose(motion[:, 3], [0, 0.1, 0.3])
    assert camera_rows(noise, VIEW, None, "turn")[2] is None


def test_turns_beyond_the_largest_rate_are_not_looked_for() -> None:
    config = VisualOdometryConfig(fov_deg=360, max_turn_rate_deg=30)  # 3 degrees, 2.7 columns, in 0.1 s
    assert abs(np.rad2deg(moved(turning([0, 40]), config)[1, 2])) <= 3.4


def test_black_frames_and_repeated_stamps_move_nothing() -> None:
    motion = moved([(time, np.zeros((24, 32), np.uint8)) for time in (0.0, 0.1, 0.1)], NARROW)
    assert (motion[:, :3] == 0).all()
    assert np.isfinite(motion).all()


UNFIT = {
    "none": ([], {}, "no frames"),
    "size": ([(24, 32), (24, 30)], {}, "frame 1: 30 x 24 pixels; expected 32 x 24, as in frame 0"),
    "crop": ([(24, 32)], {"crop": Crop(x_max=40)}, "image.crop is x 0 to 40, y 0 to 24; expected a part of"),
    "empty crop": ([(24, 32)], {"crop": Crop(y_min=9, y_max=9)}, "y 9 to 9"),
    "small": ([(1, 32)], {}, "the crop has 32 x 1 pixels; expected at least"),
}


@pytest.mark.parametrize("case", UNFIT)
def test_faulty_frames_are_refused(case: str) -> None:
    shapes, settings, expected = UNFIT[case]
    frames = [(float(i), np.zeros(shape, np.uint8)) for i, shape in enumerate(shapes)]
    with pytest.raises(InputError, match=expected):
        camera_rows(frames, VIEW.model_copy(update=settings), None, "frames")


WORLD = CorridorLoop(seed=5, length=5.0, depth=4.0, breadth=1.4, laps=0.12)
CAMERA = Camera(fov_deg=90, width=96, height=64)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video with stamps, wheel odometry and truth."""
    folder = tmp_path_factory.mktemp("video")
    time, pose = WORLD.truth
    for name, codec in (("loop.avi", "MJPG"), ("loop.mp4", "mp4v")):
        assert write_video(folder / name, CAMERA.frames(WORLD), 10, codec) == len(time)
    write_csv(folder / "stamps.csv", t=time + 100)
    write_csv(folder / "truth.csv", t=time, x=pose[:, 0], y=pose[:, 1], heading=pose[:, 2])
    clock, speed, turn = WORLD.wheels()
    write_csv(folder / "wheels.csv", t=clock + 100, vx=speed, w=turn)
    write_csv(folder / "slow.csv", t=clock[::3] + 100, vx=speed[::3], w=turn[::3])
    write_csv(folder / "short.csv", t=time[:-2])
    write_csv(folder / "back.csv", t=time[::-1])
    (folder / "text.avi").write_text("no video")
    (folder / "cut.mp4").write_bytes((folder / "loop.mp4").read_bytes()[:2000])
    return folder


def settings(folder: Path, **parts: Any) -> RecordingConfig:
    """A recording in the folder with visual odometry unless stated otherwise."""
    parts = {"file": "loop.avi", "video": {"rate": 10}, "visual_odometry": {"fov_deg": 90}} | parts
    return RecordingConfig.model_validate(parts).resolved(folder)


def opened(config: RecordingConfig) -> InMemorySource:
    source = open_recording(config)
    return source


@pytest.mark.parametrize("name", ["loop.avi", "loop.mp4"])
def test_a_video_alone_is_a_recording(folder: Path, name: str) -> None:
    table = {"truth": {"file": "truth.csv"}}
    source = opened(settings(folder, file=name, table=table, image={"rows": 4, "columns": 12}))
    time, pose = WORLD.truth
    assert source.length == len(time)
    assert source.view_shape == (4, 12, 1)
    assert source.rate_hz == pytest.approx(10)
    np.testing.assert_allclose(source.time, time, atol=1e-9)
    np.testing.assert_allclose(source.truth, pose, atol=1e-6)
    assert source.seen.all()
    views = [image_view(ImageViewConfig(rows=4, columns=12), grey) for grey in CAMERA.frames(WORLD)]
    np.testing.assert_allclose(source.views, views, atol=5 / 255)  # grey levels of compressed frames
    assert (source.motion[0] == 0).all()
    assert source.motion[1:, 0].min() > 0
    assert source.motion[:, 2].sum() == pytest.approx(pose[-1, 2] - pose[0, 2], abs=0.2)
    assert (
        0.2 < source.motion[:, 0].sum() / np.hypot(*np.diff(pose[:, :2], axis=0).T).sum() < 5.0
    )  # VO metres
    assert opened(settings(folder, file=name)).digest == source.digest


def test_stamps_give_the_times_of_every_frame_or_of_each_nth(folder: Path) -> None:
    source = opened(settings(folder, video={"stamps": "stamps.csv"}))
    np.testing.assert_allclose(source.time, WORLD.truth[0] + 100, atol=1e-9)
    assert source.digest != opened(settings(folder)).digest
    every = opened(settings(folder, video={"stamps": "stamps.csv", "every": 3}))
    np.testing.assert_array_equal(every.time, source.time[::3])
    np.testing.assert_array_equal(every.views, source.views[::3])


def test_wheel_odometry_replaces_visual_odometry(folder: Path) -> None:
    video = {"stamps": "stamps.csv", "odometry": "wheels.csv"}
    source = opened(settings(folder, video=video, table={"velocity": {}}))
    alone = opened(settings(folder, video={"stamps": "stamps.csv"}))
    _, speed, turn = WORLD.wheels()
    np.testing.assert_allclose(np.hypot(*source.motion[1:, :2].T), np.abs(speed[1:]) * 0.1, rtol=1e-5)
    np.testing.assert_allclose(source.motion[1:, 2], turn[1:] * 0.1, atol=1e-8)
    np.testing.assert_array_equal(source.views, alone.views)
    video |= {"odometry": "slow.csv", "every": 3}
    slow = opened(settings(folder, video=video, table={"velocity": {}}))
    np.testing.assert_array_equal(slow.views, alone.views[::3])


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "missing": ({"file": "lop.avi"}, "no such file.*did you mean 'loop.avi'"),
    "text": ({"file": "text.avi"}, "text.avi: cannot be decoded; expected a video"),
    "cut": ({"file": "cut.mp4"}, "cut.mp4: cannot be decoded"),
    "no times": ({"video": {}}, "no times of its frames.*recording.video.rate or stamps, rate: 10 if"),
    "both times": ({"video": {"rate": 10, "stamps": "stamps.csv"}}, "both video.rate and video.stamps"),
    "too few": ({"video": {"stamps": "short.csv"}}, r"short.csv: \d+ times; expected \d+, one for each"),
    "backwards": ({"video": {"stamps": "back.csv"}}, "t goes back"),
    "column": ({"video": {"stamps": "stamps.csv", "time": "s"}}, "stamps.csv:1: no column 's'"),
    "no odometry": ({"visual_odometry": None}, "no odometry.*visual_odometry.fov_deg"),
    "no file": ({"table": {"velocity": {}}}, "table.velocity is given, but no file"),
    "views": ({"table": {"views": {}}}, "table.views is given, and the video has views"),
    "truth": ({"table": {"truth": {}}}, "table.truth names no file"),
    "slow": ({"video": {"stamps": "stamps.csv", "odometry": "slow.csv"}, "table": {"velocity": {}}},
             "same odometry row as the previous one.*thin them out"),
    "clock": ({"video": {"rate": 10, "odometry": "wheels.csv"}, "table": {"velocity": {}}},
              "frame 0: the nearest odometry row is 100 s away"),
}  # fmt: skip


@pytest.mark.parametrize("case", FAULTS)
def test_faults_are_one_error_each(case: str, folder: Path) -> None:
    parts, expected = FAULTS[case]
    with pytest.raises(InputError, match=expected) as error:
        opened(settings(folder, **parts))
    assert len(str(error.value).splitlines()) == 1


def test_a_video_that_ends_too_early_warns(folder: Path, tmp_path: Path) -> None:
    content = (folder / "loop.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(content[: len(content) // 2])
    warnings: list[str] = []
    source = open_recording(settings(folder, file=str(tmp_path / "cut.avi")), warnings.append)
    frames = len(WORLD.truth[0])
    assert 0 < source.length < frames
    assert warnings == [f"{tmp_path / 'cut.avi'}: only {source.length} of {frames} frames can be read"]


def test_the_missing_extra_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without_opencv(name: str, *rest: Any) -> Any:
        if name == "cv2":
            raise ModuleNotFoundError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without_opencv)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[video\]'"):
        opened(settings(folder))
