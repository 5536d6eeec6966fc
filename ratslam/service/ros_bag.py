"""A run as one MCAP file for ROS 2 tools, or as a ROS 2 bag: a folder with that file and `metadata.yaml`.

Standard ROS 2 messages in CDR, made of the arrays of a run directory; ROS itself is not needed. Frames are
those of REP 105: `map` and `odom` start at the robot's first pose, `base_link` is the robot. All poses are
planar, so z, roll and pitch and their variances are 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mcap.writer import CompressionType, Writer

from evaluation.artifacts.grid_files import Nav2Map, read_nav2
from evaluation.artifacts.run_reader import (
    read_closure_table,
    read_columns,
    read_manifest,
    read_run,
    read_whisker_views,
)
from evaluation.metrics.run_metrics import arrange_pieces
from evaluation.metrics.trajectory import align
from ratslam.runs.build_session import open_observations, read_observations
from ratslam.runs.settings.run_config import load_config
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose, inverse

MAP, ODOM, BASE = "map", "odom", "base_link"
SECOND = 1_000_000_000
LAST_SECOND = 2**31 - 1
"""Largest number of seconds in a ROS 2 stamp."""
POINTS, LINES = 8, 5
"""Kinds of `visualization_msgs/Marker`: POINTS and LINE_LIST."""
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])  # x, y and yaw in a covariance of six axes
KINDS = {
    "/path/map": "nav_msgs/msg/Path",
    "/path/odometry": "nav_msgs/msg/Path",
    "/path/truth": "nav_msgs/msg/Path",
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/markers": "visualization_msgs/msg/MarkerArray",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/odom": "nav_msgs/msg/Odometry",
    "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/view": "sensor_msgs/msg/Image",
}
"""Topics and their types of messages."""
GREY, GREEN = (0.5, 0.5, 0.5, 0.6), (0.1, 0.6, 0.2, 0.9)
VERDICTS = {"accepted": GREEN, "open": (0.9, 0.5, 0.1, 0.4), "undone": (0.8, 0.1, 0.1, 0.4)}
"""Colours of the candidates for loop closures by verdict: green, orange, red."""
THIN, THICK = 0.1, 0.3
"""Width of links, and diameter of experiences, as shares of the median distance of linked experiences."""
LATCHED = ("/path/map", "/path/odometry", "/path/truth", "/map", "/markers")
"""Topics with one message, at the first stamp: late subscribers get it too."""

Fields = dict[str, Any]
"""Fields of a message; those of messages in it are nested. What is not given is 0 or empty."""


class RosRun:
    """The messages of a run of N steps, also of the incomplete one of an interrupted run.

    Args:
        directory: of the run. warn: called with a sentence if the views cannot be read.

    Attributes:
        run: its arrays, pieces of the map where plots show them.

    Raises:
        InputError: rosbags is not installed, a file is missing or malformed, or a time does not fit into a
            ROS 2 stamp.
    """

    def __init__(self, directory: Path, warn: Callable[[str], None]) -> None:
        try:
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            cure = "pip install 'ratslam[ros]'"
            raise InputError("export", "rosbags is not installed", "the extra 'ros'", cure) from None
        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        self._directory, self._warn = directory, warn
        self.run = run = arrange_pieces(read_run(directory))
        bad = ~((run.time >= 0) & (run.time <= LAST_SECOND))
        if bad.any():
            expected = f"0 to {LAST_SECOND} s, the range of ROS 2 stamps"
            raise InputError(str(directory / "online.tum"), f"a time of {run.time[bad][0]:g} s", expected)
        self._stamps = np.rint(run.time * 1e9).astype(np.int64)  # ns, the times of the recording
        columns = read_columns(directory / "steps.csv", "sd_x", "sd_y", "sd_heading")
        self._spread = np.stack([column[: len(run.time)] for column in columns], axis=1)  # [N, 3] m, m, rad
        self._closures = read_closure_table(directory)
        self._grid = read_nav2(directory / "map.yaml") if (directory / "map.yaml").exists() else None

    def _messages(self) -> Iterator[tuple[str, int, Fields]]:
        """All messages in order of time, each with its topic and its stamp in ns."""
        run = self.run
        for topic, message in self._latched_messages():
            yield topic, int(self._stamps[0]), message
        images = self._images()
        image = next(images, None)
        start = inverse(run.odometry[0])  # so that odom and map agree at the first step
        odometry = compose(compose(run.online[0], start), run.odometry)
        twist = np.zeros_like(odometry)  # mean velocity of each step in its own frame; 0 without a duration
        duration = np.diff(run.time)[:, None]
        np.divide(between(odometry[:-1], odometry[1:]), duration, out=twist[1:], where=duration > 0)
        offset = compose(run.online, inverse(odometry))
        for step, stamp in enumerate(self._stamps.tolist()):
            yield "/tf", stamp, _transforms(stamp, offset[step], odometry[step])
            velocity = {"linear": _vector(*twist[step, :2]), "angular": _vector(0.0, 0.0, twist[step, 2])}
            moving = {"pose": {"pose": _pose(odometry[step])}, "twist": {"twist": velocity}}
            # Covariances of 0: unknown.
            yield "/odom", stamp, {"header": _header(stamp, ODOM), "child_frame_id": BASE, **moving}
            covariance = np.zeros((6, 6))
            covariance[_PLANAR] = np.diag(self._spread[step] ** 2)
            online = {"pose": _pose(run.online[step]), "covariance": covariance.ravel()}
            yield "/pose", stamp, {"header": _header(stamp, MAP), "pose": online}
            if image is not None and image[0] == step:
                yield "/view", stamp, _image(stamp, image[1])
                image = next(images, None)

    def _latched_messages(self) -> Iterator[tuple[str, Fields]]:
        run, stamps = self.run, self._stamps
        yield "/path/map", _path(stamps, run.final)
        own = compose(inverse(run.odometry[0]), run.odometry)
        yield "/path/odometry", _path(stamps, compose(run.online[0], own))
        if run.truth is not None:
            known = np.isfinite(run.truth).all(axis=1)
            # Brought nearest to the final trajectory by one rigid motion.
            aligned = compose(inverse(align(run.final[known], run.truth[known])), run.truth[known])
            yield "/path/truth", _path(stamps[known], aligned)
        if self._grid is not None:
            yield "/map", _occupancy(int(stamps[0]), self._grid)
        if markers := self._markers(int(stamps[0])):
            yield "/markers", {"markers": markers}

    def _markers(self, stamp: int) -> list[Fields]:
        """Experiences and their links, and the candidates for loop closures by verdict."""
        run, parts = self.run, []
        nodes, links = run.nodes[:, :2], run.links
        between_nodes = np.hypot(*(nodes[links[:, 0]] - nodes[links[:, 1]]).T) if len(links) else np.zeros(0)
        size = float(np.median(between_nodes)) if len(links) else 0.1
        if len(nodes):
            parts.append(_marker(stamp, "graph/experiences", POINTS, nodes, GREY, THICK * size))
        if len(links):
            ends = nodes[links].reshape(-1, 2)
            parts.append(_marker(stamp, "graph/links", LINES, ends, GREY, THIN * size))
        steps, verdicts = self._closures.steps, np.array(self._closures.verdicts, dtype=str)
        known = ((steps >= 0) & (steps < len(run.time))).all(axis=1)
        for verdict, colour in VERDICTS.items():
            chosen = steps[known & (verdicts == verdict)]
            if len(chosen):
                ends = run.final[chosen, :2].reshape(-1, 2)
                parts.append(_marker(stamp, f"closures/{verdict}", LINES, ends, colour, THIN * size))
        return parts

    def _images(self) -> Iterator[tuple[int, np.ndarray]]:
        """Whisker images of the run directory, or the views of its recording if that is still there, each
        with its step; none for a simulation, which would have to be repeated."""
        if (self._directory / "views.npz").exists():
            views = read_whisker_views(self._directory / "views.npz").view
            yield from enumerate(_pixels(view[..., None]) for view in views[: len(self.run.time)])
            return
        try:
            config = load_config(self._directory / "config.yaml")
            if config.recording is None:
                return
            digest = read_manifest(self._directory).digest
            with open_observations(config) as (_, source):
                if source.digest != digest:
                    cure = "the views are those of another recording"
                    raise InputError(source.name, "changed since the run", "the recording of the run", cure)
                step = 0
                for sample, observation in read_observations(source):
                    if step == len(self.run.time):
                        return
                    if sample.time != self.run.time[step]:  # a continued run starts later in its recording
                        continue
                    if observation.view_seen and observation.view.size:
                        yield step, _pixels(observation.view)
                    step += 1
        except InputError as error:
            self._warn(f"the file has no views: {error}")

    def write_mcap(self, path: Path) -> dict[str, int]:
        """Writes an MCAP file with the ROS 2 profile; equal runs give equal bytes.

        Returns:
            its topics, each with the number of its messages.
        """
        channels: dict[str, int] = {}
        counts: dict[str, int] = {}
        with path.open("wb") as file:
            writer = Writer(file, compression=CompressionType.ZSTD)
            writer.start(profile="ros2", library="ratslam")
            schemas: dict[str, int] = {}
            for topic, stamp, fields in self._messages():
                kind = KINDS[topic]
                if topic not in channels:
                    if kind not in schemas:
                        text = self._store.generate_msgdef(kind, ros_version=2)[0]  # with all types in it
                        schemas[kind] = writer.register_schema(kind, "ros2msg", text.encode())
                    profile = {"offered_qos_profiles": _quality_of_service(topic)}
                    channels[topic] = writer.register_channel(topic, "cdr", schemas[kind], profile)
                    counts[topic] = 0
                data = bytes(self._store.serialize_cdr(self._message(kind, fields), kind))
                writer.add_message(channels[topic], stamp, data, stamp, counts[topic])
                counts[topic] += 1
            writer.finish()
        return counts

    def write_bag(self, folder: Path, name: str) -> None:
        """Writes a ROS 2 bag into an existing folder: NAME_0.mcap and metadata.yaml."""
        file = f"{name}_0.mcap"
        counts = self.write_mcap(folder / file)
        first, last = int(self._stamps[0]), int(self._stamps[-1])
        span = {
            "duration": {"nanoseconds": last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": sum(counts.values()),
        }
        information = {
            "version": 5,
            "storage_identifier": "mcap",
            **span,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": KINDS[topic],
                        "serialization_format": "cdr",
                        "offered_qos_profiles": _quality_of_service(topic),
                    },
                    "message_count": count,
                }
                for topic, count in counts.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file],
            "files": [{"path": file, **span}],
        }
        text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
        (folder / "metadata.yaml").write_text(text, encoding="utf-8")

    def _message(self, kind: str, fields: Fields) -> Any:
        types = self._store.fielddefs[kind][1]
        made = {name: self._value(form, inner, fields.get(name)) for name, (form, inner) in types}
        return self._store.types[kind](**made)

    def _value(self, form: Any, inner: Any, given: Any) -> Any:
        """A value of a message from what is given for it, None for nothing.

        Args:
            form, inner: the `rosbags.interfaces.Nodetype` of the field, and what it holds.
        """
        from rosbags.interfaces import Nodetype

        if form == Nodetype.NAME:
            return self._message(inner, given or {})
        if form == Nodetype.BASE:
            return {"string": "", "bool": False}.get(inner[0], 0) if given is None else given
        (element, detail), length = inner
        if element == Nodetype.NAME:
            return [self._message(detail, fields) for fields in given or ()]
        if given is None and detail[0] != "string":
            return np.zeros(length if form == Nodetype.ARRAY else 0, detail[0])
        return [] if given is None else given


def _header(stamp: int, frame: str) -> Fields:
    return {"stamp": _time(stamp), "frame_id": frame}


def _time(stamp: int) -> Fields:
    seconds, rest = divmod(int(stamp), SECOND)
    return {"sec": seconds, "nanosec": rest}


def _vector(x: float, y: float, z: float = 0.0) -> Fields:
    return {"x": float(x), "y": float(y), "z": float(z)}


def _turn(heading: float) -> Fields:
    half = float(heading) / 2
    return {"z": float(np.sin(half)), "w": float(np.cos(half))}


def _pose(pose: np.ndarray) -> Fields:
    return {"position": _vector(pose[0], pose[1]), "orientation": _turn(pose[2])}


def _path(stamps: np.ndarray, poses: np.ndarray) -> Fields:
    """nav_msgs/Path of poses [N, 3] in map; its own stamp is that of the first."""
    pairs = zip(stamps.tolist(), poses, strict=True)
    stamped = [{"header": _header(stamp, MAP), "pose": _pose(pose)} for stamp, pose in pairs]
    return {"header": _header(int(stamps[0]), MAP), "poses": stamped}


def _transforms(stamp: int, map_to_odom: np.ndarray, odom_to_base: np.ndarray) -> Fields:
    """tf2_msgs/TFMessage with the poses [3] of odom in map and of base_link in odom."""
    stamped = [
        {
            "header": _header(stamp, parent),
            "child_frame_id": child,
            "transform": {"translation": _vector(pose[0], pose[1]), "rotation": _turn(pose[2])},
        }
        for parent, child, pose in ((MAP, ODOM, map_to_odom), (ODOM, BASE, odom_to_base))
    ]
    return {"transforms": stamped}


def _occupancy(stamp: int, grid: Nav2Map) -> Fields:
    """nav_msgs/OccupancyGrid in map: 0 free, 100 occupied, -1 unknown, as nav2's map_server publishes."""
    height, width = grid.cell.shape
    info = {
        "map_load_time": _time(stamp),
        "resolution": grid.resolution,
        "width": width,
        "height": height,
        "origin": _pose(grid.origin),
    }
    return {"header": _header(stamp, MAP), "info": info, "data": grid.cell.astype(np.int8).ravel()}


def _image(stamp: int, pixels: np.ndarray) -> Fields:
    """sensor_msgs/Image of [R, C, K] uint8: colours for three channels, else the first one in grey."""
    colour = pixels.shape[2] == 3
    shown = np.ascontiguousarray(pixels if colour else pixels[..., :1])
    height, width, channels = shown.shape
    return {
        "header": _header(stamp, BASE),
        "height": height,
        "width": width,
        "encoding": "rgb8" if colour else "mono8",
        "step": width * channels,
        "data": shown.ravel(),
    }


def _marker(
    stamp: int, name: str, kind: int, points: np.ndarray, colour: tuple[float, ...], width: float
) -> Fields:
    """visualization_msgs/Marker of points [n, 2] in map: `POINTS`, or `LINES` between pairs of points.

    Args:
        name: namespace of the marker. colour: red, green, blue, opacity in 0..1. width: m.
    """
    return {
        "header": _header(stamp, MAP),
        "ns": name,
        "type": kind,
        "pose": _pose(np.zeros(3)),
        "scale": _vector(width, width),
        "color": dict(zip("rgba", colour, strict=True)),
        "points": [{"x": x, "y": y} for x, y in points.tolist()],
    }


def _pixels(view: np.ndarray) -> np.ndarray:
    """A view in 0..1 as 8-bit pixels."""
    return np.rint(255 * np.clip(view, 0.0, 1.0)).astype(np.uint8)


def _quality_of_service(topic: str) -> str:
    """The profile that rosbag2 plays a topic with: reliable, kept for late subscribers if `LATCHED`."""
    latched = topic in LATCHED
    forever = {"sec": 2147483647, "nsec": 4294967295}
    profile = {
        "history": 1,
        "depth": 1 if latched else 10,
        "reliability": 1,
        "durability": 1 if latched else 2,
        "deadline": forever,
        "lifespan": forever,
        "liveliness": 1,
        "liveliness_lease_duration": forever,
        "avoid_ros_namespace_conventions": False,
    }
    return yaml.safe_dump([profile], sort_keys=False, default_flow_style=None)
