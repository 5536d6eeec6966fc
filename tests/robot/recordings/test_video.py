"""Cameras: views by block means, turns and distances by profiles; videos with their times and odometry."""

import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.recordings.video import Crop, ImageViewConfig, VisualOdometryConfig, camera_rows, image_view
from tactile.base.errors import InputError
from tests.helpers.corridor_camera import Camera, CorridorLoop, write_csv, write_video

PANORAMA = VisualOdometryConfig(fov_deg=360)
NARROW = VisualOdometryConfig(fov_deg=60)
VIEW = ImageViewConfig(rows=2, columns=8)


def turning(shifts):
    """Frames of a panorama that turns by columns: a smooth random image whose columns form a ring."""
    spectrum = np.fft.rfft(np.random.default_rng(0).standard_normal((24, 320)), axis=1)
    spectrum[:, 20:] = 0.0
    picture = np.fft.irfft(spectrum, 320, axis=1)
    image = np.round(128 + 100 * picture / np.abs(picture).max()).astype(np.uint8)
    return [(0.1 * i, np.roll(image, total, axis=1)) for i, total in enumerate(np.cumsum(shifts).tolist())]


def moved(frames, config):
    return camera_rows(frames, VIEW, config, "turn")[2]


@given(st.integers(1, 7), st.integers(1, 9), st.integers(0, 3), st.integers(0, 5))
def test_a_view_is_the_mean_of_every_pixel_once(rows, columns, top, left):
    random = np.random.default_rng([rows, columns, top, left])
    grey = random.integers(0, 256, (12, 15), dtype=np.uint8)
    config = ImageViewConfig(crop=Crop(y_min=top, x_min=left), rows=rows, columns=columns)
    part = grey[top:, left:] / 255
    down = np.arange(rows + 1) * part.shape[0] // rows
    across = np.arange(columns + 1) * part.shape[1] // columns
    expected = [[part[a:b, c:d].mean() for c, d in pairwise(across)] for a, b in pairwise(down)]
    np.testing.assert_allclose(image_view(config, grey)[..., 0], expected, rtol=1e-14)


TURNS = {
    "whole columns": (PANORAMA, [0, 3, -5, 0, 9], lambda grey: grey, 1e-10),
    "quarters of columns": (PANORAMA, [0, 1, 2, 5], lambda grey: grey.reshape(24, 80, 4).mean(axis=2), 0.36),
    "with edges": (NARROW, [0, 4, 4, -6], lambda grey: grey[:, :200], 0.01),
    "dark": (PANORAMA, [0, 4, 4], lambda grey: grey * 0.3, 0.1),
}
"""The camera, its turns in columns of the panorama, its image of it, and the largest error, in degrees."""


@pytest.mark.parametrize("case", TURNS)
def test_things_that_move_to_the_right_are_a_turn_to_the_left(case):
    config, shifts, seen, error = TURNS[case]
    motion = moved([(t, np.round(seen(grey)).astype(np.uint8)) for t, grey in turning(shifts)], config)
    column = 360 / 320 if config is PANORAMA else 60 / 200
    np.testing.assert_allclose(np.rad2deg(motion[:, 2]), np.array(shifts) * column, atol=error)
    if case == "whole columns":
        np.testing.assert_allclose(motion[:, :2], 0.0, atol=1e-12)


def test_the_first_frame_is_silent_and_steps_follow_the_stamps():
    random = np.random.default_rng(3)
    noise = [(time, random.integers(0, 256, (24, 320), dtype=np.uint8)) for time in (5.0, 5.1, 5.4)]
    # The limit counts here: the distance is 0.01 dt.
    motion = moved(noise, VisualOdometryConfig(fov_deg=60, max_speed=0.01))
    assert (motion[0] == 0).all()
    np.testing.assert_allclose(np.hypot(motion[:, 0], motion[:, 1]), [0, 0.001, 0.003], rtol=1e-9)
    np.testing.assert_allclose(motion[:, 3], [0, 0.1, 0.3])
    assert camera_rows(noise, VIEW, None, "turn")[2] is None


def test_turns_beyond_the_largest_rate_black_frames_and_repeated_stamps():
    config = VisualOdometryConfig(fov_deg=360, max_turn_rate_deg=30)  # 3 degrees, 2.7 columns, in 0.1 s
    assert abs(np.rad2deg(moved(turning([0, 40]), config)[1, 2])) <= 3.4
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


@pytest.mark.parametrize(("shapes", "settings", "expected"), UNFIT.values(), ids=UNFIT.keys())
def test_faulty_frames_are_refused(shapes, settings, expected):
    frames = [(float(i), np.zeros(shape, np.uint8)) for i, shape in enumerate(shapes)]
    with pytest.raises(InputError, match=expected):
        camera_rows(frames, VIEW.model_copy(update=settings), None, "frames")


WORLD = CorridorLoop(seed=5, length=5.0, depth=4.0, breadth=1.4, laps=0.12)
CAMERA = Camera(fov_deg=90, width=96, height=64)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
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


def opened(folder, warn=None, **parts):
    parts = {"file": "loop.avi", "video": {"rate": 10}, "visual_odometry": {"fov_deg": 90}} | parts
    return open_recording(RecordingConfig.model_validate(parts).resolved(folder), warn)


@pytest.mark.parametrize("name", ["loop.avi", "loop.mp4"])
def test_a_video_alone_is_a_recording(folder, name):
    table = {"truth": {"file": "truth.csv"}}
    source = opened(folder, file=name, table=table, image={"rows": 4, "columns": 12})
    time, pose = WORLD.truth
    assert (source.length, source.view_shape) == (len(time), (4, 12, 1))
    assert source.rate_hz == pytest.approx(10)
    np.testing.assert_allclose(source.time, time, atol=1e-9)
    np.testing.assert_allclose(source.truth, pose, atol=1e-6)
    assert source.seen.all()
    views = [image_view(ImageViewConfig(rows=4, columns=12), grey) for grey in CAMERA.frames(WORLD)]
    np.testing.assert_allclose(source.views, views, atol=5 / 255)  # grey levels of compressed frames
    assert (source.motion[0] == 0).all()
    assert source.motion[1:, 0].min() > 0
    assert source.motion[:, 2].sum() == pytest.approx(pose[-1, 2] - pose[0, 2], abs=0.2)
    way = np.hypot(*np.diff(pose[:, :2], axis=0).T).sum()
    assert 0.2 < source.motion[:, 0].sum() / way < 5.0  # metres of visual odometry
    assert opened(folder, file=name).digest == source.digest


def test_stamps_give_the_times_of_frames_and_place_them_on_the_wheels_odometry(folder):
    source = opened(folder, video={"stamps": "stamps.csv"})
    np.testing.assert_allclose(source.time, WORLD.truth[0] + 100, atol=1e-9)
    assert source.digest != opened(folder).digest
    every = opened(folder, video={"stamps": "stamps.csv", "every": 3})
    np.testing.assert_array_equal(every.time, source.time[::3])
    np.testing.assert_array_equal(every.views, source.views[::3])
    video = {"stamps": "stamps.csv", "odometry": "wheels.csv"}
    rolled = opened(folder, video=video, table={"velocity": {}})
    _, speed, turn = WORLD.wheels()
    np.testing.assert_allclose(np.hypot(*rolled.motion[1:, :2].T), np.abs(speed[1:]) * 0.1, rtol=1e-5)
    np.testing.assert_allclose(rolled.motion[1:, 2], turn[1:] * 0.1, atol=1e-8)
    np.testing.assert_array_equal(rolled.views, source.views)
    slow = opened(folder, video=video | {"odometry": "slow.csv", "every": 3}, table={"velocity": {}})
    np.testing.assert_array_equal(slow.views, every.views)


FAULTS = {
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


@pytest.mark.parametrize(("parts", "expected"), FAULTS.values(), ids=FAULTS.keys())
def test_faults_are_one_error_each(parts, expected, folder):
    with pytest.raises(InputError, match=expected) as error:
        opened(folder, **parts)
    assert len(str(error.value).splitlines()) == 1


def test_a_video_that_ends_too_early_warns(folder, tmp_path):
    content = (folder / "loop.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(content[: len(content) // 2])
    warnings = []
    source = opened(folder, warnings.append, file=str(tmp_path / "cut.avi"))
    frames = len(WORLD.truth[0])
    assert 0 < source.length < frames
    assert warnings == [f"{tmp_path / 'cut.avi'}: only {source.length} of {frames} frames can be read"]


def test_the_missing_extra_is_named(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[video\]'"):
        opened(folder)
