"""Laws of view sectors: their order, their width and the heading bias."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping.odometry_calibration import NO_ESTIMATE, SectorFan

SIZE = 18


def surroundings(stream):
    """A smooth function of the bearing, rad."""
    wave, phase = stream.normal(0, 1, 8) / 4, stream.uniform(0, 2 * np.pi, 8)
    return lambda bearing: 0.5 + np.cos(bearing[..., None] * np.arange(1, 9) + phase) @ wave


def drive(seed, width, count=200, bias=0.0, noise=0.01):
    """Views [N, 18] over a fan of `width` degrees (negative: clockwise), odometry's turns, and lengths."""
    stream = np.random.default_rng(seed)
    sector = np.radians(width) / SIZE
    bearing = (np.arange(SIZE) - (SIZE - 1) / 2) * sector
    turn, length = stream.normal(0, 0.35, count), stream.uniform(0.05, 0.4, count)
    view = surroundings(stream)(np.cumsum(turn)[:, None] + bearing)
    view = view + noise * stream.normal(0, 1, view.shape)
    return view, turn - bias * length, length  # the odometry's turn lacks the bias


def fan_of(fan, view, turn, length):
    for row in zip(view, turn, length, strict=True):
        fan.append(*row)
    return fan


@pytest.mark.parametrize("width", [180, -180, 270, -270])
@pytest.mark.parametrize("seed", range(4))
def test_the_width_and_direction_of_the_sectors_are_estimated(width, seed):
    fan = fan_of(SectorFan(SIZE, 0.0), *drive(seed, width))
    assert fan.angle == 0
    fan.estimate()
    assert fan.angle == pytest.approx(np.radians(width) / SIZE)


@pytest.mark.parametrize("seed", range(4))
def test_mirrored_views_have_the_opposite_sector_angle(seed):
    view, turn, length = drive(seed, 180)
    there, back = (fan_of(SectorFan(SIZE, 0.0), rows, turn, length) for rows in (view, view[:, ::-1]))
    ahead, mirrored = there.estimate(), back.estimate()
    assert there.angle == -back.angle > 0
    assert mirrored == pytest.approx(ahead, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("kind", ["constant", "one value each", "places", "stays", "slow"])
@pytest.mark.parametrize("seed", range(3))
def test_unordered_views_have_no_sector_angle(kind, seed):
    view, turn, length = drive(seed, 180)
    stream, count = np.random.default_rng(seed + 100), len(view)
    places, noise = stream.uniform(0, 1, (count, SIZE)), 0.01 * stream.normal(0, 1, view.shape)
    view = {
        "constant": np.full_like(view, 0.5),
        "one value each": np.repeat(view[:, :1], SIZE, axis=1),
        "places": places[stream.integers(0, 12, count)] + noise,
        "stays": places[np.cumsum(stream.random(count) < 0.3)] + noise,
        "slow": np.cumsum(noise, axis=0),
    }[kind]
    fan = SectorFan(SIZE, 0.0)
    for row in zip(view, turn, length, strict=True):
        fan.append(*row)
        assert fan.estimate() == NO_ESTIMATE
    assert fan.angle == 0


def share_called_ordered(changed):
    """The share of 60 recordings with changed views whose sectors the map would count as ordered."""
    found = []
    for seed in range(60):
        view, turn, length = drive(seed, 180)
        fan = SectorFan(SIZE, 0.0)
        view = changed(np.random.default_rng(seed + 1000), view)
        for k, row in enumerate(zip(view, turn, length, strict=True)):
            fan.append(*row)
            if k >= 40 and k % 16 == 0:
                fan.estimate()
        found.append(fan.angle != 0)
    return np.mean(found)


def test_random_views_have_no_sector_angle():
    assert share_called_ordered(lambda stream, view: stream.uniform(0, 1, view.shape)) < 0.02


@pytest.mark.parametrize("width", [180, -180, 270])
@pytest.mark.parametrize("bias", [0.0, 0.1, -0.05])
@pytest.mark.parametrize("seed", range(3))
def test_the_estimated_bias_is_the_error_of_the_odometrys_turn(width, bias, seed):
    bias_estimate = fan_of(SectorFan(SIZE, 0.0), *drive(seed, width, bias=bias)).estimate()
    assert abs(bias_estimate[0] - bias) < 3 * bias_estimate[1]
    assert bias_estimate[1] < 0.02  # far below the biases


def test_the_standard_error_grows_with_noise():
    errors = [
        np.median([fan_of(SectorFan(SIZE, 0.0), *drive(k, 180, noise=noise)).estimate()[1] for k in range(5)])
        for noise in (0.01, 0.1)
    ]
    assert errors[1] > 2 * errors[0] > 0


@pytest.mark.parametrize("given", [np.radians(10), -np.radians(3)])
def test_a_given_angle_is_never_changed(given):
    view, turn, length = drive(0, 270)
    fan = SectorFan(SIZE, given)
    for row in zip(view, turn, length, strict=True):
        assert fan.angle == given
        fan.append(*row)
        fan.estimate()
    assert fan.angle == given


def test_the_bias_is_estimated_with_a_given_angle():
    bias_estimate = fan_of(SectorFan(SIZE, np.radians(10)), *drive(1, 180, 60, bias=0.1)).estimate()
    assert abs(bias_estimate[0] - 0.1) < 3 * bias_estimate[1] < 0.3


def test_few_views_give_no_estimate():
    assert SectorFan(SIZE, 0.0).estimate() == NO_ESTIMATE
    fan = fan_of(SectorFan(SIZE, 0.0), *drive(0, 180, 15))
    assert fan.estimate() == NO_ESTIMATE
    assert fan.angle == 0


@pytest.mark.parametrize("given", [0.0, np.radians(15)])
@pytest.mark.parametrize("cut", [1, 90])
def test_a_restored_fan_continues_the_same(given, cut):
    rows = list(zip(*drive(2, 270, 150, bias=0.05), strict=True))
    whole = SectorFan(SIZE, given)
    for k, row in enumerate(rows):
        whole.append(*row)
        if k % 16 == 0:
            whole.estimate()
        if k == cut:
            saved = {name: array.copy() for name, array in whole.arrays().items()}
    again = SectorFan(SIZE, given)
    for row in rows[:7]:  # its state before is replaced
        again.append(*row)
    again.restore(saved)
    for k, row in list(enumerate(rows))[cut + 1 :]:
        again.append(*row)
        if k % 16 == 0:
            again.estimate()
    assert again.estimate() == whole.estimate() != NO_ESTIMATE
    assert again.angle == whole.angle != 0
    assert all(np.array_equal(again.arrays()[name], rows) for name, rows in whole.arrays().items())


def test_evidence_in_a_single_block_is_handled():
    view, turn, length = drive(0, 180, 480)
    view[:445] = 0.5  # for example nothing in reach
    bias_estimate = fan_of(SectorFan(SIZE, np.radians(10)), view, turn, length).estimate()
    assert bias_estimate[1] > 0  # large or infinite, but not NaN
