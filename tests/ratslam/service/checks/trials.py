"""What a trial of a sound part says, and one of a broken part."""

from __future__ import annotations

from typing import Any


def assert_sound(trial: Any) -> None:
    results = list(trial.run_checks())
    assert [result.line() for result in results if result.status != "ok"] == []
    assert [result.check for result in results] == list(trial.checks())


def assert_told(trial: Any, words: str) -> None:
    """What the first check that fails says, with its name and its reason."""
    failed = next(result for result in trial.run_checks() if result.status == "FAIL")
    line = failed.line()
    assert line.startswith(f"FAIL  {failed.check.name}: ")
    assert line.endswith(f" ({failed.check.reason})")
    assert words in line
