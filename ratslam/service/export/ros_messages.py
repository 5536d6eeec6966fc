"""Standard ROS 2 messages from arrays, in CDR; ROS itself is not needed.

Frames are those of REP 105: `map` and `odom` start at the robot's first pose, `base_link` is the robot. All
poses are planar, so z, roll and pitch and their variances are 0.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from evaluation.artifacts.nav2 import Nav2Map
from tactile.base.errors import InputError

MAP, ODOM, BASE = "map", "odom", "base_link"
SECOND = 1_000_000_000
POINTS, LINES = 8, 5
"""Kinds of `visualization_msgs/Marker`: POINTS and LINE_LIST."""
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])  # x, y and yaw in a covariance of six axes


class RosMessages:
    """Builds messages from arrays.

    Raises:
        InputError: rosbags is not installed.
    """

    def __init__(self) -> None:
        try:
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            cure = "pip install 'ratslam[ros]'"
            raise InputError("export", "rosbags is not installed", "the extra 'ros'", cure) from None
        self._store = get_typestore(Stores.ROS2_HUMBLE)

    def definition(self, name: str) -> str:
        """The definition of a message type and of all types in it, as MCAP files store it."""
        return self._store.generate_msgdef(name, ros_version=2)[0]

    def serialize(self, message: Any) -> bytes:
        """A message as CDR."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__))

    def odometry(self, stamp: int, pose: np.ndarray, twist: np.ndarray) -> Any:
        """nav_msgs/Odometry: pose [3] in odom, twist [3] in base_link, m/s, m/s, rad/s. Covariances are 0,
        which means unknown."""
        make = self._make
        return make(
            "nav_msgs/msg/Odometry",
            header=self._header(stamp, ODOM),
            child_frame_id=BASE,
            pose=make("geometry_msgs/msg/PoseWithCovariance", pose=self._pose(pose)),
            twist=make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=make(
                    "geometry_msgs/msg/Twist",
                    linear=self._vector(twist[0], twist[1]),
                    angular=self._vector(0.0, 0.0, twist[2]),
                ),
            ),
        )

    def path(self, stamps: np.ndarray, poses: np.ndarray) -> Any:
        """nav_msgs/Path of poses [N, 3] in map; its own stamp is that of the first."""
        stamped = [
            self._make("geometry_msgs/msg/PoseStamped", header=self._header(s, MAP), pose=self._pose(pose))
            for s, pose in zip(stamps.tolist(), poses, strict=True)
        ]
        return self._make("nav_msgs/msg/Path", header=self._header(int(stamps[0]), MAP), poses=stamped)

    def pose(self, stamp: int, pose: np.ndarray, spread: np.ndarray) -> Any:
        """geometry_msgs/PoseWithCovarianceStamped in map, from standard deviations [3]: m, m, rad."""
        covariance = np.zeros((6, 6))
        covariance[_PLANAR] = np.diag(np.asarray(spread) ** 2)
        inner = self._make(
            "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(pose), covariance=covariance.ravel()
        )
        name = "geometry_msgs/msg/PoseWithCovarianceStamped"
        return self._make(name, header=self._header(stamp, MAP), pose=inner)

    def transforms(self, stamp: int, map_to_odom: np.ndarray, odom_to_base: np.ndarray) -> Any:
        """tf2_msgs/TFMessage with the poses [3] of odom in map and of base_link in odom."""
        pairs = ((MAP, ODOM, map_to_odom), (ODOM, BASE, odom_to_base))
        stamped = [
            self._make(
                "geometry_msgs/msg/TransformStamped",
                header=self._header(stamp, parent),
                child_frame_id=child,
                transform=self._make(
                    "geometry_msgs/msg/Transform",
                    translation=self._vector(pose[0], pose[1]),
                    rotation=self._turn(pose[2]),
                ),
            )
            for parent, child, pose in pairs
        ]
        return self._make("tf2_msgs/msg/TFMessage", transforms=stamped)

    def grid(self, stamp: int, grid: Nav2Map) -> Any:
        """nav_msgs/OccupancyGrid in map: 0 free, 100 occupied, -1 unknown, as nav2's map_server publishes."""
        height, width = grid.cell.shape
        info = self._make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=self._time(stamp),
            resolution=grid.resolution,
            width=width,
            height=height,
            origin=self._pose(grid.origin),
        )
        cells = grid.cell.astype(np.int8).ravel()
        return self._make(
            "nav_msgs/msg/OccupancyGrid", header=self._header(stamp, MAP), info=info, data=cells
        )

    def image(self, stamp: int, pixels: np.ndarray) -> Any:
        """sensor_msgs/Image of [R, C, K] uint8: colours for three channels, else the first one in grey."""
        colour = pixels.shape[2] == 3
        shown = np.ascontiguousarray(pixels if colour else pixels[..., :1])
        height, width, channels = shown.shape
        return self._make(
            "sensor_msgs/msg/Image",
            header=self._header(stamp, BASE),
            height=height,
            width=width,
            encoding="rgb8" if colour else "mono8",
            step=width * channels,
            data=shown.ravel(),
        )

    def marker(
        self, stamp: int, name: str, kind: int, points: np.ndarray, colour: tuple[float, ...], width: float
    ) -> Any:
        """visualization_msgs/Marker of points [n, 2] in map: `POINTS`, or `LINES` between pairs of points.

        Args:
            name: namespace of the marker. colour: red, green, blue, opacity in 0..1. width: m.
        """
        make = self._make
        return make(
            "visualization_msgs/msg/Marker",
            header=self._header(stamp, MAP),
            ns=name,
            type=kind,
            pose=self._pose(np.zeros(3)),
            scale=self._vector(width, width),
            color=make("std_msgs/msg/ColorRGBA", **dict(zip("rgba", colour, strict=True))),
            points=[make("geometry_msgs/msg/Point", x=x, y=y) for x, y in points.tolist()],
        )

    def markers(self, parts: list[Any]) -> Any:
        """visualization_msgs/MarkerArray."""
        return self._make("visualization_msgs/msg/MarkerArray", markers=parts)

    def _time(self, stamp: int) -> Any:
        seconds, rest = divmod(int(stamp), SECOND)
        return self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)

    def _header(self, stamp: int, frame: str) -> Any:
        return self._make("std_msgs/msg/Header", stamp=self._time(stamp), frame_id=frame)

    def _vector(self, x: float, y: float, z: float = 0.0) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))

    def _turn(self, heading: float) -> Any:
        half = float(heading) / 2
        return self._make("geometry_msgs/msg/Quaternion", z=float(np.sin(half)), w=float(np.cos(half)))

    def _pose(self, pose: np.ndarray) -> Any:
        place = self._make("geometry_msgs/msg/Point", x=float(pose[0]), y=float(pose[1]))
        return self._make("geometry_msgs/msg/Pose", position=place, orientation=self._turn(pose[2]))

    def _make(self, name: str, **given: Any) -> Any:
        """A message with the given fields; numbers, texts and lists that are not given are 0 or empty."""
        blank = self._blank(name)
        return self._store.types[name](**{field: given.get(field, blank[field]) for field in blank})

    def _blank(self, name: str) -> dict[str, Any]:
        if name not in self._blanks:
            fields = self._store.fielddefs[name][1]
            self._blanks[name] = {field: self._default(description) for field, description in fields}
        return self._blanks[name]

    @cached_property
    def _blanks(self) -> dict[str, dict[str, Any]]:
        return {}

    def _default(self, description: Any) -> Any:
        from rosbags.interfaces import Nodetype

        kind, inner = description
        if kind == Nodetype.BASE:
            return {"string": "", "bool": False}.get(inner[0], 0)
        if kind == Nodetype.NAME:
            return self._make(inner)
        (element, detail), length = inner
        if element == Nodetype.BASE and detail[0] != "string":
            return np.zeros(length if kind == Nodetype.ARRAY else 0, detail[0])
        return []
