"""A grid to export, and what tests read of exported MCAP files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from evaluation.metrics.occupancy_grid import OccupancyGrid
from tactile.base.se2 import wrap

ROOT = Path(__file__).parents[4]
GRID = OccupancyGrid(np.array([[0.0, 0.3, 1.0], [0.1, 0.5, 0.7]]), np.array([-1.25, 0.5]), 0.05)


def messages(path):
    """Messages of an MCAP file by topic, decoded by mcap-ros2-support: (time in ns, message)."""
    found = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def pose_of(pose):
    """[3] x, y, heading of a Pose or Transform."""
    place, turn = (
        (pose.position, pose.orientation) if hasattr(pose, "position") else (pose.translation, pose.rotation)
    )
    return np.array([place.x, place.y, 2 * np.arctan2(turn.z, turn.w)])


def path_of(found, name):
    return np.array([pose_of(stamped.pose) for stamped in found[name][0][1].poses])


def assert_same_poses(found, expected):
    assert found.shape == expected.shape
    difference = found - expected
    difference[:, 2] = wrap(difference[:, 2])
    assert np.abs(difference).max() < 1e-12


def nanoseconds(stamp):
    return stamp.sec * 10**9 + stamp.nanosec
