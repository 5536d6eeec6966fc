"""Files of a run directory and maps for nav2: read as written, and spoilt ones are refused by name."""

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


def test_without_files_there_are_no_walls_closures_and_views_and_scorecards_read_back_equal(tmp_path, circle):
    assert read_walls(tmp_path).shape == (0, 5)
    assert run_reader.read_closures(tmp_path).shape == (0, 2)
    assert run_reader.read_closure_views(tmp_path) is None
    assert read_manifest(tmp_path).status == "running"
    (tmp_path / "manifest.json").write_text('{"recording": 3}')
    with pytest.raises(InputError, match="manifest"):
        read_manifest(tmp_path)
    (tmp_path / "walls.csv").write_text("west,south,east,north,height\n0,0,1,1,0.05\n0,0,high,1,0.05\n")
    with pytest.raises(InputError, match=r"walls\.csv:3"):
        read_walls(tmp_path)
    card = score_run(circle, "circle")
    (tmp_path / "scorecard.json").write_text(card.model_dump_json())
    assert read_scorecard(tmp_path) == card
    (tmp_path / "scorecard.json").write_text("{}")
    with pytest.raises(InputError, match="scorecard"):
        read_scorecard(tmp_path)


def test_accepted_closures_are_read(tmp_path):
    (tmp_path / "closures.csv").write_text(CLOSURES)
    assert run_reader.read_closures(tmp_path).tolist() == [[10, 30], [25, 40]]
    table = run_reader.read_closure_table(tmp_path)
    assert table.verdicts == ["accepted", "open", "accepted", "undone"]
    evidence = {"keyframe": [9, 9, 9, 9], "match": [2, 3, 4, 4], "weight": [1, 0, np.inf, 0]}
    assert {name: values.tolist() for name, values in table.evidence.items()} == evidence
    run_reader.write_closure_pairs(tmp_path / "closures.csv", np.array([[9, 2], [12, 3]]))
    table = run_reader.read_closure_table(tmp_path)
    assert (table.steps.tolist(), table.verdicts, table.evidence) == ([[2, 9], [3, 12]], ["accepted"] * 2, {})
    # A run continued from step 20 of another; closures.csv counts from that one's first step.
    (tmp_path / "closures.csv").write_text(CLOSURES)
    (tmp_path / "online.tum").write_text("".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(30)))
    np.savez(tmp_path / "map.npz", steps=np.array(50))
    assert run_reader.read_closures(tmp_path).tolist() == [[5, 20]]


def test_malformed_closures_are_refused(tmp_path):
    odd = [CLOSURES.replace(word, "x") for word in ("match_step", "30")]
    for content in ("keyframe,match\n1,2\n", *odd):
        (tmp_path / "closures.csv").write_text(content)
        with pytest.raises(InputError, match=r"closures\.csv:2"):
            run_reader.read_closures(tmp_path)


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
    assert {"new", "(0.10,", "0.20)", "7", "76", "402,"} <= set(CHANGE.describe().split())


def test_closure_views_read_back_equal(tmp_path):
    image = run_reader.eight_bit(np.array([[[0.0, 1.0], [1e-6, 0.0]], [[1.0, 0.0], [0.5, 0.0]]]))
    assert image.tolist() == [[0, 1], [255, 128]]
    views = run_reader.ClosureViews(np.array([4]), image[None])
    run_reader.write_closure_views(tmp_path / run_reader.CLOSURE_VIEWS, views)
    again = run_reader.read_closure_views(tmp_path)
    assert all(np.array_equal(*pair) for pair in zip(views, again, strict=True))
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
    for name in ("a.npz", "b.npz"):
        run_reader.write_whisker_views(folder / name, VIEWS._replace(view=view))
    assert (folder / "a.npz").read_bytes() == (folder / "b.npz").read_bytes()
    found = run_reader.read_whisker_views(folder / "a.npz")
    assert np.abs(found.view - view).max() <= 1 / 255
    assert np.array_equal(found.view > 0, view > 0)
    for written, read in zip(VIEWS[1:], found[1:], strict=True):
        assert np.array_equal(written, read)


MAP = OccupancyGrid(np.array([[0.0, 0.3, 1.0], [0.1, 0.5, 0.1]]), np.array([-1.25, 0.5]), 0.05)
"""Two rows, the first one below the second."""
PROBABILITIES = arrays(np.float64, array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.floats(0, 1))
PLACES = st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)).map(np.array)


@given(PROBABILITIES, st.floats(-1e3, 1e3), st.floats(1e-6, 2))
def test_a_grid_file_keeps_every_digit(tmp_path_factory, probability, x, cell):
    folder = tmp_path_factory.mktemp("grid")
    np.savez_compressed(folder / "grid.npz", probability=probability, origin=np.array([x, -x / 3]), cell=cell)
    found = read_grid(folder / "grid.npz")
    assert np.array_equal(found.probability, probability)
    assert np.array_equal(found.origin, [x, -x / 3])
    assert found.cell == cell


@pytest.mark.parametrize(("read", "whole", "odd"), [
    (read_grid, MAP, {"probability": np.full((2, 2), 7.0)}),
    (run_reader.read_whisker_views, VIEWS, {"length": np.zeros(2)}),
])  # fmt: skip
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


@pytest.fixture
def folder(tmp_path):
    write_nav2(tmp_path, MAP)
    return tmp_path


@settings(max_examples=40)
@given(st.builds(OccupancyGrid, PROBABILITIES, PLACES, st.floats(1e-6, 2)))
def test_cells_read_back_as_occupied_free_or_unknown(grid):
    """Numbers have no exponent: PyYAML reads 1e-05 as a string."""
    with tempfile.TemporaryDirectory() as folder:
        write_nav2(Path(folder), grid)
        served = read_nav2(Path(folder) / "map.yaml")
        given = yaml.safe_load((Path(folder) / "map.yaml").read_text())
    p = grid.probability
    assert np.array_equal(served.cell, np.select([p > OCCUPIED_THRESH, p < FREE_THRESH], [100, 0], -1))
    assert np.array_equal(served.origin, [*grid.origin, 0.0])
    assert served.resolution == grid.cell
    assert (given["origin"], given["resolution"]) == ([*grid.origin.tolist(), 0.0], grid.cell)
    assert all(isinstance(value, float) for value in given["origin"])


def test_the_files_of_a_small_map_and_the_prior_and_the_thresholds_themselves_are_unknown(folder):
    """The first row of the image has the greatest y; the image is named without a folder."""
    assert (folder / "map.pgm").read_bytes() == b"P5\n3 2\n255\n" + bytes([254, 205, 254, 254, 205, 0])
    assert (folder / "map.yaml").read_text() == (
        "image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.25, 0.5, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.19\n"
    )
    assert read_nav2(folder / "map.yaml").cell.tolist() == [[0, -1, 100], [0, -1, 0]]
    limits = [[FREE_THRESH, OCCUPIED_THRESH, PRIOR_OCCUPANCY, 0.25, 0.6]]
    write_nav2(folder, MAP._replace(probability=np.array(limits)))
    assert (folder / "map.pgm").read_bytes() == b"P5\n5 1\n255\n" + bytes([205]) * 5
    assert (read_nav2(folder / "map.yaml").cell == -1).all()


def test_the_usual_threshold_would_turn_unknown_into_free(folder):
    text = (folder / "map.yaml").read_text()
    for threshold, cells in (("0.19", -1), ("0.196", -1), ("0.25", 0)):
        (folder / "map.yaml").write_text(text.replace("0.19", threshold))
        assert read_nav2(folder / "map.yaml").cell[0, 1] == cells


@pytest.mark.parametrize(("old", "new", "cells"), [
    ("negate: 0", "negate: true", [[100, 100, 0], [100, 100, 100]]),
    ("mode: trinary\n", "", [[0, -1, 100], [0, -1, 0]]),
    ("trinary", "scale", [[0, 1, 100], [0, 1, 0]]),
    ("trinary", "raw", [[-1, -1, 0], [-1, -1, -1]]),
])  # fmt: skip
def test_maps_of_other_tools_follow_the_same_rules_and_comments_are_skipped(folder, old, new, cells):
    path, image = folder / "map.yaml", folder / "map.pgm"
    path.write_text(path.read_text().replace(old, new))
    assert read_nav2(path).cell.tolist() == cells
    image.write_bytes(b"P5 # by hand\n# twice\n3\t2 # so wide\n255\n" + image.read_bytes()[-6:])
    assert read_nav2(path).cell.tolist() == cells


@pytest.mark.parametrize(("old", "new", "where"), [
    ("resolution: 0.05", "resolution: wide", "resolution"),
    ("resolution: 0.05", "resolution: -1", "positive"),
    ("resolution: 0.05", "resolution: .nan", "resolution"),
    ("free_thresh: 0.19", "free_thresh: 0.7", "free_thresh"),
    ("[-1.25, 0.5, 0.0]", "[-1.25, 0.5]", "origin"),
    ("[-1.25, 0.5, 0.0]", "[-1.25, x, 0]", "origin"),
    ("trinary", "grey", "mode"),
    ("map.pgm", "other.pgm", r"other\.pgm"),
    ("image: map.pgm\n", "", "image"),
])  # fmt: skip
def test_an_invalid_map_yaml_is_refused(folder, old, new, where):
    path = folder / "map.yaml"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=where):
        read_nav2(path)


def test_other_images_and_missing_and_malformed_maps_are_refused(folder):
    eight, size = b"P5\n3 2\n255\n", b"P5\n3 2\n65535\n"
    for content in (b"", b"P2\n3 2\n255\n0 0 0 0 0 0", size + bytes(12), eight + bytes(5), eight + bytes(7)):
        (folder / "map.pgm").write_bytes(content)
        with pytest.raises(InputError, match=r"map\.pgm"):
            read_nav2(folder / "map.yaml")
    (folder / "map.yaml").write_text("- a list\n")
    for name in ("map.yaml", "missing.yaml"):
        with pytest.raises(InputError, match=name):
            read_nav2(folder / name)
    with pytest.raises(ValueError, match="probabilities"):
        write_nav2(folder, MAP._replace(probability=np.full((2, 2), np.nan)))
