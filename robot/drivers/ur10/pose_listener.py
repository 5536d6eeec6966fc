"""Listener for the tool pose of a controller: a read-only RTDE client.

It writes nothing to the controller and claims no registers, so it can run beside the program that moves the
arm, with a real or an emulated controller.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from typing import NamedTuple, Self

import numpy as np

from robot.drivers.ur10 import rtde_protocol
from robot.drivers.ur10.rtde_protocol import RTDE_PORT

_FIELDS = ("timestamp", "actual_TCP_pose", "actual_TCP_speed")


class ToolPose(NamedTuple):
    """A tool pose with its time.

    Attributes:
        time: s, host's monotonic clock at receipt. tcp: [6] m and rotation vector in the base.
        speed: [6] m/s, rad/s. robot_time: s, the controller's clock.
    """

    time: float
    tcp: np.ndarray
    speed: np.ndarray
    robot_time: float


class PoseListener:
    """Reads poses in a separate thread, and reconnects when the connection is lost.

    Args:
        host: of the controller. hz: requested state rate, Hz. patience: time without a state before it
            reconnects, s. port: of RTDE.
    """

    def __init__(self, host: str, hz: float = 125, patience: float = 1.0, port: int = RTDE_PORT) -> None:
        self._address = (host, port)
        self._hz = hz
        self._patience = patience
        self._latest: ToolPose | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tool poses", daemon=True)
        self._thread.start()

    def latest(self) -> ToolPose | None:
        """The newest tool pose; None before the first."""
        return self._latest

    def close(self) -> None:
        """Ends the thread."""
        self._closing.set()
        self._thread.join(self._patience + 1.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            # an invalid package makes the connection unusable
            with contextlib.suppress(OSError, ValueError, struct.error):
                self._listen()
            self._closing.wait(0.1)

    def _listen(self) -> None:
        layout = rtde_protocol.data_layout([rtde_protocol.OUTPUT_TYPES[name] for name in _FIELDS])
        splitter = rtde_protocol.PackageSplitter()
        with socket.create_connection(self._address, timeout=self._patience) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            link.sendall(
                rtde_protocol.pack_package(rtde_protocol.PROTOCOL, struct.pack(">H", rtde_protocol.VERSION))
            )
            recipe = struct.pack(">d", self._hz) + ",".join(_FIELDS).encode()
            link.sendall(
                rtde_protocol.pack_package(rtde_protocol.OUTPUTS, recipe)
                + rtde_protocol.pack_package(rtde_protocol.START)
            )
            while not self._closing.is_set():
                data = link.recv(1 << 14)
                if not data:
                    return
                host = time.monotonic()
                for kind, body in splitter.feed(data):
                    if kind == rtde_protocol.DATA:
                        numbers = np.array(layout.unpack(body)[1:])
                        self._latest = ToolPose(host, numbers[1:7], numbers[7:13], float(numbers[0]))
