"""The figure of cue rotation: planted rotations are found; nothing turns where no cue turns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.cells.recording import CellRecording
from evaluation.papers.cells.rotation import CONDITIONS, FIGURE, measure_rotation, rotation_of
from evaluation.papers.figure import Task
from tactile.base.se2 import wrap

SHORT = TURN, _, END = 16.0, 19.0, 22.0
SHAPE, CELL_SIZE = (36, 21, 21), 0.05


def planted(turn: float) -> CellRecording:
    """A packet whose frame turns by an angle round the middle of the box, and cells tuned to its heading."""
    time = np.arange(0, END, 0.1)
    random = np.random.default_rng(3)
    truth = np.column_stack([random.uniform(0.2, 0.8, (len(time), 2)), random.uniform(-3, 3, len(time))])
    truth[0] = [0.5, 0.5, 0.0]
    angle = np.where(time >= TURN, -turn, 0.0)
    x, y = (truth[:, :2] - 0.5).T
    c, s = np.cos(angle), np.sin(angle)
    metres = np.column_stack([c * x - s * y, s * x + c * y])
    heading = truth[:, 2] + angle
    packet = np.column_stack([10 + metres / CELL_SIZE, heading * 36 / (2 * np.pi)]) % [21, 21, 36]
    cell = np.arange(36, dtype=np.int32) * 441
    activity = np.exp(4 * np.cos(heading[:, None] - 2 * np.pi * np.arange(36) / 36) - 4)
    return CellRecording(
        SHAPE, CELL_SIZE, time, truth, packet, np.zeros(len(time)), np.zeros(len(time), np.int32), cell,
        activity.astype(np.float32), None,
    )  # fmt: skip


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.floats(0.0, np.pi))
def test_a_planted_rotation_is_found(turn: float) -> None:
    (heading, place, cells), _ = rotation_of(planted(turn), SHORT, turn)
    assert abs(wrap(heading - turn)) < 1e-6
    assert abs(wrap(place - turn)) < 1e-6
    assert abs(wrap(cells - turn)) < 0.2


@pytest.mark.parametrize("turn", [0.0, np.pi / 2, np.pi])
def test_a_packet_that_follows_odometry_has_not_turned(turn: float) -> None:
    (heading, place, cells), _ = rotation_of(planted(0.0), SHORT, turn)
    assert max(abs(heading), abs(place)) < 1e-6
    assert abs(cells) < 0.2  # the rows before and after hold other headings


@pytest.fixture(scope="module")
def result() -> Any:
    return measure_rotation(Task(41000, sessions=1), SHORT)


@pytest.mark.soak
def test_nothing_turns_where_no_cue_turns(result: Any) -> None:
    _, (heading, *_), _ = result
    for (_, degrees, _), turned in zip(CONDITIONS, heading, strict=True):
        if degrees == 0:
            assert (np.abs(turned) < 40).all()


@pytest.mark.soak
def test_sessions_are_equal_until_the_turn(result: Any) -> None:
    _, _, courses = result
    before = np.radians(courses[:, 0, : round(TURN * 10)])
    assert np.abs(wrap(before - before[0])).max() < 1e-9


@pytest.mark.soak
def test_table_and_picture(result: Any, tmp_path: Path) -> None:
    text = "\n".join(FIGURE.table(result))
    assert all(f"| {name} | {degrees} |" in text for name, degrees, _ in CONDITIONS)
    assert FIGURE.draw is not None
    FIGURE.draw(result, tmp_path / "rotation.png")
    assert (tmp_path / "rotation.png").read_bytes().startswith(b"\x89PNG")
