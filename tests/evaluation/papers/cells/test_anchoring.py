"""The figure of anchoring: sessions differ in the test alone; views anchor, shuffled ones do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.cells.packet_figures import (
    PATHS,
    RATE,
    TESTS,
    AnchoringResult,
    Schedule,
    draw_anchoring,
    measure_anchoring,
    table_anchoring,
)
from evaluation.papers.figure import Task

SHORT = Schedule(test=20.0, back=28.0, end=34.0)


@pytest.fixture(scope="module")
def result() -> AnchoringResult:
    return measure_anchoring(Task(41000, sessions=1), SHORT)


def test_sessions_are_equal_until_the_test(result: AnchoringResult) -> None:
    rows = round(SHORT.test * RATE)
    for path in PATHS:
        light, *others = (result.error[path, test] for test in TESTS)
        for other in others:
            assert np.array_equal(other[:, :rows], light[:, :rows])
            assert not np.array_equal(other, light)


def test_a_packet_in_light_throughout_is_anchored(result: AnchoringResult) -> None:
    assert all((result.again[path, "light"] == 0).all() for path in PATHS)
    assert all((times >= 0).all() for times in result.again.values())


def test_shuffled_views_mislead(result: AnchoringResult) -> None:
    """On the path of the rat; on the walk no view is recalled within these 8 s."""
    rows = slice(round(SHORT.test * RATE), round(SHORT.back * RATE))
    light, _, shuffled = (result.error["sargolini", test][:, rows].mean(axis=(0, 1)) for test in TESTS)
    assert (shuffled > 1.5 * light).all(), (light, shuffled)


def test_table_and_picture(result: AnchoringResult, tmp_path: Path) -> None:
    text = "\n".join(table_anchoring(result))
    assert all(f"| {path} | {test}" in text for path in PATHS for test in TESTS)
    draw_anchoring(result, tmp_path / "anchoring.png")
    assert (tmp_path / "anchoring.png").read_bytes().startswith(b"\x89PNG")
