"""Settings of a live session on a whiskered Create."""

from __future__ import annotations

from pathlib import Path

from pydantic import PositiveFloat

from robot.drivers.create.config import CreateConfig
from robot.simulation.create.session import CreateSimulationConfig


class CreateLiveConfig(CreateConfig):
    """A Create on a serial port with fixed whiskers; `live.head` is the link to the whiskers."""

    plan: CreateSimulationConfig = CreateSimulationConfig()
    """Behaviour, whiskers and duration (`minutes` or `reports`), as in a simulated session. The arena bounds
    the map; the emulator moves in it, with the errors in `wheels`."""
    strain_per_radian: PositiveFloat = 0.01
    """Strain at the base of a whisker for each radian that its sensor reports."""
    stuck: PositiveFloat = 3.0
    """Time for which the bumper may stay pressed, s; the robot backs off at once."""
    budget: PositiveFloat = 2.0
    """Lag of the mapper above which the robot waits for it, s."""

    def resolved(self, folder: Path) -> CreateLiveConfig:
        """A copy with relative paths taken from the folder; the port's name stays as it is."""
        return self.model_copy(update={"plan": self.plan.resolved(folder)})
