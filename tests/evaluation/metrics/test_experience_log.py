"""Reading and scoring of experience logs from CSV files."""

from __future__ import annotations

import pytest

from evaluation.metrics.exm import read_experience_log
from evaluation.metrics.scorecard import render_scorecard, score_log
from tactile.base.errors import InputError

ROWS = "0,7,0.1,0.2,3\n0.5,-1,0.1,0.2,-3\n"


@pytest.mark.parametrize(
    "head",
    [
        "",
        "t,id,x,y,th\n",
        "Time, Experience, X, Y, Heading\n",
        "# any system\ntime,experience_id,x,y,theta\n",
    ],
)
def test_column_names_in_a_header(tmp_path, head):
    path = tmp_path / "log.csv"
    path.write_text(head + ROWS)
    time, experience, truth = read_experience_log(path)
    assert time.tolist() == [0, 0.5]
    assert experience.tolist() == [7, -1]
    assert truth.tolist() == [[0.1, 0.2, 3], [0.1, 0.2, -3]]


def test_columns_in_any_order_among_others(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("heading,gain,y,x,id,t\n3,9,0.2,0.1,7,0\n")
    time, experience, truth = read_experience_log(path)
    assert (time[0], experience[0], truth[0].tolist()) == (0, 7, [0.1, 0.2, 3])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,id,x,y\n0,1,2,3\n", r":1: no column theta among t id x y; expected theta/th/heading"),
        ("t,id,x,y,th\n0,1,2,3,4\n1,2,3\n2,1,2,3,4\n", r":3: '1 2 3'; expected 5 finite numbers"),
        ("t,id,x,y,th\n0,1,2,3,4\n\n1,1.5,2,3,4\n", r":4: experience id 1\.5; expected a whole number"),
        ("t,id,x,y,th\n0,1,2,nan,4\n", r":2"),
        ("t,id,x,y,th\n0,1,2,,4\n", r":2"),
        ("t,id,x,y,th\n", r": no rows"),
        ("", r": no rows"),
        ("0,1,2", r": no rows"),
    ],
)
def test_malformed_logs_are_refused_with_their_line(tmp_path, text, message):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"log\.csv{message}"):
        read_experience_log(path)


def test_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_experience_log(tmp_path / "none.csv")
    (tmp_path / "log.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(InputError, match="malformed"):
        read_experience_log(tmp_path / "log.csv")


def test_a_log_is_scored_in_all_modes(tmp_path, square):
    ids, truth = square(3, 4)
    ids[64:][ids[64:] == 3] = 7
    path = tmp_path / "log.csv"
    rows = [f"{t},{e},{x},{y},{th}" for t, (e, (x, y, th)) in enumerate(zip(ids, truth, strict=True))]
    path.write_text("\n".join(["t,id,x,y,theta", *rows]))
    card = score_log(read_experience_log(path), "my system")
    values = {name: quantity.value for name, quantity in card.quantities.items()}
    assert values["exm_base"] == 32
    assert values["exm_arr"] == 1.0
    assert [values[f"exm_arcr_{mode}"] for mode in ("strict", "paper", "or", "literal")] == [
        0.9375,
        0.875,
        0.96875,
        0,
    ]
    assert "ARCR, strict" in render_scorecard(card)
