"""Fixtures of the tests of `robot`: traces, and a check of errors in user input."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile.base.errors import InputError

SYNTHETIC = (
    "a_square3",
    "b_figure8_alias",
    "c_corridor_wrap",
    "d1_rotation_generic",
    "e_kidnap",
    "j_reverse_stop",
)


@pytest.fixture(params=SYNTHETIC)
def trace(request: pytest.FixtureRequest, find_trace: Callable[[str], Path]) -> Path:
    """Each synthetic reference trace."""
    return find_trace(request.param)


@pytest.fixture
def stream(tmp_path: Path) -> Callable[..., Path]:
    """Writes a small valid reference trace, with some arrays replaced (None: omitted)."""

    def write(**changes: Any) -> Path:
        rows = np.arange(12)
        arrays = {
            "in_t": 100 + 0.5 * rows,
            "in_v": np.full(12, 0.1),
            "in_w": np.full(12, 0.2),
            "in_flags": np.full(12, 3.0),
            "in_view": (rows[:, None] + np.arange(6)) / 20,
            "truth": np.stack([0.05 * rows, 0.0 * rows, 0.1 * rows], axis=1),
            "params_json": np.array('{"template_x_size": "3", "template_y_size": "2", "vt_match": "0.5"}'),
        }
        arrays |= {name: np.asarray(value) for name, value in changes.items() if value is not None}
        path = tmp_path / "stream.npz"
        np.savez(path, **{name: array for name, array in arrays.items() if changes.get(name, 0) is not None})
        return path

    return write


@pytest.fixture
def refused() -> Callable[..., InputError]:
    """Checks that an action raises an InputError with all given pieces of text; returns it."""

    def call(action: Callable[[], object], *pieces: str) -> InputError:
        with pytest.raises(InputError) as caught:
            action()
        for piece in pieces:
            assert piece in str(caught.value), str(caught.value)
        return caught.value

    return call
