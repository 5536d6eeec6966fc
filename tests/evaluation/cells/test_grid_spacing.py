"""Spacing and orientation of lattices that are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.cells.grid_score import HEXAGONAL, SQUARE, autocorrelogram, measure_lattice
from tactile.base.errors import InputError
from tests.evaluation.cells.lattice_maps import lattice_map


@pytest.mark.parametrize(("directions", "lattice"), [(3, HEXAGONAL), (2, SQUARE)])
@given(spacing=st.floats(7, 9), turn=st.floats(0, np.pi))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_it_is_that_of_the_lattice(directions, lattice, spacing, turn):
    maps = autocorrelogram(lattice_map(directions, spacing, turn, (30, 30))[None])
    found, orientation = measure_lattice(maps, 0.05, lattice)
    period = np.pi / directions
    assert found[0] == pytest.approx(0.05 * spacing, rel=0.04)
    error = (orientation[0] - turn + period / 2) % period - period / 2
    assert abs(error) < np.deg2rad(3)
    assert 0 <= orientation[0] <= period


def test_too_few_peaks_are_nan_and_a_bin_has_a_size():
    y, x = np.mgrid[:20, :20]
    bump = np.exp(-((x - 9.0) ** 2 + (y - 9.0) ** 2) / 8)
    maps = autocorrelogram(np.array([bump, np.ones((20, 20))]))
    spacing, orientation = measure_lattice(maps, 0.05)
    assert np.isnan(spacing).all()
    assert np.isnan(orientation).all()
    with pytest.raises(InputError, match="bin_size"):
        measure_lattice(maps, 0.0)
