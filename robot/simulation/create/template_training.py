"""Strain templates of a simulated Create: it drives into one wall at every angle (Fox et al. 2012, II-G)."""

from __future__ import annotations

from robot.simulation.create.session import RovingConfig, drive_into_wall
from tactile.base.random_streams import stream
from tactile.wall_estimation.strain_templates import (
    StrainTemplates,
    TemplateTraining,
    train_templates,
    training_drive,
)


def trained(config: RovingConfig, training: TemplateTraining | None = None) -> StrainTemplates:
    """Templates of the robot of a session; from its seed, always the same.

    Raises:
        InputError: the robot's whiskers are sampled otherwise than the training says.
    """
    training = training or TemplateTraining(rate=config.whiskers.rate, speed=config.behaviour.slow)
    random = stream(config.seed, "templates")
    return train_templates(
        (
            training_drive(angle, repeat, drive_into_wall(config, angle, random))
            for angle in training.angles.tolist()
            for repeat in range(training.repeats)
        ),
        training,
    )
