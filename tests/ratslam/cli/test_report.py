"""The commands that write a report: their messages, and nothing half-written."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from evaluation.report import page
from ratslam.cli import main

SHORT = ["create_arena", "--set", "create_simulation.reports=5"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a report, in its directory."""
    path = tmp_path_factory.mktemp("runs") / "run"
    assert main(["run", *SHORT, "-o", str(path), "--report"]) == 0
    return path


def test_a_run_writes_its_report(run: Path) -> None:
    assert (run / "report.html").read_text(encoding="utf-8").startswith("<!doctype html>")


def test_equal_runs_give_equal_pages(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pages = [tmp_path / "a.html", tmp_path / "b.html"]
    for path in pages:
        assert main(["report", str(run), str(run), "-o", str(path)]) == 0
        assert f"{path}: open it in a browser" in capsys.readouterr().out
    assert pages[0].read_bytes() == pages[1].read_bytes()


def test_folders_without_a_run_are_refused(run: Path, tmp_path: Path, capsys) -> None:
    output = tmp_path / "page.html"
    output.write_text(before := "<!doctype html>\n<title>before · ratslam report</title>")
    (tmp_path / "empty").mkdir()
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "manifest.json").write_text("{}")
    for name, words in (
        ("empty", "no run in this folder"),
        ("elsewhere", "no such folder"),
        ("begun", "no such file"),
    ):
        assert main(["report", str(run), str(tmp_path / name), "-o", str(output)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line
        assert str(tmp_path / name) in line
    assert output.read_text() == before
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize("name", ["folder", "missing/page.html"])
def test_a_page_that_cannot_be_written_is_refused_before_the_runs_are_read(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "folder").mkdir()
    assert main(["report", str(tmp_path / "no run"), "-o", str(tmp_path / name)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{(tmp_path / name) if name == 'folder' else tmp_path / 'missing'}: " in line
    assert "no run" not in line


def test_without_its_libraries_nothing_is_begun(run: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(page, "find_spec", lambda name: None if name == "plotly" else find_spec(name))
    for command in (
        ["report", str(run), "-o", str(tmp_path / "page.html")],
        ["run", *SHORT, "-o", str(tmp_path / "run"), "--report"],
    ):
        assert main(command) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "plotly not installed" in line
        assert "pip install 'ratslam[report]'" in line
    assert list(tmp_path.iterdir()) == []
