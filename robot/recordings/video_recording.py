"""A video as a recording: views of its frames; odometry from a CSV file or from the frames themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot.recordings.alignment import judged
from robot.recordings.csv_file import read_csv
from robot.recordings.csv_reader import ODOMETRY, align_truth, column_keys, each_nearest, read_csv_recording
from robot.recordings.input_judge import InputJudge
from robot.recordings.recording_config import RecordingConfig
from robot.recordings.sanity_checks import clock_errors
from robot.recordings.video import VideoConfig, camera_rows, video_frames
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of, raise_errors, require_file
from tactile.base.errors import InputError


def read_video(config: RecordingConfig, judge: InputJudge) -> InMemorySource:
    """A video as a `Source`: one sample per frame, or per odometry row where there is odometry.

    Raises:
        InputError: the video or a file beside it cannot be read, settings contradict each other, or times do
            not fit.
    """
    path, video = config.file, config.video
    assert path is not None
    require_file(path)
    raise_errors(_contradictions(config))
    wheels = None
    if video.odometry is not None:
        wheels = read_csv_recording(video.odometry, config.table, judge)
    stamps = read_csv(video.stamps) if video.stamps is not None else None
    if stamps is not None:
        raise_errors(stamps.absences([(video.time, "video.time")]))
        moments = stamps.column(video.time, "time")
        raise_errors(stamps.judge([video.time])[1] + clock_errors(moments, video.time, stamps.place))
    visual = config.visual_odometry if wheels is None else None
    frames = video_frames(path, video, stamps, judge.warn)
    time, view, motion = camera_rows(frames, config.image, visual, str(path))
    digest = digest_of([path, b"" if stamps is None else stamps.content])
    inside = judge.stretch.rows(time, str(path))
    time, view = time[inside], view[inside]
    if wheels is not None:
        source = replace(wheels, name=path.stem, digest=digest_of([digest.encode(), wheels.digest.encode()]))
        return _with_views(source, time, view, video, str(path))
    assert motion is not None  # `_contradictions` requires visual odometry
    motion = motion[inside]
    motion[:1] = 0.0
    truth = None
    if config.table.truth is not None and config.table.truth.file is not None:
        file = read_csv(config.table.truth.file, config.table.units.time)
        raise_errors(file.absences(column_keys(config.table.truth, "table.truth")))
        truth, errors = align_truth(file, config.table.truth, time, judge, same_rows=False)
        raise_errors(errors)
    everywhere = np.ones(len(time), bool)
    source = InMemorySource(
        name=path.stem,
        digest=digest,
        time=time,
        motion=motion,
        moved=everywhere,
        views=view,
        seen=everywhere,
        label=np.full(len(time), -1, np.int32),
    )
    place = lambda row: f"{path}, frame {row * video.every}"  # noqa: E731
    # Visual odometry has no scale, so its lengths cannot be compared with those of the truth.
    return replace(judged(source, [], judge, str(path), place), truth=truth)


def _contradictions(config: RecordingConfig) -> list[InputError]:
    """Errors for settings that exclude or need each other."""
    video, table, where = config.video, config.table, str(config.file)
    errors = []
    if video.rate is not None and video.stamps is not None:
        errors.append(InputError(where, "both video.rate and video.stamps are given", "one of them"))
    if table.views is not None:
        found = "table.views is given, and the video has views"
        errors.append(InputError(where, found, "views from one of them"))
    if video.odometry is not None:
        return errors
    if config.visual_odometry is None:
        angle = "set visual_odometry.fov_deg to the camera's horizontal field of view"
        cure = f"{angle}, or video.odometry to a CSV"
        errors.append(InputError(where, "no odometry", "visual odometry or wheel odometry", cure))
    given = [key for key in (*ODOMETRY, "labels", "pairs") if getattr(table, key) is not None]
    if given:
        found = f"table.{given[0]} is given, but no file that has it"
        errors.append(InputError(where, found, "the CSV file in video.odometry"))
    if table.truth is not None and table.truth.file is None:
        errors.append(InputError(where, "table.truth names no file", "a CSV file in table.truth.file"))
    return errors


def _with_views(
    source: InMemorySource, time: np.ndarray, view: np.ndarray, video: VideoConfig, where: str
) -> InMemorySource:
    """The odometry rows, each with the view of the frame nearest in time."""

    def place(row: int) -> str:
        return f"{where}, frame {row * video.every}"

    rows, errors = each_nearest(time, source.time, video.tolerance, place)
    raise_errors(errors)
    views, seen = np.zeros((source.length, *view.shape[1:])), np.zeros(source.length, bool)
    views[rows], seen[rows] = view, True
    return replace(source, views=views, seen=seen)
