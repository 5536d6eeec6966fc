"""Files of a run directory and maps for nav2: read as written, and spoilt ones are refused by name."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from evaluation.artifacts import run_reader
from evaluation.artifacts.grid_files import FREE_THRESH, OCCUPIED_THRESH, read_grid, read_nav2, write_nav2
from evaluation.artifacts.run_reader import read_manifest, read_scorecard, read_walls, write_walls
from evaluation.metrics.occupancy_grid import PRIOR_OCCUPANCY, OccupancyGrid
from evaluation.metrics.scorecard import score_run
from tactile.base.errors import InputError

CLOSURES = """keyframe,match,step,match_step,verdict,weight
9,2,30,10,accepted,1.0
9,3,31,12,open,0.0
9,4,40,25,accepted,inf
9,4,41,26,undone,0.0
"""


@given(arrays(np.float64, st.tuples(st.integers(1, 9), st.just(5)), elements=st.floats(-1e6, 1e6)))
def test_walls_read_back_equal(tmp_path_factory, walls):
    folder = tmp_path_factory.mktemp("walls")
    write_walls(folder / "walls.csv", walls)
    assert np.array_equal(read_walls(folder), walls)


def test_without_files_there_are_no_walls_closures_and_views_and_the_run_is_not_finished(tmp_path):
    assert read_walls(tmp_path).shape == (0, 5)
    assert run_reader.read_closures(tmp_path).shape == (0, 2)
    assert run_reader.read_closure_views(tmp_path) is None
    assert read_manifest(tmp_path).status == "running"
    (tmp_path / "manifest.json").write_text('{"recording": 3}')
    with pytest.raises(InputError, match="manifest"):
        read_manifest(tmp_path)


def test_malformed_walls_are_refused(tmp_path):
    (tmp_path / "walls.csv").write_text("west,south,east,north,height\n0,0,1,1,0.05\n0,0,high,1,0.05\n")
    with pytest.raises(InputError, match=r"walls\.csv:3"):
        read_walls(tmp_path)


def test_accepted_closures_are_read(tmp_path):
    (tmp_path / "closures.csv").write_text(CLOSURES)
    assert run_reader.read_closures(tmp_path).tolist() == [[10, 30], [25, 40]]
    table = run_reader.read_closure_table(tmp_path)
    assert table.verdicts == ["accepted", "open", "accepted", "undone"]
    assert {name: values.tolist() for name, values in table.evidence.items()} == {
        "keyframe": [9, 9, 9, 9], "match": [2, 3, 4, 4], "weight": [1, 0, np.inf, 0]
    }  # fmt: skip
    run_reader.write_closure_pairs(tmp_path / "closures.csv", np.array([[9, 2], [12, 3]]))
    table = run_reader.read_closure_table(tmp_path)
    assert (table.steps.tolist(), table.verdicts, table.evidence) == ([[2, 9], [3, 12]], ["accepted"] * 2, {})


def test_closures_of_a_continued_run_count_from_its_first_step(tmp_path):
    """The run continued from step 20 of another; closures.csv counts from that one's first step."""
    (tmp_path / "closures.csv").write_text(CLOSURES)
    (tmp_path / "online.tum").write_text("".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(30)))
    np.savez(tmp_path / "map.npz", steps=np.array(50))
    assert run_reader.read_closures(tmp_path).tolist() == [[5, 20]]


@pytest.mark.parametrize(
    "content", ["keyframe,match\n1,2\n", CLOSURES.replace("match_step", "other"), CLOSURES.replace("30", "x")]
)
def test_malformed_closures_are_refused(tmp_path, content):
    (tmp_path / "closures.csv").write_text(content)
    with pytest.raises(InputError, match=r"closures\.csv:2"):
        run_reader.read_closures(tmp_path)


def test_scorecards_read_back_equal(tmp_path, circle):
    card = score_run(circle, "circle")
    (tmp_path / "scorecard.json").write_text(card.model_dump_json())
    assert read_scorecard(tmp_path) == card
    (tmp_path / "scorecard.json").write_text("{}")
    with pytest.raises(InputError, match="scorecard"):
        read_scorecard(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read_scorecard(tmp_path / "elsewhere")


CHANGE = run_reader.ChangeRow(0.1, 0.2, 0.15, "new", 240.5, 1e-12, 7, 76, 402)


@pytest.mark.parametrize("rows", [[], [CHANGE, CHANGE._replace(kind="gone", evidence=50.25)]])
def test_changes_read_back_equal_and_a_malformed_line_is_named(rows, tmp_path):
    run_reader.write_changes(tmp_path / run_reader.CHANGES, rows)
    assert run_reader.read_changes(tmp_path / run_reader.CHANGES) == rows
    content = (tmp_path / run_reader.CHANGES).read_text()
    for line in ("1,2", "a,0.2,0.15,new,240.5,0,7,76,402", "nan,0.2,0.15,new,240.5,0,7,76,402"):
        (tmp_path / run_reader.CHANGES).write_text(f"{content}{line}\n")
        with pytest.raises(InputError, match=f"{run_reader.CHANGES}:{2 + len(rows)}"):
            run_reader.read_changes(tmp_path / run_reader.CHANGES)


def test_a_change_is_described_with_place_and_steps():
    assert {"new", "(0.10,", "0.20)", "7", "76", "402,"} <= set(CHANGE.describe().split())


def test_closure_views_read_back_equal(tmp_path):
    image = run_reader.eight_bit(np.array([[[0.0, 1.0], [1e-6, 0.0]], [[1.0, 0.0], [0.5, 0.0]]]))
    assert image.tolist() == [[0, 1], [255, 128]]
    views = run_reader.ClosureViews(np.array([4]), image[None])
    run_reader.write_closure_views(tmp_path / run_reader.CLOSURE_VIEWS, views)
    again = run_reader.read_closure_views(tmp_path)
    assert again is not None
    assert [np.array_equal(*pair) for pair in zip(views, again, strict=True)] == [True, True]
    np.savez(tmp_path / run_reader.CLOSURE_VIEWS, step=np.arange(2), view=image[None])
    with pytest.raises(InputError, match=r"closure_views\.npz"):
        run_reader.read_closure_views(tmp_path)


VIEWS = run_reader.WhiskerViews(
    np.zeros((4, 3, 6)), np.arange(72).reshape(4, 3, 6) % 7 > 0, np.arange(6) * np.pi / 3,
    np.array([0.05, 0.11, 0.16]), 0.05,
)  # fmt: skip


@given(arrays(np.float64, (4, 3, 6), elements=st.floats(0, 1)))
def test_whisker_images_read_back_within_one_grey_level_with_equal_bytes(tmp_path_factory, view):
    folder = tmp_path_factory.mktemp("images")
    for name in ("a", "b"):
        run_reader.write_whisker_views(folder / name, VIEWS._replace(view=view))
    assert (folder / "a").read_bytes() == (folder / "b").read_bytes()
    found = run_reader.read_whisker_views(folder / "a")
    assert np.abs(found.view - view).max() <= 1 / 255
    assert np.array_equal(found.view > 0, view > 0)
    for written, read in zip(VIEWS[1:], found[1:], strict=True):
        assert np.array_equal(written, read)


SHAPES = array_shapes(min_dims=2, max_dims=2, max_side=9)
GRID = OccupancyGrid(np.array([[0.0, 0.3, 1.0], [0.1, 0.5, 0.7]]), np.array([-1.25, 0.5]), 0.05)


@given(arrays(np.float64, SHAPES, elements=st.floats(0, 1)), st.floats(-1e3, 1e3), st.floats(1e-6, 2))
def test_a_grid_file_keeps_every_digit(tmp_path_factory, probability, x, cell):
    folder = tmp_path_factory.mktemp("grid")
    np.savez_compressed(folder / "grid.npz", probability=probability, origin=np.array([x, -x / 3]), cell=cell)
    found = read_grid(folder / "grid.npz")
    assert np.array_equal(found.probability, probability)
    assert np.array_equal(found.origin, [x, -x / 3])
    assert found.cell == cell


@pytest.mark.parametrize(
    ("read", "whole", "odd"),
    [
        (read_grid, GRID, {"probability": np.full((2, 2), 7.0)}),
        (run_reader.read_whisker_views, VIEWS, {"length": np.zeros(2)}),
    ],
)
def test_spoilt_and_foreign_archives_are_refused(tmp_path, read, whole, odd):
    np.savez(tmp_path / "whole.npz", **whole._asdict())
    content = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    (tmp_path / "text.npz").write_text("no map")
    np.savez(tmp_path / "other.npz", view=np.zeros(3))
    np.savez(tmp_path / "odd.npz", **whole._asdict() | odd)
    read(tmp_path / "whole.npz")
    for name in ("cut", "text", "other", "odd", "missing"):
        with pytest.raises(InputError, match=name):
            read(tmp_path / f"{name}.npz")


law = settings(max_examples=40)
probabilities = arrays(np.float64, array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.floats(0, 1))
places = st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)).map(np.array)
grids = st.builds(OccupancyGrid, probabilities, places, st.floats(1e-6, 2))
MAP = OccupancyGrid(np.array([[0.0, 0.3, 1.0], [0.1, 0.5, 0.1]]), np.array([-1.25, 0.5]), 0.05)
"""Two rows, the first one below the second."""


@pytest.fixture
def folder(tmp_path):
    write_nav2(tmp_path, MAP)
    return tmp_path


@law
@given(grids)
def test_cells_read_back_as_occupied_free_or_unknown(grid):
    """Numbers have no exponent: PyYAML reads 1e-05 as a string."""
    with tempfile.TemporaryDirectory() as folder:
        write_nav2(Path(folder), grid)
        served = read_nav2(Path(folder) / "map.yaml")
        given = yaml.safe_load((Path(folder) / "map.yaml").read_text())
    p = grid.probability
    assert np.array_equal(served.cell == 100, p > OCCUPIED_THRESH)
    assert np.array_equal(served.cell == 0, p < FREE_THRESH)
    assert np.array_equal(served.cell == -1, (p >= FREE_THRESH) & (p <= OCCUPIED_THRESH))
    assert np.array_equal(served.origin, [*grid.origin, 0.0])
    assert served.resolution == grid.cell
    assert (given["origin"], given["resolution"]) == ([*grid.origin.tolist(), 0.0], grid.cell)
    assert all(isinstance(value, float) for value in given["origin"])


def test_the_prior_and_the_thresholds_themselves_are_unknown(tmp_path):
    limits = [[FREE_THRESH, OCCUPIED_THRESH, PRIOR_OCCUPANCY, 0.25, 0.6]]
    write_nav2(tmp_path, MAP._replace(probability=np.array(limits)))
    assert (tmp_path / "map.pgm").read_bytes() == b"P5\n5 1\n255\n" + bytes([205]) * 5
    assert (read_nav2(tmp_path / "map.yaml").cell == -1).all()


def test_the_files_of_a_small_map(folder):
    """The first row of the image has the greatest y; the image is named without a folder."""
    assert (folder / "map.pgm").read_bytes() == b"P5\n3 2\n255\n" + bytes([254, 205, 254, 254, 205, 0])
    assert (folder / "map.yaml").read_text() == (
        "image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.25, 0.5, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.19\n"
    )
    assert read_nav2(folder / "map.yaml").cell.tolist() == [[0, -1, 100], [0, -1, 0]]


def test_the_usual_threshold_would_turn_unknown_into_free(folder):
    text = (folder / "map.yaml").read_text()
    for threshold, cells in (("0.19", -1), ("0.196", -1), ("0.25", 0)):
        (folder / "map.yaml").write_text(text.replace("0.19", threshold))
        assert read_nav2(folder / "map.yaml").cell[0, 1] == cells


@pytest.mark.parametrize(
    ("change", "cells"),
    [
        (("negate: 0", "negate: true"), [[100, 100, 0], [100, 100, 100]]),
        (("mode: trinary\n", ""), [[0, -1, 100], [0, -1, 0]]),
        (("trinary", "scale"), [[0, 1, 100], [0, 1, 0]]),
        (("trinary", "raw"), [[-1, -1, 0], [-1, -1, -1]]),
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
        ("resolution: 0.05", "resolution: -1", "positive"),
        ("resolution: 0.05", "resolution: .nan", "resolution"),
        ("free_thresh: 0.19", "free_thresh: 0.7", "free_thresh"),
        ("[-1.25, 0.5, 0.0]", "[-1.25, 0.5]", "origin"),
        ("[-1.25, 0.5, 0.0]", "[-1.25, x, 0]", "origin"),
        ("trinary", "grey", "mode"),
        ("map.pgm", "other.pgm", r"other\.pgm"),
        ("image: map.pgm\n", "", "image"),
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
