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
