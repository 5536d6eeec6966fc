"""A robot that drives rounds in a room: its odometry and scans, and what a Create 3 feels there."""

from collections.abc import Callable
from typing import Any

import numpy as np

from tactile.base.se2 import integrate
from tests.helpers.ros_bags import Entry, odometry, scan

START = 1_700_000_000_000_000_000
STEP = 0.02
"""Interval of the odometry, s."""
WALLS = np.array(
    [
        (-1.5, -1.2, 5.5, -1.2), (5.5, -1.2, 5.5, 4.2), (5.5, 4.2, -1.5, 4.2), (-1.5, 4.2, -1.5, -1.2),
        (1.2, 1.0, 2.9, 1.0), (2.9, 1.0, 2.9, 1.9), (2.9, 1.9, 1.2, 1.9), (1.2, 1.9, 1.2, 1.0),
        (4.7, -0.3, 5.1, 0.4), (-1.1, 3.2, -0.6, 3.9), (0.4, 3.7, 1.3, 4.1),
    ]
)  # fmt: skip
BEAMS = {"side_left": 81, "left": 71, "front_left": 65, "front_right": 54, "right": 47}
"""Directions of proximity sensors of a Create 3, as beams of a scan of `rounds`."""


def ranges(walls: np.ndarray, pose: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Distances to walls [W, 4], m."""
    ray = np.stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])], 1)[:, None]
    begin, edge = walls[None, :, :2] - pose[:2], (walls[:, 2:] - walls[:, :2])[None]
    with np.errstate(all="ignore"):
        cross = ray[..., 0] * edge[..., 1] - ray[..., 1] * edge[..., 0]
        away = (begin[..., 0] * edge[..., 1] - begin[..., 1] * edge[..., 0]) / cross
        along = (begin[..., 0] * ray[..., 1] - begin[..., 1] * ray[..., 0]) / cross
    return np.where((away > 0) & (along >= 0) & (along <= 1), away, 30.0).min(1)


def moves_around(count: float, sides: tuple[float, float]) -> np.ndarray:
    """[N, 4] motions (m, m, rad, s) of rounds about a rectangle, at 0.4 m/s and 0.7 rad/s."""
    moves = list[np.ndarray]()
    for side in (sides * 40)[: round(4 * count)]:
        for ahead, turn, pace in ((side, 0.0, 0.4), (0.0, np.pi / 2, 0.7)):
            steps = round((ahead + turn) / pace / STEP)
            moves.append(np.tile([ahead / steps, 0.0, turn / steps, STEP], (steps, 1)))
    return np.concatenate(moves)


def drifted(moves: np.ndarray, drift: float = 0.02) -> np.ndarray:
    """Odometry that drifts by a share of the distance and by so many rad/m."""
    return moves * [1 + drift, 1.0, 1.0, 1.0] + moves[:, :1] * [0.0, 0.0, drift, 0.0]


def rounds(
    count: float,
    measure: Callable[[np.ndarray], np.ndarray] = drifted,
    sides: tuple[float, float] = (4.0, 3.0),
    walls: np.ndarray = WALLS,
    every: int = 5,
) -> list[Entry]:
    """Messages of a robot that drives rectangles: odometry at 50 Hz, scans at 10.

    Args:
        measure: makes the odometry [N, 4] of motions. walls: [W, 4] ends of each, m. every: steps to a scan.
    """
    moves, angles, found = moves_around(count, sides), -np.pi + np.arange(120) * np.pi / 60, list[Entry]()
    for step, (pose, reckoned) in enumerate(zip(integrate(moves), integrate(measure(moves)), strict=True)):
        at = START + step * round(STEP * 1e9)
        found.append(odometry(at, *reckoned.tolist()))
        if step % every == 2:
            found.append(scan(at + 7_000_000, ranges(walls, pose, angles), -np.pi, np.pi / 60))
    return sorted(found, key=lambda entry: entry.time)


def path_of_rounds(count: float, sides: tuple[float, float] = (4.0, 3.0)) -> tuple[np.ndarray, np.ndarray]:
    """Times [N], s, and true poses [N, 3] of `rounds`."""
    moves = moves_around(count, sides)
    return START / 1e9 + STEP * np.arange(len(moves)), integrate(moves)


def touched(entries: list[Entry], topic: str) -> list[Entry]:
    """The same rounds of a Create 3, with what it feels on `/ir` or `/bumps` where there are scans: it bumps
    into something where the wall before it is nearer than 1.6 m."""
    found = list[Entry]()
    for entry in entries:
        if entry.topic == "/odom":
            found.append(entry)
            continue
        away, first = entry.fields["ranges"], entry.fields["header"]

        def named(frame: str, first: Any = first, **fields: int) -> dict[str, Any]:
            return {"header": first | {"frame_id": frame}} | fields

        readings = [named(f"ir_{name}", value=int(2000 / (1 + away[beam]))) for name, beam in BEAMS.items()]
        bumps = [named("bump_front_center", type=1)] if away[60] < 1.6 else []
        kind, name, content = {
            "/ir": ("IrIntensity", "readings", readings), "/bumps": ("HazardDetection", "detections", bumps)
        }[topic]  # fmt: skip
        fields = {"header": first, name: content}
        found.append(Entry(topic, f"irobot_create_msgs/msg/{kind}Vector", entry.time, fields))
    return found
