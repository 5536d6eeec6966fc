"""Experience-Metric regression: stored touch sessions lead to exactly the stored decisions."""

from __future__ import annotations

import json

import pytest

from tests.golden import touch

LONG = {"touch_circuits"}


@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=pytest.mark.soak) if k in LONG else k for k in touch.SESSIONS]
)
def test_decisions_are_those_stored(name):
    stored = json.loads((touch.FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    found = touch.decisions(name)
    assert found.keys() == stored.keys()
    for part in stored:
        assert found[part] == stored[part], part


@pytest.mark.parametrize("name", touch.SESSIONS)
def test_sessions_stay_small(name):
    assert (touch.FOLDER / f"{name}.mcap").stat().st_size < 300_000
