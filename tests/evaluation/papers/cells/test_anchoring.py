"""The figure of anchoring: sessions differ in the test alone; views anchor, shuffled ones do not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.papers.cells.packet_figures import ANCHORING, PATHS, RATE, TESTS, measure_anchoring
from evaluation.papers.figure import Task

TEST, BACK, END = 20.0, 28.0, 34.0


@pytest.fixture(scope="module")
def result() -> Any:
    return measure_anchoring(Task(41000, sessions=1), (TEST, BACK, END))


def test_sessions_are_equal_until_the_test(result: Any) -> None:
    rows, (_, error, _) = round(TEST * RATE), result
    for path in PATHS:
        light, *others = (error[path, test] for test in TESTS)
        for other in others:
            assert np.array_equal(other[:, :rows], light[:, :rows])
            assert not np.array_equal(other, light)


def test_a_packet_in_light_throughout_is_anchored(result: Any) -> None:
    _, _, again = result
    assert all((again[path, "light"] == 0).all() for path in PATHS)
    assert all((times >= 0).all() for times in again.values())


def test_shuffled_views_mislead(result: Any) -> None:
    """On the path of the rat; on the walk no view is recalled within these 8 s."""
    rows, (_, error, _) = slice(round(TEST * RATE), round(BACK * RATE)), result
    light, _, shuffled = (error["sargolini", test][:, rows].mean(axis=(0, 1)) for test in TESTS)
    assert (shuffled > 1.5 * light).all(), (light, shuffled)


def test_table_and_picture(result: Any, tmp_path: Path) -> None:
    text = "\n".join(ANCHORING.table(result))
    assert all(f"| {path} | {test}" in text for path in PATHS for test in TESTS)
    assert ANCHORING.draw is not None
    ANCHORING.draw(result, tmp_path / "anchoring.png")
    assert (tmp_path / "anchoring.png").read_bytes().startswith(b"\x89PNG")
