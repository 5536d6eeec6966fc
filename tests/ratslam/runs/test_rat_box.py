"""A rat in a box: the packaged sessions run, a recording has the same readings, errors exit with 2."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ratslam
from ratslam.cli import main
from ratslam.core.session import Session
from ratslam.runs.build_session import build_session, open_observations, open_source, read_observations
from ratslam.runs.settings.run_config import RunConfig, load_config

SHORT = ("rat_simulation.seconds=4", "session.reserve=64")
PHASES = ("rat_darkness", "rat_cue_rotation", "rat_cue_conflict", "rat_kidnap", "rat_stretch")


def shortened(name: str) -> RunConfig:
    """A packaged session with all times divided by 20."""
    config = load_config(name)
    rat = config.rat_simulation
    assert rat is not None
    phases = [
        phase.model_copy(update={"start": phase.start / 20, "end": phase.end and phase.end / 20})
        for phase in rat.phases
    ]
    assert rat.seconds is not None
    rat = rat.model_copy(update={"phases": tuple(phases), "seconds": rat.seconds / 20})
    return config.model_copy(update={"rat_simulation": rat})


@pytest.fixture(scope="module")
def session() -> Session:
    """One session for all of them, so that its kernel is compiled once."""
    config, source = next_of("rat_box")
    return build_session(config, source)


def next_of(name: str):
    with open_observations(shortened(name)) as opened:
        return opened


@pytest.mark.parametrize("name", PHASES)
def test_a_packaged_session_runs(name: str, session: Session) -> None:
    config, source = next_of(name)
    assert (config.backend, config.presets) == ("classic", ())
    session.restart()
    observations = [observation for _, observation in read_observations(source)]
    estimates = [step.estimate for step in session.replay(observations)]
    assert len(estimates) == source.length == 120
    assert all(np.isfinite(estimate.pose).all() and not estimate.lost for estimate in estimates)


@pytest.mark.parametrize("backend", ["classic", pytest.param("recall", marks=pytest.mark.soak)])
def test_both_methods_map_the_box(backend: str, tmp_path: Path) -> None:
    result = ratslam.run(load_config("rat_box", (*SHORT, f"backend={backend}")), tmp_path / "run")
    assert len(result.trajectory) == 80


def test_a_recording_of_a_session_has_its_readings(tmp_path: Path) -> None:
    file = tmp_path / "rat.mcap"
    sets = [argument for setting in SHORT for argument in ("--set", setting)]
    assert main(["simulate", "rat_box", "-o", str(file), *sets]) == 0
    (tmp_path / "again.yaml").write_text("recording: {file: rat.mcap}\n")
    made, read = open_source(load_config("rat_box", SHORT)), open_source(tmp_path / "again.yaml")
    assert read.info.box == made.info.box
    for ours, theirs in zip(made, read, strict=True):
        np.testing.assert_allclose(theirs.reading.view, ours.reading.view, atol=1e-6)
        np.testing.assert_allclose(theirs.reading.odometry, ours.reading.odometry)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("rat_simulation.path.file=none.npz", "none.npz: no such file"),
        ("rat_simulation.box.width=0", "rat_simulation.box.width"),
        ("rat_simulation.phases=[{start: 1}]", "changes nothing"),
        ("rat_simulation.phases=[{start: 900, dark: true}]", "rat_simulation.phases.0.start: 900 s"),
        ("rat_simulation.path.max_speed=0.1", "sargolini.npz:"),
    ],
)
def test_an_error_exits_with_two(setting: str, message: str, tmp_path: Path, capsys) -> None:
    assert main(["run", "rat_box", "-o", str(tmp_path / "run"), "--set", setting]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1
