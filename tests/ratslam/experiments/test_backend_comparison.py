"""One session through both backends: the table, what its figures mean, and what cannot be compared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.cli import main
from ratslam.config.run_config import RunConfig
from ratslam.experiments.backend_comparison import (
    RECKONED,
    Compared,
    _judged,
    _played,
    compared,
    report,
)
from tactile.base.errors import InputError
from tactile.base.se2 import compose

ROOT = Path(__file__).parents[3]
ORIGIN = np.zeros(3)
POSES = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3)).map(np.array)
SESSIONS = {
    "create": "create_simulation: {reports: 40, seed: 3}\n",
    "arm": "simulation: {maze: {columns: 2, rows: 2, loop: 4}, path: {circuits: C}}\n",
}
QUICK = ["grid.particles=20", "backend=classic", "pose_cells.cells_xy=11"]


def walk(count: int = 60) -> np.ndarray:
    turn = np.linspace(0, 4, count)
    return np.column_stack([np.cos(turn), np.sin(turn), turn + np.pi / 2])


@given(POSES)
def test_a_perfect_path_errs_by_nothing_wherever_the_world_lies(where: np.ndarray) -> None:
    path = walk()
    found = _judged("", path, path, where, compose(where, path))
    assert np.allclose([found.told, found.final, found.ate, found.energy], 0, atol=1e-6)


@given(st.floats(0.1, 1.0))
def test_a_turned_path_is_told_by_what_is_not_aligned(turn: float) -> None:
    path = walk()
    found = _judged("", path, path, np.array([0.0, 0.0, turn]), path)
    assert found.ate == pytest.approx(0, abs=1e-6)
    assert found.energy == pytest.approx(0, abs=1e-6)
    assert found.told == found.final == pytest.approx(2 * np.sin(turn / 2))


def test_what_was_told_and_what_is_known_in_the_end_are_kept_apart() -> None:
    path = walk()
    found = _judged("", path + [0.3, 0.4, 0.0], path, ORIGIN, path)
    assert found.told == pytest.approx(0.5)
    assert found.final == found.ate == pytest.approx(0)


@pytest.mark.parametrize("session", SESSIONS)
def test_both_backends_see_the_same_session(
    session: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "c.yaml").write_text(SESSIONS[session])
    assert main(["compare", str(tmp_path / "c.yaml"), *(f"--set={one}" for one in QUICK)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines[2:5]] == ["classic", "grid", RECKONED]
    assert all(float(number) < 3 for line in lines[2:5] for number in line[16:52].split())
    steps = int(lines[0].split()[0])
    assert steps == 40 if session == "create" else steps > 20
    assert all(float(line[52:64]) > 0 for line in lines[2:4])
    assert lines[4].endswith("-")


def test_perfect_odometry_leaves_nothing_to_reckon() -> None:
    settings = {"reports": 20, "seed": 3, "wheels": {"noise": "none"}}
    config = RunConfig.model_validate(
        {"create_simulation": settings, "grid": {"particles": 20}, "backend": "grid"}
    )
    _, reckoned = _played(config)
    assert reckoned.name == RECKONED
    assert np.allclose([reckoned.told, reckoned.final, reckoned.ate, reckoned.energy], 0, atol=1e-9)


def test_a_session_of_one_chunk_has_no_speed() -> None:
    one = Compared("grid", 10, 0.1, 0.1, 0.1, 0.1, np.nan, 3.0)
    assert report([one]).splitlines()[2].split()[-2:] == ["-", "-"]


def test_what_cannot_be_compared_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", str(ROOT / "configs" / "square.yaml")]) == 2
    assert "no whiskers" in capsys.readouterr().err
    (tmp_path / "c.yaml").write_text("recording: {file: missing.mcap}\n")
    assert main(["compare", str(tmp_path / "c.yaml")]) == 2
    assert "missing.mcap" in capsys.readouterr().err


def test_a_recording_without_truth_is_refused(tmp_path: Path) -> None:
    from robot.recordings.mcap_reader import record_source
    from robot.simulation.create.session import CreateSimulation, CreateSimulationConfig

    source = CreateSimulation(CreateSimulationConfig(reports=5))

    class Blind:
        def __getattr__(self, name: str):
            return getattr(source, name)

        def __iter__(self):
            return (sample._replace(truth=None) for sample in source)

    record_source(Blind(), tmp_path / "blind.mcap")  # type: ignore[arg-type]
    config = RunConfig.model_validate({"recording": {"file": "blind.mcap"}})
    with pytest.raises(InputError, match="true pose"):
        compared(config, tmp_path)
