"""The settings of the link to a whisker head."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, PositiveFloat

from robot.drivers.head.address import Address
from tactile.base.config import Settings


def _readable(address: str) -> str:
    Address.parse(address)
    return address


class HeadLinkConfig(Settings):
    """How a whisker head is reached, and what is no longer accepted of it."""

    address: Annotated[str, AfterValidator(_readable)] = "usb"
    """`usb` for the only head plugged in, `usb:1209:0001` or `usb:1209:0001:SERIAL` for a certain one, or
    HOST or HOST:PORT of an emulated one."""
    patience: PositiveFloat = 20.0
    """How long a head that is away, silent or cannot be read is waited for, with the arm still, s."""
    silence: PositiveFloat = 0.1
    """Time without a sample after which the head counts as silent, and the arm stops, s."""
    overload: PositiveFloat = 0.6
    """Deflection of a whisker beyond which the arm stops and backs off, rad: three times what whisking on
    a wall does to a simulated one in open loop, and under half of what its sensors report."""
    rcp: Literal["head", "host"] = "head"
    """Who lowers the amplitude of whiskers that touch, in the modes that do. The host answers a block of
    samples late, so it bends whiskers more; only it knows `spread`."""
