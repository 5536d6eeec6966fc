"""Configuration and files of a run, and the check of a refused command."""

from __future__ import annotations

from pathlib import Path

from ratslam.cli import main

ROOT = Path(__file__).parents[3]
FILES = {
    "online_error.csv", "calibration.yaml", "closures.csv", "config.yaml", "manifest.json", "map.g2o",
    "map.json", "map.npz", "map.png", "odometry.tum", "online.tum", "scorecard.json", "steps.csv",
    "trajectory.tum", "truth.tum", "health.json", "map.tum", "timing.csv", "closure_views.npz",
}  # fmt: skip
SQUARE = str(ROOT / "configs" / "square.yaml")


def refuses(capsys, arguments, *messages):
    """The command ends with code 2 and an error that contains all of `messages`, without a traceback."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert "ratslam: error: " in error
    for words in messages:
        assert words in error
