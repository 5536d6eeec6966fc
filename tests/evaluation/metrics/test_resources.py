"""Peak memory, load of the cores, and one core to measure on."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from evaluation.studies.machine import one_core, peak_memory, reset_peak_memory, watch_load


def test_memory_is_measured_for_one_piece_of_work():
    reset_peak_memory()
    before = peak_memory()
    large = bytearray(200 << 20)
    large[::4096] = b"x" * len(large[::4096])
    del large
    peak = peak_memory()
    reset_peak_memory()
    after = peak_memory()
    assert peak >= before > 0
    if Path("/proc/self/clear_refs").exists():
        assert peak - before > 150
        assert after < peak - 100


def test_measuring_uses_one_core_and_releases_it():
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("this system does not say on which cores a process runs")
    cores = os.sched_getaffinity(0)
    load = watch_load()
    with one_core():
        assert len(os.sched_getaffinity(0)) == 1
        assert os.sched_getaffinity(0) <= cores
    assert os.sched_getaffinity(0) == cores
    found = load()
    assert found is None or found >= 0
