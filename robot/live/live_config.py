"""Settings of a live session: robot, head, route, and checks before the start."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from robot.drivers.create.driver_config import CreateConfig
from robot.drivers.head.driver_config import HeadLinkConfig
from robot.drivers.ur10.driver_config import ArmConfig
from robot.live.goal_config import GoalConfig
from robot.simulation.create.simulated_session import CreateSimulationConfig
from robot.simulation.head.simulated_session import SimulationConfig
from robot.sources.odometry import OdometryConfig
from tactile.base.settings import Settings

ARM_ONLY = ("arm", "plan", "waypoints", "whisks", "odometry", "noise", "lift", "budget", "grace")
"""Settings without a meaning for a Create."""


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


class LivePlanConfig(SimulationConfig):
    """Plan of a session on the arm: as of a simulated session, or goals on a saved map."""

    goal: GoalConfig | None = None
    """Goals to drive to on a saved map, instead of the path."""

    def resolved(self, folder: Path) -> LivePlanConfig:
        plan = super().resolved(folder)
        assert isinstance(plan, LivePlanConfig)
        return plan if plan.goal is None else plan.model_copy(update={"goal": plan.goal.resolved(folder)})


class LiveConfig(Settings):
    """A session of `python -m ratslam live config.yaml`: an arm with a head, or a Create with whiskers."""

    create: CreateLiveConfig | None = None
    """A Create instead of the arm; of the settings below it uses `head`, `gap`, `residual` and `room`."""
    arm: ArmConfig = ArmConfig()
    """The arm and its limits."""
    head: HeadLinkConfig = HeadLinkConfig()
    """The link to the whisker head."""
    plan: LivePlanConfig = LivePlanConfig()
    """Route (maze, path, motion), whisking and calibration, as in a simulated session. The emulators use the
    other settings for their world; `odometry` and `kidnaps` have no effect.
    """
    waypoints: tuple[tuple[float, float, float], ...] = ()
    """Route instead of the plan's: x, y (m) and heading (degrees) in the map."""
    whisks: PositiveInt | None = None
    """Number of whisks; None: until the end of the route."""
    odometry: Literal["pose", "velocity"] = "pose"
    """Odometry from the arm's poses at the middle of two protractions, or from the mean velocity between
    them."""
    noise: OdometryConfig = OdometryConfig(noise="none")
    """Errors added to the arm's odometry, which is more accurate than that of a mobile robot (Salman &
    Pearson 2016, III-C). Ground truth is the pose reported by the arm."""
    lift: NonNegativeFloat = 0.1
    """Height above working height for the free-whisking record, where whiskers touch nothing, m."""
    budget: PositiveFloat = 0.6
    """Lag of the mapper above which a whisk is passed on without image (but with its odometry), s."""
    grace: Annotated[float, Field(gt=0, le=1.0)] = 0.045
    """Waiting time for the frames of a whisk after its end, s."""
    gap: PositiveInt = 5
    """Least number of consecutive missing samples that makes an image unusable."""
    residual: PositiveFloat = 5e-3
    """Largest residual of the clock synchronisation at the start of a session, s."""
    room: NonNegativeFloat = 2e9
    """Free disk space required to start, bytes."""
    seed: int = 0
    """Random seed of the errors added to the odometry."""

    @model_validator(mode="after")
    def _one_robot(self) -> LiveConfig:
        given = [name for name in ARM_ONLY if name in self.model_fields_set]
        if self.create is not None and given:
            raise ValueError(f"create and {', '.join(given)}: a session has one robot, a Create or an arm")
        return self

    def resolved(self, folder: Path) -> LiveConfig:
        """A copy with relative paths taken from the folder (of the configuration file)."""
        if self.create is not None:
            return self.model_copy(update={"create": self.create.resolved(folder)})
        return self.model_copy(update={"plan": self.plan.resolved(folder)})
