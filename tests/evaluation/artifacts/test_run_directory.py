"""Reading of walls, closures and scorecards from a run directory."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from evaluation.artifacts.closure_table import read_closures
from evaluation.artifacts.run_reader import read_scorecard, read_walls, write_walls
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


def test_without_files_there_are_no_walls_and_closures(tmp_path):
    assert read_walls(tmp_path).shape == (0, 5)
    assert read_closures(tmp_path).shape == (0, 2)


def test_malformed_walls_are_refused(tmp_path):
    (tmp_path / "walls.csv").write_text("west,south,east,north,height\n0,0,1,1,0.05\n0,0,high,1,0.05\n")
    with pytest.raises(InputError, match=r"walls\.csv:3"):
        read_walls(tmp_path)


def test_accepted_closures_are_read(tmp_path):
    (tmp_path / "closures.csv").write_text(CLOSURES)
    assert read_closures(tmp_path).tolist() == [[10, 30], [25, 40]]


def test_closures_of_a_continued_run_count_from_its_first_step(tmp_path):
    """The run continued from step 20 of another; closures.csv counts from that one's first step."""
    (tmp_path / "closures.csv").write_text(CLOSURES)
    (tmp_path / "online.tum").write_text("".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(30)))
    np.savez(tmp_path / "map.npz", steps=np.array(50))
    assert read_closures(tmp_path).tolist() == [[5, 20]]


@pytest.mark.parametrize(
    "content", ["keyframe,match\n1,2\n", CLOSURES.replace("match_step", "other"), CLOSURES.replace("30", "x")]
)
def test_malformed_closures_are_refused(tmp_path, content):
    (tmp_path / "closures.csv").write_text(content)
    with pytest.raises(InputError, match=r"closures\.csv:2"):
        read_closures(tmp_path)


def test_scorecards_read_back_equal(tmp_path, circle):
    card = score_run(circle, "circle")
    (tmp_path / "scorecard.json").write_text(card.model_dump_json())
    assert read_scorecard(tmp_path) == card
    (tmp_path / "scorecard.json").write_text("{}")
    with pytest.raises(InputError, match="scorecard"):
        read_scorecard(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read_scorecard(tmp_path / "elsewhere")
