"""What a live session is: the arm, the head, where they go, and what is asked of both before they move."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from robot.drivers.head.config import HeadLinkConfig
from robot.drivers.ur10.config import ArmConfig
from robot.simulation.head.session import SimulationConfig
from robot.sources.odometry import OdometryConfig
from tactile.base.config import Settings


class LiveConfig(Settings):
    """A session on an arm with a whisker head: `python -m ratslam live config.yaml`."""

    arm: ArmConfig = ArmConfig()
    """The arm, and what it may do."""
    head: HeadLinkConfig = HeadLinkConfig()
    """The link to the whiskers."""
    plan: SimulationConfig = SimulationConfig()
    """Where to go (maze, path, motion) and how to whisk, as a simulated session has it, with what makes the
    calibration. The emulators take the rest of it for the world; `odometry` and `kidnaps` count for neither.
    """
    waypoints: tuple[tuple[float, float, float], ...] = ()
    """Where to go instead: x, y (m) and heading (degrees) in the map."""
    whisks: PositiveInt | None = None
    """How many; none: until the way is done."""
    odometry: Literal["pose", "velocity"] = "pose"
    """From the arm's poses at the middle of two protractions, or the mean velocity between them."""
    noise: OdometryConfig = OdometryConfig(noise="none")
    """Errors added to the arm's odometry, which is better than any robot's that needs a map (Salman & Pearson
    2016, III-C). Truth is what the arm says."""
    lift: NonNegativeFloat = 0.1
    """Above working height whiskers meet nothing: there the free record is made, m."""
    budget: PositiveFloat = 0.6
    """A whisk that finds the mapper this far behind loses its image, never its odometry, s."""
    grace: Annotated[float, Field(gt=0, le=1.0)] = 0.045
    """How long frames of a whisk that is over are waited for, s."""
    gap: PositiveInt = 5
    """An image with so many samples missing on end is not used."""
    residual: PositiveFloat = 5e-3
    """Of the clocks' alignment, beyond which the session does not start, s."""
    room: NonNegativeFloat = 2e9
    """On the disk, without which it does not start, bytes."""
    seed: int = 0
    """Of the errors added to the odometry."""

    def resolved(self, folder: Path) -> LiveConfig:
        """The same with every relative path taken from the folder (of the configuration file, say)."""
        return self.model_copy(update={"plan": self.plan.resolved(folder)})
