"""The kinds of recordings, and what a file of each kind holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robot.recordings.bags.bag_description import (
    BagDescription,
    CloudShape,
    ImageShape,
    MotionShape,
    ScanShape,
    Shape,
    Times,
    ValueShape,
)
from robot.recordings.bags.images import IMAGES
from robot.recordings.bags.scans import CLOUD, SCAN
from robot.recordings.bags.views import LONGEST
from robot.recordings.camera.image_view import ImageViewConfig
from robot.recordings.camera.video import SUFFIXES as VIDEOS
from tactile.base.errors import InputError

LONG_GAP = 5.0
"""Steps of a topic after which a pause is a gap."""
USUAL_FOV = 60.0
"""Horizontal field of view of most cameras, degrees."""
NO_WHEELS = (
    f"odometry: from the images, without scale, for a camera of {USUAL_FOV:g} degrees; set "
    "recording.visual_odometry.fov_deg to yours, or give wheel odometry"
)
VIEWS = (SCAN, CLOUD, *IMAGES)
"""Types of messages that are views."""
SMALL = ImageViewConfig()
"""Smaller images are views of their own size."""
Rows = tuple[tuple[str, ...], ...]


class FileContents(NamedTuple):
    """What a file holds.

    Attributes:
        what: one line. recording: settings of `recording` that read it, besides `file`; None if none do.
        table, notes, faults: as in `Diagnosis`. max_range: of its ranges, m, NaN without ranges.
        field_of_view: of its ranges, rad, counter-clockwise positive; None if unknown.
    """

    what: str
    recording: dict[str, Any] | None
    table: Rows = ()
    notes: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    max_range: float = np.nan
    field_of_view: float | None = None


def describe_file(path: Path) -> FileContents:
    """What a recording holds.

    Raises:
        InputError: it is missing, damaged, or of no known format.
    """
    if not path.exists():
        raise InputError(str(path), "no such file or folder", "a recording or a run directory")
    if path.is_dir() or path.suffix.lower() in (".bag", ".db3"):
        return _bag(path)
    describe = KINDS.get(path.suffix.lower())
    if describe is None:
        found = f"no reader for {path.suffix!r} files" if path.suffix else "a file without a suffix"
        raise InputError(
            str(path), found, f"one of {', '.join([*KINDS, '.bag', '.db3'])}, or the folder of a bag"
        )
    return describe(path)


def _csv(path: Path) -> FileContents:
    from robot.recordings.csv_description import describe_csv

    found = describe_csv(path.resolve())  # the settings name files beside it, from any folder
    columns = [(name, f"{low:.6g}", f"{high:.6g}") for name, low, high in found.columns]
    rows = (("column", "from", "to"), *columns)
    notes, faults = list(found.parts.values()), []
    what = f"{path}: a CSV file, {found.rows} row{'s' * (found.rows != 1)}"
    if found.time is not None:
        what += f" over {found.time[-1] - found.time[0]:.6g} s"
        steps = np.diff(found.time) if len(found.time) > 1 else np.zeros(1)
        if np.median(steps) <= 0 or not steps.max() > 0:
            faults.append("its times do not increase")
        elif steps.max() > 10 * np.median(steps):
            notes.append(f"longest gap: {steps.max():.3g} s after t = {found.time[steps.argmax()]:.6g} s")
    if found.missing:
        notes.append(f"missing: {'; '.join(found.missing)}")
    table = {"table": found.table} if found.table else None
    return FileContents(what, table, rows, tuple(notes), tuple(faults), found.max_range)


def _npz(path: Path) -> FileContents:
    from robot.recordings.npz_trace import array_shapes

    shapes = [(name, " x ".join(map(str, shape))) for name, shape in array_shapes(path).items() if shape]
    return FileContents(f"{path}: arrays of a reference trace", {}, (("array", "shape"), *shapes))


def _mcap(path: Path) -> FileContents:
    from robot.recordings.mcap_scanner import is_foreign

    if is_foreign(path):
        return _bag(path)
    return FileContents(f"{path}: a recording of ratslam", {})


def _bag(path: Path) -> FileContents:
    from robot.recordings.bags.bag_description import describe_bag
    from robot.recordings.bags.topic_suggestion import robots_of, suggested_topics

    found = describe_bag(path)
    rows = [("topic", "type", "messages", "Hz", "holds", "serves as")]
    notes, faults = list(found.notes), []
    for topic in found.topics:
        clock = topic.stamped or topic.received
        roles = ", ".join(topic.roles) or "-"
        rows.append(
            (topic.name, topic.kind, str(topic.total), f"{clock.rate_hz:.3g}", in_words(topic.shape), roles)
        )
        if topic.roles:
            notes += clock_notes(topic.name, clock)
    moving = [f"{link.parent} -> {link.child}" for link in found.links if not link.fixed]
    if found.links:
        fixed = len(found.links) - len(moving)
        notes.append(f"frames: {', '.join(moving) or 'none moves'}; {fixed} fixed link{'s' * (fixed != 1)}")
    topics = suggested_topics(found)
    if not topics:
        faults.append("no topic can serve as odometry: Odometry, TwistStamped, PoseStamped, tf, or images")
    sees = {"views", "touch"} & topics.keys()
    for topic in found.topics:
        if topic.fault:
            (notes if sees or topic.kind not in VIEWS else faults).append(topic.fault)
    if faults:
        return FileContents(f"{path}: a bag", None, tuple(rows), tuple(notes), tuple(faults))
    notes += [
        f"missing: {name}"
        for name in ("views", "truth")
        if name not in topics and not (name == "views" and "touch" in topics)
    ]
    start = min(topic.received.first for topic in found.topics)
    end = max(topic.received.last for topic in found.topics)
    what = f"{path}: a bag of {len(found.topics)} topics over {end - start:.4g} s"
    recording: dict[str, Any] = {"topics": topics}
    if "tf" in (topics.get("odometry") or ()) and (others := robots_of(found)[1:]):
        named = ", ".join(f"[{parent}, {child}]" for parent, child in others)
        notes.append(f"other robots: {named}; name one with recording.topics.odometry.tf")
    if "odometry" not in topics:
        recording["visual_odometry"] = {"fov_deg": USUAL_FOV}
        notes.append(NO_WHEELS)
    shape = _shape_of_views(found, topics)
    fov = None
    if isinstance(shape, ScanShape):
        fov = 2 * np.pi if shape.extent.ring else shape.extent.width
    if isinstance(shape, ImageShape) and (shape.height < SMALL.rows or shape.width < SMALL.columns):
        size = {"rows": min(shape.height, SMALL.rows), "columns": min(shape.width, SMALL.columns)}
        recording["image"] = size
    return FileContents(what, recording, tuple(rows), tuple(notes), tuple(faults), _reach(shape), fov)


def clock_notes(name: str, clock: Times) -> list[str]:
    """What is remarkable about the stamps of a topic."""
    counts = {
        "a stamp of 0": clock.zero,
        "the stamp of the message before": clock.repeated,
        "an earlier stamp than the message before": clock.backwards,
    }
    notes = [f"{name}: {count} messages have {words}" for words, count in counts.items() if count]
    if 0.5 < clock.ahead < 1e6:
        cure = "if those of others are not, --set recording.topics.clock=bag"
        notes.append(f"{name}: stamps are {clock.ahead:.3g} s ahead of their receipt; {cure}")
    if clock.rate_hz and clock.gap > LONG_GAP / clock.rate_hz:
        notes.append(f"{name}: longest gap {clock.gap:.3g} s after {clock.gap_at:.6f} s")
    return notes


def in_words(shape: Shape | None) -> str:
    """What the messages of a topic hold."""
    match shape:
        case ScanShape():
            width = np.degrees(abs(shape.extent.width))
            turn = "all around" if shape.extent.ring else f"over {width:.0f} degrees"
            return f"{shape.beams} beams {turn}, median {shape.median:.2g} m, {shape.nothing:.0%} empty"
        case CloudShape():
            return f"{shape.points} points, median {shape.reach:.2g} m away"
        case ImageShape():
            return f"{shape.width} x {shape.height} {shape.encoding}, mean grey {shape.grey:.0f}"
        case ValueShape():
            return f"{' x '.join(map(str, shape.sizes))} values from {shape.low:.3g} to {shape.high:.3g}"
        case MotionShape():
            poses, twists = (shape.pose_path, shape.pose_speed), (shape.twist_path, shape.twist_speed)
            path, speed = poses if np.isfinite(shape.pose_path) else twists
            return f"{path:.3g} m at {speed:.2g} m/s"
    return ""


def _shape_of_views(bag: BagDescription, topics: dict[str, Any]) -> Shape | None:
    """What the topic of the views holds."""
    views = topics.get("views")
    name = views if isinstance(views, str) or views is None else views["topic"]
    return next((topic.shape for topic in bag.topics if topic.name == name), None)


def _reach(shape: Shape | None) -> float:
    """The range that becomes 1 in the views, m; NaN for images."""
    if isinstance(shape, ScanShape):
        return min(shape.high, LONGEST)
    return LONGEST if isinstance(shape, CloudShape) else np.nan


def _video(path: Path) -> FileContents:
    from robot.recordings.camera.video import describe_video

    frames, rate, width, height = describe_video(path)
    what = f"{path}: a video of {frames} frames, {width} x {height}, {rate:g} a second"
    if not rate > 0:
        fault = "it states no frame rate: set recording.video.rate, or stamps, a CSV file of times"
        return FileContents(what, None, faults=(fault,))
    recording = {"video": {"rate": rate}, "visual_odometry": {"fov_deg": USUAL_FOV}}
    return FileContents(what, recording, notes=(NO_WHEELS,))


KINDS: dict[str, Callable[[Path], FileContents]] = {
    ".csv": _csv,
    ".npz": _npz,
    ".mcap": _mcap,
    **dict.fromkeys(VIDEOS, _video),
}
"""By suffix; a folder, `.bag` and `.db3` are bags."""
