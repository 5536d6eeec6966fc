"""A rendered camera: a textured corridor around a block, driven round twice, with known truth.

Walls, floor and ceiling carry random textures of several scales, filtered by distance. Each column of an
image is one ray against the walls; rows follow from the distance.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

TEXEL = 0.02  # m
LEVELS = 7  # of the texture pyramid, each half as fine
EYE, HEIGHT = 0.6, 2.2  # m above the floor: camera, ceiling


@dataclass(frozen=True)
class CorridorLoop:
    """A corridor between two rectangles, and a drive along its middle: m, m/s, frames a second,
    and the radius of the corners of the path, m."""

    seed: int
    length: float = 8.0
    depth: float = 5.0
    breadth: float = 1.6
    laps: float = 2.1
    speed: float = 0.6
    rate: float = 10.0
    radius: float = 0.6

    @cached_property
    def truth(self) -> tuple[np.ndarray, np.ndarray]:
        """Times [N] s and poses [N, 3] (x m, y m, heading rad, not wrapped)."""
        half = self.breadth / 2
        a, b, r = self.length - 2 * half, self.depth - 2 * half, self.radius
        pieces = [(a - 2 * r, 0.0), (np.pi / 2 * r, 1 / r), (b - 2 * r, 0.0), (np.pi / 2 * r, 1 / r)] * 2
        ends = np.cumsum([length for length, _ in pieces])
        way = np.arange(0.0, self.laps * ends[-1], 0.002)
        piece = np.searchsorted(ends, way % ends[-1], side="right").clip(max=len(pieces) - 1)
        heading = np.concatenate([[0.0], np.cumsum(np.array([k for _, k in pieces])[piece] * 0.002)[:-1]])
        x = half + r + np.concatenate([[0.0], np.cumsum(np.cos(heading))[:-1]]) * 0.002
        y = half + np.concatenate([[0.0], np.cumsum(np.sin(heading))[:-1]]) * 0.002
        # The robot weaves by 8 cm, not the same way in each lap.
        off = 0.08 * np.sin(2 * np.pi * way / 5.3 + self.seed)
        slope = np.arctan(0.08 * 2 * np.pi / 5.3 * np.cos(2 * np.pi * way / 5.3 + self.seed))
        x, y, heading = x - off * np.sin(heading), y + off * np.cos(heading), heading + slope
        # It slows down and speeds up by 30 %.
        time = np.cumsum(0.002 / (self.speed * (1 + 0.3 * np.sin(2 * np.pi * way / 7.1))))
        at = np.arange(0.0, time[-1], 1 / self.rate)
        return at, np.column_stack([np.interp(at, time - time[0], c) for c in (x, y, heading)])

    def wheels(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times [N] s, speeds [N] m/s and turn rates [N] rad/s of wheel odometry: 3 % too far, a heading
        bias of 0.02 rad/m, white noise."""
        random = np.random.default_rng([self.seed, 1])
        time, pose = self.truth
        way, turn = np.hypot(*np.diff(pose[:, :2], axis=0).T), np.diff(pose[:, 2])
        way, turn = np.append(0.0, way), np.append(0.0, turn + 0.02 * way)
        v, w = way * self.rate * 1.03, turn * self.rate
        return time, v + 0.01 * random.standard_normal(len(v)), w + 0.02 * random.standard_normal(len(w))

    @cached_property
    def walls(self) -> np.ndarray:
        """[8, 4] walls: axis (0: x is constant), that constant, and the span along the other axis, m."""
        walls = []
        for inset in (0.0, self.breadth):
            x, y = (inset, self.length - inset), (inset, self.depth - inset)
            walls += [(0, x[0], *y), (0, x[1], *y), (1, y[0], *x), (1, y[1], *x)]
        return np.array(walls)

    @cached_property
    def textures(self) -> list[np.ndarray]:
        """Grey values in 0..1 of a surface of 41 m x 5 m at each level, repeated beyond."""
        random = np.random.default_rng([self.seed, 0])
        size = (256, 2048)
        total = np.zeros(size)
        for cells, weight in ((64, 0.45), (16, 0.3), (4, 0.15), (1, 0.1)):
            noise = random.random((size[0] // cells, size[1] // cells))
            total += weight * np.kron(noise, np.ones((cells, cells)))
        levels = [np.clip((total - 0.5) * 1.6 + 0.5, 0.05, 0.95)]
        while len(levels) < LEVELS:
            last = levels[-1]
            levels.append(last.reshape(last.shape[0] // 2, 2, -1, 2).mean(axis=(1, 3)))
        return levels


@dataclass(frozen=True)
class Camera:
    """A pinhole of `fov_deg` degrees across `width` pixels. `exposure` is a factor on the light."""

    fov_deg: float
    width: int = 640
    height: int = 480
    exposure: float = 1.0

    def frames(self, world: CorridorLoop) -> Iterator[np.ndarray]:
        """Images [H, W] uint8 at the times of `world.truth`."""
        random = np.random.default_rng([world.seed, 2])
        for pose in world.truth[1]:
            grey = 255 * self.exposure * self._light(world, pose)
            grey += 2.0 * random.standard_normal((self.height, self.width), np.float32)
            yield np.clip(np.round(grey), 0, 255).astype(np.uint8)

    def _light(self, world: CorridorLoop, pose: np.ndarray) -> np.ndarray:
        """[H, W] light that falls into each pixel, 0..1."""
        across = (np.arange(self.width) + 0.5) / self.width - 0.5
        focal = self.width / 2 / np.tan(np.deg2rad(self.fov_deg) / 2)
        angle = -np.arctan(across * self.width / focal)
        depth = np.cos(angle)
        distance, along = _nearest_wall(world.walls, pose, pose[2] + angle)
        rise = (self.height / 2 - np.arange(self.height) - 0.5) / focal  # per metre of depth
        hit = EYE + rise[:, None] * (distance * depth)[None, :]  # height at which a ray meets the wall
        plane = np.where(hit < 0, -EYE, HEIGHT - EYE)
        with np.errstate(divide="ignore"):
            near = np.minimum(distance, plane / rise[:, None] / depth)
        near = np.where((hit < 0) | (hit > HEIGHT), near, distance)
        ray = pose[2] + angle
        u = np.where(hit < 0, pose[0] + near * np.cos(ray), pose[0] + 17.3 + near * np.cos(ray))
        v = np.where(hit < 0, pose[1] + near * np.sin(ray), pose[1] + 3.1 + near * np.sin(ray))
        wall = (hit >= 0) & (hit <= HEIGHT)
        u, v = np.where(wall, along[None, :], u), np.where(wall, hit, v)
        return _sample(world.textures, u, v, near / focal) * np.where(wall, 1.0, 0.8)


def _nearest_wall(walls: np.ndarray, pose: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [W] m of the nearest wall along each ray, and the texture's position there, m."""
    step = np.stack([np.cos(ray), np.sin(ray)])
    distance, along = np.full(len(ray), np.inf), np.zeros(len(ray))
    for number, (axis, place, low, high) in enumerate(walls):
        axis = int(axis)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (place - pose[axis]) / step[axis]
            at = pose[1 - axis] + reach * step[1 - axis]
        hit = (reach > 0) & (low <= at) & (at <= high) & (reach < distance)
        distance, along = np.where(hit, reach, distance), np.where(hit, at + 8.7 * number, along)
    return distance, along


def _sample(levels: list[np.ndarray], u: np.ndarray, v: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Texture at (u, v) m, at the level whose texels are as large as a pixel's footprint, m."""
    level = np.clip(np.log2(np.maximum(footprint / TEXEL, 1e-9)).astype(int) + 1, 0, LEVELS - 1)
    level = np.where(footprint <= TEXEL, 0, level)
    flat = np.concatenate([texture.ravel() for texture in levels])
    starts = np.cumsum([0, *(texture.size for texture in levels)])[:-1]
    rows = np.array([texture.shape[0] for texture in levels])[level]
    columns = np.array([texture.shape[1] for texture in levels])[level]
    texel = TEXEL * 2.0**level
    i, j = np.floor(v / texel).astype(int) % rows, np.floor(u / texel).astype(int) % columns
    return flat[starts[level] + i * columns + j]


def write_video(path: Path, frames: Iterator[np.ndarray], rate: float, codec: str) -> int:
    """Writes grey frames as a video and returns their number; `MJPG` stores each as a JPEG."""
    import cv2

    images = list(frames)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate, images[0].shape[::-1])
    assert writer.isOpened()
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 90)
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return len(images)


def write_csv(path: Path, **columns: np.ndarray) -> Path:
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, fmt="%.9f", delimiter=",", header=",".join(columns), comments="")
    return path
