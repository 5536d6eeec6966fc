"""The reader on an emulated head, over the real pyusb: streams, faults and their counts, feedback."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from robot.drivers.head.device import open_bridge
from robot.drivers.head.driver_config import HeadLinkConfig
from robot.drivers.head.reader import HeadReader, LinkState
from robot.drivers.head.usb_protocol import ANGLE, FrameFlag
from robot.drivers.head.whisk_control import HeadDriver
from tactile.whisker_geometry import HeadConfig, ur10_head
from tactile.whisking import WhiskingConfig
from tests.helpers.live import until

pytest.importorskip("usb.core", reason="pyusb is not installed")
HEAD = ur10_head(HeadConfig())


class Control:
    """Connection to the emulator's fault port."""

    def __init__(self, host: str) -> None:
        self._socket = socket.create_connection((host, 30099), 60)
        self._lines = self._socket.makefile("rw")

    def __call__(self, do: str, **more) -> dict:
        self._lines.write(json.dumps({"do": do, **more}) + "\n")
        self._lines.flush()
        answer = json.loads(self._lines.readline())
        assert "error" not in answer, answer
        return answer

    def close(self) -> None:
        self._lines.close()
        self._socket.close()


@pytest.fixture(scope="module")
def emulator(loopback):
    words = [sys.executable, "-m", "robot.emulators.head", "--host", loopback]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == "ready"
        control = Control(loopback)
        yield control
        control.close()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.fixture
def reader(loopback, emulator):
    config = HeadLinkConfig(address=loopback, silence=1.0, patience=60.0)
    overloads = []
    with HeadReader(lambda: open_bridge(loopback), 18, config, on_overload=overloads.append) as reader:
        reader.overloaded = overloads  # type: ignore[attr-defined]
        until(lambda: reader.decoder.counts.good > 100)
        yield reader
    emulator("plug")


def test_sample_times_follow_from_their_numbers(reader):
    before = reader.ring.newest
    until(lambda: reader.ring.newest[0] > before[0] + 1000)
    after = reader.ring.newest
    assert (after[1] - before[1]) / (after[0] - before[0]) == pytest.approx(500, rel=0.01)
    assert reader.decoder.counts[1:] == (0,) * 6
    assert reader.identity.rate == 2000


@pytest.mark.soak
def test_two_thousand_samples_a_second(reader):
    before, began = reader.ring.newest, time.monotonic()
    time.sleep(1.0)
    after, took = reader.ring.newest, time.monotonic() - began
    assert (after[0] - before[0]) / took == pytest.approx(2000, rel=0.1)


def test_damage_is_counted_exactly(reader, emulator):
    emulator("corrupt", frames=7)
    until(lambda: reader.decoder.counts.missing == 7)
    emulator("skip", frames=30)
    until(lambda: reader.decoder.counts.missing == 37)
    emulator("garbage", bytes=1000)
    until(lambda: reader.decoder.counts.skipped_bytes == 7 * 128 + 1000)
    emulator("swap")
    swapped = reader.ring.newest[0]
    until(lambda: reader.ring.newest[0] > swapped + 100)
    counts = reader.decoder.counts
    assert counts.bad == 7
    assert (counts.missing, counts.overruns, counts.duplicates, counts.restarts) == (37, 0, 0, 0)
    first = reader.ring.newest[0] - counts.good - 37 + 1
    number = reader.ring.between(first, 2**62).sequence
    assert number[-1] - number[0] + 1 - len(number) == 37


def test_unplugged_and_plugged_in_again(reader, emulator):
    driver = HeadDriver(reader, HEAD)
    driver.whisk(WhiskingConfig(mode="open", rate=5.0))
    emulator("unplug")
    until(lambda: reader.state == LinkState.AWAY)
    emulator("plug")
    until(lambda: reader.decoder.counts.restarts == 1)
    until(lambda: reader.state == LinkState.STREAMING)
    until(lambda: any(reader.ring.between(reader.ring.newest[0] - 50, 2**62).flags & FrameFlag.CYCLE))
    assert reader.fault is None


def test_the_stream_continues_after_a_stall_and_a_silence(reader, emulator):
    emulator("stall", seconds=0.3)
    until(lambda: reader.stalls > 0)
    until(lambda: reader.state == LinkState.STREAMING)
    emulator("silence", seconds=2.0)
    until(lambda: reader.state == LinkState.SILENT)
    until(lambda: reader.state == LinkState.STREAMING)
    assert reader.fault is None


def test_a_saturated_whisker_is_an_overload(reader, emulator):
    assert reader.overloaded == []
    emulator("saturate", whisker=11, seconds=0.2)
    until(lambda: reader.overloaded)
    assert set(reader.overloaded) == {11}


def whisk(host: str, mode: str, rcp: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Largest angle and deflection [W] of a whisk, rad, and its share with feedback in the head."""
    with HeadReader(
        lambda: open_bridge(host), 18, HeadLinkConfig(address=host, rcp=rcp, silence=2.0, patience=60.0)
    ) as reader:
        driver = HeadDriver(reader, HEAD)
        driver.whisk(WhiskingConfig(mode=mode, rate=4.0), np.full(18, 0.04), np.zeros(18))

        def starts() -> np.ndarray:
            frames = reader.ring.between(0, 2**62)
            return frames.sequence[(frames.flags & FrameFlag.CYCLE) > 0]

        until(lambda: len(starts()) >= 3)
        assert set(np.diff(starts())) == {500}
        frames = reader.ring.between(int(starts()[1]), int(starts()[2]) - 1)
        driver.rest()

        def angles() -> np.ndarray:
            newest = reader.ring.newest[0]
            return reader.ring.between(newest - 100, newest).values[..., 0] * ANGLE

        until(lambda: np.abs(angles().mean(axis=0)).max() < 0.02, "the whiskers are retracted")
        until(lambda: reader.state == LinkState.STREAMING, "samples continue")
    size = np.abs(frames.values * ANGLE).max(axis=0)
    return size[:, 0], size[:, 2], float(np.mean((frames.flags & FrameFlag.RCP) > 0))


def test_feedback_in_the_head_reduces_amplitudes_on_contact(loopback, emulator):
    angle, bent, fed = whisk(loopback, "open", "head")
    assert angle.max() == pytest.approx(np.radians(65), abs=0.02)
    touched = bent > 0.1
    assert touched.any()
    assert not touched.all()
    assert fed == 0
    other, lowered, fed = whisk(loopback, "rcp", "head")
    assert (lowered[touched] < 0.8 * bent[touched]).all()
    np.testing.assert_allclose(other[~touched], angle[~touched], atol=0.02)
    assert fed > 0


@pytest.mark.soak
def test_feedback_on_the_host_reduces_amplitudes_on_contact(loopback, emulator):
    """Feedback fails if the host is late."""
    angle, bent, _ = whisk(loopback, "open", "head")
    touched = bent > 0.1
    other, lowered, fed = whisk(loopback, "rcp", "host")
    assert (lowered[touched] < 0.8 * bent[touched]).all()
    np.testing.assert_allclose(other[~touched], angle[~touched], atol=0.02)
    assert fed == 0
