"""Views of keyframes: misfits, log-odds of one place, metrics learned from a session, and restored state."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping import appearance
from ratslam.mapping.appearance import LOG_ODDS_INTERVAL, MIN_ERRORS, ViewAppearance, WhiskerAppearance
from ratslam.mapping.ground import learn_gain_odds
from ratslam.mapping.odometry_calibration import NO_ESTIMATE, SectorFan
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from ratslam.recall import whisker_likelihood as touch
from ratslam.recall.observation_model import label_gains
from ratslam.recall.whisker_likelihood import estimate_variation, live_pixels, log_odds_table, pixel_layout
from tactile.base.types import Odometry, observation

SHAPE = (3, 6, 1)
PIXELS = pixel_layout(SHAPE)
SIZE = len(PIXELS.group)
TEMPER, PLACES = 0.25, 10
seeds = st.integers(0, 10_000)
SILENT = SimpleNamespace(background=np.full(20, np.nan))


def no_pairs():
    return np.zeros((0, 3), int)


def seen(view=None, label=-1, dead=()):
    seen = observation(Odometry(0.1, 0.0, 0.0, 1.0), view, view_shape=SHAPE, label=label, whiskers=SIZE)
    return seen._replace(alive=~np.isin(np.arange(SIZE), list(dead)))


def images(stream, count):
    """[count, 3, 6, 1] whisker images."""
    return stream.random((count, *SHAPE)) * (stream.random((count, *SHAPE)) < 0.4)


def filled(frames, readings):
    """The appearance after frames with these readings, updated after each."""
    for reading in readings:
        frames.append(reading, 0.0, 0.1)
        frames.learn(SILENT, no_pairs)
    return frames


def touched(views, dead=()):
    return filled(WhiskerAppearance(PIXELS, TEMPER), (seen(view, dead=dead) for view in views))


def viewed(views, errors=(), fan=None):
    frames = filled(ViewAppearance(SIZE, fan), map(seen, views))
    for k in range(0, len(errors), 20):
        frames.learn(SimpleNamespace(background=np.asarray(errors[k : k + 20])), no_pairs)
    return frames


def labelled(labels):
    return filled(appearance.LabelAppearance(), (seen(label=label) for label in labels))


def misfit(frames, frame, near, about=()):
    """The least misfit of a frame with others; `about`: those that are seen from behind."""
    near = np.atleast_1d(near)
    return frames.least_misfit(frame, near, np.isin(near, about))


FRESH = {
    "touch": lambda: WhiskerAppearance(PIXELS, TEMPER),
    "views": lambda: ViewAppearance(SIZE, None),
    "fan": lambda: ViewAppearance(SIZE, 0.0),
    "given": lambda: ViewAppearance(SIZE, 1.5 * np.pi),
    "labels": appearance.LabelAppearance,
    "signed": lambda: appearance.SignedAppearance(SIZE),
}


@pytest.mark.parametrize("kind", ["touch", "views", "ids"])
def test_equal_views_are_likelier_of_one_place(kind):
    """The log-odds of one place fall with the misfits of the views, and are above 0 for equal ones."""
    stream, places = np.random.default_rng(0), np.arange(100) % 50
    views = images(stream, 50)[places]
    made = {"touch": touched(views), "views": viewed(views, np.full(40, 0.1)), "ids": labelled(places)}
    frames, ahead = made[kind], np.zeros(100, bool)
    odds = np.array([frames.log_odds(k, np.arange(100), ahead) for k in range(100)])
    same = places[:, None] == places
    assert odds[same].min() > 0
    assert odds[same].mean() > odds[~same].mean() + 0.5
    order = np.argsort(frames.misfits(7, np.arange(100), ahead), kind="stable")
    assert (np.diff(odds[7][order]) <= 0).all()
    neutral = appearance.NEUTRAL_IMAGE_MISFIT if kind == "touch" else appearance.NEUTRAL_MISFIT
    assert misfit(frames, 3, np.zeros(0, int)) == neutral  # without neighbours


def test_ids_fit_frames_with_the_same_id_and_tell_a_true_pose_before_any_gain_was_counted():
    frames = labelled([4, 5, 4, 6])
    assert misfit(frames, 2, 0) == 0
    assert misfit(frames, 2, 1) == 1
    assert misfit(frames, 2, [1, 3, 0]) == 0
    assert frames.metric().scale == frames.metric().angle == 0
    assert frames.learn(SILENT, no_pairs) == NO_ESTIMATE
    usual = ((2.0, 1.0), (0.5, 1.0))
    assert viewed(images(np.random.default_rng(0), 50)).gain_prior(usual) == usual
    none = np.zeros(0)
    for count in (3, 30, 300):
        (true, _), (false, _) = prior = labelled(range(count)).gain_prior(usual)
        assert (true, false) == label_gains(count)
        odds = learn_gain_odds(none, none, prior)
        assert odds.of(true) > 2 > -2 > odds.of(false)
        assert odds.expected > 2 > learn_gain_odds(none, none, usual).expected


@pytest.mark.parametrize("kind", FRESH)
@pytest.mark.parametrize("stop", [0, 1, 40, 75])
def test_a_restored_appearance_continues_as_if_uninterrupted(kind, stop):
    stream = np.random.default_rng(0)
    views, label = images(stream, 120), stream.integers(0, 9, 120)
    errors, turn, length = stream.uniform(0.1, 0.5, (120, 20)), stream.normal(0, 0.2, 120), np.full(120, 0.1)
    pairs = np.column_stack([np.arange(20, 30), np.arange(10), np.arange(10) % 2 == 0])
    if kind in ("fan", "given"):
        views, turn, length = surveyed(2, 270, 120, bias=0.05)
        views = views.reshape(-1, *SHAPE)

    def follow(frames, rows):
        estimates = []
        for k in rows:
            frames.append(seen(views[k], label=int(label[k])), turn[k], length[k])
            estimates.append(frames.learn(SimpleNamespace(background=errors[k]), lambda: pairs))
        return estimates

    whole = FRESH[kind]()
    estimates = follow(whole, range(120))
    first = FRESH[kind]()
    assert follow(first, range(stop)) == estimates[:stop]
    saved = first.arrays()
    follow(first, range(stop, 100))  # the saved arrays are copies
    second = FRESH[kind]()
    follow(second, range(5))  # and replace the whole state
    second.restore(saved)
    assert follow(second, range(stop, 120)) == estimates[stop:]
    np.testing.assert_equal([second.arrays(), second.metric()], [whole.arrays(), whole.metric()])
    near, about = np.arange(10), np.arange(0, 10, 2)
    assert misfit(whole, 100, near, about) == misfit(second, 100, near, about)
    assert (whole.metric().likeness.size > 0) == (kind in ("touch", "signed"))
    assert (whole.metric().scale > 0) == (kind != "labels")
    assert (whole.metric().angle > 0) == (kind in ("touch", "fan", "given"))
    assert any(found != NO_ESTIMATE for found in estimates) == (kind in ("fan", "given"))


def test_signed_images_of_one_place_are_more_alike():
    """Twice along ten places, four images in each: all are learned from twice."""
    random, ahead = np.random.default_rng(0), np.zeros(40, bool)
    there, frames = 10 * random.normal(size=(PLACES, *SHAPE)), appearance.SignedAppearance(SIZE)
    for k, place in enumerate([*np.repeat(np.arange(PLACES), 4)] * 2, start=1):
        frames.append(seen(there[place] + random.normal(size=SHAPE)), 0, 0)
        frames.learn(SILENT, no_pairs)
        assert frames.metric().scale == (appearance.NEW_IMAGE_LOG_ODDS if k >= LOG_ODDS_INTERVAL else 0.0)
        assert (misfit(frames, 0, 0) == appearance.NEUTRAL_IMAGE_MISFIT) == (k < LOG_ODDS_INTERVAL)
    late, early = np.arange(40, 80), np.arange(40)
    here, elsewhere = (frames.misfits(late, others, ahead) for others in (early, (late - 20) % 40))
    assert (here < elsewhere).mean() > 0.9
    odds = frames.log_odds(50, early, ahead)
    assert np.array_equal(odds, -frames.misfits(50, early, ahead))
    assert odds[8:12].min() > 0 > np.median(odds)
    np.testing.assert_allclose(odds[[10, 30]], [-here[10], -elsewhere[10]])
    assert misfit(frames, 50, 10) < misfit(frames, 50, 30)


@given(seeds)
@settings(max_examples=20)
def test_views_misfit_by_their_error_in_scales(seed):
    stream = np.random.default_rng(seed)
    views = stream.random((30, *SHAPE))
    frames = viewed(views, stream.uniform(0.1, 0.5, MIN_ERRORS))
    scale, angle, likeness = frames.metric().scale, frames.metric().angle, frames.metric().likeness
    assert 0.1 <= scale <= 0.2
    assert (angle, likeness.size) == (0, 0)  # only ordered sectors have an angle
    assert (viewed(views, fan=0.0).metric().angle, viewed(views, fan=3.6).metric().angle) == (0, 0.2)
    halved = filled(ViewAppearance(SIZE, None, lambda view: view / 2), [seen(views[0])])
    # Views are stored as recall compares them.
    assert np.array_equal(halved.arrays()["view"], views[:1].reshape(1, -1) / 2)
    for frame in (0, 11, 29):
        near = stream.integers(0, 30, 4)
        expected = min(min(np.abs(views[k] - views[frame]).mean() for k in near) / (2 * scale), 1.0)
        assert misfit(frames, frame, near, near[:2]) == pytest.approx(expected, rel=1e-12)
    assert misfit(frames, 11, 11) == 0


def test_a_scale_needs_enough_errors_and_grows_with_the_sensors_unit():
    errors = np.random.default_rng(0).uniform(0.1, 0.5, MIN_ERRORS)
    half_known = np.where(np.arange(2 * MIN_ERRORS) % 2, np.nan, np.repeat(errors, 2))
    cases = (errors, 2 * errors, half_known, errors[:-20], np.zeros(MIN_ERRORS))
    scale, *others = (viewed(np.zeros((1, *SHAPE)), each).metric().scale for each in cases)
    assert others == [2 * scale, scale, 0, 0]


def test_whiskers_are_compared_after_the_first_estimate():
    calls, frames = [], WhiskerAppearance(PIXELS, TEMPER)
    for k, view in enumerate(images(np.random.default_rng(0), 200), start=1):
        frames.append(seen(view), 0.0, 0.1)
        assert frames.learn(SILENT, lambda k=k: calls.append(k) or no_pairs()) == NO_ESTIMATE
        measure, estimated = frames.metric(), k >= appearance.MIN_KEYFRAMES
        assert (measure.angle, measure.scale) == (np.pi, appearance.NEW_IMAGE_LOG_ODDS if estimated else 0.0)
        assert measure.likeness.size == (3 * touch.LEVELS**2 if estimated else 0)
        assert (misfit(frames, 0, 0) == appearance.NEUTRAL_IMAGE_MISFIT) == (not estimated)
    assert calls == list(range(LOG_ODDS_INTERVAL, 201, LOG_ODDS_INTERVAL))


def test_log_odds_follow_from_images_and_pairs():
    views = images(np.random.default_rng(0), 2 * LOG_ODDS_INTERVAL)
    frame, match, about = np.arange(50, 70), np.arange(10, 30), np.arange(20) % 3 == 0
    likeness = touched(views).metric().likeness
    level = touch.pixel_levels(views.reshape(len(views), -1), np.ones(SIZE)).astype(int)
    known = touch.estimate_background(level, PIXELS.group)
    assert np.array_equal(likeness, log_odds_table(known, estimate_variation(level[:0], level[:0])))
    assert np.allclose(likeness, log_odds_table(known, touch.PRIOR))
    then = np.where(about[:, None], level[match][:, PIXELS.opposite], level[match])
    frames = WhiskerAppearance(PIXELS, TEMPER)
    for view in views:
        frames.append(seen(view), 0.0, 0.1)
    frames.learn(SILENT, lambda: np.column_stack([frame, match, about]))
    expected = log_odds_table(known, estimate_variation(level[frame], then))
    assert np.array_equal(frames.metric().likeness, expected)


def test_the_misfit_is_that_of_the_best_neighbour_and_a_reversed_frame_fits_by_its_opposite_pixels():
    stream = np.random.default_rng(1)
    views = images(stream, LOG_ODDS_INTERVAL)
    views[8] = views[3].reshape(-1)[PIXELS.opposite].reshape(SHAPE)
    frames, about = touched(views), np.flatnonzero(stream.random(8) < 0.5)
    each = [misfit(frames, 8, k, about) for k in range(8)]
    assert misfit(frames, 8, np.arange(8), about) == pytest.approx(min(each), rel=1e-12)
    assert misfit(frames, 8, 3, 3) == misfit(frames, 8, 8)
    assert misfit(frames, 8, 1, 1) == pytest.approx(misfit(frames, 3, 1), rel=1e-9)  # two half turns are none


def test_dead_whiskers_neither_fit_nor_misfit_and_those_without_a_flag_count_as_alive():
    stream, dead = np.random.default_rng(0), (1, 8, 15)
    views = images(stream, LOG_ODDS_INTERVAL)
    other = views.copy()
    other.reshape(LOG_ODDS_INTERVAL, -1)[:, list(dead)] = stream.random((LOG_ODDS_INTERVAL, 3))
    one, two = (touched(rows, dead=dead) for rows in (views, other))
    np.testing.assert_equal(one.arrays(), two.arrays())
    assert (one.arrays()["level"][:, list(dead)] == touch.DEAD).all()
    assert np.array_equal(one.metric().likeness, two.metric().likeness)
    assert misfit(touched(views, dead=range(SIZE)), 5, 6) == pytest.approx(np.log(2))
    plain = observation(Odometry(0.1, 0.0, 0.0, 1.0), np.ones((3, 6, 2)))
    assert plain.alive.shape == (0,)
    assert np.array_equal(live_pixels(plain), np.ones((3, 6, 2), bool))
    partial = plain._replace(alive=np.arange(18) != 7)
    assert np.array_equal(np.argwhere(~live_pixels(partial)), [[1, 1, 0], [1, 1, 1]])


@pytest.mark.parametrize(("columns", "angle"), [(6, np.pi), (22, np.pi), (5, 0.0)])
def test_only_an_even_number_of_columns_is_compared_as_seen_from_behind(columns, angle):
    config = RecallBackendConfig.model_validate({"recall": {"sector_fov": "whiskers"}})
    assert RecallBackend(config, (4, columns, 1)).new_map().feedback().angle == angle


@given(seeds)
def test_log_odds_are_summed_over_the_pixels(seed):
    stream = np.random.default_rng(seed)
    table, group = stream.normal(size=(3, 4, 4)), stream.integers(0, 3, 6)
    levels, opposite = stream.integers(0, 4, (10, 6)), stream.permutation(6)
    (a, b), reversed = stream.integers(0, 10, (2, 20)), stream.random(20) < 0.5
    other = np.where(reversed[:, None], levels[b][:, opposite], levels[b])
    expected = table[group, levels[a], other].sum(axis=1)
    found = appearance.summed_log_odds(table, group, levels, opposite, a, b, reversed)
    assert np.allclose(found, expected, atol=1e-12)


@given(seeds, st.integers(0, 5), st.floats(0.1, 2.0), st.floats(0.1, 0.99))
def test_near_keyframes_are_older_within_the_radius_and_face_along_one_line(seed, guard, radius, facing):
    stream = np.random.default_rng(seed)
    poses = stream.uniform(-1, 1, (15, 3)) * [1, 1, np.pi]
    frames = np.unique(stream.integers(0, 15, 8))
    x, y, heading = (poses[frames][:, None] - poses).transpose(2, 0, 1)
    near = (np.hypot(x, y) < radius) & (np.arange(15) < frames[:, None] - guard)
    expected = np.sign(np.cos(heading)) * (near & (abs(np.cos(heading)) > facing))
    assert np.array_equal(appearance.near_facing(poses, frames, guard, radius, facing), expected)


def surveyed(seed, width, count=200, bias=0.0, noise=0.01):
    """Views [N, 18], smooth functions of the bearing over a fan of `width` degrees (negative: clockwise),
    odometry's turns, and lengths."""
    stream = np.random.default_rng(seed)
    sector = np.radians(width) / SIZE
    turn, length = stream.normal(0, 0.35, count), stream.uniform(0.05, 0.4, count)
    wave, phase = stream.normal(0, 1, 8) / 4, stream.uniform(0, 2 * np.pi, 8)
    bearing = np.cumsum(turn)[:, None] + (np.arange(SIZE) - (SIZE - 1) / 2) * sector
    view = 0.5 + np.cos(bearing[..., None] * np.arange(1, 9) + phase) @ wave
    view = view + noise * stream.normal(0, 1, view.shape)
    return view, turn - bias * length, length  # the odometry's turn lacks the bias


def fan_of(view, turn, length, angle=0.0):
    fan = SectorFan(SIZE, angle)
    for row in zip(view, turn, length, strict=True):
        fan.append(*row)
    return fan


@pytest.mark.parametrize("kind", ["constant", "one value each", "places", "stays", "slow", "random"])
@pytest.mark.parametrize("seed", range(3))
def test_unordered_views_have_no_sector_angle(kind, seed):
    view, turn, length = surveyed(seed, 180)
    stream, count = np.random.default_rng(seed + 100), len(view)
    places, noise = stream.uniform(0, 1, (count, SIZE)), 0.01 * stream.normal(0, 1, view.shape)
    view = {
        "constant": np.full_like(view, 0.5),
        "one value each": np.repeat(view[:, :1], SIZE, axis=1),
        "places": places[stream.integers(0, 12, count)] + noise,
        "stays": places[np.cumsum(stream.random(count) < 0.3)] + noise,
        "slow": np.cumsum(noise, axis=0),
        "random": stream.uniform(0, 1, view.shape),
    }[kind]
    fan = SectorFan(SIZE, 0.0)
    for k, row in enumerate(zip(view, turn, length, strict=True)):
        fan.append(*row)
        assert k % 4 or fan.estimate() == NO_ESTIMATE
    assert fan.angle == 0


@pytest.mark.parametrize("width", [180, -180, 270, -270])
@pytest.mark.parametrize("bias", [0.0, 0.1, -0.05])
@pytest.mark.parametrize("seed", range(3))
def test_width_and_direction_of_the_sectors_and_the_bias_of_the_odometry_are_estimated(width, bias, seed):
    fan = fan_of(*surveyed(seed, width, bias=bias))
    assert fan.angle == 0
    found, error = fan.estimate()
    assert fan.angle == pytest.approx(np.radians(width) / SIZE)
    assert abs(found - bias) < 3 * error < 0.06  # far below the biases


@pytest.mark.parametrize("given", [np.radians(10), -np.radians(3)])
def test_a_given_angle_is_never_changed_and_shows_the_bias(given):
    fan = SectorFan(SIZE, given)
    for row in zip(*surveyed(0, np.degrees(given) * SIZE, 60, bias=0.1), strict=True):
        fan.append(*row)
        found, error = fan.estimate()
        assert fan.angle == given
    assert abs(found - 0.1) < 3 * error < 0.3


def test_few_views_give_no_estimate_and_evidence_in_a_single_block_a_vague_one():
    assert SectorFan(SIZE, 0.0).estimate() == NO_ESTIMATE
    fan = fan_of(*surveyed(0, 180, 15))
    assert (fan.estimate(), fan.angle) == (NO_ESTIMATE, 0)
    view, turn, length = surveyed(0, 180, 480)
    view[:445] = 0.5  # for example nothing in reach
    assert fan_of(view, turn, length, np.radians(10)).estimate()[1] > 0  # large or infinite, but not NaN
