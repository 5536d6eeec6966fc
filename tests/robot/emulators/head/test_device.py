"""The emulated bridge: every frame is counted, and faults have the effect requested."""

from __future__ import annotations

import errno
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.head.usb_protocol import ANGLE, REQUEST_IN, REQUEST_OUT, WRAP, FrameFlag, Request
from robot.emulators.head.emulated_device import Fifo
from robot.emulators.head.emulator_config import HeadEmulatorConfig
from robot.emulators.head.whiskers import BLOCK
from tests.robot.emulators.head.heads import EVER, HostedHead, drive

FREE = HeadEmulatorConfig()


def started(**changes: object) -> HostedHead:
    head = HostedHead(HeadEmulatorConfig.model_validate(changes))
    head.start()
    return head


@given(
    st.integers(1, 30),
    st.lists(
        st.tuples(st.just("push"), st.integers(1, 20)) | st.tuples(st.just("take"), st.integers(1, 900))
    ),
)
def test_frames_are_sent_lost_or_waiting(capacity: int, steps: list[tuple[str, int]]) -> None:
    fifo, made, held, read = Fifo(capacity), 0, b"", b""
    for step, count in steps:
        if step == "push":
            frames = [bytes([k % 256]) * 32 for k in range(made, made + count)]
            held += b"".join(frames[: capacity - len(fifo)])
            lost = fifo.lost
            fifo.push(frames)
            made += count
            assert fifo.overran == (fifo.lost > lost)
        else:
            part = fifo.take(count)
            assert len(part) == min(count, len(held) - len(read))
            read += part
        assert len(fifo) <= capacity
        assert fifo.made == made == fifo.sent + fifo.lost + fifo.dropped + len(fifo)
        assert fifo.sent == len(read) // 32
    assert held.startswith(read)
    fifo.clear()
    assert len(fifo) == 0
    assert fifo.made == fifo.sent + fifo.lost + fifo.dropped


def test_unread_frames_beyond_the_capacity_are_lost() -> None:
    head = started(fifo=100)
    first = head.pass_by(0.1)
    assert len(first.values) == 200
    unread = head.pass_by(0.5, read=False)
    assert len(unread.values) == 0
    rest = head.pass_by(0.1)
    found = head.do("counts")
    assert found == {"made": 1400, "sent": 480, "queued": 0, "lost": 920, "dropped": 0, "skipped": 0}
    # 100 frames were queued; the next one has the overrun flag.
    assert rest.sequence.tolist() == [*range(200, 300), *range(1220, 1400)]
    assert np.flatnonzero(rest.flags & FrameFlag.OVERRUN).tolist() == [100]
    assert head.decoder.counts.missing == 920
    assert head.decoder.counts.bad == 0


def test_times_follow_from_the_numbers() -> None:
    head = started()
    head.pass_by(0.2)
    head.bridge.control(REQUEST_OUT, Request.STOP, 0, 0, head.now)
    assert len(head.pass_by(0.3).values) == 0
    head.start()
    frames = head.pass_by(0.1)
    assert frames.sequence[0] == 1000  # numbers advance while stopped
    assert (frames.time == 500 * frames.sequence).all()


def test_a_stop_drops_queued_frames_and_retracts() -> None:
    head = started(mechanics={"noise": 0.0})
    head.send(drive())
    head.pass_by(0.4)
    head.pass_by(0.1, read=False)
    head.bridge.control(REQUEST_OUT, Request.STOP, 0, 0, head.now)
    assert head.bridge.bulk_in(EVER, head.now) == b""
    assert head.do("counts")["dropped"] == 200
    assert not head.do("state")["resting"]
    head.pass_by(0.5)
    state = head.do("state")
    assert state["resting"]
    assert state["angle"] == [0.0] * 18


def test_numbers_and_times_wrap() -> None:
    for age, name in ((WRAP / 1e6 - 0.05, "time"), (WRAP / 2000 - 0.05, "sequence")):
        head = started(age=age)
        frames = head.pass_by(0.2)
        assert head.decoder.counts.good == 400
        assert head.decoder.counts.missing == 0
        raw = getattr(frames, name) % WRAP
        assert (np.diff(raw) < 0).sum() == 1


def test_clock_drift() -> None:
    head = started(drift_ppm=500.0)
    times, frames = [], 0
    for _ in range(2):
        answer = head.bridge.control(REQUEST_IN, Request.CLOCK, 0, 8, head.now)
        times.append(int.from_bytes(answer, "little"))
        frames += len(head.pass_by(10.0).values)
    assert times[1] - times[0] == 10_005_000
    # Samples follow the head's clock, in complete blocks.
    assert 40_020 - head.bridge.samples <= frames <= 40_020


def test_clock_jump() -> None:
    head = started()
    before = head.pass_by(0.1)
    head.do("clock", jump_us=123_456)
    after = head.pass_by(0.1)
    assert after.time[0] - before.time[-1] == 500 + 123_456
    assert after.sequence[0] == before.sequence[-1] + 1


def test_counts_of_damaged_skipped_and_garbage_data() -> None:
    head = started()
    head.pass_by(0.1)
    head.do("corrupt", frames=33)
    head.pass_by(0.1)
    assert (head.decoder.counts.bad, head.decoder.counts.missing) == (33, 33)
    head.do("skip", frames=57)
    assert len(head.pass_by(0.1).values) == 143
    assert (head.decoder.counts.bad, head.decoder.counts.missing) == (33, 90)
    assert head.do("counts")["skipped"] == 57
    head.do("garbage", bytes=777)
    assert len(head.pass_by(0.1).values) == 200
    assert head.decoder.counts.skipped_bytes >= 777
    assert head.decoder.counts.missing == 90
    counted = head.do("counts")
    assert counted["made"] == counted["sent"] + counted["skipped"] == 800


def test_frames_may_come_out_of_order() -> None:
    head = started()
    head.do("swap", frames=2)
    order = head.pass_by(0.1).sequence
    assert sorted(order.tolist()) == list(range(200))
    assert order[[18, 19, 38, 39]].tolist() == [19, 18, 39, 38]
    assert head.decoder.counts.missing == 0


def test_a_saturated_whisker() -> None:
    head = started()
    head.do("saturate", whisker=5, seconds=0.2)
    y = head.pass_by(0.5).values[:, :, 2] * ANGLE
    full = np.flatnonzero(np.isclose(y[:, 5], 1.5, atol=1e-3))
    assert full.tolist() == list(range(len(full)))
    assert len(full) == pytest.approx(400, abs=20)
    assert np.abs(np.delete(y, 5, axis=1)).max() < 0.1


def test_a_stall_ends_when_cleared_after_its_duration() -> None:
    head = started()
    head.pass_by(0.1, read=False)
    head.do("stall", seconds=0.2)
    for _ in range(2):
        with pytest.raises(OSError, match="pipe") as caught:
            head.bridge.bulk_in(EVER, head.now)
        assert caught.value.errno == errno.EPIPE
        head.bridge.faults.clear_halt()
    head.pass_by(0.3, read=False)
    assert len(head.bridge.bulk_in(EVER, head.now)) == 128 * 800
    head.do("stall")
    with pytest.raises(OSError, match="pipe"):
        head.bridge.bulk_in(EVER, head.now + 60)


def test_frames_are_delayed_by_a_silence() -> None:
    head = started()
    head.do("silence", seconds=1.0)
    assert len(head.pass_by(1.0 - BLOCK).values) == 0
    assert len(head.pass_by(0.1).values) == 2180
    assert head.do("counts")["lost"] == 0


def test_unplugging_ends_the_stream() -> None:
    head = started()
    head.send(drive())
    head.pass_by(0.2)
    head.do("unplug")
    assert not head.do("state")["plugged"]
    head.do("plug")
    assert len(head.pass_by(0.5).values) == 0
    assert head.do("state")["resting"]
    head.start()
    assert len(head.pass_by(0.1).values) == 200


def test_identity_and_unknown_requests() -> None:
    head = HostedHead(HeadEmulatorConfig(head={"whiskers": 4}))
    identity = json.loads(head.bridge.control(REQUEST_IN, Request.IDENTITY, 0, 1024, 0.0))
    assert identity | {"name": "", "version": ""} == {
        "name": "",
        "version": "",
        "whiskers": 12,
        "channels": 3,
        "rate": 2000.0,
    }
    assert head.bridge.control(0x80, 6, 0x0303, 255, 0.0)[2:].decode("utf-16-le") == "EMULATED"
    assert len(head.bridge.control(REQUEST_IN, Request.IDENTITY, 0, 5, 0.0)) == 5
    for kind, request, value in ((REQUEST_IN, 99, 0), (0x80, 6, 0x0309), (0x21, 9, 0)):
        with pytest.raises(OSError, match="pipe"):
            head.bridge.control(kind, request, value, 64, 0.0)


def test_invalid_commands_are_ignored() -> None:
    head = started()
    head.send(drive())
    for packet in (b"", b"WHKC" + bytes(60), bytes(32)):
        head.bridge.bulk_out(packet, head.now)
    head.pass_by(0.1, awake=False)
    assert head.do("state")["commands"] == {"DRIVE": 1, "": 3}


@pytest.mark.parametrize(
    "fault",
    [{}, {"do": "explode"}, {"do": "saturate", "whisker": 18}, {"do": "clock"}, {"do": "stall", "for": 3}],
)
def test_invalid_fault_requests_are_refused(fault: dict[str, object]) -> None:
    with pytest.raises((TypeError, ValueError)):
        started().bridge.do(fault, 0.0)
