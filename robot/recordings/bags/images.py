"""Grey images from Image and CompressedImage messages."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from tactile.base.errors import InputError

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMAGES = (RAW, COMPRESSED)
LUMA = {"y": 1000, "r": 299, "g": 587, "b": 114}  # per mille (BT.601), as Pillow weighs them
LARGEST = 1 << 26  # pixels

ENCODINGS: dict[str, tuple[str, str]] = {
    **dict.fromkeys(("mono8", "8UC1"), ("u1", "y")),
    **dict.fromkeys(("mono16", "16UC1"), ("u2", "y")),
    **dict.fromkeys(("rgb8",), ("u1", "rgb")),
    **dict.fromkeys(("bgr8", "8UC3"), ("u1", "bgr")),
    **dict.fromkeys(("rgba8",), ("u1", "rgba")),
    **dict.fromkeys(("bgra8", "8UC4"), ("u1", "bgra")),
    **dict.fromkeys(("yuv422", "uyvy"), ("u1", "-y")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), ("u1", "y-")),
    **dict.fromkeys(("nv12", "nv21", "nv24"), ("u1", "y")),  # the other planes come after the grey one
    **{
        f"bayer_{order}{bits}": (f"u{bits // 8}", "y")
        for order in ("rggb", "bggr", "gbrg", "grbg")
        for bits in (8, 16)
    },
}
"""Encodings of raw images: NumPy type and channels."""
NO_DEPTH = "name a topic of grey or colour images with recording.topics.views"


def grey_image(message: Any, kind: str, where: str) -> np.ndarray:
    """[H, W] uint8 of an image message of this type.

    Raises:
        InputError: the encoding is unknown, or the data are damaged.
    """
    return _decoded(message, where) if kind == COMPRESSED else _raw(message, where)


def _raw(message: Any, where: str) -> np.ndarray:
    if message.encoding in ("32FC1", "64FC1"):
        raise InputError(where, f"distances ({message.encoding})", "a grey or colour image", NO_DEPTH)
    if message.encoding not in ENCODINGS:
        raise InputError(where, f"encoding {message.encoding!r}", f"one of {', '.join(ENCODINGS)}")
    number, channels = ENCODINGS[message.encoding]
    kind = np.dtype((">" if message.is_bigendian else "<") + number)
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, np.uint8)
    length = width * len(channels) * kind.itemsize
    if not (0 < height * width <= LARGEST and length <= step and len(data) >= step * (height - 1) + length):
        found = f"{width} x {height} pixels of {message.encoding}, {step} bytes a row, in {len(data)} bytes"
        raise InputError(where, found, "data that fit their description")
    strides = (step, len(channels) * kind.itemsize, kind.itemsize)
    pixels = np.ndarray((height, width, len(channels)), kind, data.tobytes(), strides=strides)
    if channels == "y":
        grey = (pixels[..., 0] >> 8).astype(np.uint8) if kind.itemsize == 2 else pixels[..., 0].copy()
        return _without_mosaic(grey) if message.encoding.startswith("bayer") else grey
    weights = np.array([LUMA.get(name, 0) for name in channels], np.int32)
    return ((pixels.astype(np.int32) @ weights + 500) // 1000).astype(np.uint8)


def _without_mosaic(mosaic: np.ndarray) -> np.ndarray:
    """[H, W] means of each pixel and its right and lower neighbours, one of each colour of the filter."""
    near = np.pad(mosaic.astype(np.uint16), ((0, 1), (0, 1)), "reflect" if min(mosaic.shape) > 1 else "edge")
    return ((near[:-1, :-1] + near[1:, :-1] + near[:-1, 1:] + near[1:, 1:] + 2) // 4).astype(np.uint8)


def _decoded(message: Any, where: str) -> np.ndarray:
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        raise InputError("pillow", "not installed", "", "pip install 'ratslam[ros]'") from None
    if "compressedDepth" in message.format:
        raise InputError(where, f"distances ({message.format})", "a grey or colour image", NO_DEPTH)
    data = bytes(message.data)
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as image:
            if image.width * image.height > LARGEST:
                raise InputError(where, f"{image.width} x {image.height} pixels", f"at most {LARGEST}")
            if image.mode.startswith("I"):  # 16 bits
                return (np.asarray(image).astype(np.int64) >> 8).clip(0, 255).astype(np.uint8)
            return np.asarray(image.convert("L"))
    except InputError:
        raise
    except UnidentifiedImageError:
        found = f"{len(data)} bytes of format {message.format!r}"
        raise InputError(where, found, "a JPEG, PNG or WebP image") from None
    except Exception as error:
        found = f"an image that cannot be decoded ({error})"
        raise InputError(where, found, "a JPEG, PNG or WebP image") from error
