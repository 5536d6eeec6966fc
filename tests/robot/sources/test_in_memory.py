"""Sources in memory: whiskers that stop working and work again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot.sources.in_memory import InMemorySource, cut_log, load_into_memory, select_rows, truncate_log

ROWS, WHISKERS = 6, 4


def source(alive: np.ndarray) -> InMemorySource:
    return InMemorySource(
        name="test",
        digest="0",
        time=np.arange(ROWS, dtype=float),
        motion=np.zeros((ROWS, 4)),
        moved=np.ones(ROWS, bool),
        views=np.zeros((ROWS, 1, WHISKERS, 1)),
        seen=np.ones(ROWS, bool),
        label=np.full(ROWS, -1, np.int32),
        alive=alive,
    )


def test_a_whisker_may_be_bent_for_a_part_of_the_session() -> None:
    alive = np.ones((ROWS, WHISKERS), bool)
    alive[2:4, 1] = False
    log = load_into_memory(source(alive))
    assert log.whiskers == WHISKERS
    np.testing.assert_array_equal([sample.reading.alive for sample in log], alive)
    np.testing.assert_array_equal([sample.reading.alive for sample in truncate_log(log, 3)], alive[:3])


def test_rows_left_out_leave_out_their_flags_and_contacts() -> None:
    alive = np.arange(ROWS)[:, None] % 3 != np.arange(WHISKERS) % 3
    point = np.arange(ROWS * WHISKERS * 2, dtype=float).reshape(ROWS, WHISKERS, 2)
    log = replace(source(alive), contact=alive, point=point)
    rows = np.array([1, 4, 5])
    for row, sample in zip(rows, select_rows(log, rows), strict=True):
        np.testing.assert_array_equal(sample.reading.alive, alive[row])
        np.testing.assert_array_equal(sample.reading.contact, alive[row])
        np.testing.assert_array_equal(sample.reading.point, point[row])


def test_one_row_of_flags_holds_for_all() -> None:
    flags = np.array([True, False, True, True])
    for sample in source(flags):
        np.testing.assert_array_equal(sample.reading.alive, flags)


def test_a_cut_log_starts_without_motion_and_leaves_the_original() -> None:
    log = replace(source(np.ones(WHISKERS, bool)), motion=np.ones((ROWS, 4)))
    before = log.motion.copy()
    part = cut_log(log, 2, 5)
    assert part.length == 3
    assert not part.motion[0].any()
    assert np.array_equal(part.motion[1:], before[3:5])
    assert np.array_equal(log.motion, before)
    assert part.digest == f"{log.digest}[2:5]"
    assert cut_log(log, 1).length == log.length - 1
