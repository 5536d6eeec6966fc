"""What a recording holds, whether it can be read, and the configuration that reads it, as a `Diagnosis`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ratslam.runs.build_session import open_source
from ratslam.runs.map_settings import Sensor, check_same_fov, differing_settings, settings_of_map
from ratslam.runs.saved_map import SavedMap
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import (
    FOLDER,
    RECORDING,
    dump_data,
    kind_of,
    override,
    parse,
    refuse_other_files,
    validate,
)
from ratslam.service.record_fit import shows_place
from ratslam.service.rig_fit import aligned
from robot.recordings.bags.bag import METADATA
from robot.recordings.bags.bag_description import Times
from robot.recordings.bags.views import CLOUD, IMAGES, LONGEST, SCAN
from robot.recordings.input_judge import MotionTrack, typical_motion
from robot.recordings.video import SUFFIXES as VIDEOS
from robot.recordings.video import ImageViewConfig
from robot.sources.source import SOURCES, Source
from tactile.base.errors import InputError, printable

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
SUFFIXES = (".csv", ".npz", ".mcap", *VIDEOS)
"""Of files that are read; besides them a folder, `.bag` and `.db3` are bags."""


class Diagnosis(NamedTuple):
    """What was found.

    Attributes:
        what: one line. table: rows of cells, the first row the heading; may be empty. notes: facts.
            faults: what prevents a run, or speaks against a map. advice: what to do next.
            config: sections of a configuration that reads the recording, {} if there is none.
    """

    what: str
    table: tuple[tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
    config: dict[str, Any] = {}  # noqa: RUF012

    def render(self) -> str:
        """The diagnosis as lines of text."""
        lines = [self.what, *(f"  {line}".rstrip() for line in aligned(self.table))]
        for mark, texts in (("", self.notes), ("fault: ", self.faults), ("next: ", self.advice)):
            lines += [f"{mark}{text}" for text in texts]
        return "\n".join(map(printable, lines))


_Found = tuple[Diagnosis, float, float | None]
"""What a file holds: the diagnosis, with the settings of `recording` that read it, besides `file`, if any do;
and of its ranges, NaN and None without any, the largest (m) and the field of view (rad)."""


def _describe_file(path: Path) -> _Found:
    """What a recording holds."""
    from robot.recordings.mcap_reader import is_foreign
    from robot.recordings.npz_trace import array_shapes

    if not path.exists():
        raise InputError(str(path), "no such file or folder", "a recording or a run directory")
    suffix = path.suffix.lower()
    if path.is_dir() or suffix in (".bag", ".db3") or (suffix == ".mcap" and is_foreign(path)):
        return _describe_bag(path)
    if suffix not in SUFFIXES:
        found = f"no reader for {path.suffix!r} files" if path.suffix else "a file without a suffix"
        known = ", ".join([*SUFFIXES, ".bag", ".db3"])
        raise InputError(str(path), found, f"one of {known}, or the folder of a bag")
    if suffix == ".csv":
        return _describe_csv(path)
    if suffix == ".npz":
        shapes = array_shapes(path).items()
        rows = (("array", "shape"), *((name, " x ".join(map(str, shape))) for name, shape in shapes if shape))
        return Diagnosis(f"{path}: arrays of a reference trace", rows, config={"recording": {}}), np.nan, None
    if suffix == ".mcap":
        return Diagnosis(f"{path}: a recording of ratslam", config={"recording": {}}), np.nan, None
    return _describe_video(path)


def _describe_csv(path: Path) -> _Found:
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
    config = {"recording": {"table": found.table}} if found.table else {}
    return Diagnosis(what, rows, tuple(notes), tuple(faults), config=config), found.max_range, None


def _describe_bag(path: Path) -> _Found:
    from robot.recordings.bags.bag_description import describe_bag, robots_of, suggested_topics

    found = describe_bag(path)
    rows = [("topic", "type", "messages", "Hz", "holds", "serves as")]
    notes, faults = list(found.notes), []
    for topic in found.topics:
        clock = topic.stamped or topic.received
        roles, words = ", ".join(topic.roles) or "-", topic.shape.words if topic.shape else ""
        rows.append((topic.name, topic.kind, str(topic.total), f"{clock.rate_hz:.3g}", words, roles))
        if topic.roles:
            notes += _clock_notes(topic.name, clock)
    moving = [f"{parent} -> {child}" for parent, child, fixed, _ in found.links if not fixed]
    if found.links:
        still = len(found.links) - len(moving)
        notes.append(f"frames: {', '.join(moving) or 'none moves'}; {still} fixed link{'s' * (still != 1)}")
    topics = suggested_topics(found)
    if not topics:
        faults.append("no topic can serve as odometry: Odometry, TwistStamped, PoseStamped, tf, or images")
    sees = {"views", "touch", "wrench"} & topics.keys()
    for topic in found.topics:
        if topic.fault:
            (notes if sees or topic.kind not in VIEWS else faults).append(topic.fault)
    if faults:
        return Diagnosis(f"{path}: a bag", tuple(rows), tuple(notes), tuple(faults)), np.nan, None
    notes += [
        f"missing: {name}"
        for name in ("views", "truth")
        if name not in topics and not (name == "views" and sees)
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
    views = topics.get("views")
    seen = views if isinstance(views, str) or views is None else views["topic"]
    kind, shape = next(((each.kind, each.shape) for each in found.topics if each.name == seen), ("", None))
    fov, reach = None, np.nan  # the range that becomes 1 in the views, m; of images there is none
    if shape is not None and shape.extent is not None:
        fov = 2 * np.pi if shape.extent.ring else shape.extent.width
        reach = min(shape.high, LONGEST)
    elif kind == CLOUD:
        reach = LONGEST
    elif shape is not None and kind in IMAGES:
        width, height = shape.size
        if height < SMALL.rows or width < SMALL.columns:
            recording["image"] = {"rows": min(height, SMALL.rows), "columns": min(width, SMALL.columns)}
    config = {"recording": recording}
    return Diagnosis(what, tuple(rows), tuple(notes), tuple(faults), config=config), reach, fov


def _clock_notes(name: str, clock: Times) -> list[str]:
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


def _describe_video(path: Path) -> _Found:
    from robot.recordings.video import describe_video

    frames, rate, width, height = describe_video(path)
    what = f"{path}: a video of {frames} frames, {width} x {height}, {rate:g} a second"
    if not rate > 0:
        fault = "it states no frame rate: set recording.video.rate, or stamps, a CSV file of times"
        return Diagnosis(what, faults=(fault,)), np.nan, None
    recording = {"video": {"rate": rate}, "visual_odometry": {"fov_deg": USUAL_FOV}}
    return Diagnosis(what, notes=(NO_WHEELS,), config={"recording": recording}), np.nan, None


CELLS_IN_RANGE = 13
"""Pose cells in the range of the sensor, as in the configurations of real buildings."""
DEFAULT_CELL = 0.1
"""Side of a pose cell of a robot that does not move, m."""
TORUS = 61
"""Cells along x and y: buildings overlap less on a larger torus, and a step costs no more."""
UNREADABLE = "no configuration reads it: see what is missing"


def diagnose_recording(path: Path, like: SavedMap | None = None) -> Diagnosis:
    """What a recording is, whether it can be read, and the configuration that reads it.

    Args:
        like: a map; the configuration then has its view, cells and method. Another sensor is a fault.

    Raises:
        InputError: it is missing, or of no known format.
    """
    path = path.parent if path.name == METADATA and kind_of(path.parent) == RECORDING else path
    refuse_other_files(path, "a recording", (RECORDING, FOLDER))
    if path.is_file() and path.suffix.lower() in (".yaml", ".yml"):
        cure = f"`run {path}` maps what it names, `doctor --live {path}` checks its robot"
        raise InputError(str(path), "a configuration", "a recording or a run directory", cure)
    try:
        found, reach, fov = _describe_file(path)
    except InputError:
        if path.is_file() and (diagnosis := _diagnose_registered(path)):
            return diagnosis
        raise
    if not found.config:
        if diagnosis := _diagnose_registered(path):
            return diagnosis
        return found._replace(faults=found.faults or (UNREADABLE,))
    recording = {"file": str(path.resolve()), **found.config["recording"]}
    sections: dict[str, Any] = {"recording": recording}
    if "visual_odometry" in recording:
        sections["presets"] = ["visual_odometry"]
    told, faults, step, whiskers = list[str](), found.faults, 0.0, 0
    facts: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
    try:
        if like is not None:
            sections = _alike(sections if fov is None else sections | {"recall": {"sector_fov": fov}}, like)
        with open_source(validate(parse(dump_data(sections), path.name), RunConfig), told.append) as source:
            facts, advice, step = _summarise(source)
            whiskers = source.whiskers
    except InputError as error:
        faults = (*faults, *str(error).splitlines())
    if like is None and not whiskers and "wrench" not in recording.get("topics", ()):
        # A share of the sensor's range, else the motion between views.
        size = reach / CELLS_IN_RANGE if np.isfinite(reach) else step or DEFAULT_CELL
        sections["pose_cells"] = {"cells_xy": TORUS, "cell_size": float(f"{size:.2g}")}
        if fov is not None:
            sections["recall"] = {"sector_fov": round(fov, 4)}
    return Diagnosis(found.what, found.table, (*found.notes, *told, *facts), faults, advice, sections)


def _alike(sections: dict[str, Any], like: SavedMap) -> dict[str, Any]:
    """The sections with all settings in which view, cells or method of a map differ from theirs."""
    name = f"doctor --like {like.path}"
    document = override(parse(dump_data(sections), name), [f"backend={like.config.backend}"])
    given = validate(document, RunConfig)
    check_same_fov(str(like.path), like.config, given)
    with open_source(given) as source:
        config = complete(given, source)
        found = like.sensor.differences(Sensor.of(config, source))
    settings = settings_of_map(found)
    if settings is None:
        like.sensor.check_same(str(like.path), Sensor.of(config, source))
    method = differing_settings([like.config, config])
    settings = {key: both[0] for key, both in method.items()} | (settings or {})
    return override(document, [f"{key}={json.dumps(value)}" for key, value in settings.items()]).data


def _diagnose_registered(path: Path) -> Diagnosis | None:
    """A recording that a registered source reads, whose only setting without default is `file`; None if no
    source does."""
    for name in SOURCES.names():
        sections = {"source": {"plugin": name, "settings": {"file": str(path.resolve())}}}
        try:
            fields = SOURCES.get(name, "source").config_class.model_fields
            if [key for key, field in fields.items() if field.is_required()] != ["file"]:
                continue
            with open_source(validate(parse(dump_data(sections), path.name), RunConfig)) as source:
                facts, advice, _ = _summarise(source)
        except Exception:  # whatever a package does with a file that is not its own
            continue
        what = f"{path}: a recording that the source {name} reads"
        return Diagnosis(what, notes=facts, advice=advice, config=sections)
    return None


def _summarise(source: Source) -> tuple[tuple[str, ...], tuple[str, ...], float]:
    """Reads all samples of a source.

    Returns:
        what they hold, and what they lack for a good map, in words; median motion between two views, m.
    """
    motions, times, truths, views = [], [], 0, []
    for sample in source:
        motions.append(np.asarray(sample.reading.odometry, float))
        times.append(sample.time)
        truths += sample.truth is not None
        views.append(shows_place(sample.reading))
    motion, time, viewed = np.array(motions).reshape(-1, 4), np.array(times), np.array(views, bool)
    length = np.hypot(motion[:, 0], motion[:, 1])
    between = np.diff(np.cumsum(length)[viewed])
    moved = between[between > 0]
    step = float(np.median(moved)) if len(moved) else 0.0
    facts, path = [], float(length.sum())
    if len(time) > 1:
        typical = typical_motion(MotionTrack(time, np.ones(len(time), bool), motion, None))
        facts.append(
            f"odometry: {path:.3g} m, typically {typical.speed:.2g} m/s and "
            f"{typical.turn_rate:.2g} rad/s, a sample every {typical.interval:.2g} s"
        )
    shape = " x ".join(map(str, source.view_shape[:2]))
    kind = f"of {source.whiskers} whiskers" if source.whiskers else f"of {shape} values"
    facts.append(f"views: {viewed.sum()} {kind}, {step:.2g} m apart")
    facts.append(f"truth: for {truths / len(time):.0%} of the samples" if truths else "truth: unknown")
    advice = []
    if not viewed.any():
        advice.append("without views or place labels no place is recognised: the map is the odometry")
    if path == 0:
        advice.append("the odometry does not move: check its topic or columns")
    return tuple(facts), tuple(advice), step
