"""Laws of the log-odds of signed images, and what they tell apart."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.recall import signed_likelihood as signed
from ratslam.recall.config import RecallConfig
from ratslam.recall.memory import MapFeedback, init_memory
from ratslam.recall.observation_model import signed_likelihood
from ratslam.recall.signed_likelihood import PRIOR, calibrate, learn, log_odds, pack, project, stored_image
from robot.recordings.real_whiskers import read_object

SIZE, PLACES, VISITS = 24, 30, 4
seeds = st.integers(0, 10_000)


def images_of(seed, size=SIZE, noise=0.5):
    """[PLACES x VISITS, D] images: a few causes, mixed into all pixels, and noise that pixels share."""
    random = np.random.default_rng(seed)
    there = random.normal(size=(PLACES, 5)) @ random.normal(size=(5, size))
    shared = random.normal(size=(PLACES * VISITS, 3)) @ random.normal(size=(3, size))
    views = np.repeat(there, VISITS, axis=0) + noise * shared + 0.1 * random.normal(size=shared.shape)
    return stored_image(views * 20, np.ones(size, bool))


PLACE = np.repeat(np.arange(PLACES), VISITS)


def pairs_of(images, places=PLACE):
    one, other = np.nonzero(np.triu(places[:, None] == places, 1))
    return np.stack([images[one], images[other]])


def apart_of(places=PLACE):
    return np.column_stack(np.nonzero(np.triu(places[:, None] != places, 1)))[::5]


def learned(images):
    return learn(images, pairs_of(images), apart_of())


def all_odds(model, images):
    """[N, N] log-odds."""
    parts = project(model, images.T)
    return np.stack([log_odds(model, part[:, None], parts) for part in parts.T])


@settings(max_examples=5)
@given(seed=seeds)
def test_log_odds_are_symmetric_and_tell_places_apart(seed):
    """And order and unit of pixels are irrelevant, and dead pixels carry no evidence."""
    images, random, same = images_of(seed), np.random.default_rng(seed), PLACE[:, None] == PLACE
    odds = all_odds(learned(images), images)
    np.testing.assert_allclose(odds, odds.T, atol=1e-9)
    assert odds[same & ~np.eye(len(odds), dtype=bool)].mean() > 1 > -1 > odds[~same].mean()
    moved = images[:, random.permutation(SIZE)] * random.choice([-3.0, 0.2, 7.0], SIZE)
    # The calibration is searched.
    np.testing.assert_allclose(all_odds(learned(moved), moved), odds, atol=1e-3)
    with_dead = np.concatenate([images, np.full((len(images), 5), np.inf)], axis=1)
    np.testing.assert_allclose(all_odds(learned(with_dead), with_dead), odds, atol=1e-9)


def test_the_value_of_a_pixel_that_dies_is_irrelevant_and_constant_or_few_pixels_have_finite_odds():
    images = images_of(3)
    model, alive = learned(images), np.arange(SIZE) > 2
    loud, silent = (stored_image(np.where(alive, images[0], value), alive) for value in (1e6, 0.0))
    parts = [project(model, image[:, None]) for image in (loud, silent)]
    np.testing.assert_array_equal(*parts)
    assert np.isfinite(log_odds(model, parts[0], parts[1])).all()
    for images in (np.zeros((50, 3)), images_of(0, size=3)[:50]):
        model = learn(images, np.stack([images[:4], images[4:8]]), apart_of()[:20] % 50)
        assert model.projection.shape == (3, signed.DIRECTIONS)
        assert np.isfinite(all_odds(model, images)).all()


def test_noise_that_pixels_share_is_removed_and_without_confirmed_pairs_successive_images_teach():
    """Plain distances fail where the noise is larger than the difference of places, but of few causes."""
    images, none = images_of(1, noise=2.0), np.zeros((2, 0, SIZE))
    plain = right(-np.abs(images[:, None] - images).sum(axis=2))
    assert right(all_odds(learned(images), images)) > plain + 0.2
    images = images_of(2)
    assert right(all_odds(learn(images, none, apart_of()), images)) > 0.9


def right(odds):
    """The share of images [N] whose likeliest other one is of their place."""
    np.fill_diagonal(odds, -np.inf)
    return (PLACE[odds.argmax(axis=1)] == PLACE).mean()


def test_calibration_recovers_that_of_samples():
    """Gaussian scores of unit width, 4 apart, have log-odds 4 x; a tenth of one kind are of the other."""
    random = np.random.default_rng(5)
    same, other = random.normal(2, 1, 5000), random.normal(-2, 1, 5000)
    same[:500] = random.normal(-2, 1, 500)
    found = calibrate(same, np.ones(5000), other)
    truth = np.log(0.9 * np.exp(4 * 1.0) + 0.1)
    assert signed.calibrated(found, np.array([1.0])) == pytest.approx(truth, abs=0.4)
    assert found.outliers == pytest.approx(0.1, abs=0.04)
    assert calibrate(np.zeros(0), np.zeros(0), np.zeros(4)) == PRIOR


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_kernel_gives_the_same_log_odds(dtype):
    images = images_of(6)
    model, config = learned(images), RecallConfig(sector_fov="whiskers", images="signed", guard=1)
    memory = init_memory(config, SIZE, 128, np.dtype(dtype))
    view = jnp.asarray(np.pad(images.T, ((0, 0), (0, 128 - len(images)))), dtype)
    memory = memory._replace(view=view, count=jnp.int32(len(images)))
    feedback = MapFeedback(np.zeros((len(images), 3)), 0.0, 0.0, 0.0, 0.0, 3.0, pack(model))
    memory = memory.apply_map_feedback(feedback)
    weigh = jax.jit(lambda memory, image: signed_likelihood(config, memory, image))
    _, found = weigh(memory, jnp.asarray(images[7], dtype))
    likelihood = np.exp(all_odds(signed.unpack(pack(model)), images)[7])
    rtol = 1e-3 if dtype == np.float32 else 1e-9
    np.testing.assert_allclose(found.likelihood[0, :119], likelihood[:119], rtol=rtol)
    assert (np.asarray(found.likelihood[0, 120:]) == 0).all()


def test_real_objects_are_told_apart():
    """Of the shipped slice, two rows a run; the other rows are learned from."""
    folder = Path(__file__).parents[2] / "data" / "real_touch" / "purdue"
    views = np.stack([read_object(path)[0].reshape(-1, 128) for path in sorted(folder.glob("*.csv"))])
    thing = np.repeat(np.arange(len(views)), views.shape[1])
    images = stored_image(views.reshape(-1, 128), np.ones(128, bool))
    held = np.arange(len(thing)) % 4 == 0
    known, places = images[~held], thing[~held]
    model = learn(known, pairs_of(known, places), apart_of(places))
    parts = project(model, known.T)
    odds = np.stack([log_odds(model, part[:, None], parts) for part in project(model, images[held].T).T])
    assert (places[odds.argmax(axis=1)] == thing[held]).mean() > 0.8
