"""Occupancy maps as files: nav2's map.yaml and map.pgm, and grid.npz."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from evaluation.artifacts.grid_files import FREE_THRESH, OCCUPIED_THRESH, read_grid, read_nav2, write_nav2
from evaluation.metrics.occupancy_grid import PRIOR_OCCUPANCY, OccupancyGrid
from tactile.base.errors import InputError

law = settings(max_examples=40)
probabilities = arrays(np.float64, array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.floats(0, 1))
places = st.floats(-1e3, 1e3)
grids = st.builds(
    lambda p, x, y, cell: OccupancyGrid(p, np.array([x, y]), cell),
    probabilities,
    places,
    places,
    st.floats(1e-6, 2),
)
MAP = OccupancyGrid(np.array([[0.0, 0.3, 1.0], [0.1, 0.5, 0.7]]), np.array([-1.25, 0.5]), 0.05)
"""Two rows, the first one below the second."""


@pytest.fixture
def folder(tmp_path):
    write_nav2(tmp_path, MAP)
    return tmp_path


def write_and_read(grid):
    with tempfile.TemporaryDirectory() as folder:
        write_nav2(Path(folder), grid)
        return read_nav2(Path(folder) / "map.yaml")


@law
@given(grids)
def test_cells_read_back_as_occupied_free_or_unknown(grid):
    served = write_and_read(grid)
    p = grid.probability
    assert np.array_equal(served.cell == 100, p > OCCUPIED_THRESH)
    assert np.array_equal(served.cell == 0, p < FREE_THRESH)
    assert np.array_equal(served.cell == -1, (p >= FREE_THRESH) & (p <= OCCUPIED_THRESH))
    assert np.array_equal(served.origin, [*grid.origin, 0.0])
    assert served.resolution == grid.cell


@given(st.floats(0.25, 0.6))
def test_cells_at_the_prior_are_unknown(prior):
    served = write_and_read(OccupancyGrid(np.full((3, 4), prior), np.zeros(2), 0.05))
    assert (served.cell == -1).all()


def test_the_thresholds_themselves_are_unknown():
    served = write_and_read(MAP._replace(probability=np.array([[FREE_THRESH, OCCUPIED_THRESH]])))
    assert (served.cell == -1).all()


def test_the_prior_is_written_as_205(tmp_path):
    write_nav2(tmp_path, OccupancyGrid(np.full((3, 4), PRIOR_OCCUPANCY), np.zeros(2), 0.05))
    assert (tmp_path / "map.pgm").read_bytes() == b"P5\n4 3\n255\n" + bytes([205]) * 12


def test_the_files_of_a_small_map(folder):
    """The first row of the image has the greatest y; the image is named without a folder."""
    assert (folder / "map.pgm").read_bytes() == b"P5\n3 2\n255\n" + bytes([254, 205, 0, 254, 205, 0])
    assert (folder / "map.yaml").read_text() == (
        "image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.25, 0.5, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.19\n"
    )
    assert read_nav2(folder / "map.yaml").cell.tolist() == [[0, -1, 100], [0, -1, 100]]


def test_the_lowest_row_is_the_last_of_the_image(tmp_path):
    wall = np.full((4, 5), PRIOR_OCCUPANCY)
    wall[0] = 1.0
    write_nav2(tmp_path, MAP._replace(probability=wall))
    pixels = np.frombuffer((tmp_path / "map.pgm").read_bytes()[-20:], np.uint8).reshape(4, 5)
    assert (pixels[-1] == 0).all()
    assert (pixels[:-1] == 205).all()
    assert (read_nav2(tmp_path / "map.yaml").cell[0] == 100).all()


@law
@given(grids)
def test_numbers_have_no_exponent(grid):
    """PyYAML reads 1e-05 as a string."""
    with tempfile.TemporaryDirectory() as folder:
        write_nav2(Path(folder), grid)
        given = yaml.safe_load((Path(folder) / "map.yaml").read_text())
    assert given["origin"] == [*grid.origin.tolist(), 0.0]
    assert given["resolution"] == grid.cell
    assert all(isinstance(value, float) for value in given["origin"])


def test_the_usual_threshold_would_turn_unknown_into_free(folder):
    text = (folder / "map.yaml").read_text()
    for threshold, cells in (("0.19", -1), ("0.196", -1), ("0.25", 0)):
        (folder / "map.yaml").write_text(text.replace("0.19", threshold))
        assert read_nav2(folder / "map.yaml").cell[0, 1] == cells


@pytest.mark.parametrize(
    ("change", "cells"),
    [
        (("negate: 0", "negate: 1"), [[100, 100, 0], [100, 100, 0]]),
        (("negate: 0", "negate: true"), [[100, 100, 0], [100, 100, 0]]),
        (("mode: trinary\n", ""), [[0, -1, 100], [0, -1, 100]]),
        (("trinary", "scale"), [[0, 1, 100], [0, 1, 100]]),
        (("trinary", "raw"), [[-1, -1, 0], [-1, -1, 0]]),
    ],
)
def test_maps_of_other_tools_follow_the_same_rules(folder, change, cells):
    path = folder / "map.yaml"
    path.write_text(path.read_text().replace(*change))
    assert read_nav2(path).cell.tolist() == cells


def test_comments_in_an_image_are_skipped(folder):
    pixels = (folder / "map.pgm").read_bytes()[-6:]
    before = read_nav2(folder / "map.yaml")
    (folder / "map.pgm").write_bytes(b"P5 # by hand\n# twice\n3\t2 # so wide\n255\n" + pixels)
    assert np.array_equal(read_nav2(folder / "map.yaml").cell, before.cell)


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("resolution: 0.05", "resolution: wide", "resolution"),
        ("resolution: 0.05\n", "", "resolution"),
        ("resolution: 0.05", "resolution: -1", "positive"),
        ("resolution: 0.05", "resolution: .nan", "resolution"),
        ("free_thresh: 0.19", "free_thresh: 0.7", "free_thresh"),
        ("[-1.25, 0.5, 0.0]", "[-1.25, 0.5]", "origin"),
        ("[-1.25, 0.5, 0.0]", "[-1.25, x, 0]", "origin"),
        ("trinary", "grey", "mode"),
        ("map.pgm", "other.pgm", r"other\.pgm"),
        ("image: map.pgm\n", "", "image"),
        ("image", "[", "malformed"),
    ],
)
def test_an_invalid_map_yaml_is_refused(folder, old, new, where):
    path = folder / "map.yaml"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=where):
        read_nav2(path)


@pytest.mark.parametrize("content", [b"", b"P2\n3 2\n255\n0 0 0 0 0 0", b"P5\n3 2\n65535\n" + bytes(12),
                                     b"P5\n3 2\n255\n" + bytes(5), b"P5\n3 2\n255\n" + bytes(7)])  # fmt: skip
def test_another_image_is_refused(folder, content):
    (folder / "map.pgm").write_bytes(content)
    with pytest.raises(InputError, match=r"map\.pgm"):
        read_nav2(folder / "map.yaml")


def test_missing_and_malformed_maps_are_refused(tmp_path):
    (tmp_path / "map.yaml").write_text("- a list\n")
    for name in ("map.yaml", "missing.yaml"):
        with pytest.raises(InputError, match=name):
            read_nav2(tmp_path / name)
    with pytest.raises(ValueError, match="probabilities"):
        write_nav2(tmp_path, MAP._replace(probability=np.full((2, 2), np.nan)))


@law
@given(grids)
def test_a_grid_file_keeps_every_digit(grid):
    with tempfile.TemporaryDirectory() as folder:
        np.savez_compressed(Path(folder) / "grid.npz", **grid._asdict())
        found = read_grid(Path(folder) / "grid.npz")
    assert np.array_equal(found.probability, grid.probability)
    assert np.array_equal(found.origin, grid.origin)
    assert found.cell == grid.cell


def test_other_archives_are_refused(tmp_path):
    np.savez_compressed(tmp_path / "whole.npz", **MAP._asdict())
    content = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    (tmp_path / "text.npz").write_text("no map")
    np.savez(tmp_path / "other.npz", probability=np.zeros((2, 2)))
    np.savez(tmp_path / "odd.npz", probability=np.full((2, 2), 7.0), origin=np.zeros(2), cell=0.1)
    for name in ("cut", "text", "other", "odd", "missing"):
        with pytest.raises(InputError, match=name):
            read_grid(tmp_path / f"{name}.npz")
