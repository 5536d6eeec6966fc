"""changes.csv reads back as it was written."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.artifacts.closure_table import CHANGES, ChangeRow, read_changes, write_changes
from tactile.base.errors import InputError

ROW = ChangeRow(0.1, 0.2, 0.15, "new", 240.5, 1e-12, 7, 76, 402)


@pytest.mark.parametrize("rows", [[], [ROW], [ROW, ROW._replace(kind="gone", evidence=50.25)]])
def test_what_is_written_is_read(rows: list[ChangeRow], tmp_path: Path) -> None:
    write_changes(tmp_path / CHANGES, rows)
    assert read_changes(tmp_path / CHANGES) == rows


@pytest.mark.parametrize(
    "line", ["1,2", "a,0.2,0.15,new,240.5,0,7,76,402", "nan,0.2,0.15,new,240.5,0,7,76,402"]
)
def test_a_malformed_line_is_named(line: str, tmp_path: Path) -> None:
    write_changes(tmp_path / CHANGES, [])
    with (tmp_path / CHANGES).open("a") as file:
        file.write(line + "\n")
    with pytest.raises(InputError, match=f"{CHANGES}:2"):
        read_changes(tmp_path / CHANGES)


def test_a_change_is_described_with_place_and_steps() -> None:
    text = ROW.describe()
    assert "something new at (0.10, 0.20) m" in text
    assert "steps 76 to 402" in text
