"""The reader thread: samples, commands, reconnection and faults; its ring buffer and overload detector."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.head.decoder import Frames
from robot.drivers.head.driver_config import HeadLinkConfig
from robot.drivers.head.reader import HeadReader, LinkState, OverloadDetector, RingBuffer
from robot.drivers.head.usb_protocol import ANGLE, Command, CommandKind, FeedbackMode, Request
from robot.drivers.outcome import SessionOutcome
from tactile.base.errors import InputError
from tests.helpers.live import until
from tests.robot.drivers.head.memory import WHISKERS, MemoryHead

QUICK = HeadLinkConfig(silence=0.5, patience=1.5)
PATIENT = HeadLinkConfig(silence=30.0, patience=60.0)
"""Limits for tests that lose no data on a busy machine."""
DRIVE = Command(CommandKind.DRIVE, FeedbackMode.RCP, 1.0, 1.0)
CENTRE = Command(CommandKind.CENTRE, numbers=np.array([3, 4], np.int16))
SIZE, LIMIT = 16, 1000
"""Of the ring buffer, and of the deflection, in counts."""


def amplitudes(number: int) -> Command:
    return Command(CommandKind.AMPLITUDES, numbers=np.array([number, number], np.int16))


@pytest.fixture
def head():
    return MemoryHead()


@pytest.fixture
def reader(head):
    with HeadReader(head.connect, WHISKERS, PATIENT) as reader:
        yield reader


@pytest.fixture
def quick_reader(head):
    """Reports a fault after 1.5 s without the head; has read ten samples."""
    with HeadReader(head.connect, WHISKERS, QUICK) as reader:
        head.send(0)
        until(lambda: good(reader) == 10)
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


def test_the_stream_is_started_and_stopped_and_has_the_times_of_the_device_clock(head):
    head.clock = 7 * 2**32 + 100
    reader = HeadReader(head.connect, WHISKERS, QUICK)
    assert reader.state == LinkState.CLOSED
    with reader:
        assert head.requests == [Request.IDENTITY, Request.CLOCK, Request.START]
        head.send(0)
        until(lambda: good(reader) == 10)
        assert reader.ring.between(0, 9).time[0] == 7 * 2**32
    assert head.requests[-1] == Request.STOP
    assert (head.opened, head.closed) == (1, 1)
    assert reader.state == LinkState.CLOSED
    assert reader.fault is None


@pytest.mark.parametrize(
    ("whiskers", "change", "match"),
    [
        (WHISKERS, {"plugged": False}, "pulled out"),
        (18, {}, "memory has 2 whiskers"),
        (WHISKERS, {"identity": {"name": "a printer"}}, "printer"),
    ],
)
def test_what_is_no_head_of_this_shape_is_refused_and_closed(head, whiskers, change, match):
    vars(head).update(change)
    with pytest.raises(InputError, match=match):
        HeadReader(head.connect, whiskers, QUICK).start()
    assert head.closed == head.opened == head.plugged


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
    begun, times = time.monotonic(), []
    while time.monotonic() - begun < 1.2:
        until(lambda: len(head.commands) > len(times))
        times.append(time.monotonic())
    assert np.median(np.diff(times)) < 0.4  # the head's time-out is 0.5 s


def test_only_the_newest_amplitudes_are_sent(head, reader):
    head.stalls = 1
    for k in range(20):
        reader.send(amplitudes(k))
    until(lambda: head.commands and head.commands[-1].numbers.tolist() == [19, 19])
    assert len(head.commands) < 20


def test_a_reconnected_head_gets_its_commands_again_and_new_numbers(head, reader):
    restarts = []
    reader.on_restart.append(lambda clock, at: restarts.append(clock))
    for command in (CENTRE, DRIVE, amplitudes(1)):
        reader.send(command)
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
    assert reader.ring.newest[0] == 2**32 + 9
    assert reader.decoder.counts.restarts == 1
    assert reader.state == LinkState.STREAMING
    assert reader.fault is None


def test_a_head_that_stays_disconnected_is_a_fault_that_stays(head, quick_reader):
    head.unplug()
    fault = until(lambda: quick_reader.fault)
    assert fault.outcome == SessionOutcome.HEAD_GONE
    assert "pulled out" in fault.detail
    head.plugged = True
    until(lambda: quick_reader.state != LinkState.AWAY)
    assert quick_reader.fault is fault


def test_a_silent_head_is_reported_and_started_again(head, quick_reader):
    until(lambda: quick_reader.state == LinkState.SILENT)
    assert until(lambda: quick_reader.fault).outcome == SessionOutcome.HEAD_SILENT
    assert head.requests.count(Request.START) >= 2


def test_a_garbled_stream_is_reported(head, quick_reader):
    assert until(lambda: head.put(b"WHK1" + bytes(60)) or quick_reader.fault).outcome == (
        SessionOutcome.HEAD_GARBLED
    )


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


def test_a_hanging_thread_is_detected(head, quick_reader):
    held = threading.Event()
    quick_reader.listeners.append(lambda frames, arrival: held.wait(5))
    head.send(10)
    until(lambda: quick_reader.state == LinkState.SILENT)
    until(lambda: quick_reader.fault)
    held.set()


def test_an_exception_in_the_thread_is_a_fault(head, reader, monkeypatch):
    monkeypatch.setattr(threading, "excepthook", lambda arguments: None)  # the error is expected

    def broken(frames, arrival):
        raise RuntimeError("a listener's bug")

    reader.listeners.append(broken)
    head.send(0)
    assert "a listener's bug" in until(lambda: reader.fault).detail
    until(lambda: reader.state == LinkState.CLOSED)


def test_overload_is_reported_with_the_whisker(head):
    overloads = []
    with HeadReader(head.connect, WHISKERS, QUICK, on_overload=overloads.append):
        values = np.zeros((10, WHISKERS, 3), np.int16)
        values[4:6, 1, 2] = -20000
        head.send(0, values=values)
        until(lambda: overloads == [1])


def watcher(alive: list[bool] | None = None) -> OverloadDetector:
    return OverloadDetector(LIMIT * ANGLE, np.array([True] * 2 if alive is None else alive))


@given(
    st.lists(st.lists(st.sampled_from([0, 999, 1000, -1000]), min_size=2, max_size=2), max_size=30), st.data()
)
def test_overload_does_not_depend_on_the_blocks(rows, data):
    values = np.zeros((len(rows), 2, 3), np.int16)
    values[:, :, 2] = np.array(rows, np.int16).reshape(-1, 2)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(rows)), max_size=4)))
    overload = watcher()
    found = [overload.check(block) for block in np.split(values, cuts)]
    over = np.abs(values[..., 2]) >= LIMIT
    twice = over[1:] & over[:-1]
    assert {one for one in found if one is not None} <= set(np.flatnonzero(twice.any(axis=0)).tolist())
    assert any(one is not None for one in found) == twice.any()


@pytest.mark.parametrize(
    ("channel", "value", "found"),
    [(0, 32767, 1), (0, -32768, 1), (0, 32766, None), (1, -32768, 1), (1, 1000, 1), (2, 999, None)],
)
def test_which_deflections_are_an_overload(channel, value, found):
    values = np.zeros((2, 2, 3), np.int16)
    values[:, 1, channel] = value
    assert watcher().check(values) == found
    assert watcher([True, False]).check(values) is None


def frames(numbers: list[int]) -> Frames:
    number = np.array(numbers, np.int64)
    values = np.repeat(number[:, None] % 30000, 3, axis=1)[:, None].astype(np.int16)
    return Frames(number, 500 * number, (number % 256).astype(np.uint8), values)


BLOCKS = st.lists(
    st.lists(st.integers(-40, 40), max_size=8, unique=True), max_size=8
)  # steps about the highest so far


@given(BLOCKS, st.integers(0, 60), st.integers(0, 40))
def test_the_ring_holds_copies_of_the_newest_frames(blocks, first, length):
    ring, stored, highest = RingBuffer(1, size=SIZE), {}, 2**32
    assert ring.newest is None
    for k, block in enumerate(blocks):
        numbers = [highest + step for step in block]
        highest = max([highest, *numbers]) if stored or numbers else highest
        ring.append(frames(numbers), float(k))
        stored |= {n: 500 * n for n in numbers}
        if stored:
            newest = max(stored)
            stored = {n: t for n, t in stored.items() if n > newest - SIZE}
            assert ring.newest[:2] == (newest, 500 * newest)
    start = 2**32 - 20 + first
    wanted = sorted(n for n in stored if start <= n <= start + length)
    got = ring.between(start, start + length)
    ring.append(frames(list(range(2**33, 2**33 + SIZE))), 0.0)
    assert got.sequence.tolist() == wanted
    assert got.time.tolist() == [500 * n for n in wanted]
    assert got.flags.tolist() == [n % 256 for n in wanted]
    assert got.values[:, 0, 2].tolist() == [n % 30000 for n in wanted]


def test_the_size_of_a_ring_must_be_a_power_of_two():
    with pytest.raises(ValueError, match="power of two"):
        RingBuffer(1, size=100)
