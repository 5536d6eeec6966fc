"""What a localised session says about the map: places that have changed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.atlas.change import RADIUS, Change, Signs, find_changes, learn_chance
from ratslam.atlas.contact_signs import ContactMap, contact_map, contact_signs
from ratslam.atlas.localiser import Place, Visits
from ratslam.keyframes.appearance import WhiskerAppearance
from tactile.whiskers.head_geometry import Head


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
    frames = np.arange(graph.count)
    made = contacts_of(place, frames, touch)
    assert made is not None
    late = np.arange(len(frames) // 3, len(frames))
    return contact_signs(made, made.ground.poses[late], made.levels[late], late - graph.guard)
