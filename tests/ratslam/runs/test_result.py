"""The result of a run: its parts, its page in a notebook, new directories."""

from __future__ import annotations

import re
import threading
from base64 import b64decode
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import ratslam
from evaluation.metrics.scorecard import render_scorecard

CONFIG = """
simulation: {path: {explore: 40}}
backend: classic
pose_cells: {cells_xy: 15, cells_heading: 12}
"""
HOSTILE = "<script>alert(1)</script> & \"'"


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("result") / "maze.yaml"
    path.write_text(CONFIG)
    return path


@pytest.fixture(scope="module")
def result(config: Path) -> ratslam.Result:
    """A run whose name is HTML."""
    return ratslam.run(config, config.parent / HOSTILE.replace("/", "\N{DIVISION SLASH}"))


def test_a_result_has_the_parts_of_a_run(result: ratslam.Result) -> None:
    steps = len(result.time)
    assert steps == 40
    truth = result.truth
    assert truth is not None
    for poses in (result.trajectory, result.odometry, truth):
        assert poses.shape == (steps, 3)
        assert np.isfinite(poses).all()
    assert np.abs(result.odometry - truth).max() > 0
    assert len(result.graph) == result.scorecard.quantities["experiences"].value
    assert {"x", "y", "heading"} <= set(result.graph.nodes[0])
    assert np.isnan(result.health.doubt)
    assert "no loop closure was accepted" in result.health.reason
    assert (result.health.input, result.warnings, result.health.doubted) == ("clean", (), False)
    assert not result.interrupted


def test_a_directory_is_opened_again(result: ratslam.Result) -> None:
    again = ratslam.Result(result.directory)
    np.testing.assert_array_equal(again.trajectory, result.trajectory)
    assert again.scorecard == result.scorecard


def test_other_directories_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ratslam.InputError, match="no such file; expected the directory of a scored run"):
        ratslam.Result(tmp_path)


def test_a_result_names_its_plots(result: ratslam.Result) -> None:
    for name in ("map", "whiskers", "experiences"):
        assert len(result.plot(name).axes) > 0
    with pytest.raises(ratslam.InputError, match="plot: 'grid'; expected one of map, whiskers, experiences"):
        result.plot("grid")


def test_the_repr_says_how_good_it_is(result: ratslam.Result) -> None:
    text = repr(result)
    assert "40 steps" in text
    assert re.search(r"position error 0\.\d+ m \(odometry 0\.\d+\)", text)
    assert str(result.directory) in text


class Page(HTMLParser):
    """Tags, attributes and texts of a page.

    Attributes:
        rows: the cells of each row of its table.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: dict[str, str | None] = {}
        self.rows: list[list[str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes |= dict(attrs)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_data(self, data: str) -> None:
        if self.tags[-1] in ("td", "th"):
            self.rows[-1][-1] += data


def test_the_page_shows_map_and_scorecard(result: ratslam.Result) -> None:
    page = Page(result._repr_html_())
    picture = b64decode((page.attributes["src"] or "").removeprefix("data:image/png;base64,"))
    assert picture == (result.directory / "map.png").read_bytes()
    cells = [list(line) for lines in result.scorecard.lines().values() for line in lines]
    assert [row for row in page.rows if row in cells] == cells
    for line in cells:
        assert line[0] in render_scorecard(result.scorecard)


def test_texts_of_the_page_are_escaped(result: ratslam.Result) -> None:
    page = Page(result._repr_html_())
    assert set(page.tags) == {"div", "img", "p", "table", "tr", "th", "td"}
    assert set(page.attributes) == {"src", "alt", "style"}
    assert page.rows[0][0] == result.scorecard.name
    assert page.rows[0][0].startswith("<script>")
    assert result.scorecard.name in (page.attributes["alt"] or "")


def test_the_page_says_whether_to_believe_the_map(result: ratslam.Result) -> None:
    page = result._repr_html_()
    assert "<p>This map is the odometry. No loop closure was accepted" in page
    assert "Against the truth, the root mean square position error is" in page


def test_a_result_writes_its_report(result: ratslam.Result, tmp_path: Path) -> None:
    page = result.report(tmp_path / "page.html")
    assert page == tmp_path / "page.html"
    assert HOSTILE.replace("<", "&lt;").partition(">")[0] in page.read_text(encoding="utf-8")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_runs_get_new_directories(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in a thread, where Ctrl-C cannot be caught."""
    monkeypatch.chdir(tmp_path)
    short = ratslam.load_config(config, ["simulation.path.explore=3"])
    (tmp_path / "runs" / "run").mkdir(parents=True)
    thread = threading.Thread(target=ratslam.run, args=(short,))
    thread.start()
    thread.join()
    assert (tmp_path / "runs" / "run-2" / "map.png").exists()
    with pytest.raises(ratslam.InputError, match="exists already"):
        ratslam.run(short, tmp_path / "runs" / "run-2")
