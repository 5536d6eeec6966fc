"""The lesions of the belief network: what they replace, and what remains on a short session."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from evaluation.papers.cells.belief_lesions import (
    CELL,
    INTACT,
    LESIONS,
    foreign_activity,
    measure_lesions,
    measure_sizes,
    replaced,
)
from evaluation.papers.figure import CELLS, Task, find_figure
from evaluation.papers.tables import touch_table as touch
from ratslam.network import pose_cells
from ratslam.network.config import Network, PoseCellConfig
from ratslam.network.pose_cells import ViewCells

SHORT = touch.TouchRow("short", {"path": {"explore": 420}, "maze": {"columns": 3, "rows": 3, "loop": 4}})
NETWORK = Network(PoseCellConfig(), excite=0.5, excite_heading=0.21, miss=0.002, leak=0.0)
CHOSEN = (INTACT, "cells and ties permuted together", "ties permuted alone", "prediction constant")


@pytest.fixture(scope="module")
def result() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("RATSLAM_DATA", raising=False)
        patch.setitem(touch.ROWS, "short", SHORT)
        return measure_lesions(Task(31001, sessions=1), CHOSEN, ("short",))


def test_the_intact_network_closes_loops_and_a_renamed_one_the_same(result: Any) -> None:
    ((_, _, true),) = result[INTACT, "short"]
    ((_, same, _),) = result["cells and ties permuted together", "short"]
    assert true > 0
    assert same == 1


@pytest.mark.parametrize("lesion", ["ties permuted alone", "prediction constant"])
def test_a_network_that_knows_no_places_closes_nothing(result: Any, lesion: str) -> None:
    ((figures, same, _),) = result[lesion, "short"]
    assert figures.metrics.closures == 0
    assert same == 0


def test_table_and_picture(result: Any, tmp_path: Path) -> None:
    figure = find_figure(CELLS["lesions"])
    rows = [line for line in figure.table(result) if line.startswith(f"| {CHOSEN[2]}")]
    assert [row.split(" | ")[3:5] for row in rows] == [["0, 0", "0%"]]
    assert figure.draw is not None
    figure.draw(result, tmp_path / "lesions.png")
    assert (tmp_path / "lesions.png").read_bytes().startswith(b"\x89PNG")


@pytest.fixture(scope="module")
def sizes() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(touch.ROWS, "short", SHORT)
        return measure_sizes(Task(31001, sessions=1), "short", sides=(7, 21), sizes=())


@pytest.mark.soak
def test_the_usual_size_is_the_product_and_a_tiny_network_closes_less(sizes: Any, result: Any) -> None:
    ((intact, _, _),) = result[INTACT, "short"]
    (fixed, tiny_sides, _), (_, usual_sides, _), (grown, _, _) = (
        sizes[network][0] for network in ((7, CELL, False), (21, CELL, False), (21, CELL, True))
    )
    assert intact is not None
    assert grown.metrics == intact.metrics
    assert fixed.metrics.closures < grown.metrics.closures
    assert (tiny_sides, usual_sides) == ((7, 7), (21, 21))


@pytest.mark.soak
def test_table_and_picture_of_sizes(sizes: Any, tmp_path: Path) -> None:
    figure = find_figure(CELLS["scale"])
    assert sum(line.startswith(("| 7 ", "| 21 ")) for line in figure.table(sizes)) == 4
    assert figure.draw is not None
    figure.draw(sizes, tmp_path / "scale.png")
    assert (tmp_path / "scale.png").read_bytes().startswith(b"\x89PNG")


def test_functions_are_replaced_within_alone() -> None:
    before = pose_cells.predict, pose_cells.anchor
    with replaced(LESIONS["ties permuted alone"](1)):
        assert pose_cells.predict is not before[0]
    assert (pose_cells.predict, pose_cells.anchor) == before


def driven(count: int) -> tuple[ViewCells, jnp.ndarray]:
    """View cells in a row, and their masses."""
    x = jnp.arange(count, dtype=jnp.float32)[None] * 0.05
    zero = jnp.zeros_like(x)
    return ViewCells(x, zero, zero, zero + 1, zero, zero + 1), jnp.full_like(x, 1 / count)


def test_silent_cells_hold_nothing_and_the_rest_what_it_held() -> None:
    cells, mass = driven(30)
    belief = pose_cells.start(NETWORK, mass.shape)
    intact = pose_cells.anchor(NETWORK, belief, cells, mass).activity
    with replaced(LESIONS["30% silent"](5)):
        left = pose_cells.anchor(NETWORK, belief, cells, mass).activity
    assert ((left == 0) | (left == intact)).all()
    assert 0.5 < float(left.sum()) < 0.9


def test_foreign_activity_is_repeated_over_a_larger_network() -> None:
    cells, mass = driven(20)
    recorded = np.random.default_rng(1).random((3, 36, 21, 21)).astype(np.float32)
    belief = pose_cells.cover(NETWORK, pose_cells.start(NETWORK, mass.shape), (42, 21))
    with replaced(foreign_activity(recorded)):
        activity = pose_cells.anchor(NETWORK, belief, cells, mass).activity
    np.testing.assert_array_equal(activity, np.tile(recorded[1], (1, 1, 2)))
