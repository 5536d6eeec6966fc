"""A run as one MCAP file for ROS 2 tools, or as a ROS 2 bag: a folder with that file and `metadata.yaml`.

Standard ROS 2 messages in CDR, made of the arrays of a run directory; ROS itself is not needed. Frames are
those of REP 105: `map` and `odom` start at the robot's first pose, `base_link` is the robot. All poses are
planar, so z, roll and pitch and their variances are 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from mcap.writer import CompressionType, Writer

from evaluation.artifacts.closure_table import read_closure_table
from evaluation.artifacts.grid_files import Nav2Map, read_nav2
from evaluation.artifacts.manifest import read_manifest
from evaluation.artifacts.recorded_views import read_whisker_views
from evaluation.artifacts.run_reader import read_columns, read_run
from evaluation.metrics.run_arrays import RunArrays
from evaluation.metrics.run_metrics import arrange_pieces
from evaluation.metrics.trajectory import align
from ratslam.runs.build_session import open_observations, read_observations
from ratslam.runs.settings.run_config import load_config
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose, inverse

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
        self._blanks: dict[str, dict[str, Any]] = {}  # default values of the fields, by type

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
        if name not in self._blanks:
            fields = self._store.fielddefs[name][1]
            self._blanks[name] = {field: self._default(description) for field, description in fields}
        blank = self._blanks[name]
        return self._store.types[name](**{field: given.get(field, blank[field]) for field in blank})

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


LAST_SECOND = 2**31 - 1
"""Largest number of seconds in a ROS 2 stamp."""


class _ExportedRun(NamedTuple):
    """A run of N steps; poses are in the frame of the map unless stated otherwise.

    Attributes:
        stamps: [N] int64, ns, the times of the recording. run: its arrays, pieces of the map where
            plots show them.
        spread: [N, 3] standard deviations of the online pose, m, m, rad.
        truth: [N, 3] true poses brought nearest to the final trajectory by one rigid motion, NaN in rows
            without one; or None.
        candidates: [n, 2] earlier and later step of each candidate for a loop closure. verdicts: of each.
        grid: the occupancy map, or None. images: yields (step, [R, C, K] uint8) of each view that was seen.
    """

    stamps: np.ndarray
    run: RunArrays
    spread: np.ndarray
    truth: np.ndarray | None
    candidates: np.ndarray
    verdicts: list[str]
    grid: Nav2Map | None
    images: Callable[[], Iterator[tuple[int, np.ndarray]]]


def read_exported_run(directory: Path, warn: Callable[[str], None]) -> _ExportedRun:
    """Reads a run directory, also the incomplete one of an interrupted run.

    Args:
        warn: called with a sentence if the views cannot be read.

    Raises:
        InputError: a file is missing or malformed, or a time does not fit into a ROS 2 stamp.
    """
    run = arrange_pieces(read_run(directory))
    steps, truth = len(run.time), None
    found = read_columns(directory / "steps.csv", "sd_x", "sd_y", "sd_heading")
    columns = [column[:steps] for column in found]
    closures = read_closure_table(directory)
    known = np.flatnonzero(((closures.steps >= 0) & (closures.steps < steps)).all(axis=1))
    bad = ~((run.time >= 0) & (run.time <= LAST_SECOND))
    if bad.any():
        expected = f"0 to {LAST_SECOND} s, the range of ROS 2 stamps"
        raise InputError(str(directory / "online.tum"), f"a time of {run.time[bad][0]:g} s", expected)
    if run.truth is not None:
        there = np.isfinite(run.truth).all(axis=1)
        truth = np.full_like(run.truth, np.nan)
        truth[there] = compose(inverse(align(run.final[there], run.truth[there])), run.truth[there])
    return _ExportedRun(
        stamps=np.rint(run.time * 1e9).astype(np.int64),
        run=run,
        spread=np.stack(columns, axis=1),
        truth=truth,
        candidates=closures.steps[known],
        verdicts=[closures.verdicts[k] for k in known],
        grid=read_nav2(directory / "map.yaml") if (directory / "map.yaml").exists() else None,
        images=lambda: _images(directory, run.time, warn),
    )


def _images(
    directory: Path, time: np.ndarray, warn: Callable[[str], None]
) -> Iterator[tuple[int, np.ndarray]]:
    """Whisker images of the run directory, or the views of its recording if that is still there; none for a
    simulation, which would have to be repeated."""
    if (directory / "views.npz").exists():
        views = read_whisker_views(directory / "views.npz").view
        yield from enumerate(_pixels(view[..., None]) for view in views[: len(time)])
        return
    try:
        config = load_config(directory / "config.yaml")
        if config.recording is None:
            return
        digest = read_manifest(directory).digest
        with open_observations(config) as (_, source):
            if source.digest != digest:
                cure = "the views are those of another recording"
                raise InputError(source.name, "changed since the run", "the recording of the run", cure)
            step = 0
            for sample, observation in read_observations(source):
                if step == len(time):
                    return
                if sample.time != time[step]:  # a continued run starts later in its recording
                    continue
                if observation.view_seen and observation.view.size:
                    yield step, _pixels(observation.view)
                step += 1
    except InputError as error:
        warn(f"the file has no views: {error}")


def _pixels(view: np.ndarray) -> np.ndarray:
    """A view in 0..1 as 8-bit pixels."""
    return np.rint(255 * np.clip(view, 0.0, 1.0)).astype(np.uint8)


GREY, GREEN, ORANGE, RED = (
    (0.5, 0.5, 0.5, 0.6),
    (0.1, 0.6, 0.2, 0.9),
    (0.9, 0.5, 0.1, 0.4),
    (0.8, 0.1, 0.1, 0.4),
)
VERDICTS = {"accepted": GREEN, "open": ORANGE, "undone": RED}
"""Colours of the candidates for loop closures by verdict."""
THIN, THICK = 0.1, 0.3
"""Width of links, and diameter of experiences, as shares of the median distance of linked experiences."""
LATCHED = ("/path/map", "/path/odometry", "/path/truth", "/map", "/markers")
"""Topics with one message, at the first stamp: late subscribers get it too."""


def _messages(exported: _ExportedRun, ros: RosMessages) -> Iterator[tuple[str, int, Any]]:
    """All messages of a run in order of time, each with its topic and its stamp in ns."""
    first = int(exported.stamps[0])
    for topic, message in _latched_messages(exported, ros, first):
        yield (topic, first, message)
    run = exported.run
    images = exported.images()
    image = next(images, None)
    start = inverse(run.odometry[0])  # so that odom and map agree at the first step
    odometry = compose(compose(run.online[0], start), run.odometry)
    twist = np.zeros_like(odometry)  # mean velocity of each step in its own frame; 0 without a duration
    duration = np.diff(run.time)[:, None]
    np.divide(between(odometry[:-1], odometry[1:]), duration, out=twist[1:], where=duration > 0)
    offset = compose(run.online, inverse(odometry))
    for step, stamp in enumerate(exported.stamps.tolist()):
        yield ("/tf", stamp, ros.transforms(stamp, offset[step], odometry[step]))
        yield ("/odom", stamp, ros.odometry(stamp, odometry[step], twist[step]))
        yield ("/pose", stamp, ros.pose(stamp, run.online[step], exported.spread[step]))
        if image is not None and image[0] == step:
            yield ("/view", stamp, ros.image(stamp, image[1]))
            image = next(images, None)


def _latched_messages(exported: _ExportedRun, ros: RosMessages, first: int) -> Iterator[tuple[str, Any]]:
    run, stamps = exported.run, exported.stamps
    yield "/path/map", ros.path(stamps, run.final)
    own = compose(inverse(run.odometry[0]), run.odometry)
    yield "/path/odometry", ros.path(stamps, compose(run.online[0], own))
    if exported.truth is not None:
        known = np.isfinite(exported.truth).all(axis=1)
        yield "/path/truth", ros.path(stamps[known], exported.truth[known])
    if exported.grid is not None:
        yield "/map", ros.grid(first, exported.grid)
    if markers := _markers(exported, ros, first):
        yield "/markers", ros.markers(markers)


def _markers(exported: _ExportedRun, ros: RosMessages, stamp: int) -> list[Any]:
    """Experiences and their links, and the candidates for loop closures by verdict."""
    run, parts = exported.run, []
    nodes, links = run.nodes[:, :2], run.links
    between_nodes = np.hypot(*(nodes[links[:, 0]] - nodes[links[:, 1]]).T) if len(links) else np.zeros(0)
    size = float(np.median(between_nodes)) if len(links) else 0.1
    if len(nodes):
        parts.append(ros.marker(stamp, "graph/experiences", POINTS, nodes, GREY, THICK * size))
    if len(links):
        parts.append(ros.marker(stamp, "graph/links", LINES, nodes[links].reshape(-1, 2), GREY, THIN * size))
    for verdict, colour in VERDICTS.items():
        chosen = exported.candidates[np.array(exported.verdicts, dtype=str) == verdict]
        if len(chosen):
            ends = run.final[chosen, :2].reshape(-1, 2)
            parts.append(ros.marker(stamp, f"closures/{verdict}", LINES, ends, colour, THIN * size))
    return parts


def write_mcap(path: Path, exported: _ExportedRun, ros: RosMessages) -> dict[str, tuple[str, int]]:
    """Writes an MCAP file with the ROS 2 profile; equal runs give equal bytes.

    Returns:
        its topics, each with its message type and the number of its messages.
    """
    kinds: dict[str, str] = {}
    channels: dict[str, int] = {}
    counts: dict[str, int] = {}
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="ratslam")
        schemas: dict[str, int] = {}
        for topic, stamp, message in _messages(exported, ros):
            if topic not in channels:
                kind = message.__msgtype__
                if kind not in schemas:
                    schemas[kind] = writer.register_schema(kind, "ros2msg", ros.definition(kind).encode())
                profile = {"offered_qos_profiles": _quality_of_service(topic)}
                channels[topic] = writer.register_channel(topic, "cdr", schemas[kind], profile)
                kinds[topic], counts[topic] = kind, 0
            writer.add_message(channels[topic], stamp, ros.serialize(message), stamp, counts[topic])
            counts[topic] += 1
        writer.finish()
    return {topic: (kind, counts[topic]) for topic, kind in kinds.items()}


def write_bag(folder: Path, name: str, exported: _ExportedRun, ros: RosMessages) -> None:
    """Writes a ROS 2 bag into an existing folder: NAME_0.mcap and metadata.yaml."""
    file = f"{name}_0.mcap"
    topics = write_mcap(folder / file, exported, ros)
    first, last = int(exported.stamps[0]), int(exported.stamps[-1])
    span = {
        "duration": {"nanoseconds": last - first},
        "starting_time": {"nanoseconds_since_epoch": first},
        "message_count": sum(count for _, count in topics.values()),
    }
    information = {
        "version": 5,
        "storage_identifier": "mcap",
        **span,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": name,
                    "type": kind,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": _quality_of_service(name),
                },
                "message_count": count,
            }
            for name, (kind, count) in topics.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file],
        "files": [{"path": file, **span}],
    }
    text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
    (folder / "metadata.yaml").write_text(text, encoding="utf-8")


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
