"""Videos as recordings: times by rate or stamps, odometry beside them or visual, one error for each fault."""

from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.recordings.video import VisualOdometryConfig
from robot.sources.in_memory import InMemorySource
from tactile.base.errors import InputError
from tests.helpers.corridor_camera import Camera, CorridorLoop, write_csv, write_video

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
    assert isinstance(source, InMemorySource)
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
    assert source.truth is not None
    np.testing.assert_allclose(source.truth, pose, atol=1e-6)
    assert source.seen.all()
    assert (source.motion[0] == 0).all()
    assert source.motion[1:, 0].min() > 0
    assert opened(settings(folder, file=name)).digest == source.digest


def test_stamps_give_the_times(folder: Path) -> None:
    source = opened(settings(folder, video={"stamps": "stamps.csv"}))
    np.testing.assert_allclose(source.time, WORLD.truth[0] + 100, atol=1e-9)
    assert source.digest != opened(settings(folder)).digest


def test_each_nth_frame(folder: Path) -> None:
    every = opened(settings(folder, video={"stamps": "stamps.csv", "every": 3}))
    full = opened(settings(folder, video={"stamps": "stamps.csv"}))
    np.testing.assert_array_equal(every.time, full.time[::3])
    np.testing.assert_array_equal(every.views, full.views[::3])


def test_wheel_odometry_replaces_visual_odometry(folder: Path) -> None:
    video = {"stamps": "stamps.csv", "odometry": "wheels.csv"}
    source = opened(settings(folder, video=video, table={"velocity": {}}))
    alone = opened(settings(folder, video={"stamps": "stamps.csv"}))
    _, speed, turn = WORLD.wheels()
    np.testing.assert_allclose(np.hypot(*source.motion[1:, :2].T), np.abs(speed[1:]) * 0.1, rtol=1e-5)
    np.testing.assert_allclose(source.motion[1:, 2], turn[1:] * 0.1, atol=1e-8)
    np.testing.assert_array_equal(source.views, alone.views)
    slow = opened(
        settings(folder, video=video | {"odometry": "slow.csv", "every": 3}, table={"velocity": {}})
    )
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
    assert source.length is not None
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


def test_visual_odometry_follows_a_short_drive(folder: Path) -> None:
    source = opened(settings(folder, visual_odometry=VisualOdometryConfig(fov_deg=90).model_dump()))
    turned, driven = source.motion[:, 2].sum(), source.motion[:, 0].sum()
    pose = WORLD.truth[1]
    assert turned == pytest.approx(pose[-1, 2] - pose[0, 2], abs=0.2)
    assert 0.2 < driven / np.hypot(*np.diff(pose[:, :2], axis=0).T).sum() < 5.0  # VO metres
