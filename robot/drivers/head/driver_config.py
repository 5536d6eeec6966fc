"""Settings of the link to a whisker head."""

from __future__ import annotations

import re
from typing import Literal, NamedTuple

from pydantic import PositiveFloat, field_validator

from robot.drivers.head.usb_protocol import PRODUCT, VENDOR
from tactile.base.settings import Settings

PORT = 30100
"""Of an emulated head."""


class HeadLinkConfig(Settings):
    """Address and time limits of a whisker head."""

    address: str = "usb"
    """`usb` for the only connected head, `usb:1209:0001` or `usb:1209:0001:SERIAL` for a specific one, HOST
    or HOST:PORT for an emulated one."""
    patience: PositiveFloat = 20.0
    """Time for which a disconnected, silent or unreadable head is awaited, with the arm at rest, s."""
    silence: PositiveFloat = 0.1
    """Time without a sample after which the head counts as silent and the arm stops, s."""
    overload: PositiveFloat = 0.6
    """Deflection of a whisker beyond which the arm stops and backs off, rad: three times that of a simulated
    one whisking on a wall in open loop, and less than half the range of its sensors."""
    rcp: Literal["head", "host"] = "head"
    """Where contact feedback (RCP) is computed, in the modes that have it. The host reacts a block of samples
    later, so whiskers bend more; only the host supports `spread`."""

    @field_validator("address")
    @classmethod
    def _readable(cls, address: str) -> str:
        Address.parse(address)
        return address


_USB = re.compile(r"usb(?::([0-9a-f]{4}):([0-9a-f]{4})(?::(\S+))?)?", re.IGNORECASE)
_HOST = re.compile(r"([\w.-]+)(?::(\d{1,5}))?")


class Address(NamedTuple):
    """Where a head is.

    Attributes:
        vendor, product: USB ids. serial: serial number of the device, or None for any.
        host, port: of an emulated head; host is None for a real head.
    """

    vendor: int = VENDOR
    product: int = PRODUCT
    serial: str | None = None
    host: str | None = None
    port: int = PORT

    @classmethod
    def parse(cls, text: str) -> Address:
        """Parses an address."""
        if found := _USB.fullmatch(text):
            vendor, product, serial = found.groups()
            return cls(int(vendor, 16), int(product, 16), serial) if vendor else cls()
        found = _HOST.fullmatch(text)
        if found and not text.lower().startswith("usb") and int(found[2] or 0) < 65536:
            return cls(host=found[1], port=int(found[2] or PORT))
        known = "usb, usb:1209:0001, usb:1209:0001:SERIAL or HOST:PORT"
        raise ValueError(f"{text!r} is not an address of a head; examples: {known}")

    def __str__(self) -> str:
        if self.host is not None:
            return f"{self.host}:{self.port}"
        return f"usb:{self.vendor:04x}:{self.product:04x}" + (f":{self.serial}" if self.serial else "")
