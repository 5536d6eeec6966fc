"""Sessions of a rat: odometry, phases, repeatability and errors."""

from __future__ import annotations

import numpy as np
import pytest

from robot.simulation.rat.box import BoxConfig
from robot.simulation.rat.rat_path import RatPath
from robot.simulation.rat.simulated_session import RatSimulation, RatSimulationConfig
from tactile.base.errors import InputError
from tactile.base.se2 import compose, integrate

EXACT = {"speed_white": 0.0, "heading_white": 0.0}
CIRCLE = np.linspace(0, 8 * np.pi, 401)
PATH = RatPath(0.1 * np.arange(401), 0.5 + 0.3 * np.column_stack([np.cos(CIRCLE), np.sin(CIRCLE)]))
"""Four rounds of 10 s on a circle of 0.3 m about the middle."""


def session(path: RatPath | None = PATH, **given) -> RatSimulation:
    return RatSimulation(RatSimulationConfig(rate_hz=20.0, odometry=EXACT, **given), path)


def test_exact_odometry_integrates_to_the_truth() -> None:
    for source in (session(), session(None, seconds=60.0), session(None, seconds=60.0, walk={})):
        found = integrate(source.odometry[:, :3], source.truth[0])
        np.testing.assert_allclose(found[:, :2], source.truth[:, :2], atol=1e-9)
        np.testing.assert_allclose(np.exp(1j * found[:, 2]), np.exp(1j * source.truth[:, 2]), atol=1e-9)
        assert source.odometry[0].tolist() == [0.0, 0.0, 0.0, 0.0]
        assert (np.diff(source.odometry[1:, 3]) == 0).all()


def test_errors_of_odometry_are_of_their_size_and_independent() -> None:
    def odometry(**errors: float) -> np.ndarray:
        config = RatSimulationConfig(walk={}, rate_hz=20.0, odometry=EXACT | errors)
        return RatSimulation(config).odometry

    truth = odometry()
    speed, heading = odometry(speed_white=0.1), odometry(heading_white=0.03)
    both = odometry(speed_white=0.1, heading_white=0.03)
    np.testing.assert_array_equal(both[:, :2], speed[:, :2])
    np.testing.assert_array_equal(both[:, 2], heading[:, 2])
    np.testing.assert_array_equal(speed[:, 2], truth[:, 2])
    np.testing.assert_array_equal(heading[:, :2], truth[:, :2])
    moved = np.abs(truth[:, 0]) > 1e-4
    share = speed[moved, 0] / truth[moved, 0] - 1
    assert abs(share.std() / (0.1 * np.sqrt(20)) - 1) < 0.05
    assert abs((heading[1:, 2] - truth[1:, 2]).std() / (0.03 / np.sqrt(20)) - 1) < 0.05
    np.testing.assert_allclose(odometry(speed_scale=0.05)[:, :2], 1.05 * truth[:, :2])
    np.testing.assert_allclose(odometry(heading_bias=0.02)[1:, 2], truth[1:, 2] + 0.001)


def test_the_same_settings_give_the_same_bits() -> None:
    def contents(**given) -> tuple:
        source = RatSimulation(RatSimulationConfig(seconds=10.0, **given))
        readings = [
            (s.time, s.truth.tobytes(), s.reading.view.tobytes(), *s.reading.odometry) for s in source
        ]
        return source.digest, readings

    assert contents() == contents()
    assert contents()[1] != contents(seed=1)[1]
    assert contents()[0] != contents(seed=1)[0]
    assert contents()[0] != contents(path={"skip": 1.0})[0]


def test_a_phase_leaves_the_noise_of_other_rows() -> None:
    light, dark = session(), session(phases=[{"start": 10, "end": 20, "dark": True}])
    np.testing.assert_array_equal(light.odometry, dark.odometry)
    rows, views = light.views()
    kept = (rows < 200) | (rows >= 400)
    lit, seen = dark.views()
    np.testing.assert_array_equal(lit, rows[kept])
    np.testing.assert_array_equal(seen, views[kept])


def test_readings_have_views_at_every_nth_row() -> None:
    samples = list(session(views={"every": 4, "columns": 12}))
    assert [bool(sample.reading.view_seen) for sample in samples[:9]] == 2 * [True, False, False, False] + [
        True
    ]
    assert {sample.reading.view.shape for sample in samples} == {(1, 12, 1)}


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
    other = {"width": 2.0, "height": 1.0, "cards": [], "distal": [], "wall_brightness": 0.0,
             "room_brightness": 0.0}  # fmt: skip
    source = session(phases=[{"start": 20, "end": 30, "box": other}], views={"noise": 0.0})
    rows, views = source.views()
    there = (rows >= 400) & (rows < 600)
    assert (views[there] == 0).all()
    assert (views[~there].max(axis=(1, 2, 3)) > 0.3).all()
    assert source.truth[400:600, 0].max() > 1.2
    assert source.info.cell_size == pytest.approx(0.1)


def test_the_suggested_torus_is_larger_than_the_box() -> None:
    assert 21 * session().info.cell_size == pytest.approx(1.05)


@pytest.mark.parametrize(
    ("phases", "message"),
    [
        ([{"start": 100, "dark": True}], "0.start: 100 s; expected a time within the session of 40.05 s"),
        (
            [{"start": 1, "stretch": [2, 1]}, {"start": 30, "box": {}}],
            "1.start: the box is changed by an earlier phase too",
        ),
        ([{"start": 5, "kidnap": [0.0, 0.0]}], r"0.kidnap: the path comes no nearer to \(0, 0\) than 0.54 m"),
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
    with pytest.raises(InputError, match=r"rat path: no position is inside the box; .*unit and shift"):
        session(PATH._replace(position=PATH.position + 5))
    with pytest.raises(InputError, match=r"rat path: \d+ positions up to 0.3 m outside, the first \("):
        session(PATH, box=BoxConfig(width=0.5))
    position = PATH.position.copy()
    position[3, 0] = np.nan
    with pytest.raises(InputError, match=r"rat path, row 3: the position is nan"):
        session(PATH._replace(position=position))
    with pytest.raises(InputError, match=r"rat_simulation.seconds: 50 s; expected at most the 40.05 s"):
        session(seconds=50.0)
