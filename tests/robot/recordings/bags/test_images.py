"""Images of every encoding become the same grey image."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from robot.recordings.bags.bag_description import describe_bag
from robot.recordings.bags.views import COMPRESSED, RAW, grey_image
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.sources.in_memory import InMemorySource
from tactile.base.errors import InputError
from tests.helpers.corridor_camera import Camera, CorridorLoop, stored_frames, write_video
from tests.helpers.ros_bags import ROS2, Entry, built, header, image, odometry, write_bag

COLOUR = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
GREY = np.asarray(Image.fromarray(COLOUR).convert("L"))
Refused = Callable[..., InputError]


def raw(pixels: np.ndarray, encoding: str, padding: int = 0, **fields: Any) -> Any:
    """A raw image whose rows end with some bytes of padding."""
    rows = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8).reshape(len(pixels), -1)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    given = {"step": data.shape[1], "data": data.reshape(-1)} | fields
    return built(ROS2, RAW, image(0, pixels, encoding, **given).fields)


def with_alpha(pixels: np.ndarray) -> np.ndarray:
    return np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 9, np.uint8)], axis=2)


def encoded(pixels: np.ndarray) -> np.ndarray:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return np.frombuffer(file.getvalue(), np.uint8)


ENCODED = {
    "mono8": GREY,
    "8UC1": GREY,
    "rgb8": COLOUR,
    "bgr8": COLOUR[..., ::-1],
    "rgba8": with_alpha(COLOUR),
    "bgra8": with_alpha(COLOUR[..., ::-1]),
}


@pytest.mark.parametrize("encoding", ENCODED)
def test_raw_images_become_grey(encoding: str) -> None:
    """As Pillow weighs the colours, to one grey level."""
    grey = grey_image(raw(ENCODED[encoding], encoding, padding=3), RAW, "here")
    assert grey.dtype == np.uint8
    assert np.abs(grey.astype(int) - GREY).max() <= (0 if ENCODED[encoding] is GREY else 1)


@pytest.mark.parametrize("order", ["<", ">"])
def test_sixteen_bits_keep_the_upper_byte(order: str) -> None:
    pixels = (GREY.astype(int) * 256 + 77).astype(f"{order}u2")
    found = grey_image(raw(pixels, "mono16", padding=2, is_bigendian=int(order == ">")), RAW, "here")
    assert np.array_equal(found, GREY)


MOSAICS = [f"bayer_{order}{bits}" for order in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)]


@pytest.mark.parametrize("encoding", MOSAICS)
def test_a_mosaic_is_the_mean_of_its_colours(encoding: str) -> None:
    levels = {"r": 40, "g": 80, "b": 200}
    block = np.array([levels[name] for name in encoding[6:10]]).reshape(2, 2)
    scale = 256 if encoding.endswith("16") else 1
    pixels = (np.tile(block, (3, 4))[:5, :7] * scale).astype("u2" if scale > 1 else "u1")
    grey = grey_image(raw(pixels, encoding, padding=2), RAW, "here")
    assert (grey.shape, np.unique(grey).tolist()) == ((5, 7), [100])


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12", "nv21"])
def test_the_grey_channel_is_taken(encoding: str) -> None:
    other = np.full_like(GREY, 128)
    if encoding.startswith("nv"):
        content = raw(GREY, encoding, data=np.concatenate([GREY.ravel(), other.ravel()[:21]]))
    else:
        first = encoding in ("yuv422_yuy2", "yuyv")
        content = raw(np.stack([GREY, other] if first else [other, GREY], -1), encoding)
    assert np.array_equal(grey_image(content, RAW, "here"), GREY)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
@pytest.mark.parametrize("pixels", [GREY, COLOUR], ids=["grey", "colour"])
def test_compressed_images_become_grey(kind: str, pixels: np.ndarray) -> None:
    file = io.BytesIO()
    Image.fromarray(pixels).save(
        file, kind, **({"quality": 100, "subsampling": 0} if kind == "JPEG" else {"lossless": True})
    )
    content = built(
        ROS2, COMPRESSED, {"format": kind.lower(), "data": np.frombuffer(file.getvalue(), np.uint8)}
    )
    away = np.abs(grey_image(content, COMPRESSED, "here").astype(int) - GREY).max()
    assert away <= {"PNG": 0, "WEBP": 1}.get(kind, 4)


def test_sixteen_bit_png() -> None:
    content = built(ROS2, COMPRESSED, {"format": "png", "data": encoded(GREY.astype(np.uint16) * 256 + 77)})
    assert np.array_equal(grey_image(content, COMPRESSED, "here"), GREY)


def test_images_that_cannot_be_read_are_refused(refused: Refused) -> None:
    def read(content: Any, kind: str = RAW) -> Any:
        return grey_image(content, kind, "here")

    refused(lambda: read(raw(GREY, "lab8")), "here", "encoding 'lab8'", "mono8")
    depth = built(ROS2, COMPRESSED, {"format": "32FC1; compressedDepth png"})
    for content, kind in ((raw(GREY.astype("f4"), "32FC1"), RAW), (depth, COMPRESSED)):
        refused(
            lambda content=content, kind=kind: read(content, kind),
            "distances (32FC1",
            "recording.topics.views",
        )
    refused(lambda: read(raw(GREY, "mono8", height=6)), "7 x 6 pixels", "in 35 bytes")
    refused(lambda: read(raw(GREY, "rgb8")), "7 bytes a row")
    refused(lambda: read(raw(GREY, "mono8", width=0)), "0 x 5 pixels")
    nonsense = {"format": "jpeg", "data": np.arange(99, dtype=np.uint8)}
    refused(lambda: read(built(ROS2, COMPRESSED, nonsense), COMPRESSED), "99 bytes of format 'jpeg'")
    cut = {"format": "png", "data": encoded(COLOUR)[:60]}
    refused(lambda: read(built(ROS2, COMPRESSED, cut), COMPRESSED), "cannot be decoded")


SPOILT = {
    "broken": {"data": np.arange(99, dtype=np.uint8)},
    "empty": {"data": np.zeros(0, np.uint8)},
    "of another size": {"data": encoded(COLOUR[:4])},
}


@pytest.mark.parametrize("case", SPOILT)
def test_one_image_that_cannot_be_used_is_left_out(case: str, tmp_path: Path) -> None:
    times = range(10**9, 3 * 10**9, 10**8)
    entries = [odometry(time, time / 10**10, 0, 0) for time in times]
    for row, time in enumerate(times):
        fields = {"header": header(time), "format": "png", "data": encoded(COLOUR)}
        entries.append(Entry("/camera", COMPRESSED, time, fields | (SPOILT[case] if row == 5 else {})))
    path = write_bag(tmp_path, "mcap", sorted(entries, key=lambda entry: entry.time))
    told: list[str] = []
    recording = {
        "file": path,
        "topics": {"odometry": "/odom", "views": "/camera"},
        "image": {"rows": 4, "columns": 7},
    }
    source = open_recording(RecordingConfig.model_validate(recording), told.append)
    assert [bool(sample.reading.view_seen) for sample in source] == [row != 5 for row in range(20)]
    assert len(told) == 1
    assert "message 5, at 1.500 s: " in told[0]
    assert "1 of 20 messages are left out" in told[0]
    assert describe_bag(path).topics[0].roles == ("views",)


def test_a_bag_of_jpegs_gives_the_rows_of_their_video(tmp_path: Path) -> None:
    """The same JPEG bytes as MJPG frames and as CompressedImage; only the decoders differ."""
    world = CorridorLoop(seed=5, length=5.0, depth=4.0, breadth=1.4, laps=0.12)
    video = tmp_path / "walk.avi"
    write_video(video, Camera(fov_deg=90, width=96, height=64).frames(world), world.rate)
    images = [
        Entry(
            "/camera/image/compressed",
            COMPRESSED,
            time,
            {"header": header(time), "format": "jpeg", "data": np.frombuffer(data, np.uint8)},
        )
        for data, time in zip(stored_frames(video), range(10**9, 10**12, 10**8), strict=False)
    ]
    bag = write_bag(tmp_path, "mcap", images)
    shared = {"image": {"rows": 4, "columns": 12}, "visual_odometry": {"fov_deg": 90}}
    of_video, of_bag = (
        open_recording(RecordingConfig.model_validate(shared | recording), pytest.fail)
        for recording in (
            {"file": video, "video": {"rate": world.rate}},
            {"file": bag, "topics": {"views": "/camera/image/compressed"}},
        )
    )
    assert isinstance(of_video, InMemorySource)
    assert isinstance(of_bag, InMemorySource)
    assert np.diff(of_bag.time) == pytest.approx(np.diff(of_video.time), abs=1e-9)
    assert of_bag.views == pytest.approx(of_video.views, abs=3 / 255)  # grey levels
    distance, turn = of_video.motion[:, 0], of_video.motion[:, 2]
    assert distance[1:].min() > 0.01
    assert of_bag.motion[:, 0] == pytest.approx(distance, rel=0.02)  # a grey level of the mean is 0.8 %
    assert of_bag.motion[:, 2] == pytest.approx(turn, abs=np.deg2rad(0.02))  # a column is 0.94 degrees
