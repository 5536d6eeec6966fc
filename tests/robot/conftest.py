"""Fixtures of the tests of `robot`: traces, and a check of errors in user input."""

import numpy as np
import pytest

from tactile.base.errors import InputError


@pytest.fixture
def stream(tmp_path):
    """Writes a small valid reference trace, with some arrays replaced (None: omitted)."""

    def write(**changes):
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
        path = tmp_path / "stream.npz"
        np.savez(path, **{name: array for name, array in (arrays | changes).items() if array is not None})
        return path

    return write


def bits(value):
    """What two equal lists or tuples of arrays, or of such, have in common: types, shapes, order, bytes."""
    if isinstance(value, (tuple, list)):
        return type(value), [bits(part) for part in value]
    array = np.asarray(value)
    return array.shape, array.dtype, array.flags.c_contiguous, array.tobytes()


@pytest.fixture
def refused():
    """Checks that an action raises an InputError with all given pieces of text; returns it."""

    def call(action, *pieces):
        with pytest.raises(InputError) as caught:
            action()
        for piece in pieces:
            assert piece in str(caught.value), str(caught.value)
        return caught.value

    return call
