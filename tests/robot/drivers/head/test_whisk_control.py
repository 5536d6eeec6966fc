"""Whisking commands follow from the settings, and feedback on the host from the whisking law."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.drivers.head import usb_protocol as wire
from robot.drivers.head.decoder import Frames
from robot.drivers.head.driver_config import HeadLinkConfig
from robot.drivers.head.reader import HeadReader
from robot.drivers.head.usb_protocol import ANGLE, CommandKind, FeedbackMode, to_counts
from robot.drivers.head.whisk_control import HeadDriver, HostRcp, whisk_commands
from tactile.base.errors import InputError
from tactile.whisker_geometry import HeadConfig, ur10_head
from tactile.whisking import WhiskingConfig, initial_drive, whisk_command
from tests.helpers.live import until
from tests.robot.drivers.head.memory import MemoryHead

HEAD = ur10_head(HeadConfig())
THRESHOLD = np.full(18, 0.04)
CENTRE = np.linspace(-0.01, 0.01, 18)


def whisks(count: int, touched: np.ndarray | None = None, start: int = 0) -> Frames:
    """Samples at 2 kHz from the start of a whisk of 1 s on; `touched` is y [N, 18], rad."""
    number = start + np.arange(count)
    values = np.zeros((count, 18, 3), np.int16)
    values[..., 2] = to_counts(CENTRE + (0.0 if touched is None else touched))
    flags = np.where(number % 2000 == 0, wire.FrameFlag.CYCLE, 0).astype(np.uint8)
    return Frames(number, 500 * number, flags, values)


def blocks(frames: Frames, cuts: list[int]) -> list[Frames]:
    return [Frames(*columns) for columns in zip(*(np.split(column, cuts) for column in frames), strict=True)]


@pytest.mark.parametrize(
    ("mode", "rcp", "threshold", "command_mode"),
    [
        ("open", "head", THRESHOLD, FeedbackMode.OPEN),
        ("rcp", "head", THRESHOLD, FeedbackMode.RCP),
        ("rcp", "head", None, FeedbackMode.OPEN),
        ("rcp", "host", THRESHOLD, FeedbackMode.OPEN),
        ("spread", "host", THRESHOLD, FeedbackMode.OPEN),
    ],
)
def test_where_feedback_is_computed(mode, rcp, threshold, command_mode):
    whisking = WhiskingConfig(mode=mode, rate=2.0, amplitude_deg=50, gain=3)
    centre, drive = whisk_commands(whisking, threshold, CENTRE, rcp)
    assert (centre.kind, drive.kind, drive.mode) == (CommandKind.CENTRE, CommandKind.DRIVE, command_mode)
    np.testing.assert_allclose(centre.numbers * ANGLE, CENTRE, atol=ANGLE)
    assert drive.amplitude == np.radians(50)
    assert (drive.frequency, drive.gain, drive.window) == (2.0, 3.0, 0.01)
    assert len(drive.numbers) == (0 if threshold is None else 18)


def test_whiskers_without_feedback_have_no_threshold():
    threshold = np.array([0.01, np.inf, 4.0])
    drive = whisk_commands(WhiskingConfig(), threshold)[-1]
    assert drive.numbers.tolist() == [int(to_counts(0.01)), wire.NO_THRESHOLD, wire.NO_THRESHOLD - 1]


@settings(max_examples=10)
@given(
    st.sampled_from(["rcp", "spread"]),
    st.lists(st.integers(0, 900), max_size=5),
    st.integers(0, 17),
    st.floats(0.05, 0.3),
)
def test_host_feedback_follows_the_whisking_law(mode, cuts, whisker, bend):
    whisking = WhiskingConfig(mode=mode)
    touched = np.zeros((900, 18))
    touched[400:, whisker] = bend
    frames = whisks(900, touched)
    host, sent = HostRcp(whisking, HEAD.shape, THRESHOLD, CENTRE), []
    for block in blocks(frames, sorted(cuts)):
        amplitudes = host.amplitudes(block)
        sent += [] if amplitudes is None else [amplitudes]

    drive = initial_drive(18)
    for k in range(900):
        y = frames.values[k, :, 2] * ANGLE - CENTRE
        aim, drive = whisk_command(whisking, drive, k / 2000, y, THRESHOLD, HEAD.shape)
    share = (1 - np.cos(2 * np.pi * 899 / 2000)) / 2
    np.testing.assert_allclose(sent[-1] * ANGLE, aim / share, atol=ANGLE)
    assert sent[-1][whisker] < to_counts(np.radians(65))


def test_amplitudes_of_a_free_whisk_are_sent_once_per_cycle_from_the_first_one_on():
    host = HostRcp(WhiskingConfig(), HEAD.shape, THRESHOLD, CENTRE)
    assert host.amplitudes(whisks(100, start=30)) is None
    touched = np.zeros((6000, 18))
    touched[500:900, 3] = 0.2
    sent = [host.amplitudes(block) for block in blocks(whisks(6000, touched), list(range(40, 6000, 40)))]
    full = to_counts(np.radians(65))
    assert (sent[0] == full).all()
    assert sum(one is not None for one in sent[1:12]) == 0
    assert min(one[3] for one in sent if one is not None) < full
    for k in (50, 100):  # the next cycles
        assert (sent[k] == full).all()
        assert all(one is None for one in sent[k + 1 : k + 50])


def test_the_driver_whisks_and_rests():
    memory = MemoryHead(18)
    with HeadReader(memory.connect, 18, HeadLinkConfig(rcp="host")) as reader:
        driver = HeadDriver(reader, HEAD)
        driver.whisk(WhiskingConfig(mode="spread"), THRESHOLD, CENTRE)
        until(lambda: len(memory.commands) == 2)
        frames = whisks(40)
        memory.send(0, 40, frames.values, wire.FrameFlag.CYCLE)
        until(lambda: memory.commands[-1].kind == CommandKind.AMPLITUDES)
        driver.rest()
        # A command on its way is written before the next samples are read.
        memory.send(40, 40, frames.values, wire.FrameFlag.CYCLE)
        until(lambda: reader.decoder.counts.good == 80)
        count = len(memory.commands)
        memory.send(80, 40, frames.values, wire.FrameFlag.CYCLE)
        until(lambda: reader.decoder.counts.good == 120)
        assert len(memory.commands) == count


def test_amplitudes_computed_during_rest_do_not_wake_the_head(monkeypatch):
    calls: list[str] = []
    monkeypatch.setattr(HeadReader, "send", lambda reader, command: calls.append(command.kind.name))
    monkeypatch.setattr(HeadReader, "rest", lambda reader: calls.append("rest"))
    reader = HeadReader(MemoryHead(18).connect, 18, HeadLinkConfig(rcp="host"))
    driver = HeadDriver(reader, HEAD)
    driver.whisk(WhiskingConfig(mode="spread"), THRESHOLD, CENTRE)
    resting = threading.Thread(target=driver.rest)

    def rest_meanwhile(host: HostRcp, frames: Frames) -> np.ndarray:
        resting.start()
        resting.join(0.1)
        return np.zeros(18, np.int16)

    monkeypatch.setattr(HostRcp, "amplitudes", rest_meanwhile)
    for listener in reader.listeners:
        listener(whisks(1), 0.0)
    resting.join()
    assert calls == ["CENTRE", "DRIVE", "AMPLITUDES", "rest"]


@pytest.mark.parametrize("change", [{"amplitude_deg": 90}, {"mode": "spread"}])
def test_whisks_beyond_the_head_are_refused(change):
    with pytest.raises(InputError, match=next(iter(change)).removesuffix("_deg")):
        HeadDriver(HeadReader(MemoryHead(18).connect, 18), HEAD).whisk(WhiskingConfig(**change), THRESHOLD)
