"""The command score."""

from __future__ import annotations

import json

import pytest

from evaluation.artifacts.run_reader import read_scorecard
from ratslam.cli import main
from tactile.base.errors import InputError
from tests.ratslam.cli.run_cases import refuses


def test_score_refuses_a_folder_or_file_without_a_log(capsys, tmp_path):
    refuses(capsys, ["score", tmp_path], "online.tum")
    (tmp_path / "log.csv").write_text("t,id\n0,1\n")
    refuses(capsys, ["score", tmp_path / "log.csv"], "log.csv")
    refuses(capsys, ["score", tmp_path / "log.csv", "--base", "-1"], "--base: -1")


def test_a_broken_scorecard_is_one_line(square, tmp_path):
    (tmp_path / "scorecard.json").write_text('{"name": 3}')
    with pytest.raises(InputError, match=r"malformed \(name: .*\)") as caught:
        read_scorecard(tmp_path)
    assert "http" not in str(caught.value).replace("\n", "http")


def test_a_scored_directory_gives_its_scorecard(capsys, square):
    capsys.readouterr()
    assert main(["score", str(square), "--json"]) == 0
    card = json.loads(capsys.readouterr().out)
    assert card["quantities"] == json.loads((square / "scorecard.json").read_text())["quantities"]
