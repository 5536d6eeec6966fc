"""A backend of another package maps a live session: the mapper process finds its entry point."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ratslam.examples import dead_reckoning
from tests.helpers.distributions import install
from tests.ratslam.live.test_complete_session import PATIENT, SAME, check_session, complete_session


@pytest.mark.soak
def test_it_maps_live_and_its_replay_gives_the_same_bits(loopback: str, tmp_path: Path, monkeypatch) -> None:
    module = Path(dead_reckoning.__file__).read_text(encoding="utf-8")
    point = {"ratslam.backends:reckoning": "own_reckoning:ENTRY"}
    install(tmp_path / "site", "own_reckoning", module, point)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"))
    settings = [*PATIENT, "live.whisks=6", "live.plan.whisking.rate=2", "live.budget=3"]
    settings += ["live.plan.calibration.min_duration=2", "backend=reckoning", "backend_settings.scale=0.5"]
    directory = complete_session(loopback, tmp_path, *settings, longest=280)
    check_session(directory, 6, [name for name in SAME if not name.startswith("map.") or name == "map.tum"])
    assert "distance" in (directory / "steps.csv").read_text().splitlines()[0].split(",")
    assert json.loads((directory / "manifest.json").read_text())["status"] == "complete"
