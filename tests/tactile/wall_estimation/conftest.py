"""Strain templates of constructed walls, which all tests of this folder share."""

from __future__ import annotations

import pytest

from tactile.base.random_streams import stream
from tactile.wall_estimation.strain_templates import (
    StrainTemplates,
    TemplateTraining,
    TrainingDrive,
    train_templates,
)
from tests.helpers.flat_walls import RATE, wall


@pytest.fixture(scope="session")
def drives() -> list[TrainingDrive]:
    random, training = stream(0, "training"), TemplateTraining()
    return [
        TrainingDrive(float(angle), k, wall(float(angle), random), RATE)
        for angle in training.angles
        for k in range(training.repeats)
    ]


@pytest.fixture(scope="session")
def templates(drives: list[TrainingDrive]) -> StrainTemplates:
    return train_templates(drives)
