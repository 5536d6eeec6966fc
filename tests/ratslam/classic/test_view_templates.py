"""Laws of view matching."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.classic import view_templates
from ratslam.classic.view_templates import TemplateConfig
from tests.oracle.plain import PlainTemplates, Settings
from tests.oracle.trace import Parameters

SHAPE = (3, 8, 1)
FLOAT = np.dtype(float)


def filled(config, views, capacity=16):
    store = view_templates.start(config, SHAPE, capacity, FLOAT)
    for k, view in enumerate(views):
        flat = jnp.asarray(view.reshape(-1))
        store, _ = view_templates.learn(
            store, flat, jnp.int32(100 + k), jnp.full(3, float(k)), jnp.bool_(True)
        )
    return store


@pytest.mark.parametrize(
    "settings",
    [{}, {"shift": 2, "column_angle": 0.1}, {"shift": 3, "shift_step": 2}, {"panoramic": True}],
    ids=["in-place", "shift", "coarse-shift", "panoramic"],
)
@pytest.mark.parametrize("seed", range(4))
def test_the_best_match_is_that_of_the_plain_engine(settings, seed):
    config = TemplateConfig.model_validate(settings | {"threshold": 1.0})
    stream = np.random.default_rng(seed)
    views = stream.random((7, *SHAPE))
    view = np.clip(np.roll(views[4], seed % 3, axis=1) + stream.normal(0, 0.01, SHAPE), 0, 1)
    found = view_templates.match_view(config, SHAPE, filled(config, views), jnp.asarray(view))
    p = Parameters(
        template_y_size=3,
        template_x_size=8,
        vt_shift_match=config.shift,
        vt_step_match=config.shift_step,
        vt_panoramic=int(config.panoramic),
        vt_match_threshold=1.0,
    )
    slow = PlainTemplates(p, Settings(config.recent, 0, config.column_angle))
    slow.views = list(views[..., 0])
    expected = slow.compare(view[..., 0])
    assert int(found.template) == expected.template
    assert float(found.error) == pytest.approx(expected.error, abs=1e-12)
    assert float(found.relative) == pytest.approx(expected.relative, abs=1e-12)


def test_ties_go_to_the_earliest():
    config = TemplateConfig(panoramic=True)
    flat = np.full(SHAPE, 0.5)
    found = view_templates.match_view(config, SHAPE, filled(config, [flat, flat, flat]), jnp.asarray(flat))
    assert int(found.template) == 0
    assert float(found.relative) == 0


def test_an_empty_store_and_a_far_view_match_nothing():
    config = TemplateConfig()
    view = jnp.full(SHAPE, 0.9)
    assert int(view_templates.match_view(config, SHAPE, filled(config, []), view).template) == -1
    found = view_templates.match_view(config, SHAPE, filled(config, [np.zeros(SHAPE)]), view)
    assert int(found.template) == -1
    assert float(found.error) == pytest.approx(0.9)


def test_labels_of_any_number_find_their_template():
    config = TemplateConfig(source="labels")
    store = filled(config, [np.zeros(0)] * 3)
    assert int(view_templates.match_label(store, jnp.int32(102)).template) == 2
    assert int(view_templates.match_label(store, jnp.int32(7)).template) == -1


def test_energy_falls_during_a_view_and_recovers_later():
    config = TemplateConfig(recent=0)
    store = filled(config, [np.zeros(SHAPE), np.ones(SHAPE)])
    first, second = (view_templates.Match(jnp.int32(k), jnp.asarray(0.0), jnp.asarray(0.0)) for k in (0, 1))
    energies = []
    for _ in range(30):
        store, energy = view_templates.recall(config, store, first, jnp.bool_(True))
        energies.append(float(energy) / config.energy)
    assert energies[0] == pytest.approx((30 - np.exp(1.2)) / 30)
    assert energies[1] == pytest.approx((30 - np.exp(1.2 * 2.0)) / 30)
    assert energies[-1] == 0
    for _ in range(60):
        store, _ = view_templates.recall(config, store, second, jnp.bool_(True))
    _, energy = view_templates.recall(config, store, first, jnp.bool_(True))
    assert float(energy) / config.energy == pytest.approx(energies[0])


def test_recent_templates_recall_nothing():
    config = TemplateConfig(recent=2)
    store = filled(config, [np.zeros(SHAPE)] * 3)
    match = [view_templates.Match(jnp.int32(k), jnp.asarray(0.0), jnp.asarray(0.0)) for k in range(3)]
    energies = [float(view_templates.recall(config, store, m, jnp.bool_(True))[1]) for m in match]
    assert energies[0] > 0
    assert energies[1:] == [0, 0]


def test_a_full_store_keeps_its_templates():
    config = TemplateConfig()
    views = np.random.default_rng(0).random((4, *SHAPE))
    store = filled(config, views, capacity=4)
    after, room = view_templates.learn(store, jnp.zeros(24), jnp.int32(9), jnp.zeros(3), jnp.bool_(True))
    assert not room
    assert np.array_equal(after.view, store.view)
    assert int(after.count) == 4


def test_flat_and_empty_views_survive_normalisation():
    patchy = TemplateConfig(patch=1)
    assert np.allclose(view_templates.normalise(patchy, jnp.full(SHAPE, 0.3)), 0.5)
    scaled = TemplateConfig(normalise_mean=0.4)
    assert not np.any(view_templates.normalise(scaled, jnp.zeros(SHAPE)))
    view = jnp.asarray(np.random.default_rng(0).random(SHAPE) * 0.3)
    assert float(jnp.mean(view_templates.normalise(scaled, view))) == pytest.approx(0.4, abs=0.05)
