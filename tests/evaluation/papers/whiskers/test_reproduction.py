"""The page of figures on real recordings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from evaluation.papers import figure as figures_of_papers
from evaluation.papers.figure import REAL, Figure, find_figure, write_page
from evaluation.papers.tables.recordings import UNPROVEN, require_recordings
from tactile.base.errors import InputError


def real_page(places: dict[str, str], data: Path, output: Path) -> Iterator[str]:
    def measure(name: str, figure: Figure) -> tuple[tuple[()], object]:
        return (), figure.measure(data)

    return write_page(output / "real.md", places, places, measure, [UNPROVEN])


@pytest.mark.parametrize("name", REAL)
def test_each_name_is_a_figure(name: str) -> None:
    figure = find_figure(REAL[name])
    assert isinstance(figure, Figure)
    assert figure.title[0].isupper()
    assert not figure.title.endswith(".")


def test_the_page_holds_what_was_measured_before_an_error(tmp_path: Path, monkeypatch) -> None:
    def measure(data: Path) -> str:
        require_recordings(data, "touch.csv")
        return "7 whiskers"

    def draw(result: str, picture: Path) -> None:
        picture.write_text(result)

    figures = {
        "good": Figure("Whiskers", lambda data: "7 whiskers", lambda result: [f"| {result} |"], draw),
        "bad": Figure("Fingers", measure, lambda result: [], draw),
    }
    monkeypatch.setattr(figures_of_papers, "find_figure", figures.__getitem__)
    output = tmp_path / "new" / "page"
    lines = list[str]()
    with pytest.raises(InputError, match=r"touch\.csv"):
        lines.extend(real_page(dict(zip(figures, figures, strict=True)), tmp_path, output))
    page = (output / "real.md").read_text(encoding="utf-8")
    assert lines == page.removesuffix(UNPROVEN).split("\n")[: len(lines)]
    assert "| 7 whiskers |" in lines
    assert "![Whiskers](good.png)" in lines
    assert sorted(path.name for path in output.iterdir()) == ["good.png", "real.md"]
    assert page.endswith(UNPROVEN)


def test_nothing_is_left_where_a_recording_is_missing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        list(real_page({"drift": REAL["drift"]}, tmp_path, tmp_path / "page"))
    assert not (tmp_path / "page").exists()
