"""The table and the picture of a figure."""

from pathlib import Path
from typing import Any

from evaluation.papers.figure import Figure


def table_of(figure: Figure, result: Any, folder: Path) -> list[str]:
    """The lines of the table of a result, whose picture, if there is one, is drawn."""
    if figure.draw is not None:
        figure.draw(result, folder / "picture.png")
        assert (folder / "picture.png").read_bytes().startswith(b"\x89PNG")
    return list(figure.table(result))


def rows_of(lines: list[str]) -> list[list[str]]:
    """The cells of the rows of a Markdown table; its first row is the header."""
    rows = [
        [cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines if line.startswith("| ")
    ]
    assert len({len(row) for row in rows}) == 1
    return rows
