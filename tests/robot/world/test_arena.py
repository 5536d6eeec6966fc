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
    OTHER_START_CLEARANCE,
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
GOOD = """# a room
outer 0 0  2 0  2 2  0 2
square 0.3 1.7 0.2 30

polygon 2 1  1.7 1.2  2 1.4 # a wedge
start 1 1 90
"""


@settings(max_examples=25)
@given(SEEDS, KINDS)
def test_passages_are_wide_enough(seed: int, config: ArenaConfig) -> None:
    arena = make_arena(config, seed)
    assert len(arena.objects) == config.count
    for number, one in enumerate(arena.objects):
        assert config.smallest**2 <= polygon_area(one) * (1 + 1e-9) <= config.largest**2 * (1 + 2e-9)
        room = polygon_gap(one, arena.outer)
        assert room < 1e-9 or room >= config.passage
        for other in arena.objects[:number]:
            assert polygon_gap(one, other) >= config.passage
    assert arena.has_clearance(arena.start[:2], 0.2)


@settings(max_examples=12)
@given(SEEDS, KINDS)
def test_all_free_space_is_connected(seed: int, config: ArenaConfig) -> None:
    arena = make_arena(config, seed)
    axis = np.arange(0.005, config.side, 0.02)
    places = np.stack(np.meshgrid(axis, axis), axis=-1)
    _, regions = label(arena.has_clearance(places, 0.18))
    assert regions == 1


def test_only_rotated_objects_are_turned() -> None:
    def slants(rotated: bool) -> np.ndarray:
        arena = make_arena(ArenaConfig(side=2.5, rotated=rotated), 3)
        along = np.array([one[1] - one[0] for one in arena.objects])
        return np.degrees(np.arctan2(along[:, 1], along[:, 0])) % 90

    assert np.allclose(slants(False), 0)
    assert np.ptp(slants(True)) > 20


def test_the_share_of_objects_at_walls_is_configurable() -> None:
    def share(against: float) -> float:
        arenas = [make_arena(ArenaConfig(side=2.5, objects=4, against=against), seed) for seed in range(8)]
        return float(
            np.mean([polygon_gap(one, room.outer) < 1e-9 for room in arenas for one in room.objects])
        )

    assert share(0.0) == 0
    assert share(1.0) == 1
    assert 0.3 < share(0.5) < 0.9


@given(st.integers(0, 50))
def test_starts_in_one_arena_differ_and_are_free(seed: int) -> None:
    place = make_arena(ArenaConfig(seed=1), 0)
    one, other = place_start(place, seed), place_start(place, seed + 1)
    assert one.has_clearance(one.start[None, :2], OTHER_START_CLEARANCE).all()
    assert not np.allclose(one.start, other.start)
    assert one.objects is place.objects


def test_a_start_needs_free_space() -> None:
    narrow = Arena(
        "narrow", 0.3 * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), (), np.zeros(3)
    )
    with pytest.raises(InputError, match="no room"):
        place_start(narrow, 0)


def test_an_arena_depends_on_its_seed_only() -> None:
    config = ArenaConfig()
    one, again, other = (make_arena(config, seed) for seed in (4, 4, 5))
    assert arena_text(one) == arena_text(again) != arena_text(other)
    assert arena_text(make_arena(ArenaConfig(seed=4), 9)) == arena_text(one)


def test_the_sizes_of_the_paper_have_four_and_seven_objects() -> None:
    assert ArenaConfig().count == 4
    assert ArenaConfig(side=2.5).count == 7
    assert make_arena(ArenaConfig(objects=0), 0).objects == ()


def test_objects_that_do_not_fit_are_refused(refused: Callable[..., InputError]) -> None:
    refused(
        lambda: make_arena(ArenaConfig(objects=30), 0),
        "create_simulation.arena.objects",
        "30 objects",
        "fewer",
    )
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


def test_the_occupied_area_is_that_of_the_objects() -> None:
    arena = make_arena(ArenaConfig(rotated=True), 2)
    axis = (np.arange(250) + 0.5) / 250 * 1.25
    cells = np.stack(np.meshgrid(axis, axis), axis=-1)
    expected = sum(polygon_area(one) for one in arena.objects) / 1.25**2
    assert (~arena.in_free_space(cells)).mean() == pytest.approx(expected, rel=0.01)
    assert not arena.in_free_space(cells + 5).any()


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
    assert polygon_contains(one, np.array([0.3, -0.2]))
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
    assert isinstance(read, Arena)
    assert len(read.objects) == 2
    assert np.allclose(read.start, [1, 1, np.pi / 2])
    assert polygon_area(read.objects[0]) == pytest.approx(0.04)
    assert not read.in_free_space(np.array([0.3, 1.7]))
    assert not read.in_free_space(np.array([1.9, 1.2]))
    path.write_text(GOOD.replace("outer 0 0  2 0  2 2  0 2", "outer 0 2  2 2  2 0  0 0"))  # clockwise
    assert (read_arena(path).in_free_space(np.array([[1.0, 1.0], [1.9, 1.2]])) == [True, False]).all()


@pytest.mark.parametrize(
    ("change", "where", "found"),
    [
        (("outer 0 0", "walls 0 0"), "room.txt:2:1", "'walls'"),
        (("2 2  0 2", "2 2  0 nan"), "room.txt:2:24", "'nan'"),
        (("0.2 30", "0.2 thirty"), "room.txt:3:20", "'thirty'"),
        (("0.2 30", "0.2"), "room.txt:3:1", "3 numbers"),
        (("0.2 30", "-0.2 30"), "room.txt:3:16", "a side of -0.2 m"),
        (("  2 2  0 2", ""), "room.txt:2:1", "4 numbers"),
        (("  2 2  0 2", "  0 2 2 2"), "room.txt:2:12", "walls that cross"),
        (("  2 2  0 2", "  2 0 2 2 0 2"), "room.txt:2:17", "the same corner twice"),
        (("  2 2  0 2", "  2 2  0 2  0 0"), "room.txt:2:7", "the same corner twice"),
        (("  2 2  0 2", "  3 0  1 0"), "room.txt:2:1", "on one line"),
        (("start 1 1 90\n", ""), "room.txt", "no line `start`"),
        (("outer 0 0  2 0  2 2  0 2", ""), "room.txt", "no line `outer`"),
        (("start 1 1 90", "start 1 1 90\nstart 1 1 80"), "room.txt:7:1", "another `start`"),
        (("square 0.3 1.7", "square 2.3 1.7"), "room.txt:3:1", "outside the walls"),
        (("square 0.3 1.7", "square 2 1.8"), "room.txt:3:1", "outside the walls"),
        (("square 0.3 1.7", "square 1.85 1.2"), "room.txt:5:1", "an object that overlaps object 1"),
        (("square 0.3 1.7 0.2", "square 1.85 1.2 0.05"), "room.txt:5:1", "an object that overlaps object 1"),
        (("start 1 1 90", "start 0.3 1.7 90"), "room.txt:6:7", "too close"),
        (("start 1 1 90", "start 0.1 1 90"), "room.txt:6:7", "too close"),
        (("start 1 1 90", "start inf 1 90"), "room.txt:6:7", "'inf'"),
    ],
)
def test_a_faulty_arena_file_is_refused(
    tmp_path: Path, change: tuple[str, str], where: str, found: str, refused: Callable[..., InputError]
) -> None:
    path = tmp_path / "room.txt"
    assert change[0] in GOOD
    path.write_text(GOOD.replace(*change, 1))
    refused(lambda: read_arena(path), where, found)


def test_a_binary_file_is_refused(tmp_path: Path, refused: Callable[..., InputError]) -> None:
    refused(lambda: read_arena(tmp_path / "none.txt"), "none.txt", "no such file")
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe\x00")
    refused(lambda: read_arena(tmp_path / "bytes.txt"), "bytes.txt", "is not text")
