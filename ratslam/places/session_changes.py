"""What a localised session says about the map: places that have changed.

Signs of a change from whisker images: contacts that a map does not expect, and expected ones that fail.

Each pixel of an image is compared with those of the keyframes near by through the log-odds that recall
learned (`ratslam.recall.whisker_likelihood`). The sign stands where the whisker touches, or where it touched
in the map: at the wall, not at the robot.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.mapping.appearance import WhiskerAppearance
from ratslam.mapping.ground import Ground
from ratslam.places.change import RADIUS, Change, Signs, find_changes, learn_chance
from ratslam.places.localiser import Place, Visits
from ratslam.recall.whisker_likelihood import PixelLayout, level_heights
from tactile.base.se2 import compose
from tactile.whiskers.head_geometry import Head
from tactile.whiskers.planar_whiskers import image_points


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


class ContactMap(NamedTuple):
    """The contacts of N keyframes with D whiskers each.

    Attributes:
        ground: the keyframes. levels: [N, D] of their images. points: [N, D, 2] contact points in the map, m.
        layout: of the pixels. log_odds: [G, LEVELS, LEVELS], see `log_odds_table`. head, tallest: see
            `image_points`.
    """

    ground: Ground
    levels: np.ndarray
    points: np.ndarray
    layout: PixelLayout
    log_odds: np.ndarray
    head: Head
    tallest: float


def contact_map(
    ground: Ground, levels: np.ndarray, layout: PixelLayout, log_odds: np.ndarray, head: Head, tallest: float
) -> ContactMap:
    """The contacts of keyframes with images of these levels [N, D]; see `ContactMap`."""
    points, _ = contact_points(ground.poses, levels, head, tallest)
    return ContactMap(ground, levels, points, layout, log_odds, head, tallest)


def contact_points(
    poses: np.ndarray, levels: np.ndarray, head: Head, tallest: float
) -> tuple[np.ndarray, np.ndarray]:
    """[n, D, 2] contact points (m) of images [n, D] of levels taken at poses [n, 3], and [n, D] bool,
    there is one."""
    points, touched = image_points(head, level_heights(levels), tallest)
    body = np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)
    return compose(poses[:, None], body)[..., :2], touched


def contact_signs(made: ContactMap, poses: np.ndarray, levels: np.ndarray, known: np.ndarray) -> Signs:
    """The signs in K images of a session.

    Args:
        poses: [K, 3] in the map. levels: [K, D] of the images. known: [K] number of the first keyframes of
            the map with which each is compared.
    """
    points, touched = contact_points(poses, levels, made.head, made.tallest)
    found = [
        (k, *_compare(made, levels[k], points[k], touched[k], near))
        for k, near in enumerate(near_keyframes(made.ground, poses, known))
        if len(near[0])
    ]
    if not found:
        empty = np.zeros(0)
        return Signs(np.zeros((0, 2)), empty, empty, empty.astype(int), len(poses))
    number = np.concatenate([np.full(len(evidence), k) for k, _, evidence, _ in found])
    where, evidence, appears = (np.concatenate(column) for column in list(zip(*found, strict=True))[1:])
    return Signs(where, evidence, appears, number, len(poses))


def near_keyframes(
    ground: Ground, poses: np.ndarray, known: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The sector shifts and keyframes with which a robot at each of the poses [K, 3] is compared, among the
    first `known` [K] keyframes."""
    found = []
    for pose, count in zip(poses, known, strict=True):
        shift, frame = ground.near(pose, ground.reach, ground.reach_heading)
        found.append((shift[frame < count], frame[frame < count]))
    return found


def _compare(
    made: ContactMap,
    level: np.ndarray,
    points: np.ndarray,
    touched: np.ndarray,
    near: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [n, 2], evidence [n] and appearance [n] of the signs in one image."""
    frame, pixel, log_odds = compared_pixels(made, level, near)
    total = log_odds.sum(axis=1)
    weight = np.exp(total - total.max())
    weight = weight / weight.sum()
    expected = weight[:, None] * (level_heights(made.levels[frame, pixel]) > 0)
    share = expected.sum(axis=0)
    middle = (expected[..., None] * made.points[frame, pixel]).sum(axis=0) / np.maximum(share, 1e-9)[:, None]
    was = share > 0.5
    here = touched | was
    where = np.where(touched[:, None], points, middle)
    return where[here], -(weight @ log_odds)[here], touched[here].astype(float) - was[here]


def compared_pixels(
    made: ContactMap, level: np.ndarray, near: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keyframes [n, 1], their pixels [n, D] that each pixel of an image of `level` [D] is compared with,
    and the log-odds [n, D] that they show the same."""
    shift, frame = near
    own = np.arange(len(level))
    reversed = np.cos(made.ground.turns[shift]) < 0
    pixel = np.where(reversed[:, None], made.layout.opposite, own)
    log_odds = made.log_odds[made.layout.group, level, made.levels[frame[:, None], pixel]]
    return frame[:, None], pixel, log_odds
