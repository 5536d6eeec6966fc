"""Recording formats: which reader opens a file, by its suffix."""

from __future__ import annotations

from robot.recordings.input_judge import InputJudge
from robot.recordings.recording_config import RecordingConfig
from robot.recordings.sanity_checks import Stretch
from robot.recordings.video import SUFFIXES as VIDEO_SUFFIXES
from robot.sources.input_files import require_file
from robot.sources.odometry import correct_odometry
from robot.sources.source import SOURCES, Source, SourceEntry, Warn
from tactile.base.errors import InputError
from tactile.base.plugins import read_settings
from tactile.pokes import DEFAULT_POKES, PokeConfig

BAGS = (".bag", ".db3")
FORMATS = (".mcap", ".npz", ".csv", *BAGS, *VIDEO_SUFFIXES)
"""Suffixes of the files that are read without a plug-in."""


def open_recording(config: RecordingConfig, warn: Warn = None, pokes: PokeConfig = DEFAULT_POKES) -> Source:
    """Open a recording, in the format of its suffix, and check all of it. A folder, and every recording with
    `topics`, is a bag.

    Args:
        warn: called with one sentence if only a part of the recording is readable. pokes: of another
            program, whose wrench and pose a bag has.

    Raises:
        InputError: the file is missing, its format is unknown, or it has errors.
    """
    stretch = Stretch(getattr(config, "from"), config.to)
    judge = InputJudge(config.limits, config.odometry, warn, stretch)
    return correct_odometry(_open(config, judge, pokes), config.odometry)


def _open(config: RecordingConfig, judge: InputJudge, pokes: PokeConfig) -> Source:
    """The recording as it is. Readers are imported when they are needed: some are slow to load."""
    file = config.file
    if file is None:
        raise InputError("recording.file", "missing", "the path of a recording")
    suffix = file.suffix.lower()
    if suffix == ".mcap":
        from robot.recordings.mcap_reader import is_foreign
    whole = config.topics is not None or (file / "metadata.yaml").is_file()
    if whole or suffix in BAGS or (suffix == ".mcap" and is_foreign(file)):
        from robot.recordings.bags.bag_reader import read_bag

        return read_bag(config, judge, pokes)
    if suffix == ".mcap":
        from robot.recordings.mcap_reader import Recording

        return Recording(file, judge)
    if suffix == ".npz":
        from robot.recordings.npz_trace import read_trace

        return read_trace(file, judge)
    if suffix == ".csv":
        from robot.recordings.csv_reader import read_csv_recording

        return read_csv_recording(file, config.table, judge)
    if suffix in VIDEO_SUFFIXES:
        from robot.recordings.video_recording import read_video

        return read_video(config, judge)
    registered, broken = _registered_formats()
    if suffix not in registered:
        require_file(file)
        found = f"no reader for {file.suffix!r} files" if suffix else "a file without a suffix"
        cure = "; ".join(error.found for error in broken)
        raise InputError(str(file), found, f"one of {', '.join([*FORMATS, *registered])}", cure)
    entry = registered[suffix]
    settings = read_settings(entry.config_class, {"file": str(file)}, "recording")
    return entry.open(settings, judge.warn)


def _registered_formats() -> tuple[dict[str, SourceEntry], list[InputError]]:
    """The registered sources that read files, by suffix, and the errors of those that cannot be loaded."""
    formats, broken = dict[str, SourceEntry](), list[InputError]()
    for name in SOURCES.names():
        try:
            entry = SOURCES.get(name, "recording.file")
        except InputError as error:
            broken.append(error)
        else:
            formats |= {suffix.lower(): entry for suffix in entry.suffixes}
    return formats, broken
