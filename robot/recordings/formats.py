"""Recording formats: one entry per format in `FORMATS`."""

from __future__ import annotations

from collections.abc import Callable

from robot.recordings.bags.topics_config import TopicsConfig
from robot.recordings.input_judge import InputJudge
from robot.recordings.recording_config import RecordingConfig
from robot.recordings.sanity_checks import Stretch
from robot.recordings.video import SUFFIXES as VIDEO_SUFFIXES
from robot.sources.input_files import require_file
from robot.sources.odometry import correct_odometry
from robot.sources.source import SOURCES, Source, SourceEntry, Warn
from tactile.base.errors import InputError
from tactile.base.plugins import read_settings


def _open_mcap(config: RecordingConfig, judge: InputJudge) -> Source:
    from robot.recordings.mcap_reader import Recording
    from robot.recordings.mcap_scanner import is_foreign

    if is_foreign(config.file):
        return _open_bag(config, judge)
    return Recording(config.file, judge)


def _open_bag(config: RecordingConfig, judge: InputJudge) -> Source:
    from robot.recordings.bags.bag_reader import read_bag

    return read_bag(
        config.file,
        config.topics or TopicsConfig(),
        judge,
        image=config.image,
        visual_odometry=config.visual_odometry,
    )


def _open_npz(config: RecordingConfig, judge: InputJudge) -> Source:
    from robot.recordings.npz_trace import read_trace

    return read_trace(config.file, judge)


def _open_csv(config: RecordingConfig, judge: InputJudge) -> Source:
    from robot.recordings.csv_reader import read_csv_recording

    return read_csv_recording(config.file, config.table, judge)


def _open_video(config: RecordingConfig, judge: InputJudge) -> Source:
    from robot.recordings.video_recording import read_video

    return read_video(config, judge)


FORMATS: dict[str, Callable[[RecordingConfig, InputJudge], Source]] = {
    ".mcap": _open_mcap,
    ".npz": _open_npz,
    ".csv": _open_csv,
    ".bag": _open_bag,
    ".db3": _open_bag,
    **dict.fromkeys(VIDEO_SUFFIXES, _open_video),
}


def open_recording(config: RecordingConfig, warn: Warn = None) -> Source:
    """Open a recording, in the format of its suffix, and check all of it. A folder, and every recording with
    `topics`, is a bag.

    Args:
        warn: called with one sentence if only a part of the recording is readable.

    Raises:
        InputError: the file is missing, its format is unknown, or it has errors.
    """
    stretch = Stretch(getattr(config, "from"), config.to)
    judge = InputJudge(config.limits, config.odometry, warn, stretch)
    return correct_odometry(_open(config, judge), config.odometry)


def _open(config: RecordingConfig, judge: InputJudge) -> Source:
    """The recording as it is."""
    suffix = config.file.suffix.lower()
    if config.topics is not None or (config.file / "metadata.yaml").is_file():
        return _open_bag(config, judge)
    if suffix in FORMATS:
        return FORMATS[suffix](config, judge)
    registered, broken = _registered_formats()
    if suffix not in registered:
        require_file(config.file)
        found = f"no reader for {config.file.suffix!r} files" if suffix else "a file without a suffix"
        cure = "; ".join(error.found for error in broken)
        raise InputError(str(config.file), found, f"one of {', '.join([*FORMATS, *registered])}", cure)
    entry = registered[suffix]
    settings = read_settings(entry.config_class, {"file": str(config.file)}, "recording")
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
