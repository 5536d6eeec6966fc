"""Arenas: free space, walls and objects, the file format; contact of whiskers with walls in closed form."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.ndimage import label

from robot.world import arena as arenas
from robot.world import walls as geometry
from robot.world.arena import Arena, ArenaConfig, arena_text, make_arena, read_arena
from robot.world.maze import random_loop, random_maze, wall_boxes
from robot.world.walls import NO_CONTACT, Surroundings, Walls
from tactile.base.random_streams import stream
from tactile.whisker_geometry import Head, HeadConfig, RingConfig, shaft_points, ur10_head

SEEDS = st.integers(0, 10**6)
KINDS = st.builds(ArenaConfig, side=st.sampled_from([1.25, 2.5]), rotated=st.booleans())
GOOD = """# a room
outer 0 0  2 0  2 2  0 2
square 0.3 1.7 0.2 30

polygon 2 1  1.7 1.2  2 1.4 # a wedge
start 1 1 90
"""


@settings(max_examples=12)
@given(SEEDS, KINDS)
def test_passages_are_wide_enough_and_all_free_space_is_connected(seed, config):
    arena = make_arena(config, seed)
    assert len(arena.objects) == config.count
    for number, one in enumerate(arena.objects):
        assert config.smallest**2 <= geometry.polygon_area(one) * (1 + 1e-9) <= config.largest**2 * (1 + 2e-9)
        room = geometry.polygon_gap(one, arena.outer)
        assert room < 1e-9 or room >= config.passage
        assert all(geometry.polygon_gap(one, other) >= config.passage for other in arena.objects[:number])
    assert arena.has_clearance(arena.start[:2], 0.2)
    axis = np.arange(0.005, config.side, 0.02)
    _, regions = label(arena.has_clearance(np.stack(np.meshgrid(axis, axis), axis=-1), 0.18))
    assert regions == 1


def test_an_arena_follows_from_its_seed():
    def described(arena: Arena) -> np.ndarray:
        side = [one[1] - one[0] for one in arena.objects]
        turn = [np.degrees(np.arctan2(y, x)) for x, y in side]
        middle = [one.mean(axis=0) for one in arena.objects]
        return np.column_stack([middle, np.hypot(*np.transpose(side)), turn])

    turned = make_arena(ArenaConfig(rotated=True), 3)
    expected = [
        [0.1383, 1.1117, 0.2177, 71.1081, 0.1235, 0.1235, 0.2045, 76.3727],
        [1.0763, 1.0763, 0.2471, 51.3911, 1.1109, 0.1391, 0.2233, 73.2565],
    ]
    np.testing.assert_allclose(described(turned).reshape(2, 8), expected, atol=1e-4)
    np.testing.assert_allclose(turned.start, [0.6154, 0.7506, -1.7743], atol=1e-4)
    np.testing.assert_allclose(arenas.place_start(turned, 1).start, [0.7971, 0.7852, -0.5786], atol=1e-4)
    plain = make_arena(ArenaConfig(), 4)
    assert not described(plain)[:, 3].any()
    assert arena_text(make_arena(ArenaConfig(seed=4), 9)) == arena_text(plain)
    assert len(make_arena(ArenaConfig(side=2.5), 0).objects) == 7  # of the paper
    assert make_arena(ArenaConfig(objects=0), 0).objects == ()


def test_what_does_not_fit_is_refused(refused, monkeypatch):
    monkeypatch.setattr("robot.world.arena.MAX_RESTARTS", 2)
    narrow = Arena("narrow", geometry.square(np.zeros(2), 0.3, 0.0), (), np.zeros(3))
    refused(lambda: arenas.place_start(narrow, 0), "no room")
    crowded = ArenaConfig(objects=30)
    refused(lambda: make_arena(crowded, 0), "create_simulation.arena.objects", "30 objects", "fewer")
    for name, changes in (("smallest", {"smallest": 0.3}), ("largest", {"side": 0.2})):
        with pytest.raises(ValidationError, match=name):
            ArenaConfig(**changes)


@settings(max_examples=30)
@given(SEEDS, KINDS)
def test_wall_segments_free_space_and_file_describe_the_same_arena(tmp_path_factory, seed, config):
    """A line from inside to outside crosses an odd number of walls."""
    arena, path = make_arena(config, seed), tmp_path_factory.getbasetemp() / "room.txt"
    path.write_text(arena_text(arena))
    read = read_arena(path)
    assert read.name == "room"
    assert (arenas.wall_segments(read) == arenas.wall_segments(arena)).all()
    assert np.allclose(read.start, arena.start)
    points = np.random.default_rng(seed).uniform(-0.2, config.side + 0.2, (40, 2, 2))
    crossings = geometry.segments_cross(points.reshape(-1, 4), arenas.wall_segments(arena)).sum(axis=1)
    free = arena.in_free_space(points)
    assert ((crossings % 2 == 1) == (free[:, 0] != free[:, 1])).all()
    assert (free <= arena.is_enclosed(points)).all()
    assert not arena.in_free_space(points + 5).any()


@given(SEEDS, st.floats(-10, 10))
def test_segments_have_their_distance_and_rotated_squares_stay_square(seed, angle):
    random = np.random.default_rng(seed)
    walls, points = random.uniform(-1, 1, (5, 4)), random.uniform(-1, 1, (7, 2))
    along = walls[:, :2] + np.linspace(0, 1, 2001)[:, None, None] * (walls[:, 2:] - walls[:, :2])
    sampled = np.linalg.norm(points[:, None, None] - along, axis=-1).min(axis=1)
    assert np.allclose(geometry.segment_distance(walls, points), sampled, atol=1e-3)
    assert (geometry.segment_distance(walls, points) <= sampled + 1e-12).all()
    one = geometry.square(np.array([0.3, -0.2]), 0.4, angle)
    assert geometry.polygon_area(one) == pytest.approx(0.16)
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (50, 2))
    c, s = np.cos(angle), np.sin(angle)
    u, v = np.abs((points - [0.3, -0.2]) @ np.array([[c, -s], [s, c]])).T
    assert (geometry.polygon_contains(one, points) == (np.maximum(u, v) < 0.2)).all()
    sides = geometry.polygon_edges(one)  # they touch each other
    assert not geometry.segments_cross(sides, sides).any()
    assert geometry.segments_cross(sides, np.array([[0.3, -0.2, 2.3, -0.1]])).sum() == 1


def test_an_arena_file_gives_walls_objects_and_start_and_a_faulty_one_is_refused(tmp_path, refused):
    path = tmp_path / "room.txt"
    path.write_text(GOOD)
    read = read_arena(path)
    assert len(read.objects) == 2
    assert np.allclose(read.start, [1, 1, np.pi / 2])
    assert geometry.polygon_area(read.objects[0]) == pytest.approx(0.04)
    places = np.array([[0.3, 1.7], [1.0, 1.0], [1.9, 1.2]])
    assert read.in_free_space(places).tolist() == [False, True, False]
    path.write_text(GOOD.replace("outer 0 0  2 0  2 2  0 2", "outer 0 2  2 2  2 0  0 0"))  # clockwise
    assert read_arena(path).in_free_space(places).tolist() == [False, True, False]
    for change, where, found in (
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
    ):
        assert change[0] in GOOD
        path.write_text(GOOD.replace(*change, 1))
        refused(lambda: read_arena(path), f"room.txt{where}: ", found)
    path.write_bytes(b"\xff\xfe\x00")
    refused(lambda: read_arena(path), "room.txt", "is not text")


STEP, SHARES = 1 / 600, np.arange(1, 161) / 160
"""Step of the search, and its points of the shaft, as fractions of the sweep and of the length."""
WIDE = (RingConfig(length=0.05, radius=0.09, height=0.09), RingConfig(length=0.16, radius=0.12, height=0.17))
FIVE = (RingConfig(length=0.16, radius=0.05, height=0.16),)
HEADS = {
    "ur10": (HeadConfig(), 65.0),
    "steep": (HeadConfig(rest_deg=60.0, first_deg=17.0), 70.0),
    "past the vertical": (HeadConfig(rest_deg=45.0, limit_deg=100.0, rings=WIDE), 95.0),
    "one ring of five": (HeadConfig(rings=FIVE, whiskers=5), 70.0),
}


def maze_of(seed: int, heights: tuple[float, ...] = (0.05,)) -> Walls:
    maze = random_maze(3, 3, random_loop(3, 3, 8, stream(seed, "maze.loop")), 0.6, stream(seed, "maze.walls"))
    return wall_boxes(maze, stream(seed, "heights"), heights)


def search_contact(head: Head, boxes: Walls, pose: np.ndarray, sweep: float) -> tuple[np.ndarray, np.ndarray]:
    """First protraction [W] with a point of the shaft inside a box; the points [S, W] inside then."""
    angle = np.arange(0, sweep, sweep * STEP)
    shape = (len(angle), len(SHARES), len(head.length))
    along = SHARES[:, None] * head.length + np.zeros(shape)
    point = shaft_points(head, np.broadcast_to(angle[:, None, None], shape), along)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    low = point[..., 2] < boxes.height.max()
    u, v, z = point[low].T
    x, y = pose[0] + c * u - s * v, pose[1] + s * u + c * v
    within = np.zeros(len(z), bool)
    for (west, south, east, north), height in zip(boxes.box, boxes.height, strict=True):
        within |= (west < x) & (x < east) & (south < y) & (y < north) & (z < height)
    inside = np.zeros(shape, bool)
    inside[low] = within
    hit = inside.any(axis=1)
    first = np.argmax(hit, axis=0)
    return np.where(hit.any(axis=0), angle[first], NO_CONTACT), inside[first, :, np.arange(shape[2])].T


@pytest.mark.parametrize("name", HEADS)
def test_contact_agrees_with_the_search(name):
    config, degrees = HEADS[name]
    head, sweep = ur10_head(config), np.radians(degrees)
    random = np.random.default_rng(0)
    late, beside, missed = [], [], []
    for seed in range(3):
        boxes = maze_of(seed, (0.05, 0.03))
        poses = np.column_stack([random.uniform(0, 0.54, (2, 2)), random.uniform(-9, 9, 2)])
        contact = Surroundings(boxes, head).contact(poses)
        for pose, angle, reach in zip(poses, contact.angle, contact.reach, strict=True):
            brute, inside = search_contact(head, boxes, pose, sweep)
            there, met = angle <= sweep, np.isfinite(brute)
            assert (there | ~met).all()  # every contact of the search is found
            late += (brute[met] - angle[met]).tolist()
            missed += (there & ~met)[there].tolist()
            nearest = np.where(inside, np.abs(SHARES[:, None] - reach), 1.0).min(axis=0)
            beside += nearest[met & (angle > 0)].tolist()
    assert len(late) > 4
    # The search may miss a corner touched for less than a step.
    assert min(late) > -1e-9
    assert np.quantile(late, 0.95) < 0.006
    assert np.mean(missed) < 0.05
    assert np.quantile(beside, 0.95) < 0.01


def test_the_tip_touches_the_top_of_a_wall_and_the_shaft_its_far_edge():
    """By hand: a 100 mm whisker, horizontal at rest, with its base 100 mm above the floor on the axis."""
    ring = RingConfig(length=0.1, radius=1e-9, height=0.1)
    head = ur10_head(HeadConfig(rings=(ring,), whiskers=1, rest_deg=90.0, limit_deg=90.0))

    def first_contact(west: float, east: float, height: float) -> tuple[float, float]:
        boxes = Walls(np.array([[west, -0.5, east, 0.5]]), np.array([height]))
        contact = Surroundings(boxes, head).contact(np.zeros((1, 3)))
        return float(contact.angle[0, 0]), float(contact.reach[0, 0])

    angle, reach = first_contact(0.05, 0.2, 0.04)  # the tip descends to 4 cm: cos = 0.6
    assert (angle, reach) == pytest.approx((np.pi / 2 - np.arccos(0.6), 1.0))
    angle, reach = first_contact(0.02, 0.03, 0.06)  # the edge 3 cm out and 4 cm below the base
    assert (angle, reach) == pytest.approx((np.pi / 2 - np.arctan2(0.03, 0.04), 0.5))
    assert first_contact(0.09, 0.2, 0.04)[0] == NO_CONTACT  # beyond the tip's range
    assert first_contact(-0.2, -0.1, 0.04)[0] == NO_CONTACT  # behind


@settings(max_examples=15)
@given(st.integers(0, 50), st.integers(1, 12))
def test_a_query_of_many_poses_equals_queries_of_each(seed, count):
    random, walls, head = np.random.default_rng(seed), maze_of(seed), ur10_head(HeadConfig())
    pose = np.column_stack([random.uniform(-0.1, 0.64, (count, 2)), random.uniform(-9, 9, count)])
    pose[0] = 30.0, -20.0, 1.0  # far from walls
    whole = Surroundings(walls, head).contact(pose)
    for row in range(count):
        alone = Surroundings(walls, head).contact(pose[row : row + 1])
        for column, other in zip(whole, alone, strict=True):
            assert (column[row] == other[0]).all()
    assert (whole.angle[0] == NO_CONTACT).all()
    assert ((whole.wall >= 0) == np.isfinite(whole.angle)).all()
    assert (whole.reach[~np.isfinite(whole.angle)] == 0).all()
