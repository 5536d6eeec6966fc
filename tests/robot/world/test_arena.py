"""Arenas: reachable free space, geometry of walls and objects, and the file format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.ndimage import label

from robot.world.arena import (
    Arena,
    ArenaConfig,
    arena_text,
    make_arena,
    place_start,
    read_arena,
    wall_segments,
)
from robot.world.walls import (
    polygon_area,
    polygon_contains,
    polygon_edges,
    polygon_gap,
    segment_distance,
    segments_cross,
    square,
)
from tactile.base.errors import InputError

SEEDS = st.integers(0, 10**6)
KINDS = st.sampled_from(
    [ArenaConfig(side=side, rotated=rotated) for side in (1.25, 2.5) for rotated in (False, True)]
)
PLACE = make_arena(ArenaConfig(seed=1), 0)
GOOD = """# a room
outer 0 0  2 0  2 2  0 2
square 0.3 1.7 0.2 30

polygon 2 1  1.7 1.2  2 1.4 # a wedge
start 1 1 90
"""


@settings(max_examples=12)
@given(SEEDS, KINDS)
def test_passages_are_wide_enough_and_all_free_space_is_connected(seed: int, config: ArenaConfig) -> None:
    arena = make_arena(config, seed)
    assert len(arena.objects) == config.count
    for number, one in enumerate(arena.objects):
        assert config.smallest**2 <= polygon_area(one) * (1 + 1e-9) <= config.largest**2 * (1 + 2e-9)
        room = polygon_gap(one, arena.outer)
        assert room < 1e-9 or room >= config.passage
        assert all(polygon_gap(one, other) >= config.passage for other in arena.objects[:number])
    assert arena.has_clearance(arena.start[:2], 0.2)
    axis = np.arange(0.005, config.side, 0.02)
    _, regions = label(arena.has_clearance(np.stack(np.meshgrid(axis, axis), axis=-1), 0.18))
    assert regions == 1


def test_an_arena_follows_from_its_seed() -> None:
    def described(arena: Arena) -> np.ndarray:
        side = [one[1] - one[0] for one in arena.objects]
        turn = [np.degrees(np.arctan2(y, x)) for x, y in side]
        middle = [one.mean(axis=0) for one in arena.objects]
        return np.column_stack([middle, np.hypot(*np.transpose(side)), turn])

    turned = make_arena(ArenaConfig(rotated=True), 3)
    expected = [
        [0.1383, 1.1117, 0.2177, 71.1081],
        [0.1235, 0.1235, 0.2045, 76.3727],
        [1.0763, 1.0763, 0.2471, 51.3911],
        [1.1109, 0.1391, 0.2233, 73.2565],
    ]
    np.testing.assert_allclose(described(turned), expected, atol=1e-4)
    np.testing.assert_allclose(turned.start, [0.6154, 0.7506, -1.7743], atol=1e-4)
    np.testing.assert_allclose(place_start(turned, 1).start, [0.7971, 0.7852, -0.5786], atol=1e-4)
    plain = make_arena(ArenaConfig(), 4)
    assert not described(plain)[:, 3].any()
    assert arena_text(make_arena(ArenaConfig(seed=4), 9)) == arena_text(plain)
    assert len(make_arena(ArenaConfig(side=2.5), 0).objects) == 7  # of the paper
    assert make_arena(ArenaConfig(objects=0), 0).objects == ()


def test_what_does_not_fit_is_refused(refused: Callable[..., InputError], monkeypatch) -> None:
    monkeypatch.setattr("robot.world.arena.MAX_RESTARTS", 2)
    narrow = Arena("narrow", square(np.zeros(2), 0.3, 0.0), (), np.zeros(3))
    refused(lambda: place_start(narrow, 0), "no room")
    crowded = ArenaConfig(objects=30)
    refused(lambda: make_arena(crowded, 0), "create_simulation.arena.objects", "30 objects", "fewer")
    with pytest.raises(ValidationError, match="smallest"):
        ArenaConfig(smallest=0.3)
    with pytest.raises(ValidationError, match="largest"):
        ArenaConfig(side=0.2)


@settings(max_examples=30)
@given(SEEDS, KINDS)
def test_a_line_from_inside_to_outside_crosses_an_odd_number_of_walls(seed: int, config: ArenaConfig) -> None:
    """Wall segments and free space describe the same arena."""
    arena = make_arena(config, seed)
    points = np.random.default_rng(seed).uniform(-0.2, config.side + 0.2, (40, 2, 2))
    crossings = segments_cross(points.reshape(-1, 4), wall_segments(arena)).sum(axis=1)
    free = arena.in_free_space(points)
    assert ((crossings % 2 == 1) == (free[:, 0] != free[:, 1])).all()
    assert (free <= arena.is_enclosed(points)).all()
    assert not arena.in_free_space(points + 5).any()


@given(SEEDS)
def test_segment_distance_is_that_of_the_nearest_point(seed: int) -> None:
    random = np.random.default_rng(seed)
    walls, points = random.uniform(-1, 1, (5, 4)), random.uniform(-1, 1, (7, 2))
    share = np.linspace(0, 1, 2001)[:, None, None]
    along = walls[:, :2] + share * (walls[:, 2:] - walls[:, :2])
    sampled = np.linalg.norm(points[:, None, None] - along, axis=-1).min(axis=1)
    assert np.allclose(segment_distance(walls, points), sampled, atol=1e-3)
    assert (segment_distance(walls, points) <= sampled + 1e-12).all()


@given(SEEDS, st.floats(-10, 10))
def test_rotated_squares_stay_square(seed: int, angle: float) -> None:
    one = square(np.array([0.3, -0.2]), 0.4, angle)
    assert polygon_area(one) == pytest.approx(0.16)
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (50, 2))
    c, s = np.cos(angle), np.sin(angle)
    u, v = np.abs((points - [0.3, -0.2]) @ np.array([[c, -s], [s, c]])).T
    assert (polygon_contains(one, points) == (np.maximum(u, v) < 0.2)).all()


def test_touching_segments_do_not_cross() -> None:
    sides = polygon_edges(square(np.zeros(2), 1.0, 0.0))
    assert not segments_cross(sides, sides).any()
    assert segments_cross(sides, np.array([[0.0, 0.0, 2.0, 0.1]])).sum() == 1


@settings(max_examples=20)
@given(SEEDS, KINDS)
def test_an_arena_file_is_read_back_equal(tmp_path_factory, seed: int, config: ArenaConfig) -> None:
    arena = make_arena(config, seed)
    path = tmp_path_factory.getbasetemp() / "room.txt"
    path.write_text(arena_text(arena))
    read = read_arena(path)
    assert read.name == "room"
    assert (wall_segments(read) == wall_segments(arena)).all()
    assert np.allclose(read.start, arena.start)


def test_an_arena_file_gives_walls_objects_and_start(tmp_path: Path) -> None:
    path = tmp_path / "room.txt"
    path.write_text(GOOD)
    read = read_arena(path)
    assert len(read.objects) == 2
    assert np.allclose(read.start, [1, 1, np.pi / 2])
    assert polygon_area(read.objects[0]) == pytest.approx(0.04)
    places = np.array([[0.3, 1.7], [1.0, 1.0], [1.9, 1.2]])
    assert read.in_free_space(places).tolist() == [False, True, False]
    path.write_text(GOOD.replace("outer 0 0  2 0  2 2  0 2", "outer 0 2  2 2  2 0  0 0"))  # clockwise
    assert read_arena(path).in_free_space(places).tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("change", "where", "found"),
    [
        (("outer 0 0", "walls 0 0"), ":2:1", "'walls'"),
        (("2 2  0 2", "2 2  0 nan"), ":2:24", "'nan'"),
        (("0.2 30", "0.2 thirty"), ":3:20", "'thirty'"),
        (("0.2 30", "0.2"), ":3:1", "3 numbers"),
        (("0.2 30", "-0.2 30"), ":3:16", "a side of -0.2 m"),
        (("  2 2  0 2", ""), ":2:1", "4 numbers"),
        (("  2 2  0 2", "  0 2 2 2"), ":2:12", "walls that cross"),
        (("  2 2  0 2", "  2 0 2 2 0 2"), ":2:17", "the same corner twice"),
        (("  2 2  0 2", "  2 2  0 2  0 0"), ":2:7", "the same corner twice"),
        (("  2 2  0 2", "  3 0  1 0"), ":2:1", "on one line"),
        (("start 1 1 90\n", ""), "", "no line `start`"),
        (("outer 0 0  2 0  2 2  0 2", ""), "", "no line `outer`"),
        (("start 1 1 90", "start 1 1 90\nstart 1 1 80"), ":7:1", "another `start`"),
        (("square 0.3 1.7", "square 2.3 1.7"), ":3:1", "outside the walls"),
        (("square 0.3 1.7", "square 2 1.8"), ":3:1", "outside the walls"),
        (("square 0.3 1.7", "square 1.85 1.2"), ":5:1", "overlaps object 1"),
        (("square 0.3 1.7 0.2", "square 1.85 1.2 0.05"), ":5:1", "overlaps object 1"),
        (("start 1 1 90", "start 0.3 1.7 90"), ":6:7", "too close"),
        (("start 1 1 90", "start 0.1 1 90"), ":6:7", "too close"),
        (("start 1 1 90", "start inf 1 90"), ":6:7", "'inf'"),
    ],
)
def test_a_faulty_arena_file_is_refused(
    tmp_path: Path, change: tuple[str, str], where: str, found: str, refused: Callable[..., InputError]
) -> None:
    path = tmp_path / "room.txt"
    assert change[0] in GOOD
    path.write_text(GOOD.replace(*change, 1))
    refused(lambda: read_arena(path), f"room.txt{where}: ", found)
    path.write_bytes(b"\xff\xfe\x00")
    refused(lambda: read_arena(path), "room.txt", "is not text")
