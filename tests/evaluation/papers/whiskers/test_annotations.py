"""Marks of annotators: read, refused where incomplete, merged; scores against them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.whiskers.contact import (
    read_annotators,
    score_contacts,
)
from tactile.base.errors import InputError

WHISKERS = ("left0", "right0")
HEADER = "whisker,start_row,end_row,label\n"
MARKS = "left0,0,6,free\nleft0,6,8,contact\nleft0,8,10,unclear\nright0,0,10,free\n"


def write(folder: Path, text: str, name: str = "one") -> Path:
    (folder / f"{name}.csv").write_text(text)
    return folder


def test_every_row_gets_its_label(tmp_path: Path) -> None:
    marks = read_annotators(write(tmp_path, HEADER + MARKS), WHISKERS, 10)["one"]
    assert marks[:, 0].tolist() == [0] * 6 + [1] * 2 + [2] * 2
    assert not marks[:, 1].any()


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("whisker,row,label\n", "columns"),
        (HEADER + MARKS.replace("left0,6,8", "left0,6,7"), "row 7 of left0 is not marked"),
        (HEADER + MARKS.replace("left0,6,8", "left0,5,8"), ":3: rows 5 to 8"),
        (HEADER + MARKS.replace("right0,0,10", "right0,0,11"), ":5: rows 0 to 11"),
        (HEADER + MARKS.replace("unclear", "maybe"), ":4: .*maybe"),
        (HEADER + MARKS.replace("right0", "right7"), ":5: .*right7"),
        (HEADER + "left0,0\n", ":2: "),
    ],
)
def test_damaged_marks_are_refused(tmp_path: Path, text: str, match: str) -> None:
    with pytest.raises(InputError, match=match):
        read_annotators(write(tmp_path, text), WHISKERS, 10)


def test_a_folder_without_marks_has_no_annotators(tmp_path: Path) -> None:
    assert read_annotators(tmp_path / "nowhere", WHISKERS, 10) == {}
    write(tmp_path, HEADER + MARKS, "two")
    write(tmp_path, HEADER + MARKS, "one")
    assert list(read_annotators(tmp_path, WHISKERS, 10)) == ["one", "two"]


def test_scores_without_and_with_unclear_rows() -> None:
    marks = np.array([1, 1, 1, 1, 0, 0, 0, 2, 2, 2])
    contact = np.array([1, 1, 1, 0, 1, 0, 0, 1, 0, 0], bool)
    score = score_contacts(contact, marks)
    assert score == pytest.approx((3 / 4, 3 / 4, 3 / 5, 3 / 6, 0.3))


def test_a_score_without_contacts_has_no_precision() -> None:
    score = score_contacts(np.zeros(4, bool), np.zeros(4, np.int8))
    assert np.isnan(score[:2]).all()
