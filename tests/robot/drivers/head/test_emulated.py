"""The reader at an emulated head, by the real pyusb: what the head says went wrong is what is counted."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from robot.drivers.head.config import HeadLinkConfig
from robot.drivers.head.device import open_bridge
from robot.drivers.head.protocol import ANGLE, FrameFlag
from robot.drivers.head.reader import HeadReader, LinkState
from robot.drivers.head.whisk_control import HeadDriver
from tactile.whiskers.head_geometry import HeadConfig, ur10_head
from tactile.whiskers.whisking import WhiskingConfig
from tests.robot.drivers.head.memory import until

pytest.importorskip("usb.core", reason="pyusb is not installed")
HEAD = ur10_head(HeadConfig())


class Control:
    """The emulator's faults."""

    def __init__(self, host: str) -> None:
        self._socket = socket.create_connection((host, 30099), 5)
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
    config = HeadLinkConfig(address=loopback, silence=0.2, patience=5.0)
    told = []
    with HeadReader(lambda: open_bridge(loopback), 18, config, on_overload=told.append) as reader:
        reader.overloaded = told  # type: ignore[attr-defined]
        until(lambda: reader.decoder.counts.good > 100)
        yield reader
    emulator("plug")


def test_two_thousand_samples_a_second(reader):
    before, began = reader.ring.newest, time.monotonic()
    time.sleep(1.0)
    after, took = reader.ring.newest, time.monotonic() - began
    assert (after[0] - before[0]) / took == pytest.approx(2000, rel=0.1)
    assert (after[1] - before[1]) / (after[0] - before[0]) == pytest.approx(500, rel=0.01)
    counts = reader.decoder.counts
    assert counts[1:] == (0,) * 6
    assert reader.identity.rate == 2000


def test_what_went_wrong_is_counted_exactly(reader, emulator):
    emulator("corrupt", frames=7)
    until(lambda: reader.decoder.counts.missing == 7)
    emulator("skip", frames=30)
    until(lambda: reader.decoder.counts.missing == 37)
    emulator("garbage", bytes=1000)
    until(lambda: reader.decoder.counts.skipped_bytes == 7 * 128 + 1000)
    emulator("swap")
    time.sleep(0.2)
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
    until(lambda: reader.state.link == LinkState.AWAY, 2.0)
    emulator("plug")
    until(lambda: reader.state.link == LinkState.STREAMING, 2.0)
    assert reader.decoder.counts.restarts == 1
    until(lambda: any(reader.ring.between(reader.ring.newest[0] - 50, 2**62).flags & FrameFlag.CYCLE))
    assert reader.fault is None


def test_a_stall_and_a_silence_pass(reader, emulator):
    emulator("stall", seconds=0.3)
    until(lambda: reader.stalls > 0)
    until(lambda: reader.state.link == LinkState.STREAMING)
    emulator("silence", seconds=0.6)
    until(lambda: reader.state.link == LinkState.SILENT)
    until(lambda: reader.state.link == LinkState.STREAMING)
    assert reader.fault is None


def test_a_whisker_pressed_to_its_end(reader, emulator):
    assert reader.overloaded == []
    emulator("saturate", whisker=11, seconds=0.2)
    until(lambda: reader.overloaded)
    assert set(reader.overloaded) == {11}


def whisk(host: str, mode: str, rcp: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Largest angle and deflection [W], rad, of a whole whisk, and in how much of it the head fed back."""
    with HeadReader(lambda: open_bridge(host), 18, HeadLinkConfig(address=host, rcp=rcp)) as reader:
        driver = HeadDriver(reader, HEAD)
        driver.whisk(WhiskingConfig(mode=mode, rate=4.0), np.full(18, 0.04), np.zeros(18))

        def starts() -> np.ndarray:
            frames = reader.ring.between(0, 2**62)
            return frames.sequence[(frames.flags & FrameFlag.CYCLE) > 0]

        until(lambda: len(starts()) >= 3)
        assert set(np.diff(starts())) == {500}
        frames = reader.ring.between(int(starts()[1]), int(starts()[2]) - 1)
        driver.rest()
        time.sleep(1.0)
        newest = reader.ring.newest[0]
        rest = reader.ring.between(newest - 100, newest).values[..., 0] * ANGLE
        assert np.abs(rest.mean(axis=0)).max() < 0.02
        assert reader.state.link == LinkState.STREAMING
    size = np.abs(frames.values * ANGLE).max(axis=0)
    return size[:, 0], size[:, 2], float(np.mean((frames.flags & FrameFlag.RCP) > 0))


def test_whiskers_that_touch_are_held_back_by_whom_the_settings_say(loopback, emulator):
    (angle, bent, fed), *others = (
        whisk(loopback, *how) for how in (("open", "head"), ("rcp", "head"), ("rcp", "host"))
    )
    assert angle.max() == pytest.approx(np.radians(65), abs=0.02)
    touched = bent > 0.1
    assert touched.any()
    assert not touched.all()
    assert fed == 0
    for other, lowered, _ in others:
        assert (lowered[touched] < 0.8 * bent[touched]).all()
        np.testing.assert_allclose(other[~touched], angle[~touched], atol=0.02)
    assert [share > 0 for _, _, share in others] == [True, False]
