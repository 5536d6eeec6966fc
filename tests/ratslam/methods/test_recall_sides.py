"""The network of `backend: recall` covers the pieces of a map, not the ground between them."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping.keyframe_graph import piece_start
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from ratslam.recall.memory import MapFeedback
from tactile.base.se2 import compose

PATH = np.array([[0.0, 0.0, 0.0], [1.5, 0.4, 1.0], [-0.8, -0.7, 2.0]])


@pytest.fixture(scope="module")
def backend() -> RecallBackend:
    return RecallBackend(RecallBackendConfig(), (1, 8, 1))


def sides(backend: RecallBackend, poses: np.ndarray) -> tuple[int, ...]:
    return backend.sides(MapFeedback(poses, 0.0, 0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("pieces", [2, 3, 5])
def test_pieces_that_lie_apart_need_no_more_cells_than_one(backend: RecallBackend, pieces: int) -> None:
    apart = [compose(piece_start(k, backend.cell), PATH) for k in range(pieces)]
    assert sides(backend, np.concatenate(apart)) == sides(backend, PATH) == (21, 21)


def test_a_large_map_has_more_cells_in_one_piece_or_in_two(backend: RecallBackend) -> None:
    large = PATH * [3, 1, 1]
    both = np.concatenate([PATH, compose(piece_start(1, backend.cell), large)])
    assert sides(backend, large) == sides(backend, both) == (84, 21)
    assert sides(backend, PATH * [60, 1, 1])[0] == 8 * 21
