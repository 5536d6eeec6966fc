"""An emulated head over the real pyusb: time-outs, stalls, unplugging as over USB, and the reader on it."""

import errno
import importlib
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest

from robot.drivers.head import usb_protocol as wire
from robot.drivers.head.decoder import Decoder
from robot.drivers.head.device import open_bridge
from robot.drivers.head.driver_config import PORT, HeadLinkConfig
from robot.drivers.head.emulated_cable import SocketBackend
from robot.drivers.head.reader import HeadReader, LinkState
from robot.drivers.head.usb_protocol import ANGLE, ENDPOINT_IN, ENDPOINT_OUT, KEEP_ALIVE, FrameFlag, Request
from robot.drivers.head.whisk_control import HeadDriver
from robot.emulators.head.__main__ import main
from robot.emulators.head.emulator_config import HeadEmulatorConfig
from tactile.whisker_geometry import HeadConfig, ur10_head
from tactile.whisking import WhiskingConfig
from tests.helpers.live import Faults, until
from tests.robot.emulators.head.heads import running

core = pytest.importorskip("usb.core", reason="pyusb is not installed: pip install 'ratslam[live]'")
util = importlib.import_module("usb.util")
HEAD = ur10_head(HeadConfig())


@pytest.fixture(scope="module")
def process(loopback, tmp_path_factory):
    config = HeadEmulatorConfig(host=loopback, fifo=1 << 16)
    with running(config, tmp_path_factory.mktemp("head")) as head:
        yield head


@pytest.fixture
def head(process):
    process(do="plug")
    return process


def find_device(head):
    return core.find(backend=SocketBackend(head.host, PORT), idVendor=wire.VENDOR, idProduct=wire.PRODUCT)


@pytest.fixture
def device(head):
    one = find_device(head)
    one.get_active_configuration()
    yield one
    util.dispose_resources(one)


@contextmanager
def usb_error(number):
    with pytest.raises(core.USBError) as caught:
        yield
    assert caught.value.errno == number


def start(device):
    device.ctrl_transfer(wire.REQUEST_OUT, Request.START, 0, 0, b"", 30_000)


def read(device, count, decoder):
    count += decoder.counts.good
    while decoder.counts.good < count:
        decoder.feed(device.read(ENDPOINT_IN, 4096, 30_000).tobytes())


def test_the_device_is_found_with_its_descriptors(head, device):
    assert (device.idVendor, device.idProduct, device.speed) == (wire.VENDOR, wire.PRODUCT, util.SPEED_HIGH)
    assert device.serial_number == "EMULATED"
    (interface,) = device.get_active_configuration()
    assert [end.bEndpointAddress for end in interface] == [ENDPOINT_IN, ENDPOINT_OUT]
    assert util.endpoint_type(interface[0].bmAttributes) == util.ENDPOINT_TYPE_BULK
    assert core.find(backend=SocketBackend(head.host, PORT), idVendor=0x1234) is None
    assert find_device(Faults(head.process, "127.0.0.1", 0)) is None or head.host == "127.0.0.1"


def test_a_second_program_gets_a_busy_error(head, device):
    util.claim_interface(device, 0)
    other = find_device(head)
    with usb_error(errno.EBUSY):
        util.claim_interface(other, 0)
    util.dispose_resources(device)
    util.claim_interface(other, 0)
    util.dispose_resources(other)


def test_a_paused_process_loses_no_frames(head, device):
    """The process makes the frames of the pause afterwards; its queue has room for them."""
    before, decoder = head(do="counts"), Decoder(18, 3)
    start(device)
    read(device, 200, decoder)
    os.kill(head.process.pid, signal.SIGSTOP)
    time.sleep(0.7)
    os.kill(head.process.pid, signal.SIGCONT)
    read(device, 1400, decoder)
    assert (decoder.counts.missing, decoder.counts.overruns) == (0, 0)
    device.write(ENDPOINT_OUT, KEEP_ALIVE.pack(), 30_000)
    clock = device.ctrl_transfer(wire.REQUEST_IN, Request.CLOCK, 0, 0, 8, 30_000).tobytes()
    assert int.from_bytes(clock, "little") >= 500 * 1600
    after = head(do="counts")
    assert after["sent"] - before["sent"] >= decoder.counts.good
    assert after["lost"] == before["lost"]


def test_a_read_times_out(head, device):
    device.ctrl_transfer(wire.REQUEST_OUT, Request.STOP, 0, 0, b"", 30_000)
    began = time.monotonic()
    with pytest.raises(core.USBTimeoutError) as caught:
        device.read(ENDPOINT_IN, 4096, 150)
    assert caught.value.errno == errno.ETIMEDOUT
    assert time.monotonic() - began >= 0.15


def test_a_stalled_endpoint_is_cleared_and_an_unknown_request_stalls(head, device):
    start(device)
    head(do="stall")
    for _ in range(2):
        with usb_error(errno.EPIPE):
            device.read(ENDPOINT_IN, 4096, 30_000)
    device.clear_halt(ENDPOINT_IN)
    assert len(device.read(ENDPOINT_IN, 4096, 30_000)) > 0
    with usb_error(errno.EPIPE):
        device.ctrl_transfer(wire.REQUEST_IN, 77, 0, 0, 8, 30_000)


def test_unplugging_is_reported_and_the_old_handle_stays_invalid(head, device):
    start(device)
    device.read(ENDPOINT_IN, 4096, 30_000)
    head(do="unplug")
    for _ in range(2):
        with usb_error(errno.ENODEV):
            device.read(ENDPOINT_IN, 4096, 30_000)
    assert find_device(head) is None
    head(do="plug")
    with usb_error(errno.ENODEV):
        device.write(ENDPOINT_OUT, KEEP_ALIVE.pack(), 30_000)
    again = until(lambda: find_device(head))
    start(again)
    assert len(again.read(ENDPOINT_IN, 4096, 30_000)) > 0
    util.dispose_resources(again)


def test_a_pending_read_ends_when_the_device_is_unplugged(head, device):
    device.ctrl_transfer(wire.REQUEST_OUT, Request.STOP, 0, 0, b"", 30_000)
    with ThreadPoolExecutor() as pool, usb_error(errno.ENODEV):
        waiting = pool.submit(device.read, ENDPOINT_IN, 4096, 60_000)
        head(do="unplug")
        waiting.result(60)


def test_an_invalid_configuration_is_refused(tmp_path, capsys):
    file = tmp_path / "head.json"
    wrong = {"": "head.json", '{"hots": ""}': "hots", '{"maze": {"heights": [0.3]}}': "maze.heights"}
    for content, named in wrong.items():
        if content:
            file.write_text(content)
        assert main(["--config", str(file)]) == 2
        assert named in capsys.readouterr().err


def test_a_dead_emulator_is_a_disconnected_device(tmp_path, loopback):
    host = f"127.0.1.{loopback.rsplit('.', 1)[1]}"
    with running(HeadEmulatorConfig(host=host, path={"explore": 5}), tmp_path) as head:
        device = find_device(head)
        start(device)
        head.die()
        with usb_error(errno.ENODEV):
            read(device, 2**40, Decoder(18, 3))
        assert find_device(head) is None
        util.dispose_resources(device)


@pytest.fixture
def reader(loopback, head):
    config = HeadLinkConfig(silence=1.0, patience=60.0)
    with HeadReader(lambda: open_bridge(loopback), 18, config) as reader:
        until(lambda: reader.decoder.counts.good > 100)
        yield reader


def test_damage_is_counted_exactly(reader, head):
    before = reader.ring.newest
    until(lambda: reader.ring.newest[0] > before[0] + 1000)
    after = reader.ring.newest
    assert (after[1] - before[1]) / (after[0] - before[0]) == pytest.approx(500, rel=0.01)
    assert reader.decoder.counts[1:] == (0,) * 6
    assert reader.identity.rate == 2000
    head(do="corrupt", frames=7)
    until(lambda: reader.decoder.counts.missing == 7)
    head(do="skip", frames=30)
    until(lambda: reader.decoder.counts.missing == 37)
    head(do="garbage", bytes=1000)
    until(lambda: reader.decoder.counts.skipped_bytes == 7 * 128 + 1000)
    head(do="swap")
    swapped = reader.ring.newest[0]
    until(lambda: reader.ring.newest[0] > swapped + 100)
    assert reader.decoder.counts[1:] == (7, 37, 7 * 128 + 1000, 0, 0, 0)


def test_a_whisk_continues_after_a_stall_a_silence_and_unplugging(reader, head):
    driver = HeadDriver(reader, HEAD)
    driver.whisk(WhiskingConfig(mode="open", rate=5.0))
    head(do="stall", seconds=0.3)
    until(lambda: reader.stalls > 0)
    until(lambda: reader.state == LinkState.STREAMING)
    head(do="silence", seconds=2.0)
    until(lambda: reader.state == LinkState.SILENT)
    until(lambda: reader.state == LinkState.STREAMING)
    head(do="unplug")
    until(lambda: reader.state == LinkState.AWAY)
    head(do="plug")
    until(lambda: reader.decoder.counts.restarts == 1)
    until(lambda: reader.state == LinkState.STREAMING)
    until(lambda: any(reader.ring.between(reader.ring.newest[0] - 50, 2**62).flags & FrameFlag.CYCLE))
    assert reader.fault is None


def whisk(host, mode, rcp):
    """Largest angle and deflection [W] of a whisk, rad, and its share with feedback in the head."""
    config = HeadLinkConfig(rcp=rcp, silence=2.0, patience=60.0)
    with HeadReader(lambda: open_bridge(host), 18, config) as reader:
        driver = HeadDriver(reader, HEAD)
        driver.whisk(WhiskingConfig(mode=mode, rate=4.0), np.full(18, 0.04), np.zeros(18))

        def starts():
            frames = reader.ring.between(0, 2**62)
            return frames.sequence[(frames.flags & FrameFlag.CYCLE) > 0]

        until(lambda: len(starts()) >= 3)
        assert set(np.diff(starts())) == {500}
        frames = reader.ring.between(int(starts()[1]), int(starts()[2]) - 1)
        driver.rest()

        def angles():
            newest = reader.ring.newest[0]
            return reader.ring.between(newest - 100, newest).values[..., 0] * ANGLE

        until(lambda: np.abs(angles().mean(axis=0)).max() < 0.02, "the whiskers are retracted")
        until(lambda: reader.state == LinkState.STREAMING, "samples continue")
    size = np.abs(frames.values * ANGLE).max(axis=0)
    return size[:, 0], size[:, 2], float(np.mean((frames.flags & FrameFlag.RCP) > 0))


@pytest.mark.parametrize("rcp", ["head", pytest.param("host", marks=pytest.mark.soak)])
def test_feedback_reduces_amplitudes_on_contact(rcp, loopback, head):
    angle, bent, fed = whisk(loopback, "open", "head")
    assert angle.max() == pytest.approx(np.radians(65), abs=0.02)
    touched = bent > 0.1
    assert touched.any()
    assert not touched.all()
    assert fed == 0
    other, lowered, fed = whisk(loopback, "rcp", rcp)
    assert (lowered[touched] < 0.8 * bent[touched]).all()
    np.testing.assert_allclose(other[~touched], angle[~touched], atol=0.02)
    assert (fed > 0) == (rcp == "head")
