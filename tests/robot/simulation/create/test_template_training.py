"""Strain templates of simulated drives: training by the command, other walls, use in sessions, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.fox2012.template_training import (
    ESTIMATORS,
    HeldOutDrive,
    drive_held_out,
)
from ratslam.cli import main
from robot.simulation.create.simulated_session import (
    CreateSimulation,
    CreateSimulationConfig,
    train_strain_templates,
)
from robot.touch_source import observation_of, open_touch_source
from tactile.base.errors import InputError
from tactile.frontend import TouchConfig
from tactile.wall_estimation.strain_templates import StrainTemplates

CONFIG = CreateSimulationConfig(seed=4)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Templates made from a configuration by the program."""
    folder = tmp_path_factory.mktemp("templates")
    (folder / "create.yaml").write_text("create_simulation: {seed: 4}\n")
    path = folder / "new" / "t.npz"
    assert main(["reproduce", "templates", str(folder / "create.yaml"), "-o", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def templates(file: Path) -> StrainTemplates:
    return StrainTemplates.read(file)


def errors(drives: list[HeldOutDrive], way: str, known: bool) -> np.ndarray:
    """Errors [drives, DURATIONS] of one estimator, at trained angles or between them."""
    return np.array([error[:, ESTIMATORS.index(way)] for _, there, error in drives if there == known])


@pytest.mark.soak
def test_the_file_follows_from_the_seed(templates: StrainTemplates) -> None:
    again = train_strain_templates(CONFIG)
    assert len(templates.angle) == 15
    assert np.array_equal(templates.mean, again.mean)
    assert templates.training == again.training
    other = train_strain_templates(CONFIG.model_copy(update={"seed": 5}))
    assert not np.array_equal(templates.mean, other.mean)


def test_walls_without_training_are_recognised(templates: StrainTemplates) -> None:
    tried = drive_held_out(CONFIG, templates)
    assert [known for _, known, _ in tried] == [True, False] * 14 + [True]
    assert np.allclose([angle for angle, _, _ in tried], np.arange(20, 161, 5))
    assert errors(tried, "winner", True).mean() < 2
    # Between two templates the error of the nearer one is at least half a step.
    between = errors(tried, "winner", False)
    assert between.min() == pytest.approx(5)
    assert between.mean() < 6
    assert np.nanmean(errors(tried, "fused", False)) < 1
    with pytest.raises(InputError, match="does not fit straight whiskers"):
        drive_held_out(CONFIG, templates._replace(mean=templates.mean[::-1].copy()))


def test_sessions_use_the_file(file: Path) -> None:
    given = {"walls": "template", "templates": file, "max_template_error": None}
    seen = []
    for reports in (given, given | {"templates": None}):
        simulation = CreateSimulation(CreateSimulationConfig(reports=40, seed=1))
        samples = open_touch_source(simulation, TouchConfig.model_validate({"reports": reports}))
        walls = [observation_of(sample) for sample in samples]
        seen.append([np.degrees(np.arctan2(*one.wall_point[::-1])) for one in walls if one.wall])
    assert len(seen[0]) == len(seen[1]) > 0
    assert np.allclose(seen[0], seen[1], atol=10.01)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("simulation: {}\n", "create_simulation"),
        ("create_simulation: {behaviour: {contact: 0.0019}, whiskers: {length: 0.01}}\n", "no contact"),
    ],
)
def test_invalid_sessions_are_refused(text: str, message: str, tmp_path: Path, capsys) -> None:
    config = tmp_path / "c.yaml"
    config.write_text(text)
    assert main(["reproduce", "templates", str(config), "-o", str(tmp_path / "t.npz")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "t.npz").exists()
