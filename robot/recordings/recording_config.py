"""The settings of a recording of any format."""

from __future__ import annotations

from collections.abc import Container
from pathlib import Path
from typing import Self

from robot.recordings.bags.topics_config import TopicsConfig
from robot.recordings.csv_config import CsvConfig
from robot.recordings.input_judge import DEFAULT_LIMITS, UnitLimits
from robot.recordings.sanity_checks import StretchConfig
from robot.recordings.video import ImageViewConfig, VideoConfig, VisualOdometryConfig
from robot.sources.odometry import UNCORRECTED, OdometryCorrection
from tactile.base.settings import KeyPath


class RecordingConfig(StretchConfig):
    """A recording to run on."""

    file: Path | None = None
    """The recording: `.mcap` (of ratslam), `.npz` (reference trace), `.csv` (odometry), a bag (`.bag`,
    `.db3`, `.mcap`, a folder) or a video (`.mp4`, `.avi`, `.mkv`, `.mov`, `.webm`). Null: the topics of
    `live.topics`."""
    table: CsvConfig = CsvConfig()
    """Columns of a `.csv` recording, or of the odometry and truth beside a video."""
    topics: TopicsConfig | None = None
    """Topics of a bag, or of a running robot."""
    video: VideoConfig = VideoConfig()
    """Times and odometry of a video."""
    image: ImageViewConfig = ImageViewConfig()
    """How images become views."""
    visual_odometry: VisualOdometryConfig | None = None
    """Odometry from the images of a recording that has no other."""
    odometry: OdometryCorrection = UNCORRECTED
    """Systematic errors to take out of the odometry, of any format; the unit check comes first."""
    limits: UnitLimits = DEFAULT_LIMITS
    """Limits of the unit check, beyond which a recording is refused."""

    def resolved(self, folder: Path, here: Container[KeyPath] = (), at: KeyPath = ()) -> Self:
        """See `Settings.resolved`.

        One `*` in the file name of a part of the table or of the video stands for the beginning of the
        recording's file name: beside `aces_odom_gt.csv`, `*_scans.csv` is `aces_scans.csv`.
        """
        found = super().resolved(folder, here, at)
        file = found.file
        if file is None:
            return found
        parts = {
            key: getattr(found.table, key).model_copy(update={"file": _companion(file, part.file)})
            for key in ("views", "contacts", "labels", "pairs", "truth")
            if (part := getattr(self.table, key)) is not None and _names_companion(part.file)
        }
        given = {key: getattr(self.video, key) for key in ("stamps", "odometry")}
        beside = {key: _companion(file, part) for key, part in given.items() if _names_companion(part)}
        table, video = found.table.model_copy(update=parts), found.video.model_copy(update=beside)
        return found.model_copy(update={"table": table, "video": video})


def _names_companion(file: Path | None) -> bool:
    return file is not None and file.name.count("*") == 1


def _companion(recording: Path, file: Path) -> Path:
    """The file beside a recording whose name has a `*` for the beginning of the recording's name."""
    before, after = file.name.split("*")
    beside = recording.parent / file.parent
    star = slice(len(before), -len(after) or None)
    found = [path for path in beside.glob(file.name) if recording.name.startswith(path.name[star])]
    return max(found, key=lambda path: len(path.name), default=beside / file.name)
