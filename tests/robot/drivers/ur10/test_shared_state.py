"""The ring buffer in shared memory: every state complete, once and in order; no file remains."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from robot.drivers.ur10.shared_state import ARM_STATE, SLOTS, SharedState

WRITER = """
import sys, numpy as np
from robot.drivers.ur10.shared_state import ARM_STATE, SharedState
shared = SharedState(int(sys.argv[1]))
state = np.zeros((), ARM_STATE)
for k in range(1, int(sys.argv[2]) + 1):
    for name in ("host", "robot", "tcp", "speed", "force", "joints", "mode", "safety", "runtime"):
        state[name] = k
    shared.publish(state)
"""


def write(shared: SharedState, count: int) -> None:
    state = np.zeros((), ARM_STATE)
    for _ in range(count):
        state["robot"] = shared.newest + 1
        shared.publish(state)


@pytest.fixture
def shared() -> Iterator[SharedState]:
    shared = SharedState()
    yield shared
    shared.close()


def test_states_come_in_order_and_once(shared: SharedState) -> None:
    assert shared.latest() is None
    assert len(shared.since(0)) == 0
    write(shared, 10)
    assert shared.since(0)["counter"].tolist() == list(range(1, 11))
    assert shared.since(7)["counter"].tolist() == [8, 9, 10]
    assert len(shared.since(10)) == len(shared.since(99)) == 0
    write(shared, SLOTS)
    states = shared.since(3)
    assert states["counter"].tolist() == list(range(12, SLOTS + 11))
    np.testing.assert_array_equal(states["counter"], states["robot"])


def test_a_reader_beside_a_writer_sees_whole_states_only(shared: SharedState) -> None:
    count = 20_000
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(shared.fd), str(count)],
        cwd=Path(__file__).parents[4],
        pass_fds=[shared.fd],
    )
    try:
        seen, until = 0, time.monotonic() + 60
        while seen < count and time.monotonic() < until:
            states = shared.since(seen)
            if not len(states):
                continue
            counters = states["counter"].astype(float)
            for name in ("host", "robot", "mode", "safety", "runtime"):
                np.testing.assert_array_equal(states[name], counters)
            for name in ("tcp", "speed", "force", "joints"):
                np.testing.assert_array_equal(states[name], np.repeat(counters[:, None], 6, axis=1))
            assert counters[0] > seen
            assert (np.diff(counters) > 0).all()
            seen = int(counters[-1])
        assert seen == count
        assert writer.wait(30) == 0
        # The end of the writer does not release the memory.
        assert int(shared.since(count - 1)["counter"][-1]) == count
    finally:
        writer.kill()
        writer.wait()


def test_the_memory_has_no_name_and_is_released_on_close() -> None:
    shared = SharedState()
    fd = shared.fd
    assert os.readlink(f"/proc/self/fd/{fd}").endswith("(deleted)")
    write(shared, 3)
    states = shared.since(0)
    shared.close()
    with pytest.raises(OSError, match="descriptor"):
        os.fstat(fd)
    assert states["counter"].tolist() == [1, 2, 3]
