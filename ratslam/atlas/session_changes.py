"""What a localised session says about the map: places that have changed, and keyframes that are outdated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ratslam.atlas.change import PASS, RADIUS, Change, Signs, find_changes, learn_chance
from ratslam.atlas.contact_signs import (
    ContactMap,
    compared_pixels,
    contact_map,
    contact_points,
    contact_signs,
    near_keyframes,
)
from ratslam.atlas.localiser import Place, Visits
from ratslam.keyframes.appearance import WhiskerAppearance
from tactile.whiskers.head_geometry import Head

CONTRADICTIONS = 2
"""Passes that have to contradict a keyframe before it is outdated."""


class Touch(NamedTuple):
    """How whisker images become points: the head, and the height (m) of pixel value 1 and of walls."""

    head: Head
    tallest: float


def session_changes(place: Place, visits: Visits, touch: Touch) -> list[Change]:
    """The places at which a session does not agree with the map, the surest first; none for maps of other
    images than those of the head's whiskers.

    Args:
        visits: of the session; `Change.keyframes` number them.
    """
    made = contacts_of(place, place.frames, touch)
    if made is None or not len(visits.step):
        return []
    radius = RADIUS * place.ground.reach
    known = np.full(len(visits.step), len(place.frames))
    signs = contact_signs(made, visits.pose, visits.view.astype(int), known)
    return find_changes(signs, learn_chance(_revisits(place, touch), radius), radius)


def contradicted_keyframes(
    place: Place, visits: Visits, touch: Touch, changes: Sequence[Change]
) -> np.ndarray:
    """[n] keyframes of the map, numbered as they were taken, that `CONTRADICTIONS` passes of a session
    contradict at places that have changed."""
    made = contacts_of(place, place.frames, touch)
    if made is None:
        return np.zeros(0, int)
    outdated = np.zeros(len(place.frames), bool)
    for change in changes:
        passes = np.cumsum(np.diff(change.keyframes, prepend=change.keyframes[:1]) > PASS)
        against = np.zeros((len(place.frames), passes.max(initial=0) + 1), bool)
        radius = RADIUS * place.ground.reach
        for k, number in zip(change.keyframes.tolist(), passes.tolist(), strict=True):
            against[_contradicted_by(made, visits, k, change.position, radius), number] = True
        outdated |= against.sum(axis=1) >= CONTRADICTIONS
    return place.frames[outdated]


def contacts_of(place: Place, frames: np.ndarray, touch: Touch) -> ContactMap | None:
    """The contacts of keyframes [n] of a map; None where its views are not images of the head's whiskers, or
    recall has not learned to compare them."""
    appearance = place.map.appearance
    if not isinstance(appearance, WhiskerAppearance) or not appearance.metric().likeness.size:
        return None
    levels = appearance.stored(frames)[0].astype(int)
    if levels.shape[1] != len(touch.head.length):
        return None
    ground = place.ground._replace(poses=place.map.solution().fit.poses[frames])
    return contact_map(ground, levels, appearance.layout, appearance.metric().likeness, *touch)


def _revisits(place: Place, touch: Touch) -> Signs:
    """The signs in the map itself: its later two thirds, each keyframe compared with those long before it."""
    graph = place.map.keyframes()
    frames = np.flatnonzero(~place.map.outdated.flags(graph.count))
    made = contacts_of(place, frames, touch)
    assert made is not None
    late = np.arange(len(frames) // 3, len(frames))
    return contact_signs(made, made.ground.poses[late], made.levels[late], late - graph.guard)


def _contradicted_by(
    made: ContactMap, visits: Visits, k: int, position: np.ndarray, radius: float
) -> np.ndarray:
    """Rows [n] of the ground that keyframe k of a session contradicts near a position [2]."""
    level = visits.view[k].astype(int)
    near = near_keyframes(made.ground, visits.pose[k : k + 1], np.array([len(made.levels)]))[0]
    frame, pixel, log_odds = compared_pixels(made, level, near)
    points, touched = contact_points(visits.pose[k : k + 1], level[None], made.head, made.tallest)
    where = np.where(touched[0][:, None], points[0], made.points[frame, pixel])
    there = np.hypot(*(where - position).transpose(2, 0, 1)) < radius
    return near[1][(log_odds * there).sum(axis=1) < 0]
