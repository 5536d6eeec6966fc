"""A bag: the wheel odometry and the laser of a robot, in ROS 2 messages, become a map without ROS.

`python -m ratslam.examples.a_bag` writes a bag as a robot would record it, maps it and prints

    400 samples: 0.006 m off, odometry 0.3 m

Install its reader first: `pip install 'ratslam[ros]'`.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import ratslam
from tactile.base.se2 import integrate

SAMPLES, ROOM, RAYS = 400, (4.0, 3.0), np.radians(np.arange(-177.5, 180, 5))
MOTION = np.array([0.05, 0.0, 2 * np.pi / 100])  # per sample, every 0.1 s: m, m, rad
CONFIG = """
recording:
  file: robot
  topics:
    odometry: /odom
    views: {topic: /scan, rows: 1, columns: 24, max_range: 5, yaw: 0}
    truth: /truth
"""


def main() -> None:
    with TemporaryDirectory() as name:
        folder = Path(name)
        _write_bag(folder / "robot")
        (folder / "robot.yaml").write_text(CONFIG, encoding="utf-8")
        result = ratslam.run(folder / "robot.yaml", folder / "a bag")
        error = result.scorecard.quantities["ate_final"]
        print(f"{len(result.time)} samples: {error.value:.1g} m off, odometry {error.odometry:.1g} m")
        result.plot().savefig("a_bag.png")


def _write_bag(path: Path) -> None:
    """A robot that drives circles in a room; its odometry turns 5 % too far."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    make: Any = {name.split("/")[-1]: kind for name, kind in store.types.items()}
    truth = integrate(np.tile(MOTION, (SAMPLES, 1)))
    odometry = integrate(np.tile(MOTION * [1, 1, 1.05], (SAMPLES, 1)))
    angle = truth[:, 2:] + RAYS
    ahead = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    walls = np.where(ahead > 0, ROOM, 0.0) - (truth[:, None, :2] + (ROOM[0] / 2, 0.4))
    measured = (walls / ahead).min(axis=-1).astype(np.float32)  # [T, 72] ranges to the walls, m
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        names = {"/odom": "PoseStamped", "/truth": "PoseStamped", "/scan": "LaserScan"}
        packages = {"PoseStamped": "geometry_msgs", "LaserScan": "sensor_msgs"}
        kinds = {topic: f"{packages[name]}/msg/{name}" for topic, name in names.items()}
        links = {topic: bag.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for k, ranges in enumerate(measured):
            time = 10**9 + k * 10**8  # ns
            header = make["Header"](make["Time"](time // 10**9, time % 10**9), "odom")
            limits = (RAYS[0], RAYS[-1], RAYS[1] - RAYS[0], 0.0, 0.1, 0.1, 9.0)  # angles, times, ranges
            messages = {"/scan": make["LaserScan"](header, *limits, ranges, ranges)}
            for topic, (x, y, heading) in (("/odom", odometry[k]), ("/truth", truth[k])):
                turn = make["Quaternion"](0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2))
                messages[topic] = make["PoseStamped"](header, make["Pose"](make["Point"](x, y, 0.0), turn))
            for topic, message in messages.items():
                bag.write(links[topic], time, store.serialize_cdr(message, kinds[topic]))


if __name__ == "__main__":
    main()
