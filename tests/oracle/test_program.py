"""The program that compares traces: a line for each file, exit codes."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.oracle.__main__ import main
from tests.oracle.trace import load
from tests.oracle.trace_cases import GOLDEN, changed


def test_the_program_prints_one_line_per_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit codes 0, 1 and 2."""
    golden = GOLDEN / "j_reverse_stop.npz"
    assert main([str(golden)]) == 0
    actions = load(golden).arrays["out_action"].copy()
    actions[-1] = 7
    assert main([str(changed(tmp_path, out_action=actions))]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(",")[0] for line in lines] == ["j_reverse_stop: ok", "changed: DIFFERS"]
    assert "action at 160" in lines[1]
    best = load(golden).arrays["out_best_x"].copy()
    best[-1] += 1e-6
    assert main([str(changed(tmp_path, out_best_x=best))]) == 1
    capsys.readouterr()

    broken = tmp_path / "broken.npz"
    broken.write_bytes(b"PK no archive")
    for path in (tmp_path / "missing.npz", broken):
        assert main([str(path)]) == 2
        output = capsys.readouterr()
        assert output.err.startswith(f"error: {path}") or str(path) in output.err
        assert output.err.count("\n") == 1
        assert not output.out
