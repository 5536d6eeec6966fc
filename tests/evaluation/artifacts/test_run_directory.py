"""What the pictures need from a run directory comes back as it was written, or is refused by name."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from evaluation.artifacts.run_directory import read_closures, read_scorecard, read_walls, write_walls
from evaluation.metrics.scorecard import score_run
from tactile.base.errors import InputError

CLOSURES = """keyframe,match,step,match_step,verdict,weight
9,2,30,10,accepted,1.0
9,3,31,12,open,0.0
9,4,40,25,accepted,inf
9,4,41,26,undone,0.0
"""


@given(arrays(np.float64, st.tuples(st.integers(1, 9), st.just(5)), elements=st.floats(-1e6, 1e6)))
def test_walls_come_back_to_the_last_bit(tmp_path_factory, walls):
    folder = tmp_path_factory.mktemp("walls")
    write_walls(folder / "walls.csv", walls)
    assert np.array_equal(read_walls(folder), walls)


def test_no_file_no_walls_and_no_closures(tmp_path):
    assert read_walls(tmp_path).shape == (0, 5)
    assert read_closures(tmp_path).shape == (0, 2)


def test_a_wall_that_is_none_is_refused(tmp_path):
    (tmp_path / "walls.csv").write_text("west,south,east,north,height\n0,0,1,1,0.05\n0,0,high,1,0.05\n")
    with pytest.raises(InputError, match=r"walls\.csv:3"):
        read_walls(tmp_path)


def test_accepted_closures_are_read(tmp_path):
    (tmp_path / "closures.csv").write_text(CLOSURES)
    assert read_closures(tmp_path).tolist() == [[10, 30], [25, 40]]


def test_steps_before_the_checkpoint_are_not_in_the_directory(tmp_path):
    """A run that went on from step 20 of another counts its closures from the beginning."""
    (tmp_path / "closures.csv").write_text(CLOSURES)
    (tmp_path / "online.tum").write_text("".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(30)))
    np.savez(tmp_path / "map.npz", steps=np.array(50))
    assert read_closures(tmp_path).tolist() == [[5, 20]]


@pytest.mark.parametrize(
    "content", ["keyframe,match\n1,2\n", CLOSURES.replace("match_step", "other"), CLOSURES.replace("30", "x")]
)
def test_closures_that_are_none_are_refused(tmp_path, content):
    (tmp_path / "closures.csv").write_text(content)
    with pytest.raises(InputError, match=r"closures\.csv:2"):
        read_closures(tmp_path)


def test_a_scorecard_comes_back(tmp_path, circle):
    card = score_run(circle, "circle")
    (tmp_path / "scorecard.json").write_text(card.model_dump_json())
    assert read_scorecard(tmp_path) == card
    (tmp_path / "scorecard.json").write_text("{}")
    with pytest.raises(InputError, match="scorecard"):
        read_scorecard(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read_scorecard(tmp_path / "elsewhere")
