"""Real recordings as messages, and CSV files that hold what these messages hold."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robot.recordings.bags.transforms import pose_in_plane
from robot.recordings.csv_file import read_csv
from robot.sources.odometry import from_motions
from tactile.base.se2 import integrate
from tests.helpers.ros_bags import Entry, header, odometry, pose, quaternion, scan


class RealBag(NamedTuple):
    """A recording as messages.

    Attributes:
        entries: its messages. topics: settings that read them. table: settings that read the CSV files, which
            `write_tables` wrote.
    """

    entries: list[Entry]
    topics: dict[str, Any]
    table: dict[str, Any]


def intel(data: Path, folder: Path) -> RealBag:
    """Intel Research Lab: odometry poses, truth poses, 180 beams."""
    log, laser = read_csv(data / "intel_odom_gt.csv"), read_csv(data / "intel_scans.csv")
    ranges, _ = laser.block("r")
    step = np.deg2rad(1.0)
    scans = [
        scan(time, row, -90 * step, step)
        for time, row in zip(_stamps(data / "intel_scans.csv"), ranges, strict=True)
    ]
    moments = _stamps(data / "intel_odom_gt.csv")
    wheels = np.column_stack([log.column(name) for name in ("odo_x", "odo_y", "odo_th")])
    truth = np.column_stack([log.column(name) for name in ("gt_x", "gt_y", "gt_th")])
    return _bag(folder, (moments, wheels), scans, (moments, truth), {"max_range": 8.0})


def create(data: Path, folder: Path) -> RealBag:
    """A Create in a walled lab: poses by its wheels, nine depth rays from left to right, overhead truth."""
    log, depth = read_csv(data / "create_lab_odometry.csv"), read_csv(data / "create_lab_depth.csv")
    camera = read_csv(data / "create_lab_truth.csv")
    distance, turn = log.column("distance"), log.column("turn")
    wheels = integrate(from_motions(log.column("t"), distance, 0.0, turn)[:, :3])
    rays, _ = depth.block("d")
    step = np.deg2rad(7.5)
    scans = [
        scan(time, row, 4 * step, -step)
        for time, row in zip(_stamps(data / "create_lab_depth.csv"), rays, strict=True)
    ]
    truth = np.column_stack([camera.column(name) for name in ("x", "y", "heading")])
    moments = _stamps(data / "create_lab_odometry.csv"), _stamps(data / "create_lab_truth.csv")
    views = {"max_range": 4.0, "rows": 1, "columns": 9}
    return _bag(folder, (moments[0], wheels), scans, (moments[1], truth), views)


def _bag(
    folder: Path,
    wheels: tuple[list[int], np.ndarray],
    scans: list[Entry],
    truth: tuple[list[int], np.ndarray],
    views: dict[str, Any],
) -> RealBag:
    """Messages, and the tables of what they hold: ranges as float32, the yaw of each quaternion."""
    entries = [odometry(time, *row) for time, row in zip(wheels[0], wheels[1].tolist(), strict=True)]
    entries += scans
    entries += [
        Entry("/truth", "geometry_msgs/msg/PoseStamped", time, {"header": header(time), "pose": pose(*row)})
        for time, row in zip(truth[0], truth[1].tolist(), strict=True)
    ]
    for name, (stamps, rows) in {"odometry": wheels, "truth": truth}.items():
        held = []
        for x, y, heading in rows.tolist():
            turn = quaternion(heading)
            held.append(pose_in_plane((x, y, 0.0), (0.0, 0.0, turn["z"], turn["w"]), name))
        _write_table(folder / f"{name}.csv", ["x", "y", "heading"], stamps, held)
    beams = [np.asarray(entry.fields["ranges"], float).tolist() for entry in scans]
    names = [f"r{number}" for number in range(len(beams[0]))]
    _write_table(folder / "scans.csv", names, [entry.time for entry in scans], beams)
    size = {key: views[key] for key in ("rows", "columns") if key in views}
    table = {
        **size,
        "pose": {},
        "views": {"file": str(folder / "scans.csv"), "max_range": views["max_range"]},
        "truth": {"file": str(folder / "truth.csv")},
    }
    topics = {"odometry": "/odom", "views": {"topic": "/scan", **views}, "truth": "/truth"}
    return RealBag(sorted(entries, key=lambda entry: entry.time), topics, table)


def _stamps(path: Path) -> list[int]:
    """The times of a file in ns, from its decimal digits."""
    lines = path.read_text().splitlines()[1:]
    return [int((Decimal(line.split(",")[0]) * 10**9).to_integral_value()) for line in lines]


def _write_table(path: Path, names: list[str], stamps: list[int], rows: Sequence[Sequence[float]]) -> None:
    lines = [",".join(["t", *names])]
    for stamp, row in zip(stamps, rows, strict=True):
        lines.append(",".join([f"{stamp // 10**9}.{stamp % 10**9:09d}", *map(repr, row)]))
    path.write_text("\n".join(lines) + "\n")
