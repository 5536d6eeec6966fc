"""Settings that assign the topics of a bag."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    GetJsonSchemaHandler,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    model_validator,
)
from pydantic_core import CoreSchema

from tactile.base.settings import Settings, Side


def _as_tuple(value: Any) -> Any:
    """A list as a tuple: after a validator of the whole section, lists no longer count as tuples."""
    return tuple(value) if isinstance(value, list) else value


FromList = BeforeValidator(_as_tuple)


class Topic(Settings):
    """A topic and how it is read; in a configuration a bare name stands for the topic alone."""

    @model_validator(mode="before")
    @classmethod
    def _name_alone(cls, given: Any) -> Any:
        return {"topic": given} if isinstance(given, str) else given

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        schema = handler(core)
        handler.resolve_ref_schema(schema)["type"] = ["object", "string"]
        return schema


class PoseTopic(Topic):
    """Poses on a topic, or between two frames of /tf."""

    topic: str | None = None
    """Topic of Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped messages."""
    tf: Annotated[tuple[str, str] | None, FromList] = None
    """Or two frames of /tf and /tf_static: the pose of the second in the first, such as [map, base_link]."""
    frames: Annotated[tuple[str, ...], FromList, Field(max_length=2)] = ()
    """Only messages with this frame and child frame, where several nodes publish on the topic."""
    plane: Literal["xy", "xz"] = "xy"
    """Plane of the motion: `xz` for poses of a camera (x to the right, y down, z ahead)."""

    @model_validator(mode="after")
    def _one_origin(self) -> PoseTopic:
        if (self.topic is None) == (self.tf is None):
            raise ValueError("give a topic, or tf: [frame, child frame]")
        return self


class OdometryTopic(PoseTopic):
    """Odometry: each message is a sample of the recording."""

    use: Literal["pose", "twist"] = "pose"
    """Which part of Odometry messages: differences of the poses, or the velocities linear.x, linear.y and
    angular.z, which hold since the message before. TwistStamped messages have velocities only."""
    every: PositiveInt = 1
    """Joins this many messages to one sample, for odometry much faster than the views."""


class ViewsTopic(Topic):
    """Views from LaserScan, PointCloud2, Image or CompressedImage messages; images: `recording.image`."""

    topic: str
    """The topic."""
    rows: Side = 3
    """R, rows of a view of ranges."""
    columns: Side = 6
    """C, columns of a view of ranges; its R x C sectors are filled row by row."""
    max_range: PositiveFloat | None = None
    """Range that becomes 1, m; null: `range_max` of the first scan, at most 8 m."""
    yaw: float | None = None
    """Direction of the sensor in the frame of the robot, rad, counter-clockwise; null: from /tf_static."""
    span: Annotated[tuple[float, float] | None, FromList] = None
    """Scans: the directions that are cut into sectors, from the first to the last, rad in the frame of the
    sensor; a whole turn is a ring; null: those of the first scan."""
    heights: Annotated[tuple[float, float], FromList] = (0.1, 1.0)
    """Point clouds: lowest and highest point that counts, m, in the frame of the robot."""
    tolerance: NonNegativeFloat | None = None
    """Largest time between a view and its nearest sample, s; null: the median step of the odometry."""

    @model_validator(mode="after")
    def _spans_at_most_a_turn(self) -> ViewsTopic:
        if self.span is not None and not 0 < abs(self.span[1] - self.span[0]) < 6.284:
            raise ValueError(f"span is {list(self.span)}: give two directions in rad, at most a turn apart")
        return self


class TouchTopic(Topic):
    """Touch sensors as a view, from JointState, Float32MultiArray or Float64MultiArray messages, or from the
    bumpers, hazards and proximity sensors of a Create."""

    topic: str
    """The topic."""
    rows: Side | None = None
    """R, rows of the sensors; null: those of the message's layout, else 1."""
    columns: Side | None = None
    """C, columns of the sensors; null: the values divided by the rows."""
    use: Literal["position", "velocity", "effort"] = "position"
    """Which values of JointState messages."""
    joints: Annotated[tuple[str, ...], FromList] = ()
    """Joints of JointState messages, in the order of the pixels; messages without them are for others. Empty:
    all joints of the first message. Of a Create, the frames or fields of its sensors; empty: its bumpers."""
    low: float = 0.0
    """Value that becomes 0; lower ones too."""
    high: float = 1.0
    """Value that becomes 1; higher ones too."""
    tolerance: NonNegativeFloat | None = None
    """As for views."""

    @model_validator(mode="after")
    def _has_span(self) -> TouchTopic:
        if not self.low < self.high:
            raise ValueError(f"low is {self.low} and high {self.high}: give low < high")
        return self


class WrenchTopic(Topic):
    """Force at a tool that another program pokes with (`touch.pokes`), from WrenchStamped or Wrench messages;
    their frame may be any. The odometry is the pose of the tool."""

    topic: str
    """The topic."""
    yaw: float = 0.0
    """Direction of the first poke in the frame of the tool, rad, counter-clockwise."""


class TopicsConfig(Settings):
    """Topics of a bag."""

    odometry: OdometryTopic | None = None
    """Odometry."""
    views: ViewsTopic | None = None
    """Views, if any."""
    touch: TouchTopic | None = None
    """Touch sensors, instead of views."""
    wrench: WrenchTopic | None = None
    """Force at a tool that another program pokes with, instead of views."""
    truth: PoseTopic | None = None
    """True poses, if known; interpolated to the samples."""
    openratslam: str | None = Field(default=None, min_length=1)
    """Root of OpenRatSLAM's topics, such as irat_red: ROOT/odom by its velocities and ROOT/camera/image, raw
    or compressed, where `odometry` and `views` are not given."""
    clock: Literal["header", "bag"] = "header"
    """Times of messages: the stamp in their header, or the time at which the bag received them. Messages
    without a header have the latter only."""
    samples: Literal["odometry", "views"] = "odometry"
    """What makes a sample: each odometry message, with the nearest view; or each view (or touch reading),
    with the odometry interpolated to its time, for views faster than the odometry, and for pokes."""
    body: str | None = None
    """Frame of the robot, in which sensors are mounted; null: the child frame of the odometry, else
    base_link or base_footprint."""

    @model_validator(mode="after")
    def _has_one_kind_of_views(self) -> TopicsConfig:
        given = [name for name in ("views", "touch", "wrench") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"both {given[0]} and {given[1]}: give one of them")
        if self.wrench is not None and self.samples != "views":
            raise ValueError("a wrench makes a sample of each ring of pokes: give samples: views")
        return self
