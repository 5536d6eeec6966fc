"""Whiskers among walls: geometry of bending, beam theory, and strain sensors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from robot.simulation.create.strain_sensors import (
    Bending,
    FixedWhiskers,
    ShakeConfig,
    WhiskersConfig,
    base_strains,
    bend_whiskers,
    fixed_whiskers,
    sample_strain,
    shaft_tilt,
)
from robot.world.arena import Arena, ArenaConfig, make_arena, wall_segments
from robot.world.walls import polygon_edges, segment_distance, segments_cross, square
from tactile.base.random_streams import stream
from tactile.contact_threshold import ShaftConfig, stiffness

SEEDS = st.integers(0, 10**6)
CONFIG = WhiskersConfig()
FAN = fixed_whiskers(CONFIG)
LENGTH = FAN.length
FREE = np.zeros(4, int)


def arena_and_poses(seed: int) -> tuple[Arena, np.ndarray]:
    """An arena with rotated objects, and free poses [50, 3] in it, mostly near walls."""
    room, random = make_arena(ArenaConfig(rotated=True), seed % 20), np.random.default_rng(seed)
    poses = random.uniform([0, 0, -np.pi], [1.25, 1.25, np.pi], (4000, 3))
    near = segment_distance(wall_segments(room), poses[:, :2]).min(axis=1) < 0.25
    return room, poses[near & room.has_clearance(poses[:, :2], 0.17)][:50]


ONE = FAN._replace(base=np.zeros((1, 2)), direction=np.zeros(1))
"""A whisker ahead, at the origin of the body."""


def each(poses: np.ndarray, walls: np.ndarray) -> Bending:
    """Bending of whiskers at independent poses."""
    alone = [bend_whiskers(FAN, pose[None], walls, FREE) for pose in poses]
    return Bending(*(np.concatenate(column) for column in zip(*alone, strict=True)))


def lines(poses: np.ndarray, turn: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Segments [N * 4, 4] from each whisker's base, of length `reach`, turned by `turn`."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x = poses[:, :1] + c * FAN.base[:, 0] - s * FAN.base[:, 1]
    y = poses[:, 1:2] + s * FAN.base[:, 0] + c * FAN.base[:, 1]
    way = poses[:, 2:] + FAN.direction + turn
    return np.stack([x, y, x + reach * np.cos(way), y + reach * np.sin(way)], axis=-1).reshape(-1, 4)


@settings(max_examples=20)
@given(SEEDS)
def test_whiskers_bend_only_where_they_would_enter_walls(seed: int) -> None:
    room, poses = arena_and_poses(seed)
    walls, bend = wall_segments(room), each(poses, wall_segments(room))
    straight = lines(poses, np.zeros((len(poses), 4)), np.full((len(poses), 4), LENGTH))
    assert ((bend.turn != 0) == segments_cross(straight, walls).any(axis=1).reshape(-1, 4)).all()
    assert (np.sign(bend.turn) == bend.side).all()
    assert (bend.turn != 0).sum() > 10


@settings(max_examples=20)
@given(SEEDS)
def test_a_bent_whisker_touches_a_wall_and_enters_none(seed: int) -> None:
    room, poses = arena_and_poses(seed)
    walls, bend = wall_segments(room), each(poses, wall_segments(room))
    held = (bend.turn != 0).ravel()
    reached = lines(poses, bend.turn, bend.reach)[held]
    assert segment_distance(walls, reached[:, 2:]).min(axis=1).max() < 1e-6
    # Slightly shorter and turned slightly further, the line to the contact crosses no wall.
    clear = lines(poses, bend.turn + 1e-7 * bend.side, bend.reach - 1e-5)[held]
    assert not segments_cross(clear, walls).any()
    assert (bend.reach <= LENGTH * (1 + 1e-9)).all()


@settings(max_examples=20)
@given(SEEDS)
def test_a_whisker_turns_by_the_smallest_free_angle(seed: int) -> None:
    """With a smaller turn the straight shaft would be in a wall, on either side."""
    room, poses = arena_and_poses(seed)
    walls, bend = wall_segments(room), each(poses, wall_segments(room))
    held, whole = bend.turn != 0, np.full(bend.turn.shape, LENGTH)
    for share in np.linspace(-0.999, 0.999, 14):
        blocked = segments_cross(lines(poses, share * bend.turn, whole), walls).any(axis=1).reshape(-1, 4)
        assert blocked[held].all()
    beyond = (
        segments_cross(lines(poses, bend.turn + 1e-6 * bend.side, whole), walls).any(axis=1).reshape(-1, 4)
    )
    assert not beyond[bend.reach > LENGTH - 1e-9].any()
    assert flat(bend)[beyond].all()  # along a wall a smaller turn suffices


def flat(bend: Bending) -> np.ndarray:
    """Whiskers whose shaft lies along a wall or a corner."""
    return np.isclose((shaft_tilt(FAN, bend.reach) - 1) * np.abs(bend.turn), bend.lean, atol=1e-6)


@settings(max_examples=15)
@given(SEEDS, *[st.floats(-3, 3)] * 3)
def test_bending_does_not_depend_on_the_origin(seed: int, x: float, y: float, angle: float) -> None:
    room, poses = arena_and_poses(seed)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    walls = (wall_segments(room).reshape(-1, 2) @ turn.T + [x, y]).reshape(-1, 4)
    moved = np.column_stack([poses[:, :2] @ turn.T + [x, y], poses[:, 2] + angle])
    here, there = each(poses, wall_segments(room)), each(moved, walls)
    assert np.allclose(here.turn, there.turn, atol=1e-7)
    assert np.allclose(here.reach, there.reach, atol=1e-7)


@settings(max_examples=15)
@given(SEEDS)
def test_mirrored_walls_give_mirrored_bending(seed: int) -> None:
    room, poses = arena_and_poses(seed)
    mirror = np.array([1.0, -1.0])
    walls = (wall_segments(room).reshape(-1, 2) * mirror).reshape(-1, 4)
    here = each(poses, wall_segments(room))
    there = each(poses * [1, -1, -1], walls)
    assert np.allclose(here.turn, -there.turn[:, ::-1], atol=1e-9)  # the fan is symmetric
    one, other = base_strains(CONFIG, FAN, here), base_strains(CONFIG, FAN, there)
    assert np.allclose(one[..., 0], -other[:, ::-1, 0], atol=1e-12)


@settings(max_examples=20)
@given(SEEDS, st.integers(1, 58))
def test_a_motion_may_be_computed_in_parts(seed: int, cut: int) -> None:
    """The bending side is the only state."""
    room, poses = arena_and_poses(seed)
    assume(len(poses) > 0)
    way = poses[0] + np.linspace(0, 1, 60)[:, None] * [0.03, -0.02, 1.5]
    whole = bend_whiskers(FAN, way, wall_segments(room), FREE)
    first = bend_whiskers(FAN, way[:cut], wall_segments(room), FREE)
    second = bend_whiskers(FAN, way[cut:], wall_segments(room), first.side[-1])
    for column, one, two in zip(whole, first, second, strict=True):
        assert (column == np.concatenate([one, two])).all()


def test_a_whisker_stays_on_its_side() -> None:
    """A wall first straight across, then tilted to the other side."""
    tips = np.radians(np.linspace(85, 95, 40))
    turns = [
        bend_whiskers(
            ONE,
            np.zeros((1, 3)),
            np.array([[0.13 - np.cos(a), -np.sin(a), 0.13 + np.cos(a), np.sin(a)]]),
            np.array([side]),
        ).turn[0, 0]
        for side in (1, -1)
        for a in tips
    ]
    assert (np.array(turns[:40]) > 0).all()
    assert (np.array(turns[40:]) < 0).all()
    # Turned on the spot before one wall, from one side of the perpendicular to the other.
    wall = np.array([[0.13, -1.0, 0.13, 1.0]])
    turned = np.column_stack([np.zeros((40, 2)), np.linspace(0.1, -0.1, 40)])
    assert (bend_whiskers(ONE, turned, wall, np.zeros(1, int)).side == 1).all()
    assert bend_whiskers(ONE, turned[-1:], wall, np.zeros(1, int)).side[0, 0] == -1


def test_contact_with_a_tip_a_shaft_and_a_corner() -> None:
    wall = np.array([[-1.0, 0.0, 1.0, 0.0]])
    height = np.linspace(0.0999, 0.02, 400)  # of the base above the wall, seen at 45 degrees
    poses = np.column_stack([np.zeros(400), height, np.full(400, -np.pi / 4)])
    bend = bend_whiskers(ONE, poses, wall, np.zeros(1, int))
    turn, reach = bend.turn[:, 0], bend.reach[:, 0]
    touching = turn != 0
    assert touching.argmax() > 0
    assert (turn[touching] > 0).all()  # along the wall, away from the base
    assert (np.diff(turn) >= -1e-12).all()
    tip = reach > LENGTH - 1e-9
    assert np.allclose(height[tip & touching], LENGTH * np.sin(np.pi / 4 - turn[tip & touching]))
    lies = ~tip
    assert lies.any()
    assert lies.argmax() > touching.argmax()
    assert (np.diff(reach[lies]) < 0).all()
    assert np.abs(np.diff(reach)).max() < 3e-3  # without jumps
    # A whisker along the wall has the wall's direction.
    assert np.allclose(turn[lies] * shaft_tilt(FAN, reach[lies]), np.pi / 4)

    # Swept past the corner of an object: the bend grows, then the whisker is free at once.
    sides = polygon_edges(square(np.array([0.12, 0.1]), 0.2, np.pi / 4))
    sweep = np.column_stack([np.zeros((400, 2)), np.linspace(-0.7, 0.7, 400)])
    bend = bend_whiskers(ONE, sweep, sides + [0.09, -0.1] * 2, np.zeros(1, int))
    turn, reach = bend.turn[:, 0], bend.reach[:, 0]
    held = turn != 0
    assert held.any()
    assert (turn[held] < 0).all()
    assert (np.diff(turn[held]) < 0).all()
    rows = np.flatnonzero(held)
    assert (np.diff(rows) == 1).all()
    assert turn[rows[-1]] < -0.1
    assert turn[rows[-1] + 1] == 0


def test_a_wall_out_of_reach_bends_no_whisker() -> None:
    wall = np.array([[0.0, 0.5, 1.0, 0.5]])
    bend = bend_whiskers(FAN, np.zeros((3, 3)), wall, FREE)
    for column, value in zip(bend, (0.0, LENGTH, 0.0, 0), strict=True):
        assert (column == value).all()
    nothing = bend_whiskers(FAN, np.zeros((3, 3)), np.zeros((0, 4)), FREE)
    for one, other in zip(bend, nothing, strict=True):
        assert (one == other).all()


def strain_at(shaft: FixedWhiskers, turn: float, reach: float) -> float:
    """Horizontal strain of a whisker that is turned by an angle by a contact at a distance from its base."""
    bent = Bending(*(np.full((1, 1), value) for value in (turn, reach, 0.0, 1)))
    return float(base_strains(CONFIG, shaft._replace(alive=np.ones(1, bool)), bent)[0, 0, 0])


@given(st.floats(0.02, 0.139), st.floats(0.2, 1.0))
def test_moments_are_those_of_a_tapered_beam(reach: float, taper: float) -> None:
    """Compared with the integrated curvature of a cone under a point force."""
    shaft = FAN._replace(radius=0.7e-3, taper=(1 - taper) / LENGTH)
    x = np.linspace(0, reach, 4001)
    curvature = (reach - x) / (1 - shaft.taper * x) ** 4  # F / (E I0) = 1

    def integral(y: np.ndarray) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum((y[1:] + y[:-1]) / 2 * np.diff(x))])

    slope = integral(curvature)
    turn = integral(slope)[-1] / reach
    assert shaft_tilt(shaft, np.array(reach)) == pytest.approx(slope[-1] / turn, rel=1e-4)
    assert strain_at(shaft, turn, reach) == pytest.approx(0.7e-3 * curvature[0], rel=1e-4)


@given(st.floats(0.1, 1.0))
def test_wall_estimation_uses_the_same_beam_model(share: float) -> None:
    config = ShaftConfig(taper=0.3 / 1.45)
    mine, other = (strain_at(FAN, 1.0, LENGTH * place) for place in (share, config.reference))
    assert mine / other == pytest.approx(float(stiffness(config, share)))


def test_horizontal_strain_has_the_side_and_vertical_strain_the_slant() -> None:
    wall = np.array([[-1.0, 0.0, 1.0, 0.0]])

    def strains(angle: float) -> np.ndarray:
        """Strain [2] of a whisker at this angle to the wall, with its tip bent aside by 0.1 rad."""
        pose = np.array([[0.0, LENGTH * np.sin(angle - 0.1), -angle]])
        one = bend_whiskers(ONE, pose, wall, np.zeros(1, int))
        return base_strains(CONFIG, ONE._replace(alive=np.ones(1, bool)), one)[0, 0]

    steep, slanting = strains(1.2), strains(0.5)
    assert steep[0] == pytest.approx(slanting[0])
    assert steep[0] > 0
    assert steep[1] < slanting[1] < CONFIG.crosstalk * slanting[0]
    assert abs(steep[1]) < abs(steep[0])


def test_dead_whiskers_have_no_strain() -> None:
    config = WhiskersConfig(dead=(1, 2))
    one = fixed_whiskers(config)
    bend = bend_whiskers(one, np.zeros((5, 3)), np.array([[0.25, -1.0, 0.25, 1.0]]), FREE)
    strain = base_strains(config, one, bend)
    assert (bend.turn[:, 1:3] != 0).all()
    assert (strain[:, 1:3] == 0).all()
    read = sample_strain(config, np.ones((9, 4, 2)), one.alive, stream(0, "strain"))
    assert (read[:, 1:3] == 0).all()
    assert (read[:, [0, 3]] != 1).all()


def test_body_vibration_has_its_frequency_and_decays() -> None:
    still, config = CONFIG.model_copy(update={"noise": 0.0}), CONFIG.shake

    def shake(rows: int, seed: int) -> np.ndarray:
        return sample_strain(still, np.zeros((rows, 4, 2)), FAN.alive, stream(seed, "strain"))[:, 0]

    shakes = np.array([shake(4000, seed) for seed in range(60)])
    power = (np.abs(np.fft.rfft(shakes, axis=1)) ** 2).mean(axis=(0, 2))
    frequency = np.fft.rfftfreq(4000, 1 / 2000.0)
    assert abs(frequency[power.argmax()] - config.frequency) < 2
    assert power[frequency < 17].sum() < 0.1 * power.sum()  # removed by the paper's filter
    late = shakes[:, 2000:].std()
    assert late == pytest.approx(config.rumble, rel=0.1)
    assert shakes[:, :100].std() > 2 * late
    assert shake(0, 0).shape == (0, 2)


def test_sensor_noise_has_the_configured_level() -> None:
    calm = CONFIG.model_copy(update={"shake": ShakeConfig(start=0.0, rumble=0.0)})
    true = np.linspace(0, 1e-3, 3000)[:, None, None] * np.ones((1, 4, 2))
    error = sample_strain(calm, true, FAN.alive, stream(0, "strain")) - true
    assert error.std() == pytest.approx(calm.noise, rel=0.03)
    assert abs(error.mean()) < 0.05 * calm.noise
    # The vibration is the same for all whiskers and differs between the channels.
    shaking = (
        sample_strain(CONFIG.model_copy(update={"noise": 0.0}), true, FAN.alive, stream(0, "strain")) - true
    )
    assert np.allclose(shaking, shaking[:, :1])
    assert not np.allclose(shaking[..., 0], shaking[..., 1])


@pytest.mark.parametrize(
    "changes", [{"dead": (4,)}, {"tip_diameter": 2e-3}, {"mounts": ()}, {"length": 0.0}, {"droop_deg": 45.0}]
)
def test_impossible_whiskers_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        WhiskersConfig.model_validate(changes)
