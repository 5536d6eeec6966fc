"""The reader thread: samples, commands, reconnection and faults."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from robot.drivers.head.driver_config import HeadLinkConfig
from robot.drivers.head.reader import HeadReader, LinkState
from robot.drivers.head.usb_protocol import Command, CommandKind, FeedbackMode, Request
from robot.drivers.outcome import SessionOutcome
from tactile.base.errors import InputError
from tests.helpers.live import until
from tests.robot.drivers.head.memory import WHISKERS, MemoryHead

QUICK = HeadLinkConfig(silence=0.5, patience=1.5)
PATIENT = HeadLinkConfig(silence=30.0, patience=60.0)
"""Limits for tests that lose no data on a busy machine."""
DRIVE = Command(CommandKind.DRIVE, FeedbackMode.RCP, 1.0, 1.0)
CENTRE = Command(CommandKind.CENTRE, numbers=np.array([3, 4], np.int16))


@pytest.fixture
def head():
    return MemoryHead()


@pytest.fixture
def reader(head):
    with HeadReader(head.connect, WHISKERS, PATIENT) as reader:
        yield reader


@pytest.fixture
def quick_reader(head):
    """Reports a fault after 1.5 s without the head."""
    with HeadReader(head.connect, WHISKERS, QUICK) as reader:
        yield reader


def good(reader: HeadReader) -> int:
    return reader.decoder.counts.good


def kinds(head: MemoryHead) -> list[CommandKind]:
    return [command.kind for command in head.commands]


def test_samples_reach_the_ring_and_every_listener(head, reader):
    calls = []
    reader.listeners.append(lambda frames, arrival: calls.append((frames, arrival)))
    began = time.monotonic()
    for k in range(5):
        head.send(10 * k)
    until(lambda: good(reader) == 50)
    assert reader.ring.between(0, 99).sequence.tolist() == list(range(50))
    until(lambda: sum(len(frames.sequence) for frames, _ in calls) == 50)
    assert all(began <= arrival <= time.monotonic() for _, arrival in calls)
    assert reader.state == LinkState.STREAMING
    assert reader.fault is None


def test_times_are_those_of_the_device_clock(head):
    head.clock = 7 * 2**32 + 100
    with HeadReader(head.connect, WHISKERS, QUICK) as reader:
        head.send(0)
        until(lambda: good(reader) == 10)
        assert reader.ring.between(0, 9).time[0] == 7 * 2**32


def test_the_stream_is_started_and_stopped(head):
    reader = HeadReader(head.connect, WHISKERS, QUICK)
    assert reader.state == LinkState.CLOSED
    with reader:
        assert head.requests == [Request.IDENTITY, Request.CLOCK, Request.START]
    assert head.requests[-1] == Request.STOP
    assert (head.opened, head.closed) == (1, 1)
    assert reader.state == LinkState.CLOSED
    assert reader.fault is None


def test_a_missing_head_is_an_input_error(head):
    head.unplug()
    with pytest.raises(InputError, match="pulled out"):
        HeadReader(head.connect, WHISKERS, QUICK).start()


def test_a_head_of_another_shape_is_refused(head):
    with pytest.raises(InputError, match="memory has 2 whiskers"):
        HeadReader(head.connect, 18, QUICK).start()
    assert head.closed == head.opened == 1


def test_a_device_without_identity_is_refused(head):
    head.identity = {"name": "a printer"}
    with pytest.raises(InputError, match="printer"):
        HeadReader(head.connect, WHISKERS, QUICK).start()


def test_keep_alives_are_sent_only_while_whisking(head, reader):
    time.sleep(0.3)
    assert head.commands == []
    reader.send(DRIVE)
    until(lambda: len(head.commands) >= 4)
    assert kinds(head)[:4] == [CommandKind.DRIVE, CommandKind.KEEP, CommandKind.KEEP, CommandKind.KEEP]
    reader.rest()
    time.sleep(0.3)  # commands already sent
    count = len(head.commands)
    time.sleep(0.3)
    assert len(head.commands) == count


@pytest.mark.soak
def test_keep_alive_period(head, reader):
    reader.send(DRIVE)
    begun, gaps, last = time.monotonic(), [], None
    while time.monotonic() - begun < 1.2:
        before = len(head.commands)
        until(lambda before=before: len(head.commands) > before)
        now = time.monotonic()
        gaps += [now - last] if last else []
        last = now
    assert np.median(gaps) < 0.4  # the head's time-out is 0.5 s


def test_only_the_newest_amplitudes_are_sent(head, reader):
    head.stalls = 1
    for k in range(20):
        reader.send(Command(CommandKind.AMPLITUDES, numbers=np.array([k, k], np.int16)))
    until(lambda: head.commands)
    until(lambda: head.commands[-1].numbers.tolist() == [19, 19])
    assert len(head.commands) < 20


def test_a_reconnected_head_gets_its_commands_again_and_new_numbers(head, reader):
    restarts = []
    reader.on_restart.append(lambda clock, at: restarts.append(clock))
    reader.send(CENTRE)
    reader.send(DRIVE)
    reader.send(Command(CommandKind.AMPLITUDES, numbers=np.array([1, 1], np.int16)))
    head.send(0)
    until(lambda: good(reader) == 10 and len(head.commands) >= 3)
    head.unplug()
    until(lambda: reader.state == LinkState.AWAY)
    assert reader.fault is None
    head.commands.clear()
    head.clock, head.plugged = 12345, True
    until(lambda: reader.state != LinkState.AWAY)
    head.send(0)
    until(lambda: good(reader) == 20)
    until(lambda: len(head.commands) >= 2)
    assert kinds(head)[:2] == [CommandKind.CENTRE, CommandKind.DRIVE]
    assert CommandKind.AMPLITUDES not in kinds(head)
    assert restarts == [12345]
    assert reader.ring.newest is not None
    assert reader.ring.newest[0] == 2**32 + 9
    assert reader.decoder.counts.restarts == 1
    assert reader.state == LinkState.STREAMING
    assert reader.fault is None


def test_a_head_that_stays_disconnected_is_a_fault(head, quick_reader):
    head.send(0)
    until(lambda: good(quick_reader) == 10)
    head.unplug()
    until(lambda: quick_reader.fault is not None)
    assert quick_reader.fault is not None
    assert quick_reader.fault.outcome == SessionOutcome.HEAD_GONE
    assert "pulled out" in quick_reader.fault.detail
    head.plugged = True
    until(lambda: quick_reader.state != LinkState.AWAY)
    assert quick_reader.fault.outcome == SessionOutcome.HEAD_GONE  # a fault stays


def test_a_silent_head_is_reported_and_started_again(head, quick_reader):
    head.send(0)
    until(lambda: quick_reader.state == LinkState.SILENT)
    until(lambda: quick_reader.fault is not None)
    assert quick_reader.fault is not None
    assert quick_reader.fault.outcome == SessionOutcome.HEAD_SILENT
    assert head.requests.count(Request.START) >= 2


def test_a_garbled_stream_is_reported(head, quick_reader):
    head.send(0)
    until(lambda: good(quick_reader) == 10)
    end = time.monotonic() + 60
    while quick_reader.fault is None and time.monotonic() < end:
        head.put(b"WHK1" + bytes(60))
        time.sleep(0.01)
    assert quick_reader.fault is not None
    assert quick_reader.fault.outcome == SessionOutcome.HEAD_GARBLED


def test_a_stall_loses_nothing(head, reader):
    reader.send(DRIVE)
    until(lambda: head.commands)
    head.commands.clear()
    head.stalls = 5
    reader.send(CENTRE)
    head.send(0)
    until(lambda: good(reader) == 10)
    until(lambda: CommandKind.CENTRE in kinds(head))
    assert reader.stalls == 5
    assert reader.fault is None


def test_a_hanging_thread_is_detected(head):
    held = threading.Event()
    with HeadReader(head.connect, WHISKERS, QUICK) as reader:
        reader.listeners.append(lambda frames, arrival: held.wait(5))
        head.send(0)
        until(lambda: reader.state == LinkState.SILENT)
        until(lambda: reader.fault is not None)
        held.set()


def test_an_exception_in_the_thread_is_a_fault(head, reader, monkeypatch):
    monkeypatch.setattr(threading, "excepthook", lambda arguments: None)  # the error is expected

    def broken(frames, arrival):
        raise RuntimeError("a listener's bug")

    reader.listeners.append(broken)
    head.send(0)
    until(lambda: reader.fault is not None)
    assert reader.fault is not None
    assert "a listener's bug" in reader.fault.detail
    until(lambda: reader.state == LinkState.CLOSED)


def test_overload_is_reported_with_the_whisker(head):
    overloads = []
    with HeadReader(head.connect, WHISKERS, QUICK, on_overload=overloads.append) as reader:
        values = np.zeros((10, WHISKERS, 3), np.int16)
        values[4:6, 1, 2] = -20000
        head.send(0, values=values)
        until(lambda: good(reader) == 10)
        until(lambda: overloads == [1])
