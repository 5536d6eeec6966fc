"""The page of figures on real recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.papers.whiskers import reproduction
from evaluation.papers.whiskers.figure import RealFigure, require_recordings
from evaluation.papers.whiskers.reproduction import NAMES, UNPROVEN, find_figure, reproduce_real
from tactile.base.errors import InputError


@pytest.mark.parametrize("name", NAMES)
def test_each_name_is_a_figure(name: str) -> None:
    figure = find_figure(name)
    assert isinstance(figure, RealFigure)
    assert figure.title[0].isupper()
    assert not figure.title.endswith(".")


def test_the_page_holds_what_was_measured_before_an_error(tmp_path: Path, monkeypatch) -> None:
    def measure(data: Path) -> str:
        require_recordings(data, "touch.csv")
        return "7 whiskers"

    def draw(result: str, picture: Path) -> None:
        picture.write_text(result)

    figures = {
        "good": RealFigure("Whiskers", lambda data: "7 whiskers", lambda result: [f"| {result} |"], draw),
        "bad": RealFigure("Fingers", measure, lambda result: [], draw),
    }
    monkeypatch.setattr(reproduction, "find_figure", figures.__getitem__)
    output = tmp_path / "new" / "page"
    lines = list[str]()
    with pytest.raises(InputError, match=r"touch\.csv"):
        lines.extend(reproduce_real(["good", "bad"], tmp_path, output))
    page = (output / "real.md").read_text(encoding="utf-8")
    assert lines == page.removesuffix(UNPROVEN).split("\n")[: len(lines)]
    assert "| 7 whiskers |" in lines
    assert "![Whiskers](good.png)" in lines
    assert sorted(path.name for path in output.iterdir()) == ["good.png", "real.md"]
    assert page.endswith(UNPROVEN)


def test_nothing_is_left_where_a_recording_is_missing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        list(reproduce_real(["drift"], tmp_path, tmp_path / "page"))
    assert not (tmp_path / "page").exists()
