"""The command path on a saved map, its refusals, and coordinates that begin with a minus sign."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.cli import build_parser, main
from ratslam.cli.maps import read_place
from ratslam.live.goal_planner import TOLERANCE, experience_at
from ratslam.runs.saved_map import read_map
from tactile.base.errors import InputError
from tests.ratslam.places.test_route import TRAVEL, line_map, travel_graph
from tests.ratslam.runs.test_map_formats import FILES

MAP = str(FILES[-1])
number = st.floats(-1e6, 1e6)


@given(number, number, st.sampled_from(["{:g}", "{:.3f}", "{:e}"]))
@settings(derandomize=True, deadline=None, max_examples=60)
def test_a_coordinate_may_be_negative(x: float, y: float, form: str) -> None:
    text = f"{form.format(x)},{form.format(y)}"
    words = ["path", "runs/maze", "--from", text, "--to", text, "--json"]
    found = build_parser().parse_args(words)
    assert (found.start, found.goal, found.json) == (text, text, True)
    assert read_place(found.goal, "--to") == pytest.approx((x, y), rel=1e-4, abs=1e-3)
    corners = f"{text},{text}"
    crop = build_parser().parse_args(["map", "crop", "runs/maze", "--box", corners, "-o", "part.npz"])
    assert crop.box == corners


def test_a_value_may_begin_with_a_point() -> None:
    assert build_parser().parse_args(["path", "map", "--to", "-.5,1"]).goal == "-.5,1"


def test_an_option_is_no_value(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        build_parser().parse_args(["path", "map", "--to", "--json"])
    assert "--to: expected one argument" in capsys.readouterr().err


def test_the_end_of_a_way_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nodes = read_map(Path(MAP)).open_session().map.graph().nodes(data=True)
    x, y = min((data["x"], data["y"]) for _, data in nodes)
    picture = tmp_path / "way.PNG"
    point = f"{x:.3f},{y:.3f}"
    assert main(["path", MAP, "--to", point, "-o", str(picture)]) == 0
    assert f" m from {float(f'{x:.3f}'):g}," in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")
    places = {place: np.array([data["x"], data["y"]]) for place, data in nodes}
    goal = next(
        a for a in places for b in places if a != b and np.hypot(*(places[a] - places[b])) < TOLERANCE / 2
    )
    assert main(["path", MAP, "--to", str(goal)]) == 0
    first, *others = capsys.readouterr().out.splitlines()
    end = first.split(" to ")[1].split(":")[0]
    assert (end != str(goal)) == any(f"ends at {end}, which is so near to {goal}" in one for one in others)
    assert "a link may be blocked" in others[-1]


def test_the_help_says_how_near_the_goal_is_reached() -> None:
    text = " ".join(build_parser().commands.parsers["path"].format_help().split())
    assert f"within {TOLERANCE:g} m of it" in text
    assert "such as -0.1,0.2" in text


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["--to", "nan,nan"], "--to: 'nan,nan'; expected X,Y in m (finite numbers)"),
        (["--to", "inf,0"], "--to: 'inf,0'; expected X,Y in m (finite numbers)"),
        (["--from", "1e400,0", "--to", "1"], "--from: '1e400,0'; expected X,Y in m (finite numbers)"),
        (["--to", "1,2,3"], "--to: '1,2,3'; expected X,Y in m"),
        (["--to", "here"], "--to: 'here'; expected X,Y in m"),
        (
            ["--to", "1", "-o", "way.txt"],
            "-o way.txt: not the name of a picture; expected a new file that ends",
        ),
        (["--to", "1", "-o", ""], "not the name of a picture"),
        (["--to", "1", "-o", "none/way.png"], "none: no such folder"),
        (["--to", "1", "-o", "map.png"], "map.png: exists already"),
    ],
)
def test_what_is_refused(words: list[str], error: str, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map.png").write_bytes(b"mine")
    assert main(["path", MAP, *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert error in line
    assert [one.read_bytes() for one in tmp_path.iterdir()] == [b"mine"]


@pytest.mark.parametrize("point", [(np.nan, np.nan), (np.inf, 0.0)])
def test_a_goal_of_a_drive_is_finite(point: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="expected finite numbers x, y, m"):
        experience_at(travel_graph(line_map(0.0, 0.0), TRAVEL), point, 0.1, "live.plan.goal.to[0]")
