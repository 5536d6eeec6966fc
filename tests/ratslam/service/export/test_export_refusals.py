"""What cannot be exported is refused, and nothing is written."""

from __future__ import annotations

import sys

import pytest

from ratslam.cli import main
from ratslam.service.export_formats import export_run
from tactile.base.errors import InputError


@pytest.mark.parametrize(
    ("output", "words"),
    [
        ("a.bag", "suffix '.bag'"),
        ("missing/a.mcap", "no such folder"),
        ("a.yaml", "occupancy grid"),
        ("taken.mcap", "exists already"),
    ],
)
def test_refusals(square, tmp_path, capsys, output, words):
    (tmp_path / "taken.mcap").write_text("mine")
    capsys.readouterr()
    assert main(["export", str(square), "-o", str(tmp_path / output)]) == 2
    error = capsys.readouterr().err
    assert error.count("ratslam: error: ") == 1
    assert words in error
    assert [path.name for path in tmp_path.iterdir()] == ["taken.mcap"]
    assert (tmp_path / "taken.mcap").read_text() == "mine"


def test_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"nothing: no such folder"):
        export_run(tmp_path / "nothing", tmp_path / "a.mcap")
    with pytest.raises(InputError, match=r"online.tum: no such file"):
        export_run(tmp_path, tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("row", "time"), [(0, "-1.0"), (-1, "2147483648.0")])
def test_times_beyond_ros_stamps_are_refused(copy, tmp_path, row, time):
    lines = (copy / "online.tum").read_text().splitlines(keepends=True)
    lines[row] = " ".join([time, *lines[row].split(" ")[1:]])
    (copy / "online.tum").write_text("".join(lines))
    with pytest.raises(InputError, match="the range of ROS 2 stamps"):
        export_run(copy, tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()


def test_a_missing_library_is_named(square, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[ros\]'"):
        export_run(square, tmp_path / "a.mcap")
