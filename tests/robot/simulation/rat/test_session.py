"""Sessions of a rat: panoramic views, odometry, phases, errors; paths, their files and random walks."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from robot.simulation.rat import simulated_session as simulated
from robot.simulation.rat.box import BoxConfig, CueConfig, ViewConfig, panoramic_views, torus_ratio
from robot.simulation.rat.rat_path import MotionConfig, RatPath, sample_path
from robot.simulation.rat.simulated_session import PathFileConfig, RatSimulation, RatSimulationConfig
from tactile.base.errors import InputError
from tactile.base.se2 import compose, integrate

EXACT = {"speed_white": 0.0, "heading_white": 0.0}
CIRCLE = np.linspace(0, 8 * np.pi, 401)
PATH = RatPath(0.1 * np.arange(401), 0.5 + 0.3 * np.column_stack([np.cos(CIRCLE), np.sin(CIRCLE)]))
"""Four rounds of 10 s on a circle of 0.3 m about the middle."""
BARE = {"cards": (), "distal": ()}


def session(path: RatPath | None = PATH, **given) -> RatSimulation:
    return RatSimulation(RatSimulationConfig(**{"rate_hz": 20.0, "odometry": EXACT} | given), path)


def look(box: BoxConfig, pose: list, turns: tuple = (0.0, 0.0), stretch: tuple = (1.0, 1.0)) -> np.ndarray:
    """[C] the view from a pose."""
    scene = np.array([pose], float), *np.array(turns)[:, None], np.array([stretch])
    return panoramic_views(box, ViewConfig(noise=0.0), *scene)[0, 0, :, 0]


@given(st.floats(0.01, 0.99), st.floats(0.01, 0.99), st.integers(0, 35))
def test_a_turn_by_columns_rolls_the_view(x, y, columns):
    turned = look(BoxConfig(), [x, y, 0.003 + columns * 2 * np.pi / 36])
    np.testing.assert_allclose(turned, np.roll(look(BoxConfig(), [x, y, 0.003]), -columns), atol=1e-9)


def test_cues_are_at_their_directions_and_views_of_a_turned_and_stretched_box_stay_the_same():
    card = CueConfig(at_deg=90, extent_deg=40, brightness=1.0)
    box = BoxConfig(wall=10.0, cards=(card,), distal=(), wall_brightness=0.2)
    view = look(box, [0.5, 0.5, 0.0])
    np.testing.assert_allclose(view[8:11], 1.0)
    np.testing.assert_allclose(np.delete(view, range(7, 12)), 0.2)
    far = box.model_copy(update={"wall": 0.05, "cards": (), "distal": (card,)})
    for place in ([0.2, 0.3, 0.0], [0.8, 0.7, 0.0]):
        assert look(far, place)[9] > 0.8
    turned = look(BoxConfig(), [0.7, 0.2, 0.5], (0.3, -0.4), (1.4, 1.0))
    known = [0.946, 0.433, 0.264, 0.088, 0.262, 0.358, 0.350, 0.409, 0.394, 0.384, 0.337, 0.277]
    np.testing.assert_allclose(turned[::3], known, atol=6e-4)
    for place in ([0.0, 0.0, 0.0], [1.0, 0.5, 1.0], [1.0, 1.0, -2.0]):  # at walls
        assert np.isfinite(look(BoxConfig(), place)).all()
    assert torus_ratio((0.0, 0.0, 3.5, 2.1), 1.05) == pytest.approx((10 / 3, 2.0))


def test_exact_odometry_integrates_to_the_truth():
    for source in (session(), session(None, seconds=60.0), session(None, seconds=60.0, walk={})):
        found = integrate(source.odometry[:, :3], source.truth[0])
        np.testing.assert_allclose(found[:, :2], source.truth[:, :2], atol=1e-9)
        np.testing.assert_allclose(np.exp(1j * found[:, 2]), np.exp(1j * source.truth[:, 2]), atol=1e-9)
        assert source.odometry[0].tolist() == [0.0, 0.0, 0.0, 0.0]
        assert (source.odometry[1:, 3] == 0.05).all()


def test_the_same_settings_give_the_same_bits():
    def contents(**given) -> tuple:
        source = RatSimulation(RatSimulationConfig(seconds=10.0, **given))
        parts = [(s.time, s.truth.tobytes(), s.reading.view.tobytes(), *s.reading.odometry) for s in source]
        return source.digest, parts

    assert contents() == contents()
    assert contents()[1] != contents(seed=1)[1]
    assert len({contents(**given)[0] for given in ({}, {"seed": 1}, {"path": {"skip": 1.0}})}) == 3


def test_readings_have_views_at_every_nth_row_and_a_dark_phase_leaves_the_noise_of_others():
    samples = list(session(views={"every": 4, "columns": 12}))
    seen = [bool(sample.reading.view_seen) for sample in samples[:9]]
    assert seen == 2 * [True, False, False, False] + [True]
    assert {sample.reading.view.shape for sample in samples} == {(1, 12, 1)}
    light, dark = session(), session(phases=[{"start": 10, "end": 20, "dark": True}])
    np.testing.assert_array_equal(light.odometry, dark.odometry)
    rows, views = light.views()
    kept = (rows < 200) | (rows >= 400)
    lit, seen = dark.views()
    np.testing.assert_array_equal(lit, rows[kept])
    np.testing.assert_array_equal(seen, views[kept])
    assert 21 * light.info.cell_size == pytest.approx(1.05)  # a torus larger than the box


def test_a_kidnap_or_a_stretched_box_changes_the_truth_and_the_odometry_goes_on():
    source = session(phases=[{"start": 20, "kidnap": [0.2, 0.5]}], seconds=30.0)
    assert np.hypot(*(source.truth[400, :2] - [0.2, 0.5])) < 0.02
    assert np.flatnonzero(np.hypot(*np.diff(source.truth[:, :2], axis=0).T) > 0.3).tolist() == [399]
    assert np.hypot(*source.odometry[:, :2].T).max() < 0.02
    after = integrate(source.odometry[401:, :3], source.truth[400])
    np.testing.assert_allclose(after[:, :2], source.truth[401:, :2], atol=1e-9)
    plain, source = session(), session(phases=[{"start": 20, "stretch": [1.4, 1.0]}])
    np.testing.assert_allclose(source.truth[400:, :2], plain.truth[400:, :2] * [1.4, 1.0])
    np.testing.assert_array_equal(source.odometry[:400], plain.odometry[:400])
    after = compose(source.truth[399:-1], source.odometry[400:, :3])
    np.testing.assert_allclose(after[1:, :2], source.truth[401:, :2], atol=1e-9)
    assert source.info.box == pytest.approx((0.0, 0.0, 1.4, 1.0))
    assert np.hypot(*source.odometry[:, :2].T).max() < 0.02


def test_a_conflict_of_cues_is_two_phases_and_another_box_has_its_own_cues_and_size():
    local = {"start": 10, "rotate_cues_deg": 45, "cues": "local"}
    distal = {"start": 20, "rotate_cues_deg": -45, "cues": "distal"}
    times = session(phases=[local, distal, {"start": 30, "rotate_cues_deg": 10}]).timeline
    turns = np.degrees([times.card_turn, times.distal_turn])[:, :800:200]
    np.testing.assert_allclose(turns, [[0, 45, 45, 55], [0, 0, -45, -35]])
    other = BARE | {"width": 2.0, "height": 1.0, "wall_brightness": 0.0, "room_brightness": 0.0}
    source = session(phases=[{"start": 20, "end": 30, "box": other}], views={"noise": 0.0})
    rows, views = source.views()
    there = (rows >= 400) & (rows < 600)
    assert (views[there] == 0).all()
    assert (views[~there].max(axis=(1, 2, 3)) > 0.3).all()
    assert source.truth[400:600, 0].max() > 1.2
    assert source.info.cell_size == pytest.approx(0.1)


def test_phases_boxes_and_paths_that_do_not_fit():
    broken = PATH.position.copy()
    broken[3, 0] = np.nan
    for phases, message in (
        ([{"start": 100, "dark": True}], "0.start: 100 s; expected .*40.05 s"),
        ([{"start": 1, "stretch": [2, 1]}, {"start": 30, "box": {}}], "1.start: the box is changed"),
        ([{"start": 5, "kidnap": [0.0, 0.0]}], r"0.kidnap: .*no nearer to \(0, 0\) than 0.54 m"),
    ):
        with pytest.raises(InputError, match=f"^rat_simulation.phases.{message}"):
            session(phases=phases)
    for path, changes, message in (
        (PATH._replace(position=PATH.position + 5), {}, "rat path: no position is inside the box"),
        (PATH, {"box": BoxConfig(width=0.5)}, r"rat path: \d+ positions up to 0.3 m outside"),
        (PATH._replace(position=broken), {}, "rat path, row 3: the position is nan"),
        (PATH, {"seconds": 50.0}, "rat_simulation.seconds: 50 s; expected at most the 40.05 s"),
    ):
        with pytest.raises(InputError, match=message):
            session(path, **changes)
    for settings, message in (
        ({"phases": [{"start": 5, "end": 5, "dark": True}]}, "is not after the start"),
        ({"phases": [{"start": 5}]}, "changes nothing"),
        ({"phases": [{"start": 5, "end": 6, "kidnap": [0.5, 0.5]}]}, "has no end"),
        ({"phases": [{"start": 5, "dark": True, "cues": "local"}]}, "no rotate_cues_deg"),
        ({"phases": [{"start": 5, "stretch": [2, 1], "box": {}}]}, "another box"),
        *(({"box": box}, next(iter(box))) for box in ({"width": 0}, {"height": -1}, {"wall_brightness": 2})),
    ):
        with pytest.raises(ValidationError, match=message):
            RatSimulationConfig(**settings)


def test_errors_of_odometry_are_independent_and_stay_the_same():
    def odometry(**errors: float) -> np.ndarray:
        return session(None, walk={}, seconds=50.0, odometry=EXACT | errors).odometry

    truth, speed, heading = odometry(), odometry(speed_white=0.1), odometry(heading_white=0.03)
    both = odometry(speed_white=0.1, heading_white=0.03)
    np.testing.assert_array_equal(both, np.column_stack([speed[:, :2], heading[:, 2:]]))
    np.testing.assert_array_equal(speed[:, 2], truth[:, 2])
    np.testing.assert_array_equal(heading[:, :2], truth[:, :2])
    assert (speed[1:, 0] / truth[1:, 0] - 1).std() == pytest.approx(0.1 * np.sqrt(20), rel=0.05)
    assert (heading - truth)[1:, 2].std() == pytest.approx(0.03 / np.sqrt(20), rel=0.05)
    np.testing.assert_allclose(odometry(speed_scale=0.05)[:, :2], 1.05 * truth[:, :2])
    np.testing.assert_allclose(odometry(heading_bias=0.02)[1:, 2], truth[1:, 2] + 0.001)


MOTION = MotionConfig()
MILLIMETRES = st.integers(0, 1000).map(lambda value: value / 1000)
POINTS = st.lists(st.tuples(MILLIMETRES, MILLIMETRES), min_size=2, max_size=20)


@given(POINTS, st.floats(5, 60), st.sampled_from([0.0, 0.1]))
def test_sampled_positions_stay_in_bounds(points, rate, smoothing):
    position = np.array(points)
    path = RatPath(0.5 * np.arange(len(points)), position)
    pose = sample_path(path, MOTION, rate, smoothing)
    low, high = position.min(axis=0) - 1e-12, position.max(axis=0) + 1e-12
    assert ((low <= pose[:, :2]) & (pose[:, :2] <= high)).all()
    assert len(pose) == int(path.time[-1] * rate + 1e-6) + 1
    kept = sample_path(path, MOTION, 2.0)  # at the path's own times
    np.testing.assert_allclose(kept[:, :2], path.position, atol=1e-9)


def test_the_heading_is_that_of_a_circle_and_not_wrapped_and_a_standing_rat_keeps_it():
    angle = np.linspace(0, 6 * np.pi, 601)
    heading = sample_path(RatPath(angle, np.column_stack([np.cos(angle), np.sin(angle)])), MOTION, 50.0)[:, 2]
    np.testing.assert_allclose(heading[50:-50], (np.arange(len(heading)) / 50)[50:-50] + np.pi / 2, atol=0.01)
    given = RatPath(np.array([0.0, 1.0]), np.zeros((2, 2)), np.array([3.0, -3.0]))
    np.testing.assert_allclose(sample_path(given, MOTION, 2.0)[:, 2], [3.0, np.pi, 2 * np.pi - 3.0])
    # North, 4 s of standing with a jitter of 0.1 mm, then west.
    way = np.linspace(0, 0.4, 41)
    place = np.column_stack([np.pad(-way, (81, 0)), np.pad(way, (0, 81), "edge")])
    position = place + 1e-4 * np.random.default_rng(1).standard_normal((122, 2))
    pose = sample_path(RatPath(0.1 * np.arange(122), position), MOTION, 50.0)
    np.testing.assert_allclose(pose[220:360, 2], np.pi / 2, atol=0.05)
    np.testing.assert_allclose(pose[-100:, 2], np.pi, atol=0.05)
    assert np.abs(np.diff(pose[:, 2])).max() < 0.2


def test_packaged_paths_are_of_rats():
    for name, seconds, size in (("sargolini", 599.5, (1.0, 1.0)), ("tanni", 1199.5, (3.5, 2.5))):
        path = simulated.read_path(PathFileConfig(file=name))
        assert path.time[-1] - path.time[0] > seconds
        assert ((path.position > -0.1) & (path.position < np.add(size, 0.1))).all()
        assert simulated.PACKAGED[name].with_name("LICENSE").exists()


@pytest.mark.parametrize("kind", ["csv", "npz", "whole numbers"])
def test_files_of_each_kind_give_the_same_path(kind, tmp_path):
    time, position = 0.1 * np.arange(30), np.random.default_rng(0).integers(0, 10_000, (30, 2)) / 1000
    file = tmp_path / ("a.csv" if kind == "csv" else "a.npz")
    if kind == "csv":
        rows = np.column_stack([time, position])
        np.savetxt(file, rows, delimiter=",", header="t,x,y", comments="", fmt="%.17g")
    elif kind == "npz":
        np.savez(file, t=time, pos=position)
    else:  # in ms and mm
        np.savez(file, t=np.arange(0, 3000, 100), pos=np.round(1000 * position).astype(int))
    path = simulated.read_path(PathFileConfig(file=file, unit=0.01, shift=(1.0, 0.0), skip=1.05))
    np.testing.assert_allclose(path.time, time[11:], atol=1e-12)
    np.testing.assert_allclose(path.position, position[11:] * 0.01 + [1.0, 0.0], atol=1e-12)


def test_a_faulty_path_gives_file_and_row(tmp_path):
    np.savez(tmp_path / "a.npz", t=np.arange(3.0), pos=np.zeros((3, 3)))
    np.savez(tmp_path / "b.npz", t=np.array([0.0, 0.1]), pos=np.array([[0.0, 0.0], [np.nan, 0.0]]))
    for config, message in (
        ({"file": tmp_path / "a.npz"}, r"a.npz: another kind of file .*pos \[3, 3\]"),
        ({"file": tmp_path / "b.npz"}, "b.npz:1: the position is nan"),
        ({"skip": 700}, r"rat_simulation.path.skip: 700 s to skip"),
    ):
        with pytest.raises(InputError, match=message):
            simulated.read_path(PathFileConfig(**config))
    for lines, message in (
        (["0,0,0", "0.1,nan,0", "0.2,0,0"], ":3: x is nan"),
        (["0,0,0", "0.1,0,0", "0.05,0,0"], ":4: t goes back"),
        (["0,0,0", "0.1,60,0"], ":3: a speed of 600 m/s; expected at most 5 m/s"),
        (["0,0,0", "0.1,0,0", "9,0,0"], ":4: no position for 8.9 s; expected at most 2 s"),
        (["0,0,0"], ":2: 1 positions"),
    ):
        file = tmp_path / "path.csv"
        file.write_text("\n".join(["t,x,y", *lines]))
        with pytest.raises(InputError, match=f"^{re.escape(f'{file}{message}')}"):
            simulated.read_path(PathFileConfig(file=file))


def test_a_walk_has_the_given_speeds_stays_inside_and_begins_a_longer_one():
    config = simulated.RandomWalkConfig(speed=0.2, speed_sd=0.1)
    path = simulated.walk_randomly(config, (1.0, 0.6), 300.0, 20.0, 3)
    assert ((path.position >= 0) & (path.position <= [1.0, 0.6])).all()
    speed = np.hypot(*np.diff(path.position, axis=0).T) * 20
    assert abs(speed.mean() - 0.2) < 0.02
    assert abs(speed.std() - 0.1) < 0.02
    short = simulated.walk_randomly(config, (1.0, 0.6), 5.0, 20.0, 3).position
    np.testing.assert_array_equal(short, path.position[: len(short)])
    known = [[0.5, 0.3], [0.93205, 0.218491], [0.53375, 0.344527], [0.756468, 0.06543]]
    np.testing.assert_allclose(path.position[[0, 50, 100, -1]], known, atol=1e-6)
