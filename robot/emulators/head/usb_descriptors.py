"""USB descriptors of the emulated bridge."""

from __future__ import annotations

import struct

from robot.drivers.head.usb_protocol import ENDPOINT_IN, ENDPOINT_OUT, INTERFACE, PRODUCT, VENDOR

STRINGS = ("", "ratslam", "emulated whisker head", "EMULATED")
"""String descriptors by index: none, manufacturer, product, serial."""
LANGUAGE = 0x0409
"""Language of the strings: English."""
PACKET = 512
"""Size of a high-speed bulk packet, bytes."""


def device() -> bytes:
    """The device descriptor: USB 2.0, vendor-specific class."""
    return struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x0200, 0xFF, 0, 0, 64, VENDOR, PRODUCT, 0x0100, 1, 2, 3, 1)


def configuration() -> bytes:
    """The only configuration descriptor: self-powered, one interface, bulk endpoints in and out."""
    interface = struct.pack("<9B", 9, 4, INTERFACE, 0, 2, 0xFF, 0, 0, 0)
    ends = b"".join(struct.pack("<BBBBHB", 7, 5, end, 2, PACKET, 0) for end in (ENDPOINT_IN, ENDPOINT_OUT))
    size = 9 + len(interface) + len(ends)
    return struct.pack("<BBHBBBBB", 9, 2, size, 1, 1, 0, 0xC0, 0) + interface + ends


def string(number: int) -> bytes | None:
    """The string descriptor with an index; index 0 gives the language. None if it does not exist."""
    if not 0 <= number < len(STRINGS):
        return None
    text = STRINGS[number].encode("utf-16-le") if number else struct.pack("<H", LANGUAGE)
    return struct.pack("<BB", 2 + len(text), 3) + text
