"""The reader thread: samples, commands, reconnection, faults, overload; whisking and feedback on the host."""

import threading
import time
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.drivers.head import usb_protocol as wire
from robot.drivers.head.decoder import Frames, FrameWindow
from robot.drivers.head.driver_config import HeadLinkConfig
from robot.drivers.head.reader import HeadReader, LinkState, OverloadDetector
from robot.drivers.head.usb_protocol import ANGLE, Command, CommandKind, FeedbackMode, Request, to_counts
from robot.drivers.head.whisk_control import HeadDriver, HostRcp, whisk_commands
from robot.drivers.outcome import SessionOutcome
from tactile.base.errors import InputError
from tactile.whisker_geometry import HeadConfig, ur10_head
from tactile.whisking import WhiskingConfig, initial_drive, whisk_command
from tests.helpers.live import until
from tests.robot.drivers.head.memory import WHISKERS, MemoryHead

QUICK = HeadLinkConfig(silence=0.5, patience=1.5)
PATIENT = HeadLinkConfig(silence=30.0, patience=60.0)
"""Limits for tests that lose no data on a busy machine."""
DRIVE = Command(CommandKind.DRIVE, FeedbackMode.RCP, 1.0, 1.0)
CENTRE = Command(CommandKind.CENTRE, numbers=np.array([3, 4], np.int16))
LIMIT = 1000  # of the deflection, counts


def amplitudes(number):
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


def good(reader):
    return reader.decoder.counts.good


def kinds(head):
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
    assert (reader.state, reader.fault) == (LinkState.STREAMING, None)


def test_the_stream_is_started_and_stopped_and_has_the_times_of_the_device_clock(head):
    head.clock = 7 * 2**32 + 100
    reader = HeadReader(head.connect, WHISKERS, QUICK)
    assert reader.state == LinkState.CLOSED
    with reader:
        assert head.requests == [Request.IDENTITY, Request.CLOCK, Request.START]
        head.send(0)
        until(lambda: good(reader) == 10)
        assert reader.ring.between(0, 9).time[0] == 7 * 2**32
    assert (head.requests[-1], head.opened, head.closed) == (Request.STOP, 1, 1)
    assert (reader.state, reader.fault) == (LinkState.CLOSED, None)


REFUSED = [(WHISKERS, {"plugged": False}, "pulled out"), (18, {}, "memory has 2 whiskers"),
           (WHISKERS, {"identity": {"name": "a printer"}}, "printer")]  # fmt: skip


@pytest.mark.parametrize(("whiskers", "change", "match"), REFUSED)
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
    assert (restarts, reader.ring.newest[0], reader.decoder.counts.restarts) == ([12345], 2**32 + 9, 1)
    assert (reader.state, reader.fault) == (LinkState.STREAMING, None)


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
    fault = until(lambda: head.put(b"WHK1" + bytes(60)) or quick_reader.fault)
    assert fault.outcome == SessionOutcome.HEAD_GARBLED


def test_a_stall_loses_nothing(head, reader):
    reader.send(DRIVE)
    until(lambda: head.commands)
    head.commands.clear()
    head.stalls = 5
    reader.send(CENTRE)
    head.send(0)
    until(lambda: good(reader) == 10)
    until(lambda: CommandKind.CENTRE in kinds(head))
    assert (reader.stalls, reader.fault) == (5, None)


def test_a_hanging_thread_is_detected(head, quick_reader):
    held = threading.Event()
    quick_reader.listeners.append(lambda frames, arrival: held.wait(5))
    head.send(10)
    until(lambda: quick_reader.state == LinkState.SILENT)
    until(lambda: quick_reader.fault)
    held.set()


def test_an_exception_in_the_thread_is_a_fault(head, reader, monkeypatch):
    monkeypatch.setattr(threading, "excepthook", lambda arguments: None)  # the error is expected
    reader.listeners.append(Mock(side_effect=RuntimeError("a listener's bug")))
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


def watcher(*alive):
    return OverloadDetector(LIMIT * ANGLE, np.array(alive or (True, True)))


@given(st.lists(st.tuples(*[st.sampled_from([0, 999, 1000, -1000])] * 2), max_size=30), st.data())
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


def test_which_deflections_are_an_overload():
    over = (0, 32767), (0, -32768), (1, -32768), (1, 1000)
    for channel, value in (*over, (0, 32766)):
        values = np.zeros((2, 2, 3), np.int16)
        values[:, 1, channel] = value
        assert watcher().check(values) == (1 if (channel, value) in over else None)
        assert watcher(True, False).check(values) is None


def frames(numbers):
    number = np.array(numbers, np.int64)
    values = np.repeat(number[:, None] % 30000, 3, axis=1)[:, None].astype(np.int16)
    return Frames(number, 500 * number, (number % 256).astype(np.uint8), values)


BLOCKS = st.lists(st.lists(st.integers(-40, 40), max_size=8, unique=True), max_size=8)


@given(BLOCKS, st.integers(0, 60), st.integers(0, 40))
def test_the_window_holds_the_newest_frames(blocks, first, length):
    window, stored, highest = FrameWindow(1), [], 2**32
    assert window.newest is None
    for k, block in enumerate(blocks):
        numbers = [number for step in block if (number := highest + step) not in stored]
        window.add(frames(numbers), float(k))
        stored += numbers
        highest = max(stored, default=highest)
        if stored:
            assert window.newest[:2] == (highest, 500 * highest)
    start = 2**32 - 20 + first
    wanted = sorted(number for number in stored if start <= number <= start + length)
    for column, expected in zip(window.between(start, start + length), frames(wanted), strict=True):
        np.testing.assert_array_equal(column, expected)


HEAD = ur10_head(HeadConfig())
THRESHOLD = np.full(18, 0.04)
REST = np.linspace(-0.01, 0.01, 18)


def whisks(count, touched=None, start=0):
    """Samples at 2 kHz from the start of a whisk of 1 s on; `touched` is y [N, 18], rad."""
    number = start + np.arange(count)
    values = np.zeros((count, 18, 3), np.int16)
    values[..., 2] = to_counts(REST + (0.0 if touched is None else touched))
    flags = np.where(number % 2000 == 0, wire.FrameFlag.CYCLE, 0).astype(np.uint8)
    return Frames(number, 500 * number, flags, values)


def blocks(frames, cuts):
    return [Frames(*columns) for columns in zip(*(np.split(column, cuts) for column in frames), strict=True)]


FEEDBACK = [("open", "head", THRESHOLD), ("rcp", "head", THRESHOLD), ("rcp", "head", None),
            ("rcp", "host", THRESHOLD), ("spread", "host", THRESHOLD)]  # fmt: skip


@pytest.mark.parametrize(("mode", "rcp", "threshold"), FEEDBACK)
def test_where_feedback_is_computed(mode, rcp, threshold):
    in_head = (mode, rcp) == ("rcp", "head") and threshold is not None
    command_mode = FeedbackMode.RCP if in_head else FeedbackMode.OPEN
    whisking = WhiskingConfig(mode=mode, rate=2.0, amplitude_deg=50, gain=3)
    centre, drive = whisk_commands(whisking, threshold, REST, rcp)
    assert (centre.kind, drive.kind, drive.mode) == (CommandKind.CENTRE, CommandKind.DRIVE, command_mode)
    np.testing.assert_allclose(centre.numbers * ANGLE, REST, atol=ANGLE)
    assert drive.amplitude == np.radians(50)
    assert (drive.frequency, drive.gain, drive.window) == (2.0, 3.0, 0.01)
    assert len(drive.numbers) == (0 if threshold is None else 18)


def test_whiskers_without_feedback_have_no_threshold():
    threshold = np.array([0.01, np.inf, 4.0])
    drive = whisk_commands(WhiskingConfig(), threshold)[-1]
    assert drive.numbers.tolist() == [int(to_counts(0.01)), wire.NO_THRESHOLD, wire.NO_THRESHOLD - 1]


MODES, CUTS = st.sampled_from(["rcp", "spread"]), st.lists(st.integers(0, 900), max_size=5)


@settings(max_examples=10)
@given(MODES, CUTS, st.integers(0, 17), st.floats(0.05, 0.3))
def test_host_feedback_follows_the_whisking_law(mode, cuts, whisker, bend):
    whisking = WhiskingConfig(mode=mode)
    touched = np.zeros((900, 18))
    touched[400:, whisker] = bend
    frames = whisks(900, touched)
    host, sent = HostRcp(whisking, HEAD.shape, THRESHOLD, REST), []
    for block in blocks(frames, sorted(cuts)):
        amplitudes = host.amplitudes(block)
        sent += [] if amplitudes is None else [amplitudes]
    drive = initial_drive(18)
    for k in range(900):
        y = frames.values[k, :, 2] * ANGLE - REST
        aim, drive = whisk_command(whisking, drive, k / 2000, y, THRESHOLD, HEAD.shape)
    share = (1 - np.cos(2 * np.pi * 899 / 2000)) / 2
    np.testing.assert_allclose(sent[-1] * ANGLE, aim / share, atol=ANGLE)
    assert sent[-1][whisker] < to_counts(np.radians(65))


def test_amplitudes_of_a_free_whisk_are_sent_once_per_cycle_from_the_first_one_on():
    host = HostRcp(WhiskingConfig(), HEAD.shape, THRESHOLD, REST)
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
        driver.whisk(WhiskingConfig(mode="spread"), THRESHOLD, REST)
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
    calls = []
    monkeypatch.setattr(HeadReader, "send", lambda reader, command: calls.append(command.kind.name))
    monkeypatch.setattr(HeadReader, "rest", lambda reader: calls.append("rest"))
    reader = HeadReader(MemoryHead(18).connect, 18, HeadLinkConfig(rcp="host"))
    driver = HeadDriver(reader, HEAD)
    driver.whisk(WhiskingConfig(mode="spread"), THRESHOLD, REST)
    resting = threading.Thread(target=driver.rest)

    def rest_meanwhile(host, frames):
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
