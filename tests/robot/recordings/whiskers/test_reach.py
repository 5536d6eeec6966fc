"""The reach through clutter: read as its authors stored it, and refused where damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ratslam.service.source_checks import check_source
from robot.recordings.real_whiskers import COLUMNS, REACH, WHISKERS, ReachConfig, open_reach, read_reach
from robot.sources.source import SOURCES
from tactile.base.errors import InputError

FILE = Path(__file__).parents[3] / "data" / "real_touch" / "stanford" / "reach_free_rows.csv"


@pytest.fixture
def lines() -> list[str]:
    return FILE.read_text().splitlines(keepends=True)


def test_the_columns_are_pose_and_whiskers() -> None:
    record = read_reach(FILE)
    assert record.signal.shape == (130, len(WHISKERS), 3)
    np.testing.assert_allclose(record.position[0], [0.614017904, 0.244095653, 0.0448988117])
    np.testing.assert_allclose(record.signal[0, 13], [23.4805737, 697.151611, 518.673706])
    np.testing.assert_allclose(np.linalg.norm(record.quaternion, axis=1), 1.0, atol=1e-4)


def test_as_a_source_it_has_contacts_for_views() -> None:
    source = open_reach(ReachConfig(file=FILE, rate=100.0))
    samples = list(source)
    assert source.rate_hz == pytest.approx(100.0)
    touched = np.array([sample.reading.view[0, :, 0] for sample in samples])
    assert touched[:, -1].any()
    assert not touched[:, :13].any()
    travel = np.array([sample.reading.odometry[:2] for sample in samples]).sum(axis=0)
    np.testing.assert_allclose(travel, samples[-1].truth[:2] - samples[0].truth[:2], atol=1e-12)


def test_it_passes_the_checks_of_a_source(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SOURCES.builtin, "reach_under_test", REACH)
    failed = [
        result
        for result in check_source("reach_under_test", [f"settings.file={FILE}"])
        if result.status == "FAIL"
    ]
    assert not failed


def test_a_dirty_free_record_may_be_refused() -> None:
    config = ReachConfig.model_validate({"file": FILE, "free": {"on_dirty": "refuse"}})
    with pytest.raises(InputError, match="free rows: contacts of whisker 13: its standard deviation"):
        open_reach(config)


def change(lines: list[str], row: int, column: int, value: str) -> list[str]:
    cells = lines[row + 1].rstrip("\n").split(",")
    cells[column] = value
    return [*lines[: row + 1], ",".join(cells) + "\n", *lines[row + 2 :]]


@pytest.mark.parametrize(
    ("damage", "match"),
    [
        (lambda lines: [], "is empty"),
        (lambda lines: lines[:1], "no rows"),
        (lambda lines: lines[:-1] + [lines[-1].rstrip("\n")], "last line is cut"),
        (lambda lines: lines[:-1] + [lines[-1][:40] + "\n"], "cells; expected 50"),
        (lambda lines: ["\ufeff" + lines[0], *lines[1:4], "3,x\n"], r"reach\.csv:5: 2 cells"),
        (lambda lines: lines[:5] + lines[6:], "row 4: row number 5; expected 4"),
        (lambda lines: change(lines, 7, 9, "nan"), rf"reach\.csv:9: {COLUMNS[9]} is nan"),
        (lambda lines: change(lines, 7, 9, "abc"), "abc"),
        (lambda lines: [lines[0].replace("left0_x", "left_x"), *lines[1:]], "no column 'left0_x'"),
        (lambda lines: [lines[0].replace("row", "row,time", 1), *lines[1:]], "51 columns"),
    ],
)
def test_damaged_files_get_one_clear_error(lines: list[str], tmp_path: Path, damage, match: str) -> None:
    file = tmp_path / "reach.csv"
    file.write_text("".join(damage(lines)))
    with pytest.raises(InputError, match=match):
        read_reach(file)
