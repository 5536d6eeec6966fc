"""Strain templates: training by the command, tests on other walls, use in sessions, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.fox2012.template_training import (
    DURATIONS,
    ESTIMATORS,
    HeldOutDrive,
    drive_held_out,
    render_drives,
)
from ratslam.cli import main
from ratslam.runs.settings.run_config import RunConfig
from robot.simulation.create.simulated_session import (
    CreateSimulation,
    CreateSimulationConfig,
    train_strain_templates,
)
from robot.touch_source import observation_of, open_touch_source
from tactile.base.errors import InputError
from tactile.wall_estimation.strain_templates import StrainTemplates

CONFIG = CreateSimulationConfig(seed=4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a configuration and the templates made from it by the program."""
    folder = tmp_path_factory.mktemp("templates")
    (folder / "create.yaml").write_text("create_simulation: {seed: 4}\n")
    arguments = ["reproduce", "templates", str(folder / "create.yaml"), "-o", str(folder / "new" / "t.npz")]
    assert main(arguments) == 0
    return folder


@pytest.fixture(scope="module")
def templates(folder: Path) -> StrainTemplates:
    return StrainTemplates.read(folder / "new" / "t.npz")


def errors(drives: list[HeldOutDrive], way: str, known: bool) -> np.ndarray:
    """Errors [drives, DURATIONS] of one estimator, at trained angles or between them."""
    return np.array([error[:, ESTIMATORS.index(way)] for _, there, error in drives if there == known])


@pytest.mark.soak
def test_the_file_follows_from_the_seed(templates: StrainTemplates) -> None:
    again = train_strain_templates(CONFIG)
    assert len(templates.angle) == 15
    assert np.array_equal(templates.mean, again.mean)
    assert templates.training == again.training
    assert not np.array_equal(
        templates.mean, train_strain_templates(CONFIG.model_copy(update={"seed": 5})).mean
    )


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


def test_bad_templates_have_large_errors(templates: StrainTemplates) -> None:
    # The template of one angle is replaced by that of another.
    mean = templates.mean.copy()
    mean[5] = mean[12]
    tried = drive_held_out(CONFIG, templates._replace(mean=mean))
    assert (errors(tried, "winner", True)[5] > 5).all()
    with pytest.raises(InputError, match="does not fit straight whiskers"):
        drive_held_out(CONFIG, templates._replace(mean=templates.mean[::-1].copy()))


def test_the_report_marks_large_errors_and_missing_walls() -> None:
    error = np.full((len(DURATIONS), len(ESTIMATORS)), 1.0)
    far, unknown = error.copy(), error.copy()
    far[0, 0], unknown[:, 2] = 12.3, np.nan
    lines = render_drives(
        [(20.0, True, far), (25.0, False, unknown), (30.0, True, error)],
        4,
    ).splitlines()
    assert lines[2].split()[:3] == ["20", "!", "12.3"]
    assert lines[3].split()[:4] == ["25~", "1.0", "1.0", "-"]
    assert lines[5].split()[1] == f"{(12.3 + 1) / 2:.1f}"
    assert lines[6].split()[-1] == "-"


def test_sessions_use_the_file(folder: Path, templates: StrainTemplates) -> None:
    given = {"walls": "template", "templates": folder / "new" / "t.npz", "max_template_error": None}
    simulated = {"create_simulation": {"reports": 60, "seed": 1}, "touch": {"reports": given}}
    config = RunConfig.model_validate(simulated)
    assert config.create_simulation is not None
    walls = []
    for reports in (config.touch.reports, config.touch.reports.model_copy(update={"templates": None})):
        touch = config.touch.model_copy(update={"reports": reports})
        samples = open_touch_source(CreateSimulation(config.create_simulation), touch)
        walls.append([observation_of(sample).wall_point for sample in samples if observation_of(sample).wall])
    assert len(walls[0]) == len(walls[1]) > 0
    directions = [np.degrees(np.arctan2(*np.array(points).T[::-1])) for points in walls]
    assert np.allclose(directions[0], directions[1], atol=10.01)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("simulation: {}\n", "create_simulation"),
        ("create_simulation: {seed: -1}\n", "create_simulation.seed"),
        ("create_simulation: {behaviour: {contact: 0.0019}, whiskers: {length: 0.01}}\n", "no contact"),
    ],
)
def test_invalid_sessions_are_refused(text: str, message: str, tmp_path: Path, capsys) -> None:
    config = tmp_path / "c.yaml"
    config.write_text(text)
    assert main(["reproduce", "templates", str(config), "-o", str(tmp_path / "t.npz")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "t.npz").exists()
