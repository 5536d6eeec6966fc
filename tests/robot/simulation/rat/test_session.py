"""Sessions of a rat: panoramic views, odometry, phases, repeatability and errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from robot.simulation.rat.box import BoxConfig, CueConfig, ViewConfig, panoramic_views, torus_ratio
from robot.simulation.rat.rat_path import RatPath
from robot.simulation.rat.simulated_session import RatSimulation, RatSimulationConfig
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
    rows = [np.array([value]) for value in turns]
    views = ViewConfig(noise=0.0)
    return panoramic_views(box, views, np.array([pose], float), *rows, np.array([stretch]))[0, 0, :, 0]


@given(st.floats(0.01, 0.99), st.floats(0.01, 0.99), st.integers(0, 35))
def test_a_turn_by_columns_rolls_the_view(x: float, y: float, columns: int) -> None:
    """Counter-clockwise: what was seen `columns` to the left is now ahead."""
    turned = look(BoxConfig(), [x, y, 0.003 + columns * 2 * np.pi / 36])
    np.testing.assert_allclose(turned, np.roll(look(BoxConfig(), [x, y, 0.003]), -columns), atol=1e-9)


def test_cues_are_at_their_directions() -> None:
    card = CueConfig(at_deg=90, extent_deg=40, brightness=1.0)
    box = BoxConfig(wall=10.0, cards=(card,), distal=(), wall_brightness=0.2)
    view = look(box, [0.5, 0.5, 0.0])
    np.testing.assert_allclose(view[8:11], 1.0)
    np.testing.assert_allclose(np.delete(view, range(7, 12)), 0.2)
    far = box.model_copy(update={"wall": 0.05, "cards": (), "distal": (card,)})
    for place in ([0.2, 0.3, 0.0], [0.8, 0.7, 0.0]):
        assert look(far, place)[9] > 0.8


def test_views_of_a_turned_and_stretched_box_stay_the_same() -> None:
    turned = look(BoxConfig(), [0.7, 0.2, 0.5], (0.3, -0.4), (1.4, 1.0))
    known = [0.946, 0.433, 0.264, 0.088, 0.262, 0.358, 0.350, 0.409, 0.394, 0.384, 0.337, 0.277]
    np.testing.assert_allclose(turned[::3], known, atol=6e-4)
    for place in ([0.0, 0.0, 0.0], [1.0, 0.5, 1.0], [1.0, 1.0, -2.0]):  # at walls
        assert np.isfinite(look(BoxConfig(), place)).all()
    assert torus_ratio((0.0, 0.0, 3.5, 2.1), 1.05) == pytest.approx((10 / 3, 2.0))


@pytest.mark.parametrize("change", [{"width": 0}, {"height": -1}, {"wall_brightness": 2}])
def test_a_box_without_area_is_refused(change: dict) -> None:
    with pytest.raises(ValidationError):
        BoxConfig(**change)


def test_exact_odometry_integrates_to_the_truth() -> None:
    for source in (session(), session(None, seconds=60.0), session(None, seconds=60.0, walk={})):
        found = integrate(source.odometry[:, :3], source.truth[0])
        np.testing.assert_allclose(found[:, :2], source.truth[:, :2], atol=1e-9)
        np.testing.assert_allclose(np.exp(1j * found[:, 2]), np.exp(1j * source.truth[:, 2]), atol=1e-9)
        assert source.odometry[0].tolist() == [0.0, 0.0, 0.0, 0.0]
        assert (source.odometry[1:, 3] == 0.05).all()


def test_the_same_settings_give_the_same_bits() -> None:
    def contents(**given) -> tuple:
        source = RatSimulation(RatSimulationConfig(seconds=10.0, **given))
        parts = [(s.time, s.truth.tobytes(), s.reading.view.tobytes(), *s.reading.odometry) for s in source]
        return source.digest, parts

    assert contents() == contents()
    assert contents()[1] != contents(seed=1)[1]
    assert len({contents(**given)[0] for given in ({}, {"seed": 1}, {"path": {"skip": 1.0}})}) == 3


def test_readings_have_views_at_every_nth_row() -> None:
    samples = list(session(views={"every": 4, "columns": 12}))
    seen = [bool(sample.reading.view_seen) for sample in samples[:9]]
    assert seen == 2 * [True, False, False, False] + [True]
    assert {sample.reading.view.shape for sample in samples} == {(1, 12, 1)}
    assert 21 * session().info.cell_size == pytest.approx(1.05)  # a torus larger than the box


def test_a_dark_phase_leaves_the_noise_of_other_rows() -> None:
    light, dark = session(), session(phases=[{"start": 10, "end": 20, "dark": True}])
    np.testing.assert_array_equal(light.odometry, dark.odometry)
    rows, views = light.views()
    kept = (rows < 200) | (rows >= 400)
    lit, seen = dark.views()
    np.testing.assert_array_equal(lit, rows[kept])
    np.testing.assert_array_equal(seen, views[kept])


def test_a_conflict_of_cues_is_two_phases() -> None:
    phases = [
        {"start": 10, "rotate_cues_deg": 45, "cues": "local"},
        {"start": 20, "rotate_cues_deg": -45, "cues": "distal"},
        {"start": 30, "rotate_cues_deg": 10},
    ]
    times = session(phases=phases).timeline
    np.testing.assert_allclose(np.degrees(times.card_turn[[0, 200, 400, 600]]), [0, 45, 45, 55])
    np.testing.assert_allclose(np.degrees(times.distal_turn[[0, 200, 400, 600]]), [0, 0, -45, -35])


def test_a_kidnap_is_in_the_truth_and_not_in_the_odometry() -> None:
    source = session(phases=[{"start": 20, "kidnap": [0.2, 0.5]}], seconds=30.0)
    assert np.hypot(*(source.truth[400, :2] - [0.2, 0.5])) < 0.02
    moved = np.hypot(*np.diff(source.truth[:, :2], axis=0).T)
    assert int(moved.argmax()) == 399
    assert moved[399] > 0.3
    assert np.hypot(*source.odometry[:, :2].T).max() < 0.02
    after = integrate(source.odometry[401:, :3], source.truth[400])
    np.testing.assert_allclose(after[:, :2], source.truth[401:, :2], atol=1e-9)


def test_a_stretched_box_stretches_the_path_and_its_odometry() -> None:
    plain, source = session(), session(phases=[{"start": 20, "stretch": [1.4, 1.0]}])
    np.testing.assert_allclose(source.truth[400:, :2], plain.truth[400:, :2] * [1.4, 1.0])
    np.testing.assert_array_equal(source.odometry[:400], plain.odometry[:400])
    after = compose(source.truth[399:-1], source.odometry[400:, :3])
    np.testing.assert_allclose(after[1:, :2], source.truth[401:, :2], atol=1e-9)
    assert source.info.box == pytest.approx((0.0, 0.0, 1.4, 1.0))
    assert np.hypot(*source.odometry[:, :2].T).max() < 0.02


def test_another_box_has_its_own_cues_and_size() -> None:
    other = BARE | {"width": 2.0, "height": 1.0, "wall_brightness": 0.0, "room_brightness": 0.0}
    source = session(phases=[{"start": 20, "end": 30, "box": other}], views={"noise": 0.0})
    rows, views = source.views()
    there = (rows >= 400) & (rows < 600)
    assert (views[there] == 0).all()
    assert (views[~there].max(axis=(1, 2, 3)) > 0.3).all()
    assert source.truth[400:600, 0].max() > 1.2
    assert source.info.cell_size == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("phases", "message"),
    [
        ([{"start": 100, "dark": True}], r"0.start: 100 s; expected .*40.05 s"),
        ([{"start": 1, "stretch": [2, 1]}, {"start": 30, "box": {}}], "1.start: the box is changed"),
        ([{"start": 5, "kidnap": [0.0, 0.0]}], r"0.kidnap: .*no nearer to \(0, 0\) than 0.54 m"),
    ],
)
def test_phases_that_cannot_be(phases: list[dict], message: str) -> None:
    with pytest.raises(InputError, match=rf"^rat_simulation.phases.{message}"):
        session(phases=phases)


@pytest.mark.parametrize(
    ("phase", "message"),
    [
        ({"start": 5, "end": 5, "dark": True}, "is not after the start"),
        ({"start": 5}, "changes nothing"),
        ({"start": 5, "end": 6, "kidnap": [0.5, 0.5]}, "has no end"),
        ({"start": 5, "dark": True, "cues": "local"}, "no rotate_cues_deg"),
        ({"start": 5, "stretch": [2, 1], "box": {}}, "another box"),
    ],
)
def test_phases_that_make_no_sense(phase: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RatSimulationConfig(phases=[phase])


def test_a_path_that_does_not_fit() -> None:
    broken = PATH.position.copy()
    broken[3, 0] = np.nan
    for path, changes, message in (
        (PATH._replace(position=PATH.position + 5), {}, "rat path: no position is inside the box"),
        (PATH, {"box": BoxConfig(width=0.5)}, r"rat path: \d+ positions up to 0.3 m outside"),
        (PATH._replace(position=broken), {}, "rat path, row 3: the position is nan"),
        (PATH, {"seconds": 50.0}, "rat_simulation.seconds: 50 s; expected at most the 40.05 s"),
    ):
        with pytest.raises(InputError, match=message):
            session(path, **changes)


def test_errors_of_odometry_are_independent_and_stay_the_same() -> None:
    def odometry(**errors: float) -> np.ndarray:
        return session(None, walk={}, seconds=50.0, odometry=EXACT | errors).odometry

    truth, speed, heading = odometry(), odometry(speed_white=0.1), odometry(heading_white=0.03)
    both = odometry(speed_white=0.1, heading_white=0.03)
    np.testing.assert_array_equal(both, np.column_stack([speed[:, :2], heading[:, 2:]]))
    np.testing.assert_array_equal(speed[:, 2], truth[:, 2])
    np.testing.assert_array_equal(heading[:, :2], truth[:, :2])
    share = speed[1:, 0] / truth[1:, 0] - 1
    assert share.std() == pytest.approx(0.1 * np.sqrt(20), rel=0.05)
    assert (heading - truth)[1:, 2].std() == pytest.approx(0.03 / np.sqrt(20), rel=0.05)
    np.testing.assert_allclose(odometry(speed_scale=0.05)[:, :2], 1.05 * truth[:, :2])
    np.testing.assert_allclose(odometry(heading_bias=0.02)[1:, 2], truth[1:, 2] + 0.001)
