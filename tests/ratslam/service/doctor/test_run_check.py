"""The doctor says whether to believe the map of a run, and what to try first."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from ratslam.cli import main
from tests.helpers.square_run import copy_square_run

ROOT = Path(__file__).parents[4]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copy_square_run(tmp_path_factory.mktemp("runs") / "square")


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


def said(run: Path, capsys: pytest.CaptureFixture[str], code: int = 0) -> str:
    assert main(["doctor", str(run)]) == code
    return capsys.readouterr().out


def test_a_good_map_is_believed(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = said(run, capsys)
    assert "Believe this map." in text
    assert "better than odometry" in text
    assert "no better" not in text


@pytest.mark.parametrize(
    ("doubt", "words"),
    [
        (0.9, "Do not believe this map. It is 90%"),
        (0.5, "Take this map with care. It is 50%"),
        (0.1, "Believe this map. It is 90%"),
    ],
)
def test_the_health_decides(run: Path, capsys: pytest.CaptureFixture[str], doubt: float, words: str) -> None:
    (run / "health.json").write_text(json.dumps({"worse_than_odometry": doubt}))
    assert words in said(run, capsys)


def test_without_truth_only_the_health_tells(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "truth.tum").write_text("")
    assert "nothing but the health tells" in said(run, capsys)


def test_a_map_without_closures_has_a_reason(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = run / "closures.csv"
    file.write_text(file.read_text().replace(",accepted,", ",open,"))
    assert "no loop closure was accepted" in said(run, capsys)
    file.write_text(file.read_text().splitlines()[0] + "\n")
    assert "no place was recognised" in said(run, capsys)


def test_an_interrupted_run_can_be_continued(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    manifest = json.loads((run / "manifest.json").read_text())
    (run / "manifest.json").write_text(json.dumps(manifest | {"status": "interrupted"}))
    assert f"--continue {run}/map.npz" in said(run, capsys)


@pytest.mark.parametrize(
    ("digest", "steps", "words"),
    [
        ("abc", True, "It was killed, or ended by an error"),
        ("abc", False, "a run that was killed before its first step"),
        ("", True, "next: map its recording: python -m ratslam run "),
    ],
)
def test_a_killed_run_is_said_to_be_killed_and_how_to_go_on(
    run: Path, capsys: pytest.CaptureFixture[str], digest: str, steps: bool, words: str
) -> None:
    manifest = json.loads((run / "manifest.json").read_text())
    recording = manifest["recording"] | {"sha256": digest}
    killed = manifest | {"status": "running", "recording": recording}
    (run / "manifest.json").write_text(json.dumps(killed))
    if not steps:
        (run / "online.tum").write_text("")
    text = said(run, capsys)
    assert words in text
    assert ("--continue" in text) == bool(digest)
    assert "This method" not in text


def test_bad_steps_are_faults(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    header, *lines = (run / "steps.csv").read_text().splitlines()
    column = header.split(",").index("outcome")
    cells = lines[7].split(",")
    cells[column] = "too_fast"
    lines[7] = ",".join(cells)
    (run / "steps.csv").write_text("\n".join([header, *lines]) + "\n")
    assert "fault: 1 of 349 steps: too fast" in said(run, capsys, 1)


def test_the_advice_is_a_setting_of_the_program(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("cell_size: 0.1\n", "cell_size: 0.01\n", 1))
    (advice,) = (line for line in said(run, capsys).splitlines() if "cell_size" in line)
    assignment = advice.split("--set ")[1].split(":")[0]
    assert assignment == "pose_cells.cell_size=0.1"


def test_a_folder_that_is_no_run_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "manifest.json").write_text("{}")
    assert main(["doctor", str(tmp_path)]) == 2
    assert "expected the manifest of a run" in capsys.readouterr().err
