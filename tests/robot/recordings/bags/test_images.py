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
from tactile.base.errors import InputError
from tests.helpers.ros_bags import ROS2, Entry, built, header, image, odometry
from tests.robot.recordings.bags.conftest import opened

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


MOSAIC = {"r": 40, "g": 80, "b": 200}
OTHER = np.full_like(GREY, 128)
PLANES = np.concatenate([GREY.ravel(), OTHER.ravel()[:21]])


def mosaic(order: str, scale: int) -> np.ndarray:
    block = np.array([MOSAIC[name] for name in order]).reshape(2, 2)
    return (np.tile(block, (3, 4))[:5, :7] * scale).astype("u2" if scale > 1 else "u1")


def compressed(pixels: np.ndarray, kind: str, **options: Any) -> Any:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **options)
    data = np.frombuffer(file.getvalue(), np.uint8)
    return built(ROS2, COMPRESSED, {"format": kind.lower(), "data": data})


DEEP = GREY.astype(int) * 256 + 77
READABLE: dict[str, tuple[Any, int]] = {
    "mono8": (raw(GREY, "mono8", 3), 0),
    "8UC1": (raw(GREY, "8UC1", 3), 0),
    "rgb8": (raw(COLOUR, "rgb8", 3), 1),
    "bgr8": (raw(COLOUR[..., ::-1], "bgr8", 3), 1),
    "rgba8": (raw(with_alpha(COLOUR), "rgba8", 3), 1),
    "bgra8": (raw(with_alpha(COLOUR[..., ::-1]), "bgra8", 3), 1),
    "mono16": (raw(DEEP.astype("<u2"), "mono16", 2), 0),
    "big-endian mono16": (raw(DEEP.astype(">u2"), "mono16", 2, is_bigendian=1), 0),
    "yuv422": (raw(np.stack([OTHER, GREY], -1), "yuv422"), 0),
    "uyvy": (raw(np.stack([OTHER, GREY], -1), "uyvy"), 0),
    "yuv422_yuy2": (raw(np.stack([GREY, OTHER], -1), "yuv422_yuy2"), 0),
    "yuyv": (raw(np.stack([GREY, OTHER], -1), "yuyv"), 0),
    "nv12": (raw(GREY, "nv12", data=PLANES), 0),
    "nv21": (raw(GREY, "nv21", data=PLANES), 0),
    "grey PNG": (compressed(GREY, "PNG"), 0),
    "PNG": (compressed(COLOUR, "PNG"), 0),
    "PNG of 16 bits": (compressed(DEEP.astype("<u2"), "PNG"), 0),
    "grey WebP": (compressed(GREY, "WEBP", lossless=True), 1),
    "WebP": (compressed(COLOUR, "WEBP", lossless=True), 1),
    "grey JPEG": (compressed(GREY, "JPEG", quality=100, subsampling=0), 4),
    "JPEG": (compressed(COLOUR, "JPEG", quality=100, subsampling=0), 4),
}
"""Images, and how far their grey levels may be from those of Pillow."""


@pytest.mark.parametrize("case", READABLE)
def test_images_become_grey(case: str) -> None:
    content, away = READABLE[case]
    grey = grey_image(content, COMPRESSED if hasattr(content, "format") else RAW, "here")
    assert grey.dtype == np.uint8
    assert np.abs(grey.astype(int) - GREY).max() <= away


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_mosaic_is_the_mean_of_its_colours(order: str) -> None:
    for bits, scale in ((8, 1), (16, 256)):
        grey = grey_image(raw(mosaic(order, scale), f"bayer_{order}{bits}", 2), RAW, "here")
        assert (grey.shape, np.unique(grey).tolist()) == ((5, 7), [100])


def test_images_that_cannot_be_read_are_refused(refused: Refused) -> None:
    nonsense = {"format": "jpeg", "data": np.arange(99, dtype=np.uint8)}
    cut = {"format": "png", "data": encoded(COLOUR)[:60]}
    for content, *pieces in (
        (raw(GREY, "lab8"), "here", "encoding 'lab8'", "mono8"),
        (raw(GREY.astype("f4"), "32FC1"), "distances (32FC1", "recording.topics.views"),
        (raw(GREY, "mono8", height=6), "7 x 6 pixels", "in 35 bytes"),
        (raw(GREY, "rgb8"), "7 bytes a row"),
        (raw(GREY, "mono8", width=0), "0 x 5 pixels"),
        (built(ROS2, COMPRESSED, {"format": "32FC1; compressedDepth png"}), "distances (32FC1"),
        (built(ROS2, COMPRESSED, nonsense), "99 bytes of format 'jpeg'"),
        (built(ROS2, COMPRESSED, cut), "cannot be decoded"),
    ):
        kind = COMPRESSED if hasattr(content, "format") else RAW
        refused(lambda content=content, kind=kind: grey_image(content, kind, "here"), *pieces)


SPOILT = {
    "broken": {"data": np.arange(99, dtype=np.uint8)},
    "empty": {"data": np.zeros(0, np.uint8)},
    "of another size": {"data": encoded(COLOUR[:4])},
}


@pytest.mark.parametrize("case", SPOILT)
def test_one_image_that_cannot_be_used_is_left_out(case: str, write: Callable[..., Path]) -> None:
    times, told = range(10**9, 3 * 10**9, 10**8), list[str]()
    entries = []
    for row, time in enumerate(times):
        fields = {"header": header(time), "format": "png", "data": encoded(COLOUR)}
        entries.append(Entry("/camera", COMPRESSED, time, fields | (SPOILT[case] if row == 5 else {})))
    path = write([odometry(time, time / 10**10, 0, 0) for time in times], entries)
    source = opened(path, told, views="/camera", image={"rows": 4, "columns": 7})
    assert source.seen.tolist() == [row != 5 for row in range(20)]
    assert len(told) == 1
    assert "message 5, at 1.500 s: " in told[0]
    assert "1 of 20 messages are left out" in told[0]
    assert describe_bag(path).topics[0].roles == ("views",)
