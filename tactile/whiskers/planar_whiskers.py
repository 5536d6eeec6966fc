"""Whiskers as straight lines in the plane of the floor, as grid maps use them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.whiskers.head_geometry import Head


class PlanarWhiskers(NamedTuple):
    """W whiskers in base_link.

    Attributes:
        base: [W, 2] m. direction: [W, 2] unit vectors. length: [W] m.
    """

    base: np.ndarray
    direction: np.ndarray
    length: np.ndarray

    def points(self, share: np.ndarray) -> np.ndarray:
        """Points [W, K, 2] at shares [K] of the lengths, m."""
        along = self.length[:, None] * np.asarray(share, float)
        return self.base[:, None] + along[..., None] * self.direction[:, None]


def project_to_plane(head: Head, height: float) -> PlanarWhiskers:
    """The whiskers of a head projected to the plane, for obstacles of a height (m).

    Each reaches from its base to where its tip descends to that height.
    """
    outwards = head.rest[:, :2] / np.linalg.norm(head.rest[:, :2], axis=1, keepdims=True)
    drop = np.clip((head.base[:, 2] - height) / head.length, 0.0, 1.0)
    return PlanarWhiskers(head.base[:, :2], outwards, head.length * np.sqrt(1 - drop**2))


def image_points(head: Head, image: np.ndarray, tallest: float) -> tuple[np.ndarray, np.ndarray]:
    """Where whiskers touched walls of a known height.

    A pixel is the height of the tip at first contact as a share of `tallest`, hence the whisker's angle. The
    contact is where the shaft crosses the height of the walls, or the tip if it is above.

    Args:
        image: [..., W] pixels in 0..1, 0 without contact. tallest: height of pixel value 1 and of walls, m.

    Returns:
        [..., W, 2] points in base_link, m, and [..., W] bool, there is one.
    """
    touched = image > 0
    tip = image * tallest
    cos = np.clip((head.base[:, 2] - tip) / head.length, 0.0, 1.0)
    radius = np.hypot(head.base[:, 0], head.base[:, 1])
    tangent = np.sqrt(1 - cos**2) / np.maximum(cos, 1e-6)
    reach = radius + (head.base[:, 2] - np.maximum(tip, tallest)) * tangent
    outwards = head.rest[:, :2] / np.linalg.norm(head.rest[:, :2], axis=1, keepdims=True)
    return reach[..., None] * outwards, touched
