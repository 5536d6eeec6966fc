"""Whiskers among walls: geometry of bending, beam theory, strain sensors; templates of simulated drives."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from evaluation.papers.fox2012.template_training import ESTIMATORS, HeldOutDrive, drive_held_out
from ratslam.cli import main
from robot.simulation.create import strain_sensors as sensors
from robot.simulation.create.simulated_session import CreateSimulation, CreateSimulationConfig
from robot.simulation.create.strain_sensors import Bending, WhiskersConfig, bend_whiskers, shaft_tilt
from robot.touch_source import observation_of, open_touch_source
from robot.world.arena import Arena, ArenaConfig, make_arena, wall_segments
from robot.world.walls import segment_distance, segments_cross
from tactile.base.errors import InputError
from tactile.frontend import TouchConfig
from tactile.wall_estimation.strain_templates import StrainTemplates
from tests.helpers.commands import refused

SEEDS, CONFIG, FREE = st.integers(0, 10**6), WhiskersConfig(), np.zeros(4, int)
FAN = sensors.fixed_whiskers(CONFIG)
LENGTH = FAN.length


def arena_and_poses(seed: int) -> tuple[Arena, np.ndarray]:
    room, random = make_arena(ArenaConfig(rotated=True), seed % 20), np.random.default_rng(seed)
    poses = random.uniform([0, 0, -np.pi], [1.25, 1.25, np.pi], (1000, 3))
    near = segment_distance(wall_segments(room), poses[:, :2]).min(axis=1) < 0.25
    return room, poses[near & room.has_clearance(poses[:, :2], 0.17)][:30]


ONE = FAN._replace(base=np.zeros((1, 2)), direction=np.zeros(1))
"""A whisker ahead, at the origin of the body."""


def each(poses: np.ndarray, walls: np.ndarray) -> Bending:
    alone = [bend_whiskers(FAN, pose[None], walls, FREE) for pose in poses]
    return Bending(*(np.concatenate(column) for column in zip(*alone, strict=True)))


def lines(poses: np.ndarray, turn: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Segments [N * 4, 4] from each whisker's base, of length `reach`, turned by `turn`."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x = poses[:, :1] + c * FAN.base[:, 0] - s * FAN.base[:, 1]
    y = poses[:, 1:2] + s * FAN.base[:, 0] + c * FAN.base[:, 1]
    way = poses[:, 2:] + FAN.direction + turn
    return np.stack([x, y, x + reach * np.cos(way), y + reach * np.sin(way)], axis=-1).reshape(-1, 4)


@settings(max_examples=10)
@given(SEEDS)
def test_whiskers_bend_by_the_smallest_angle_that_keeps_them_out_of_walls(seed):
    room, poses = arena_and_poses(seed)
    walls, bend = wall_segments(room), each(poses, wall_segments(room))
    whole, held = np.full(bend.turn.shape, LENGTH), bend.turn != 0

    def blocked(turn: np.ndarray, reach: np.ndarray = whole) -> np.ndarray:
        return segments_cross(lines(poses, turn, reach), walls).any(axis=1).reshape(-1, 4)

    assert (held == blocked(0 * bend.turn)).all()
    assert (np.sign(bend.turn) == bend.side).all()
    assert held.sum() > 10
    # A bent whisker touches a wall; slightly shorter and turned slightly further, it crosses none.
    reached = lines(poses, bend.turn, bend.reach)[held.ravel()]
    assert segment_distance(walls, reached[:, 2:]).min(axis=1).max() < 1e-6
    assert not blocked(bend.turn + 1e-7 * bend.side, bend.reach - 1e-5)[held].any()
    assert (bend.reach <= LENGTH * (1 + 1e-9)).all()
    for share in np.linspace(-0.999, 0.999, 8):
        assert blocked(share * bend.turn)[held].all()
    beyond = blocked(bend.turn + 1e-6 * bend.side)
    assert not beyond[bend.reach > LENGTH - 1e-9].any()
    flat = np.isclose((shaft_tilt(FAN, bend.reach) - 1) * np.abs(bend.turn), bend.lean, atol=1e-6)
    assert flat[beyond].all()  # along a wall a smaller turn suffices


@settings(max_examples=8)
@given(SEEDS, *[st.floats(-3, 3)] * 3)
def test_bending_moves_and_is_mirrored_with_the_walls(seed, x, y, angle):
    room, poses = arena_and_poses(seed)
    segments, here = wall_segments(room).reshape(-1, 2), each(poses, wall_segments(room))
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    moved = np.column_stack([poses[:, :2] @ turn.T + [x, y], poses[:, 2] + angle])
    there = each(moved, (segments @ turn.T + [x, y]).reshape(-1, 4))
    assert np.allclose(here.turn, there.turn, atol=1e-7)
    assert np.allclose(here.reach, there.reach, atol=1e-7)
    mirrored = each(poses * [1, -1, -1], (segments * [1.0, -1.0]).reshape(-1, 4))
    assert np.allclose(here.turn, -mirrored.turn[:, ::-1], atol=1e-9)  # the fan is symmetric
    one, other = sensors.base_strains(CONFIG, FAN, here), sensors.base_strains(CONFIG, FAN, mirrored)
    assert np.allclose(one[..., 0], -other[:, ::-1, 0], atol=1e-12)


@settings(max_examples=10)
@given(SEEDS, st.integers(1, 58))
def test_a_motion_may_be_computed_in_parts(seed, cut):
    room, poses = arena_and_poses(seed)
    assume(len(poses) > 0)
    way = poses[0] + np.linspace(0, 1, 60)[:, None] * [0.03, -0.02, 1.5]
    whole = bend_whiskers(FAN, way, wall_segments(room), FREE)
    first = bend_whiskers(FAN, way[:cut], wall_segments(room), FREE)
    second = bend_whiskers(FAN, way[cut:], wall_segments(room), first.side[-1])
    for column, one, two in zip(whole, first, second, strict=True):
        assert (column == np.concatenate([one, two])).all()


def test_a_whisker_stays_on_its_side():
    """A wall first straight across, then tilted to the other side."""
    for tip in np.radians(np.linspace(85, 95, 40)):
        wall = np.array([[0.13 - np.cos(tip), -np.sin(tip), 0.13 + np.cos(tip), np.sin(tip)]])
        for side in (1, -1):
            assert bend_whiskers(ONE, np.zeros((1, 3)), wall, np.array([side])).turn[0, 0] * side > 0
    # Turned on the spot before one wall, from one side of the perpendicular to the other.
    wall = np.array([[0.13, -1.0, 0.13, 1.0]])
    turned = np.column_stack([np.zeros((40, 2)), np.linspace(0.1, -0.1, 40)])
    assert (bend_whiskers(ONE, turned, wall, np.zeros(1, int)).side == 1).all()
    assert bend_whiskers(ONE, turned[-1:], wall, np.zeros(1, int)).side[0, 0] == -1


def test_contact_with_a_tip_and_a_shaft_and_no_wall_in_reach():
    wall = np.array([[-1.0, 0.0, 1.0, 0.0]])
    height = np.linspace(0.0999, 0.02, 400)  # of the base above the wall, seen at 45 degrees
    poses = np.column_stack([np.zeros(400), height, np.full(400, -np.pi / 4)])
    bend = bend_whiskers(ONE, poses, wall, np.zeros(1, int))
    turn, reach = bend.turn[:, 0], bend.reach[:, 0]
    touching, lies = turn != 0, reach <= LENGTH - 1e-9
    assert (turn[touching] > 0).all()  # along the wall, away from the base
    assert (np.diff(turn) >= -1e-12).all()
    by_tip = touching & ~lies
    assert np.allclose(height[by_tip], LENGTH * np.sin(np.pi / 4 - turn[by_tip]))
    assert lies.argmax() > touching.argmax() > 0
    assert (np.diff(reach[lies]) < 0).all()
    assert np.abs(np.diff(reach)).max() < 3e-3  # without jumps
    assert np.allclose(turn[lies] * shaft_tilt(FAN, reach[lies]), np.pi / 4)
    for wall in (np.array([[0.0, 0.5, 1.0, 0.5]]), np.zeros((0, 4))):
        bend = bend_whiskers(FAN, np.zeros((3, 3)), wall, FREE)
        for column, value in zip(bend, (0.0, LENGTH, 0.0, 0), strict=True):
            assert (column == value).all()


@given(st.floats(0.02, 0.139), st.floats(0.2, 1.0))
def test_moments_are_those_of_a_tapered_beam(reach, taper):
    """Compared with the integrated curvature of a cone under a point force."""
    shaft = FAN._replace(radius=0.7e-3, taper=(1 - taper) / LENGTH)
    x = np.linspace(0, reach, 4001)
    curvature = (reach - x) / (1 - shaft.taper * x) ** 4  # F / (E I0) = 1

    def integral(y: np.ndarray) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum((y[1:] + y[:-1]) / 2 * np.diff(x))])

    slope = integral(curvature)
    turn = integral(slope)[-1] / reach
    assert shaft_tilt(shaft, np.array(reach)) == pytest.approx(slope[-1] / turn, rel=1e-4)
    bent = Bending(*(np.full((1, 1), value) for value in (turn, reach, 0.0, 1)))
    strain = sensors.base_strains(CONFIG, shaft._replace(alive=np.ones(1, bool)), bent)
    assert strain[0, 0, 0] == pytest.approx(0.7e-3 * curvature[0], rel=1e-4)


def test_impossible_whiskers_are_refused():
    wrong = {"dead": (4,), "tip_diameter": 2e-3, "mounts": (), "length": 0.0, "droop_deg": 45.0}
    for name, value in wrong.items():
        with pytest.raises(ValidationError):
            WhiskersConfig.model_validate({name: value})


DRIVES = CreateSimulationConfig(seed=4)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("templates")
    (folder / "create.yaml").write_text("create_simulation: {seed: 4}\n")
    path = folder / "new" / "t.npz"
    assert main(["reproduce", "templates", str(folder / "create.yaml"), "-o", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def templates(file):
    return StrainTemplates.read(file)


def errors(drives: list[HeldOutDrive], way: str, known: bool) -> np.ndarray:
    """Errors [drives, DURATIONS] of one estimator, at trained angles or between them."""
    return np.array([error[:, ESTIMATORS.index(way)] for _, there, error in drives if there == known])


def test_walls_without_training_are_recognised(templates):
    assert np.abs(templates.mean).sum() == pytest.approx(117.444679)
    tried = drive_held_out(DRIVES, templates)
    assert [known for _, known, _ in tried] == [True, False] * 14 + [True]
    assert np.allclose([angle for angle, _, _ in tried], np.arange(20, 161, 5))
    assert errors(tried, "winner", True).mean() < 2
    # Between two templates the error of the nearer one is at least half a step.
    between = errors(tried, "winner", False)
    assert between.min() == pytest.approx(5)
    assert between.mean() < 6
    assert np.nanmean(errors(tried, "fused", False)) < 1
    with pytest.raises(InputError, match="does not fit straight whiskers"):
        drive_held_out(DRIVES, templates._replace(mean=templates.mean[::-1].copy()))


def test_sessions_use_the_file(file):
    given, seen = {"walls": "template", "templates": file, "max_template_error": None}, []
    for reports in (given, given | {"templates": None}):
        simulation = CreateSimulation(CreateSimulationConfig(reports=40, seed=1))
        samples = open_touch_source(simulation, TouchConfig.model_validate({"reports": reports}))
        walls = [observation_of(sample) for sample in samples]
        seen.append([np.degrees(np.arctan2(*one.wall_point[::-1])) for one in walls if one.wall])
    assert len(seen[0]) == len(seen[1]) > 0
    assert np.allclose(seen[0], seen[1], atol=10.01)


def test_invalid_sessions_are_refused(tmp_path, capsys):
    config = tmp_path / "c.yaml"
    for text, message in (
        ("simulation: {}\n", "create_simulation"),
        ("create_simulation: {behaviour: {contact: 0.0019}, whiskers: {length: 0.01}}\n", "no contact"),
    ):
        config.write_text(text)
        assert message in refused(capsys, "reproduce", "templates", config, "-o", tmp_path / "t.npz")
    assert list(tmp_path.iterdir()) == [config]
