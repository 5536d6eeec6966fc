"""Settings of a live session: robot, head, route, checks before the start, and goals on a saved map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from robot.drivers.create.driver_config import CreateConfig
from robot.drivers.head.driver_config import HeadLinkConfig
from robot.drivers.ur10.driver_config import ArmConfig
from robot.simulation.create.simulated_session import CreateSimulationConfig
from robot.simulation.head.odometry_errors import OdometryConfig
from robot.simulation.head.simulated_session import SimulationConfig
from tactile.base.settings import Settings

Point = tuple[float, float]


class GoalConfig(Settings):
    """Goals on a saved map. The head moves only along links between experiences, which were driven before."""

    map: Path
    """The map: a run directory or its `map.npz`."""
    to: Annotated[tuple[Point | NonNegativeInt, ...], Field(min_length=1)]
    """Goals in order: x, y in the map (m), or the number of an experience."""
    start: Literal["here", "unknown"] = "here"
    """Where the robot stands at first: where the map ended, or anywhere: then the head rests until its
    place is found, and if it is not, the session ends as lost."""
    at: tuple[float, float, float] | None = None
    """Where the arm begins: x, y (m) and heading (degrees), as `live.waypoints`. null: where the session of
    the map ended by the truth.tum beside it; without one, at the end of the path or of `live.waypoints`."""
    mode: Literal["time", "temporal"] = "time"
    """The way: `time` by least expected time, `temporal` by RatSLAM's goal temporal map."""
    farthest: PositiveFloat = 0.1
    """Largest distance of a goal, or of the robot, from the nearest experience, m."""
    tolerance: PositiveFloat = 0.02
    """Distance from the goal at which it is reached, by the estimate, m."""
    standoff: PositiveFloat = 0.045
    """Contacts nearer than this to the way ahead block it, m; less than half a corridor, whose walls are
    beside the way."""
    confirm: PositiveInt = 2
    """Consecutive whisks with such a contact after which the way counts as blocked; the head rests from the
    first one on."""
    off_way: PositiveFloat = 1.2
    """Distance of the estimate from the way above which a new way is planned, pose cells."""
    coast: NonNegativeFloat = 1.0
    """Way that the arm drives by its own motion while the method is lost and the contacts of the last whisks
    agree with the map, m; then the head rests."""
    patience: PositiveInt = 20
    """Consecutive whisks at rest without an estimate, or with one away from all experiences, after which the
    session is lost."""
    returns: NonNegativeInt = 2
    """Number of times that some of the way is driven back and again while the pose at a goal is not sure;
    then the session is lost."""
    replans: NonNegativeInt = 5
    """Number of new ways for a goal, after which it counts as blocked."""


class TopicsLiveConfig(Settings):
    """A running robot, simulator or player that publishes topics, which `recording.topics` assigns."""

    source: str = Field(min_length=1)
    """Address: `ws://HOST:8765` of a Foxglove bridge, or `wss://` with TLS; `zenoh://HOST:7447/DOMAIN` of the
    router of `rmw_zenoh`, or `zenoh+tls://`; the domain may be left out if it is 0."""
    max_wait: PositiveFloat = 1.0
    """Longest time that a view waits for the odometry at its stamp, s; then it is dropped, and its motion is
    part of the next one's. Of a TurtleBot 4 over Wi-Fi, 3 % of the views wait 0.2 to 0.35 s."""
    patience: PositiveFloat = 60.0
    """Time without connection, odometry or views after which the session ends, s."""
    minutes: PositiveFloat | None = None
    """Duration of the session; null: until Ctrl-C."""
    record: tuple[str, ...] = ()
    """Topics that are recorded besides those that are used, such as an IMU."""
    publish: bool = False
    """Whether pose, path and health of the map are published to the robot, once a second, under /ratslam;
    never a velocity."""


ARM_ONLY = ("arm", "plan", "waypoints", "whisks", "odometry", "noise", "lift", "budget", "grace")
"""Settings without a meaning for a Create."""


class CreateLiveConfig(CreateConfig):
    """A Create on a serial port with fixed whiskers, to which `live.head` is the link, or a bare Create 2."""

    touch: Literal["whiskers", "light"] = "whiskers"
    """What it feels with: built-on whiskers, or the light bumpers and the bumper of a Create 2."""
    plan: CreateSimulationConfig = CreateSimulationConfig()
    """Behaviour, whiskers and duration (`minutes` or `reports`), as in a simulated session. The arena bounds
    the map; the emulator moves in it, with the errors in `wheels`."""
    strain_per_radian: PositiveFloat = 0.01
    """Strain at the base of a whisker for each radian that its sensor reports."""
    stuck: PositiveFloat = 3.0
    """Time for which the bumper may stay pressed, s; the robot backs off at once."""
    budget: PositiveFloat = 2.0
    """Lag of the mapper above which the robot waits for it, s."""

    @model_validator(mode="after")
    def _has_light(self) -> CreateLiveConfig:
        if self.touch == "light" and self.model != "create2":
            raise ValueError(f"touch: light: {self.model} has no light bumpers; `model: create2` has")
        return self


class LivePlanConfig(SimulationConfig):
    """Plan of a session on the arm: as of a simulated session, or goals on a saved map."""

    goal: GoalConfig | None = None
    """Goals to drive to on a saved map, instead of the path."""


class LiveConfig(Settings):
    """A session of `python -m ratslam live config.yaml`: an arm with a head, a Create with whiskers, or the
    topics of a running robot."""

    create: CreateLiveConfig | None = None
    """A Create instead of the arm; of the settings below it uses `head`, `gap`, `residual` and `room`."""
    topics: TopicsLiveConfig | None = None
    """The topics of a running robot; of the settings below it uses `budget` and `room`."""
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
    """Number of whisks, or of rings of pokes; None: until the end of the route."""
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

    @property
    def route_speed(self) -> float:
        """Speed of the arm on a route: the lower of the plan's and the arm's, m/s."""
        return min(self.plan.motion.speed, self.arm.speed)

    @model_validator(mode="after")
    def _one_robot(self) -> LiveConfig:
        given = [name for name in ARM_ONLY if name in self.model_fields_set]
        if self.create is not None and given:
            raise ValueError(f"create and {', '.join(given)}: a session has one robot, a Create or an arm")
        if self.plan.touch == "force":
            raise ValueError("plan.touch: what a real arm feels with is `live.arm.touch`")
        given = [name for name in ("create", *ARM_ONLY) if name in self.model_fields_set - {"budget"}]
        if self.topics is not None and given:
            raise ValueError(f"topics and {', '.join(given)}: a session has one robot")
        return self
