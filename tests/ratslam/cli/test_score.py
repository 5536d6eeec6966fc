"""The command score."""

from __future__ import annotations

import json

from ratslam.cli import main
from tests.ratslam.cli.run_cases import refuses


def test_score_refuses_a_folder_or_file_without_a_log(capsys, tmp_path):
    refuses(capsys, ["score", tmp_path], "online.tum")
    (tmp_path / "log.csv").write_text("t,id\n0,1\n")
    refuses(capsys, ["score", tmp_path / "log.csv"], "log.csv")
    refuses(capsys, ["score", tmp_path / "log.csv", "--base", "-1"], "--base: -1")


def test_a_scored_directory_gives_its_scorecard(capsys, square):
    capsys.readouterr()
    assert main(["score", str(square), "--json"]) == 0
    card = json.loads(capsys.readouterr().out)
    assert card["quantities"] == json.loads((square / "scorecard.json").read_text())["quantities"]
