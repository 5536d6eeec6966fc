"""Program that `test_umock` runs: a host of the head on the system's libusb. Prints JSON."""

from __future__ import annotations

import json
import socket
import sys
import time
from typing import Any

from robot.drivers.head.decoder import Decoder
from robot.drivers.head.device import Bridge, Disconnected, HeadIdentity, Stalled, open_bridge
from robot.drivers.head.usb_protocol import KEEP_ALIVE, Request
from robot.emulators.head.emulator_config import CONTROL_PORT
from tests.robot.emulators.head.heads import drive


def main(host: str) -> None:
    """Reads frames through a stall, a stop, and unplugging and plugging in."""
    # The libusb of `libusb-package` gets unplug events from the kernel, not from umockdev.
    sys.modules["libusb_package"] = None  # type: ignore[assignment]
    seen: dict[str, Any] = {}
    bridge = open_bridge("usb")
    decoder = Decoder(18, 3)
    seen["whiskers"] = HeadIdentity.read(bridge).whiskers
    bridge.request(Request.START)
    bridge.write(drive().pack())
    seen["frames"] = read(bridge, decoder, 3000)

    request_fault(host, do="stall")
    seen["stalls"] = 0
    for _ in range(3):
        try:
            decoder.feed(bridge.read(4096, 0.5))
        except Stalled:
            seen["stalls"] += 1
    read(bridge, decoder, 500)
    seen["counts"] = decoder.counts._asdict()

    bridge.request(Request.STOP)
    began = time.monotonic()
    seen["idle"] = len(bridge.read(4096, 0.2)), time.monotonic() - began
    bridge.request(Request.START)

    request_fault(host, do="unplug")
    seen["gone"] = is_disconnected(bridge)
    bridge.close()
    seen["absent"] = is_absent()
    request_fault(host, do="plug")
    bridge = reconnect(5.0)
    bridge.request(Request.START)
    decoder = Decoder(18, 3)
    seen["again"] = read(bridge, decoder, 1000)
    seen["missing"] = decoder.counts.missing
    bridge.close()
    print(json.dumps(seen))


def read(bridge: Bridge, decoder: Decoder, frames: int) -> int:
    """Reads at least `frames` frames, for at most 10 s; returns their number."""
    end, got = time.monotonic() + 10.0, 0
    while got < frames and time.monotonic() < end:
        got += len(decoder.feed(bridge.read(4096, 0.5)).values)
        bridge.write(KEEP_ALIVE.pack())
    return got


def is_disconnected(bridge: Bridge) -> bool:
    """Whether a read reports a disconnected head within 5 s."""
    end = time.monotonic() + 5.0
    try:
        while time.monotonic() < end:
            bridge.read(4096, 0.5)
    except Disconnected:
        return True
    return False


def is_absent() -> bool:
    """Whether opening reports an absent head within 5 s."""
    end = time.monotonic() + 5.0
    while time.monotonic() < end:
        try:
            open_bridge("usb").close()
        except Disconnected:
            return True
        except Stalled:
            pass  # libusb still lists the device
        time.sleep(0.02)
    return False


def reconnect(seconds: float) -> Bridge:
    """Opens the head once it is plugged in."""
    end = time.monotonic() + seconds
    while True:
        try:
            return open_bridge("usb")
        except (Disconnected, Stalled):
            if time.monotonic() > end:
                raise
            time.sleep(0.02)


def request_fault(host: str, **fault: Any) -> None:
    """Starts a fault."""
    with socket.create_connection((host, CONTROL_PORT), 5) as link, link.makefile("rw") as lines:
        lines.write(json.dumps(fault) + "\n")
        lines.flush()
        assert json.loads(lines.readline())["ok"]


if __name__ == "__main__":
    main(sys.argv[1])
