"""The socket backend under the real pyusb: transfers, time-outs, stalls and unplugging as over USB."""

from __future__ import annotations

import errno
import importlib
import inspect
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.drivers.head.decoder import Decoder, Frames
from robot.drivers.head.driver_config import PORT
from robot.drivers.head.emulated_cable import SocketBackend
from robot.drivers.head.usb_protocol import (
    ENDPOINT_IN,
    ENDPOINT_OUT,
    KEEP_ALIVE,
    PRODUCT,
    REQUEST_IN,
    REQUEST_OUT,
    VENDOR,
    FrameFlag,
    Request,
)
from robot.emulators.head.emulator_config import HeadEmulatorConfig
from tests.helpers.live import Faults, until
from tests.robot.emulators.head.heads import drive, running

core = pytest.importorskip("usb.core", reason="pyusb is not installed: pip install 'ratslam[live]'")
util = importlib.import_module("usb.util")


@pytest.fixture(scope="module")
def process(loopback: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Faults]:
    config = HeadEmulatorConfig(host=loopback, path={"explore": 5}, follow=True, fifo=1 << 16)
    with running(config, tmp_path_factory.mktemp("head")) as head:
        yield head


@pytest.fixture
def head(process: Faults) -> Faults:
    """A connected head without faults."""
    process(do="plug")
    return process


def find_device(head: Faults) -> Any:
    return core.find(backend=SocketBackend(head.host, PORT), idVendor=VENDOR, idProduct=PRODUCT)


@pytest.fixture
def device(head: Faults) -> Iterator[Any]:
    one = find_device(head)
    one.get_active_configuration()
    try:
        yield one
    finally:
        util.dispose_resources(one)


def start(device: Any) -> None:
    device.ctrl_transfer(REQUEST_OUT, Request.START, 0, 0, b"", 30_000)


def read(device: Any, count: int, decoder: Decoder) -> Frames:
    """Reads 4 KiB at a time until there are at least `count` frames."""
    parts: list[Frames] = []
    while sum(len(part.sequence) for part in parts) < count:
        parts.append(decoder.feed(device.read(ENDPOINT_IN, 4096, 30_000).tobytes()))
    return Frames(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def test_the_backend_has_the_methods_of_pyusb() -> None:
    interface = importlib.import_module("usb.backend").IBackend
    required = {
        name: method
        for name, method in inspect.getmembers(interface, inspect.isfunction)
        if not name.startswith("_") and name != "finalize"
    }
    assert len(required) > 20
    for name, method in required.items():
        ours = list(inspect.signature(getattr(SocketBackend, name)).parameters)
        if "transfer" not in ours:  # of transfer kinds without a use here
            assert ours == list(inspect.signature(method).parameters), name


def test_the_device_is_found_with_its_descriptors(head: Faults, device: Any) -> None:
    assert (device.idVendor, device.idProduct, device.speed) == (VENDOR, PRODUCT, util.SPEED_HIGH)
    assert device.serial_number == "EMULATED"
    (interface,) = device.get_active_configuration()
    assert [end.bEndpointAddress for end in interface] == [ENDPOINT_IN, ENDPOINT_OUT]
    assert util.endpoint_type(interface[0].bmAttributes) == util.ENDPOINT_TYPE_BULK
    assert core.find(backend=SocketBackend(head.host, PORT), idVendor=0x1234) is None
    assert find_device(Faults(head.process, "127.0.0.1", 0)) is None or head.host == "127.0.0.1"


def test_a_second_program_gets_a_busy_error(head: Faults, device: Any) -> None:
    util.claim_interface(device, 0)
    other = find_device(head)
    with pytest.raises(core.USBError) as caught:
        util.claim_interface(other, 0)
    assert caught.value.errno == errno.EBUSY
    util.dispose_resources(device)
    util.claim_interface(other, 0)
    util.dispose_resources(other)


def test_all_frames_are_transferred(head: Faults, device: Any) -> None:
    """Two cycles begin within `COMMAND_TIMEOUT` after the command, so they do not depend on the host."""
    before, earlier = head(do="counts"), head.state()["commands"]
    decoder, samples = Decoder(18, 3), 500
    start(device)
    device.write(ENDPOINT_OUT, drive(frequency=2000 / samples).pack(), 30_000)
    parts: list[Frames] = []
    begins = np.zeros(0, int)
    while (
        len(parts) < 3 or not len(begins) or sum(len(part.flags) for part in parts) < begins[0] + 2 * samples
    ):
        parts.append(read(device, 800, decoder))
        device.write(ENDPOINT_OUT, KEEP_ALIVE.pack(), 30_000)
        begins = np.flatnonzero(np.concatenate([part.flags for part in parts]) & FrameFlag.CYCLE)
    frames = Frames(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    assert (np.diff(frames.sequence) == 1).all()
    assert (np.diff(frames.time) == 500).all()
    cycles = begins[begins < begins[0] + 2 * samples]
    assert len(cycles) == 2
    assert np.diff(cycles) == samples
    commands = {kind: count - earlier.get(kind, 0) for kind, count in head.state()["commands"].items()}
    assert (commands["DRIVE"], commands["KEEP"]) == (1, len(parts))
    after = head(do="counts")
    sent = after["sent"] - before["sent"]
    assert sent == decoder.counts.good == len(frames.values)
    assert after["lost"] == before["lost"]
    clock = int.from_bytes(
        device.ctrl_transfer(REQUEST_IN, Request.CLOCK, 0, 0, 8, 30_000).tobytes(), "little"
    )
    assert clock >= frames.time[-1]


def test_a_paused_process_loses_no_frames(head: Faults, device: Any) -> None:
    """The process makes the frames of the pause afterwards; its queue has room for them."""
    decoder = Decoder(18, 3)
    start(device)
    read(device, 200, decoder)
    os.kill(head.process.pid, signal.SIGSTOP)
    time.sleep(0.7)
    os.kill(head.process.pid, signal.SIGCONT)
    read(device, 1400, decoder)
    assert decoder.counts.missing == 0
    assert decoder.counts.overruns == 0


def test_a_read_times_out(head: Faults, device: Any) -> None:
    device.ctrl_transfer(REQUEST_OUT, Request.STOP, 0, 0, b"", 30_000)
    began = time.monotonic()
    with pytest.raises(core.USBTimeoutError) as caught:
        device.read(ENDPOINT_IN, 4096, 150)
    assert caught.value.errno == errno.ETIMEDOUT
    assert time.monotonic() - began >= 0.15


def test_a_stalled_endpoint_is_cleared(head: Faults, device: Any) -> None:
    start(device)
    head(do="stall")
    with pytest.raises(core.USBError) as caught:
        device.read(ENDPOINT_IN, 4096, 30_000)
    assert caught.value.errno == errno.EPIPE
    with pytest.raises(core.USBError):
        device.read(ENDPOINT_IN, 4096, 30_000)
    device.clear_halt(ENDPOINT_IN)
    assert len(device.read(ENDPOINT_IN, 4096, 30_000)) > 0


def test_an_unknown_request_is_stalled(device: Any) -> None:
    with pytest.raises(core.USBError) as caught:
        device.ctrl_transfer(REQUEST_IN, 77, 0, 0, 8, 30_000)
    assert caught.value.errno == errno.EPIPE


def test_unplugging_is_reported_and_the_old_handle_stays_invalid(head: Faults, device: Any) -> None:
    start(device)
    device.read(ENDPOINT_IN, 4096, 30_000)
    head(do="unplug")
    for _ in range(2):
        with pytest.raises(core.USBError) as caught:
            device.read(ENDPOINT_IN, 4096, 30_000)
        assert caught.value.errno == errno.ENODEV
    assert find_device(head) is None
    head(do="plug")
    with pytest.raises(core.USBError) as caught:
        device.write(ENDPOINT_OUT, KEEP_ALIVE.pack(), 30_000)
    assert caught.value.errno == errno.ENODEV
    again = until(lambda: find_device(head))
    start(again)
    assert len(again.read(ENDPOINT_IN, 4096, 30_000)) > 0
    util.dispose_resources(again)


def test_a_pending_read_ends_when_the_device_is_unplugged(head: Faults, device: Any) -> None:
    caught: list[int | None] = []

    def wait() -> None:
        try:
            device.read(ENDPOINT_IN, 4096, 60_000)
        except core.USBError as error:
            caught.append(error.errno)

    device.ctrl_transfer(REQUEST_OUT, Request.STOP, 0, 0, b"", 30_000)
    waiting = threading.Thread(target=wait)
    waiting.start()
    head(do="unplug")
    waiting.join(60)
    assert caught == [errno.ENODEV]


def test_an_invalid_configuration_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from robot.emulators.head.__main__ import main

    assert main(["--config", str(tmp_path / "none.json")]) == 2
    (tmp_path / "bad.json").write_text('{"hots": "127.0.0.1"}')
    assert main(["--config", str(tmp_path / "bad.json")]) == 2
    (tmp_path / "wall.json").write_text('{"maze": {"heights": [0.3]}}')
    assert main(["--config", str(tmp_path / "wall.json")]) == 2
    output = capsys.readouterr().err
    assert all(piece in output for piece in ("none.json", "hots", "simulation.maze.heights"))


def test_a_dead_emulator_is_a_disconnected_device(tmp_path: Path, loopback: str) -> None:
    host = f"127.0.1.{loopback.rsplit('.', 1)[1]}"
    with running(HeadEmulatorConfig(host=host, path={"explore": 5}), tmp_path) as head:
        device = find_device(head)
        start(device)
        head.die()
        with pytest.raises(core.USBError) as caught:
            read(device, 2**40, Decoder(18, 3))
        assert caught.value.errno == errno.ENODEV
        assert find_device(head) is None
        util.dispose_resources(device)
