"""Publishes what a session knows to the robot: pose, transform from map to odom, path, grid and health.

All go to `/ratslam/...`, `/tf` and `/diagnostics`, once a second at most; a velocity never does.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np

from robot.live.topics_client import TopicsClient
from tactile.base.se2 import compose, inverse

PERIOD = 1.0
"""Time between two publications, s."""
MAP, ODOM = "map", "odom"


class PoseReport(NamedTuple):
    """What is published.

    Attributes:
        time: of the newest mapped view, s. pose: [3] in the map (m, m, rad). spread: [3] standard deviations,
            NaN if unknown. odometry: [3] pose in the frame `odom` at that time, or None.
        doubt: probability that the map is worse than odometry, NaN if not judged. lost: whether the method
            has lost track of the position.
    """

    time: float
    pose: np.ndarray
    spread: np.ndarray
    odometry: np.ndarray | None
    doubt: float
    lost: bool


class Drawing(NamedTuple):
    """The map as a whole.

    Attributes:
        path: [N, 3] of views (m, m, rad). occupied: [H, W] probability of an obstacle, rows are y upwards,
            from the lower left corner `origin` [2] m, in cells of `cell` m; None of a method without a grid.
    """

    path: np.ndarray
    occupied: np.ndarray | None = None
    origin: np.ndarray | None = None
    cell: float = 0.0


class MapPublisher:
    """Publishes over the connection to a robot."""

    def __init__(self, client: TopicsClient) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._client, self._store = client, get_typestore(Stores.ROS2_HUMBLE)
        self._due = 0.0

    def due(self) -> bool:
        """Whether it is time to publish again."""
        now = time.monotonic()
        if now < self._due:
            return False
        self._due = now + PERIOD
        return True

    def publish(self, state: PoseReport, drawing: Drawing | None) -> None:
        """Publishes the present state, and the map where it is known."""
        ns = round(state.time * 1e9)
        stamp = self._make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        header = self._make("std_msgs/msg/Header", stamp=stamp, frame_id=MAP)
        variance = np.where(np.isfinite(state.spread), state.spread**2, 0.0)
        covariance = np.zeros(36)
        covariance[[0, 7, 35]] = variance
        pose = self._make(
            "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(state.pose), covariance=covariance
        )
        self._send("/ratslam/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=pose)
        if state.odometry is not None:
            x, y, heading = compose(state.pose, inverse(state.odometry)).tolist()
            moved = self._make(
                "geometry_msgs/msg/Transform",
                translation=self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=0.0),
                rotation=self._turn(heading),
            )
            link = self._make(
                "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=ODOM, transform=moved
            )
            self._send("/tf", "tf2_msgs/msg/TFMessage", transforms=[link])
        doubted = bool(state.doubt > 0.5)
        level, words = (1, "the map is doubted") if doubted else (1, "lost") if state.lost else (0, "mapping")
        value = self._make("diagnostic_msgs/msg/KeyValue", key="doubt", value=f"{state.doubt:.3g}")
        status = self._make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level, name="ratslam", message=words, hardware_id="", values=[value],
        )  # fmt: skip
        self._send("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", header=header, status=[status])
        if drawing is not None:
            self._publish_map(header, drawing)

    def _publish_map(self, header: Any, drawing: Drawing) -> None:
        stamped = [
            self._make("geometry_msgs/msg/PoseStamped", header=header, pose=self._pose(row))
            for row in drawing.path
        ]
        self._send("/ratslam/path", "nav_msgs/msg/Path", header=header, poses=stamped)
        if drawing.occupied is None or drawing.origin is None:
            return
        (rows, columns), cells = drawing.occupied.shape, np.rint(100 * drawing.occupied).astype(np.int8)
        about = self._make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=header.stamp, resolution=drawing.cell, width=int(columns), height=int(rows),
            origin=self._pose(np.array([*drawing.origin, 0.0])),
        )  # fmt: skip
        self._send(
            "/ratslam/grid", "nav_msgs/msg/OccupancyGrid", header=header, info=about, data=cells.ravel()
        )

    def _pose(self, pose: np.ndarray) -> Any:
        x, y, heading = (float(value) for value in pose)
        place = self._make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        return self._make("geometry_msgs/msg/Pose", position=place, orientation=self._turn(heading))

    def _turn(self, heading: float) -> Any:
        half = heading / 2
        return self._make(
            "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=float(np.sin(half)), w=float(np.cos(half))
        )

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _send(self, topic: str, kind: str, **fields: Any) -> None:
        self._client.publish(topic, kind, bytes(self._store.serialize_cdr(self._make(kind, **fields), kind)))
