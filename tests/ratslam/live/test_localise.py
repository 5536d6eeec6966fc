"""Live sessions in a saved map: refused before the arm moves, or localised to the bits of a replay."""

from __future__ import annotations

import csv
from pathlib import Path

from ratslam.cli import main
from tests.helpers.live import ROOT, moves
from tests.helpers.square_run import copy_square_run
from tests.ratslam.live.bench import Bench

TOUCH = ROOT / "tests" / "data" / "maps" / "ratslam-map-1.npz"
"""A map by the whiskers of the emulated head."""
WHISKS = 6


def test_a_map_of_another_sensor_is_refused_before_the_arm_moves(bench: Bench, tmp_path: Path) -> None:
    square = copy_square_run(tmp_path / "square")
    sent = len(bench.arm.state()["targets"])
    with bench.session(mapper=None, options=["--localise", str(square)]) as session:
        assert session.code() == 2, session.output()
        assert "the sensor is whisker head and was camera or laser when the map was made" in session.output()
        assert "Traceback" not in session.output()
        assert not session.directory.exists()
    assert moves(bench.arm, sent) == []


def test_a_session_is_localised_and_its_replay_gives_the_same_bits(bench: Bench, tmp_path: Path) -> None:
    before = TOUCH.read_bytes()
    with bench.session(mapper=None, options=["--localise", str(TOUCH)], whisks=WHISKS) as session:
        assert session.code() == 0, session.output()
        live = session.directory
        with (live / "localisation.csv").open() as file:
            rows = list(csv.DictReader(file))
        # The emulated head is too low for its whiskers to touch walls, so there is nothing to find it by.
        assert [row["state"] for row in rows] == ["searching"] * WHISKS
        assert float(rows[-1]["sd"]) > float(rows[0]["sd"])
        assert main(["run", str(live / "config.yaml"), "-o", str(tmp_path / "again")]) == 0
        for name in ("localisation.csv", "steps.csv", "trajectory.tum"):
            assert (live / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    assert TOUCH.read_bytes() == before
