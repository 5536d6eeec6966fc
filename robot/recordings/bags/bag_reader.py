"""Bags as sources: odometry, views or touch, and truth, each from a topic."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from robot.recordings.alignment import (
    RecordingRows,
    interpolated_poses,
    nearest_rows,
    no_overlap_error,
)
from robot.recordings.bags.bag import Bag, bag_files
from robot.recordings.bags.bag_odometry import BagOdometry, motion_at, read_odometry, read_poses
from robot.recordings.bags.bag_touch import read_touch
from robot.recordings.bags.images import IMAGES
from robot.recordings.bags.stamps import Report, Series, other_clock
from robot.recordings.bags.topics_config import OdometryTopic, TopicsConfig, ViewsTopic
from robot.recordings.bags.views import KEY, read_image_views, read_range_views
from robot.recordings.camera.image_view import ImageViewConfig
from robot.recordings.camera.visual_odometry import VisualOdometryConfig
from robot.recordings.input_judge import DEFAULT_JUDGE, InputJudge, MotionTrack, unit_cure
from robot.recordings.sanity_checks import SPOILT
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of_files, missing_error, raise_errors
from tactile.base.errors import InputError

NO_VIEWS = (3, 6, 1)  # shape of the masked views of a recording without any


@np.errstate(all="ignore")  # what is no number, or far too large, is reported
def read_bag(
    path: Path,
    config: TopicsConfig,
    judge: InputJudge = DEFAULT_JUDGE,
    *,
    image: ImageViewConfig | None = None,
    visual_odometry: VisualOdometryConfig | None = None,
) -> InMemorySource:
    """A bag as a `Source`: one sample for each odometry message, or for each view.

    Args:
        judge: is told of every message that is left out, and judges the odometry.
        image: how images become views. visual_odometry: for a bag of images without odometry.

    Raises:
        InputError: the bag is damaged, topics are missing or of another type, or values are impossible.
    """
    report = judge.say
    with Bag(path, report, judge.stretch) as bag:
        config = with_preset(bag, config)
        _check_roles(bag, config, visual_odometry)
        images = image or ImageViewConfig()
        odometry, views = _read_steps(bag, config, images, visual_odometry, report)
        truth = None if config.truth is None else read_poses(bag, config.truth, config.clock, report)
    found = [*odometry.errors, *(views.errors if views else []), *(truth.errors if truth else [])]
    raise_errors(list(dict.fromkeys(found)))
    raise_errors(_judge(odometry, judge))
    if views is not None and config.samples == "views":
        odometry, views = _sample_views(odometry, views, report)
    shape, whiskers = NO_VIEWS, 0
    if views is not None:
        rows, columns = views.values.shape[1:3]
        shape, whiskers = (rows, columns, 1), rows * columns if config.touch is not None else 0
    recording = RecordingRows(str(path), odometry.time, odometry.motion, shape, whiskers)
    if views is not None:
        part = config.views or config.touch
        _place_views(recording, views, part.tolerance if part else None, report)
    if truth is not None:
        recording.truth, faults = interpolated_poses(
            odometry.time, truth.time, truth.values, "time", truth.where
        )
        recording.errors += faults
    judge = replace(judge, warn=None)  # the odometry is judged: only the truth is compared
    return recording.source(path.stem, digest_of_files(bag_files(path)), judge)


def _judge(odometry: BagOdometry, judge: InputJudge) -> list[InputError]:
    """Judges the odometry as recorded, each step by the number of its message."""
    time, motion, where = odometry.time, odometry.motion, odometry.where
    track = MotionTrack(time, np.ones(len(time), bool), motion, None, odometry.held, odometry.poses)

    def cures(quantity: str, unit: str) -> str:
        return odometry.clock or other_clock("header") if quantity == "time" else unit_cure(quantity, unit)

    place = lambda row: f"{where}, message {odometry.numbers[row]}"  # noqa: E731
    return judge.errors(track, place, where, odometry.clock, cures)


def with_preset(bag: Bag, config: TopicsConfig) -> TopicsConfig:
    """The topics, with those of OpenRatSLAM where only their root is given.

    Raises:
        InputError: the bag has none of these.
    """
    if config.openratslam is None:
        return config
    root = f"/{config.openratslam.strip('/')}"
    wheels, image = f"{root}/odom", f"{root}/camera/image"
    images = [name for name in (image, f"{image}/compressed") if name in bag.topics]
    if wheels not in bag.topics and not images:
        key = "recording.topics.openratslam"
        raise missing_error(str(bag.path), "topic", wheels, list(bag.topics), key)
    found: dict[str, OdometryTopic | ViewsTopic] = {}
    if config.odometry is None and wheels in bag.topics:
        found["odometry"] = OdometryTopic(topic=wheels, use="twist")
    if config.views is None and config.touch is None and images:
        found["views"] = ViewsTopic(topic=images[0])
    return config.model_copy(update=found)


def _check_roles(bag: Bag, config: TopicsConfig, visual_odometry: VisualOdometryConfig | None) -> None:
    if config.views is not None and config.touch is not None:
        raise InputError("recording.topics", "both views and touch", "one of them")
    if config.odometry is None and (visual_odometry is None or config.views is None):
        expected = "topics: {odometry: TOPIC}, or images as views and visual_odometry"
        cure = f"the bag has {', '.join(f'{topic.name} ({topic.kind})' for topic in bag.topics.values())}"
        raise InputError("recording.topics", "no odometry", expected, cure)


def _read_steps(
    bag: Bag,
    config: TopicsConfig,
    image: ImageViewConfig,
    visual_odometry: VisualOdometryConfig | None,
    report: Report,
) -> tuple[BagOdometry, Series | None]:
    """The odometry, and the views or touch readings if there are any."""
    clock, odometry = config.clock, None
    if config.odometry is not None:
        odometry = read_odometry(bag, config.odometry, clock, report)
    if config.views is not None and (topic := bag.topic(config.views.topic, KEY)).kind in IMAGES:
        wanted = None if odometry is not None else visual_odometry
        views, motion = read_image_views(bag, topic, image, wanted, clock, report)
        if odometry is not None:
            return odometry, views
        assert motion is not None
        return BagOdometry(views.time, motion, views.where, "", views.errors, views.numbers), views
    if odometry is None:
        raise InputError("recording.visual_odometry", "views without images", "images, or topics.odometry")
    if config.views is not None:
        body = config.body or odometry.body
        return odometry, read_range_views(bag, config.views, body, clock, report)
    return odometry, None if config.touch is None else read_touch(bag, config.touch, clock, report)


def _sample_views(odometry: BagOdometry, views: Series, report: Report) -> tuple[BagOdometry, Series]:
    """Odometry at the times of the views, and the views within the odometry."""
    inside, motion = motion_at(views.time, odometry.time, odometry.motion)
    if not inside.any():
        raise no_overlap_error(views.time, odometry.time, "time", views.where)
    _report_unused(views, ~inside, "outside the times of the odometry", report)
    views = views._replace(
        time=views.time[inside], values=views.values[inside], numbers=views.numbers[inside]
    )
    return odometry._replace(time=views.time, motion=motion), views


def _place_views(recording: RecordingRows, views: Series, tolerance: float | None, report: Report) -> None:
    """Gives each view to the nearest sample; of several for one sample the nearest is used."""
    found = nearest_rows(views.time, recording.time, tolerance)
    assert found is not None  # the clock is checked
    rows, away, reach = found
    near = away <= reach
    if not near.any():
        recording.errors.append(no_overlap_error(views.time, recording.time, "time", views.where))
        return
    _report_unused(views, ~near, f"over {reach:.3g} s away from every sample", report)
    order = np.lexsort([away, rows])
    order = order[near[order]]
    first = np.concatenate([[True], np.diff(rows[order]) > 0])
    use = np.sort(order[first])
    beaten = near.copy()
    beaten[use] = False
    why = "farther from their sample than another (or set recording.topics.samples: views)"
    _report_unused(views, beaten, why, report)
    recording.views[rows[use]], recording.seen[rows[use]] = views.values[use], True


def _report_unused(views: Series, unused: np.ndarray, why: str, report: Report) -> None:
    if unused.any():
        first = float(views.time[int(unused.argmax())])
        count = f"{int(unused.sum())} of {len(unused)} views, the first at {first:.3f} s"
        few = "note: " if unused.mean() <= SPOILT else ""
        report(f"{few}{views.where}: {count}, are {why}; they are left out")
