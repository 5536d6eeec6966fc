"""Images of every encoding become the same grey image."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

from robot.recordings.bags.images import COMPRESSED, RAW, grey_image
from tactile.base.errors import InputError
from tests.helpers.ros_bags import ROS2, built

COLOUR = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
GREY = np.asarray(Image.fromarray(COLOUR).convert("L"))
Refused = Callable[..., InputError]


def raw(pixels: np.ndarray, encoding: str, padding: int = 0, **fields: Any) -> Any:
    """A raw image whose rows end with some bytes of padding."""
    rows = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8).reshape(len(pixels), -1)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    given = {
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
        "step": data.shape[1],
        "data": data.reshape(-1),
    }
    return built(ROS2, RAW, given | fields)


def with_alpha(pixels: np.ndarray) -> np.ndarray:
    return np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 9, np.uint8)], axis=2)


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


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
@pytest.mark.parametrize("pixels", [GREY, COLOUR], ids=["grey", "colour"])
def test_compressed_images_become_grey(kind: str, pixels: np.ndarray) -> None:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **({"quality": 100, "subsampling": 0} if kind == "JPEG" else {}))
    content = built(
        ROS2, COMPRESSED, {"format": kind.lower(), "data": np.frombuffer(file.getvalue(), np.uint8)}
    )
    away = np.abs(grey_image(content, COMPRESSED, "here").astype(int) - GREY).max()
    assert away <= (0 if kind == "PNG" else 4)


def test_sixteen_bit_png() -> None:
    file = io.BytesIO()
    Image.fromarray(GREY.astype(np.uint16) * 256 + 77).save(file, "PNG")
    content = built(ROS2, COMPRESSED, {"format": "png", "data": np.frombuffer(file.getvalue(), np.uint8)})
    assert np.array_equal(grey_image(content, COMPRESSED, "here"), GREY)


def test_images_that_cannot_be_read_are_refused(refused: Refused) -> None:
    def read(content: Any, kind: str = RAW) -> Any:
        return grey_image(content, kind, "here")

    refused(lambda: read(raw(GREY, "yuv422")), "here", "encoding 'yuv422'", "mono8")
    refused(lambda: read(raw(GREY, "mono8", height=6)), "7 x 6 pixels", "in 35 bytes")
    refused(lambda: read(raw(GREY, "rgb8")), "7 bytes a row")
    refused(lambda: read(raw(GREY, "mono8", width=0)), "0 x 5 pixels")
    nonsense = {"format": "jpeg", "data": np.arange(99, dtype=np.uint8)}
    refused(lambda: read(built(ROS2, COMPRESSED, nonsense), COMPRESSED), "99 bytes of format 'jpeg'")
    file = io.BytesIO()
    Image.fromarray(COLOUR).save(file, "PNG")
    cut = {"format": "png", "data": np.frombuffer(file.getvalue(), np.uint8)[:60]}
    refused(lambda: read(built(ROS2, COMPRESSED, cut), COMPRESSED), "cannot be decoded")
