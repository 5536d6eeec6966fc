"""Whisker curves."""

from __future__ import annotations

import numpy as np

from ratslam.service.viewer_process import POINTS, whisker_curves
from tactile.whisker_geometry import HeadConfig, shaft_points, ur10_head

HEAD = ur10_head(HeadConfig())
WHISKERS = len(HEAD.length)


def parts(curve):
    return np.diff(curve, axis=0)


def test_free_whiskers_are_straight_to_their_tips():
    free = np.zeros(WHISKERS, bool)
    curves = whisker_curves(HEAD, free, np.full((WHISKERS, 2), 9.0), np.full(WHISKERS, 9.0))
    assert curves.shape == (WHISKERS, POINTS, 3)
    assert np.allclose(curves[:, 0], HEAD.base, atol=1e-12)
    assert np.allclose(curves[:, -1], shaft_points(HEAD, np.zeros(WHISKERS), HEAD.length), atol=1e-12)
    along = curves - HEAD.base[:, None]
    assert np.allclose(np.cross(along, HEAD.rest[:, None]), 0.0, atol=1e-12)


def test_a_whisker_in_contact_ends_at_the_contact_and_leaves_its_base_as_at_rest():
    contact = np.arange(WHISKERS) == 4
    point = np.zeros((WHISKERS, 2))
    point[4] = 0.03, 0.04
    height = np.full(WHISKERS, 0.02)
    curves = whisker_curves(HEAD, contact, point, height)
    assert np.allclose(curves[4, -1], [0.03, 0.04, 0.02], atol=1e-12)
    turns = [np.linalg.norm(np.cross(part / np.linalg.norm(part), HEAD.rest[4])) for part in parts(curves[4])]
    assert turns[0] < 0.5 * turns[-1]  # it bends away from its direction at rest
