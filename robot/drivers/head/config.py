"""Settings of the link to a whisker head."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, PositiveFloat

from robot.drivers.head.address import Address
from tactile.base.config import Settings


def _readable(address: str) -> str:
    Address.parse(address)
    return address


class HeadLinkConfig(Settings):
    """Address and time limits of a whisker head."""

    address: Annotated[str, AfterValidator(_readable)] = "usb"
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
